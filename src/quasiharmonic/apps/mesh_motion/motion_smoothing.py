"""Frames of low distortion whose vertices move continuously.

The least distorted map for a boundary is one of many local minima. If every frame is polished separately, successive
frames may end in different minima, and vertices jump by up to thirty times the motion of the boundary. The frames are
therefore polished in order, each with a proximal term to the previous frame. This follows a branch of minima and leaves
it slowly at its end. If a move is still too long, sweeps spread it over neighbouring frames. They polish the frames at
both ends again with proximal terms to the previous and the next frame. The weight grows until no move is too long.

    forward   t = 0, 1, 2, …       E(wₜ) + near(wₜ₋₁), soft
    sweeps    ↓↑ at long moves     E(wₜ) + near(wₜ₋₁) + near(wₜ₊₁), hard

The proximal term keeps a map near its neighbours in the sequence. A penalty is added to the mean energy E for vertices
further than ``s`` lengths r from their positions in another map a. It is the mean over all n vertices::

    E(w) + (k/n) Σₐ Σᵥ max(0, |wᵥ − aᵥ| / rₐ − s)²

Vertices within this distance are not penalised, so the result is the minimum of the energy if that is near enough. The
term is convex and separate for each vertex. Its second derivative is ``2k/(n r²)`` along the vertex's displacement, and
``1 − s r/|w − a|`` of that across. It is a 2×2 block in the existing matrix pattern.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from quasiharmonic.apps.mesh_motion.animation import find_longest
from quasiharmonic.energies.energies import Energy
from quasiharmonic.energies.newton.map_model import Coordinates, MapModel, in_units
from quasiharmonic.energies.newton.newton_descent import NewtonDescent
from quasiharmonic.energies.newton.newton_system import NewtonSystem
from quasiharmonic.energies.polishing import scale_energy
from quasiharmonic.problem import Domain
from quasiharmonic.util.arrays import ComplexArray, FloatArray


class SmoothingTuning(NamedTuple):
    """Numbers that tune the forward pass and the sweeps."""

    # Weight of the proximal term in the forward pass, as a fraction of the mean energy.
    proximal_weight: float = 0.5
    # Lower bound of that mean energy.
    min_energy: float = 1.0
    # The forward pass does not penalise displacements up to this multiple of the boundary's displacement.
    free_motion: float = 1.5
    # Factor of the weight in the first sweep.
    sweep_weight: float = 300.0
    # Factor of the weight from one sweep to the next.
    sweep_growth: float = 1.5
    # Moves within this fraction of the limit cost nothing in a sweep.
    free_share: float = 0.9
    # Maximum number of sweeps, and relative decrease below which they end.
    sweeps: int = 40
    tolerance: float = 1e-4


_TUNING = SmoothingTuning()


@dataclass(frozen=True, eq=False)
class Neighbour:
    """A neighbouring map (n, 2) in the sequence, and the length unit r for displacements between the two maps."""

    uv: FloatArray
    length: float


@dataclass(frozen=True)
class ProximalPenalty:
    """The proximal penalty: its weight k relative to a mean energy, and the displacement s without penalty."""

    weight: float
    within: float

    def value(self, away: ComplexArray) -> float:
        """Value of the penalty for displacements (n,) in lengths."""
        return self.weight * float(np.mean(self._excess(np.abs(away)) ** 2))

    def gradient(self, away: ComplexArray) -> ComplexArray:
        """Derivative with respect to the displacements, ``∂/∂u + i ∂/∂v``; (n,) complex128."""
        distance = np.abs(away)
        return 2 * self.weight / away.size * self._excess(distance) * _direction(away, distance)

    def blocks(self, away: ComplexArray) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Second derivatives by the displacements: xx, xy and yy of each vertex's block; (n,) float64 each."""
        distance = np.abs(away)
        along = 2 * self.weight / away.size * (distance > self.within)
        across = along * self._excess(distance) / np.where(distance > 0, distance, 1)
        unit = _direction(away, distance)
        xx = along * unit.real**2 + across * unit.imag**2
        yy = along * unit.imag**2 + across * unit.real**2
        return xx, (along - across) * unit.real * unit.imag, yy

    def _excess(self, distance: FloatArray) -> FloatArray:
        return np.maximum(0.0, distance - self.within)


