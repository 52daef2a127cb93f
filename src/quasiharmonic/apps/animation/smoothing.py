"""Frames of low distortion whose vertices move continuously.

The least distorted map for a boundary is one of many local minima. If every frame is polished separately, successive
frames may end in different minima, and vertices jump by up to thirty times the motion of the boundary. The frames are
therefore polished in order, each with a proximal term to the previous frame
(`quasiharmonic.energies.newton.proximal`). This follows a branch of minima and leaves it slowly at its end. If a move
is still too long, sweeps spread it over neighbouring frames. They polish the frames at both ends again with proximal
terms to the previous and the next frame. The weight grows until no move is too long.

    forward   t = 0, 1, 2, …       E(wₜ) + near(wₜ₋₁), soft
    sweeps    ↓↑ at long moves     E(wₜ) + near(wₜ₋₁) + near(wₜ₊₁), hard
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np

from quasiharmonic.apps.animation.frames import farthest
from quasiharmonic.energies.energies import Energy
from quasiharmonic.energies.newton.newton_system import NewtonSystem
from quasiharmonic.energies.newton.proximal import NearDescent, Nearness, Neighbour
from quasiharmonic.energies.polishing import at_own_scale
from quasiharmonic.problem import Domain
from quasiharmonic.util.arrays import FloatArray

# Weight of the proximal term in the forward pass, as a fraction of the mean energy, which is at least ``_LEAST``. Moves
# of up to the last factor times the boundary's motion cost nothing.
_SOFT, _LEAST, _FREELY = 0.5, 1.0, 1.5
# Factor of the weight in the first sweep, and for each further sweep. Moves within the last fraction of the limit then
# cost nothing.
_HARD, _HARDER, _WITHIN = 300.0, 1.5, 0.9
_SWEEPS = 40
# Newton steps per frame in the forward pass, and in a sweep.
_STEPS, _AGAIN = 60, 20
_TOLERANCE = 1e-4


class Smoothing:
    """Polishing of frames with a limit on the motion of vertices.

    Parameters
    ----------
    domain : Domain
    energy : Energy
    max_motion_ratio : float
        Maximum vertex displacement between frames, relative to the maximum boundary displacement.
    linear_solver : str

    Attributes
    ----------
    domain : Domain
    maps : list of (n, 2) float64
        The frames so far, each injective.
    energies : list of float
        Their mean energies.
    """

    def __init__(self, domain: Domain, energy: Energy, max_motion_ratio: float, linear_solver: str) -> None:
        self.domain = domain
        self._energy, self._limit, self._linear_solver = energy, max_motion_ratio, linear_solver
        self._system: NewtonSystem | None = None
        # Per pair of successive frames: the boundary displacement, and the vertex displacement relative to it.
        self._lengths: list[float] = []
        self._moves: list[float] = []
        self.maps: list[FloatArray] = []
        self.energies: list[float] = []

    def append(self, uv: FloatArray) -> None:
        """Polish a further frame, given as an injective map, close to the last one.

        Its target positions must differ from those of the last frame.
        """
        before = []
        if self.maps:
            fixed = self.domain.fixed
            self._lengths.append(farthest(uv[fixed] - self.maps[-1][fixed]))
            before = [Neighbour(self.maps[-1], self._lengths[-1])]
        weight = _SOFT * max(_LEAST, self.energies[-1] if self.energies else 0.0)
        lowered, energy = self._lowered(uv, before, Nearness(weight, _FREELY), _STEPS)
        self.maps.append(lowered)
        self.energies.append(energy)
        if before:
            self._moves.append(0.0)
            self._measure(len(self._moves) - 1)

    def largest_move(self) -> float:
        """Return the maximum vertex displacement between frames, relative to that of the boundary."""
        return max(self._moves, default=0.0)

    def _measure(self, t: int) -> None:
        """Store the maximum vertex displacement between frames t and t + 1, relative to that of the boundary."""
        self._moves[t] = farthest(self.maps[t + 1] - self.maps[t]) / self._lengths[t]

    def sweep(self, told: Callable[[int, int], object]) -> None:
        """Spread moves that are too long over the neighbouring frames.

        Parameters
        ----------
        told : callable
            Called with the number of the sweep, from 1, and the frame.
        """
        weight = _SOFT * _HARD * max(_LEAST, sum(self.energies) / max(len(self.energies), 1))
        for sweep in range(1, _SWEEPS + 1):
            if self.largest_move() <= self._limit:
                return
            # Alternate the direction, so that the next frame takes up the change of the previous one.
            order = range(len(self.maps))
            for t in order if sweep % 2 else reversed(order):
                beside = range(max(t - 1, 0), min(t + 1, len(self._moves)))
                if any(self._moves[one] > self._limit for one in beside):
                    told(sweep, t)
                    nearness = Nearness(weight, _WITHIN * self._limit)
                    self.maps[t], self.energies[t] = self._lowered(self.maps[t], self._around(t), nearness, _AGAIN)
                    for one in beside:
                        self._measure(one)
            weight *= _HARDER

    def _around(self, t: int) -> list[Neighbour]:
        before = [Neighbour(self.maps[t - 1], self._lengths[t - 1])] if t > 0 else []
        after = [Neighbour(self.maps[t + 1], self._lengths[t])] if t < len(self._lengths) else []
        return before + after

    def _lowered(
        self, uv: FloatArray, around: Sequence[Neighbour], nearness: Nearness, steps: int
    ) -> tuple[FloatArray, float]:
        """Return a frame after Newton steps, and its mean energy."""
        domain = self.domain
        # As in a polish: overflow gives inf or NaN, and a step with either is never accepted.
        with np.errstate(all="ignore"):
            energy, exponent = at_own_scale(domain, uv, self._energy)
            if self._system is None:
                self._system = NewtonSystem(energy.F, energy.g, domain.n, domain.fixed, self._linear_solver)
            descent = NearDescent(energy, uv, domain.fixed, exponent, self._system, around, nearness)
            for _ in descent.descend(steps, _TOLERANCE):
                pass
            return descent.positions(descent.w), descent.lowered
