"""Frames of low distortion that do not leap.

The least distorted map for a boundary is one of many local minima, and as the boundary moves, the one that a frame's
own polish ends in changes: vertices leap by thirty times what the boundary does. So frames are lowered one after
another, each near to the one before (`quasiharmonic.energies.newton.proximal`), which keeps to a branch of minima and
leaves it slowly where it ends. What has to go further than is allowed is spread over the frames around it then: sweeps
lower the frames at both ends of too long a move once more, near to the one before and to the one after, with a weight
that grows, until no move is too long.

    forward   t = 0, 1, 2, …     E(wₜ) + near(wₜ₋₁), soft
    sweeps    ↓↑ where it leaps  E(wₜ) + near(wₜ₋₁) + near(wₜ₊₁), hard
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

# What nearness weighs on the way forward, as a share of the mean energy, which is taken to be _LEAST at the least; and
# how many lengths of the boundary vertices go for nothing.
_SOFT, _LEAST, _FREELY = 0.5, 1.0, 1.5
# So much harder it is in the first sweep, and again in each further one; vertices then go this share of the limit for
# nothing.
_HARD, _HARDER, _WITHIN = 300.0, 1.5, 0.9
_SWEEPS = 40
# Newton steps for a frame on the way forward, and in a sweep.
_STEPS, _AGAIN = 60, 20
_TOLERANCE = 1e-4


class Smoothing:
    """Frames whose distortion is lowered without leaps.

    Parameters
    ----------
    domain : Domain
    energy : Energy
    max_motion_ratio : float
        As many times as far as the boundary a vertex may move at most.
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
        # From a frame to the next: what the boundary moves, and what any vertex does over that.
        self._lengths: list[float] = []
        self._moves: list[float] = []
        self.maps: list[FloatArray] = []
        self.energies: list[float] = []

    def append(self, uv: FloatArray) -> None:
        """Lower a further frame, an injective map, near to the last.

        Its fixed vertices are elsewhere than the last one's.
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
        """How far a vertex moves at most from a frame to the next, over what the boundary does."""
        return max(self._moves, default=0.0)

    def _measure(self, t: int) -> None:
        """Take down how far vertices move from a frame to the next."""
        self._moves[t] = farthest(self.maps[t + 1] - self.maps[t]) / self._lengths[t]

    def sweep(self, told: Callable[[int, int], object]) -> None:
        """Spread the moves that are too long over the frames around them.

        Parameters
        ----------
        told : callable
            Is called with each sweep's number, from 1 on, and frame.
        """
        weight = _SOFT * _HARD * max(_LEAST, sum(self.energies) / max(len(self.energies), 1))
        for sweep in range(1, _SWEEPS + 1):
            if self.largest_move() <= self._limit:
                return
            # What a frame gives way is the next one's to take up.
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
        """A frame after Newton's steps, and its mean energy."""
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