class ProximalTerm:
    """The proximal penalty towards one neighbouring map, as a `Term` for maps in units of ``2 ** exponent``."""

    def __init__(self, neighbour: Neighbour, penalty: ProximalPenalty, exponent: int) -> None:
        self._penalty = penalty
        self._neighbour = in_units(neighbour.uv, exponent)
        self._length = float(np.ldexp(neighbour.length, -exponent))

    def value(self, w: ComplexArray) -> float:
        """See `Term`."""
        return self._penalty.value((w - self._neighbour) / self._length)

    def gradient(self, w: ComplexArray) -> ComplexArray:
        """See `Term`."""
        return self._penalty.gradient((w - self._neighbour) / self._length) / self._length

    def add_to(self, system: NewtonSystem, w: ComplexArray) -> None:
        """See `Term`."""
        blocks = self._penalty.blocks((w - self._neighbour) / self._length)
        system.add_blocks(*(block[system.free] / self._length**2 for block in blocks))


def _direction(away: ComplexArray, distance: FloatArray) -> ComplexArray:
    return np.where(distance > 0, away / np.where(distance > 0, distance, 1), 0)


class MotionSmoothing:
    """Polishing of frames with a limit on the motion of vertices.

    ``maps`` are the frames so far, (n, 2) and injective, and ``energies`` their mean energies. ``max_motion_ratio`` is
    the maximum vertex displacement between frames, relative to the maximum boundary displacement.
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
            self._lengths.append(find_longest(uv[fixed] - self.maps[-1][fixed]))
            before = [Neighbour(self.maps[-1], self._lengths[-1])]
        weight = _TUNING.proximal_weight * max(_TUNING.min_energy, self.energies[-1] if self.energies else 0.0)
        lowered, energy = self._lower(uv, before, ProximalPenalty(weight, _TUNING.free_motion), steps=60)
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
        self._moves[t] = find_longest(self.maps[t + 1] - self.maps[t]) / self._lengths[t]

    def sweep(self, report: Callable[[int, int], object]) -> None:
        """Spread moves that are too long over the neighbouring frames.

        ``report`` is called with the number of the sweep, from 1, and the frame.
        """
        weight = (
            _TUNING.proximal_weight
            * _TUNING.sweep_weight
            * max(_TUNING.min_energy, sum(self.energies) / max(len(self.energies), 1))
        )
        for sweep in range(1, _TUNING.sweeps + 1):
            if self.largest_move() <= self._limit:
                return
            # Alternate the direction, so that the next frame takes up the change of the previous one.
            order = range(len(self.maps))
            for t in order if sweep % 2 else reversed(order):
                beside = range(max(t - 1, 0), min(t + 1, len(self._moves)))
                if any(self._moves[one] > self._limit for one in beside):
                    report(sweep, t)
                    penalty = ProximalPenalty(weight, _TUNING.free_share * self._limit)
                    self.maps[t], self.energies[t] = self._lower(self.maps[t], self._neighbours(t), penalty, steps=20)
                    for one in beside:
                        self._measure(one)
            weight *= _TUNING.sweep_growth

    def _neighbours(self, t: int) -> list[Neighbour]:
        before = [Neighbour(self.maps[t - 1], self._lengths[t - 1])] if t > 0 else []
        after = [Neighbour(self.maps[t + 1], self._lengths[t])] if t < len(self._lengths) else []
        return before + after

    def _lower(
        self, uv: FloatArray, around: Sequence[Neighbour], penalty: ProximalPenalty, steps: int
    ) -> tuple[FloatArray, float]:
        """Return a frame after Newton steps, and its mean energy."""
        domain = self.domain
        # As in a polish: overflow gives inf or NaN, and a step with either is never accepted.
        with np.errstate(all="ignore"):
            energy, exponent = scale_energy(domain, uv, self._energy)
            if self._system is None:
                self._system = NewtonSystem(energy.F, energy.g, domain.n, domain.fixed, self._linear_solver)
            self._system.take_gradients(energy.g)
            terms = [ProximalTerm(neighbour, penalty, exponent) for neighbour in around]
            model = MapModel(energy, Coordinates.of(uv, domain.fixed, exponent), self._system, terms)
            descent = NewtonDescent(model, model.evaluate(in_units(uv, exponent)))
            for _ in descent.descend(steps, _TUNING.tolerance):
                pass
            return model.positions(descent.w), energy.value_of(descent.state.derivatives)
