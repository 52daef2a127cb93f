"""Newton steps on a deformation energy with a proximal term, which keeps a map near its neighbours in a sequence.

A penalty is added to the mean energy E for vertices further than ``s`` lengths r from their positions in another map a.
It is the mean over all n vertices::

    E(w) + (k/n) Σₐ Σᵥ max(0, |wᵥ − aᵥ| / rₐ − s)²

Vertices within this distance are not penalised, so the result is the minimum of the energy if that is near enough. The
term is convex and separate for each vertex. Its second derivative is ``2k/(n r²)`` along the vertex's displacement, and
``1 − s r/|w − a|`` of that across. It is a 2×2 block in the existing matrix pattern.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from quasiharmonic.energies.newton.map_model import in_units
from quasiharmonic.energies.newton.newton_system import NewtonSystem
from quasiharmonic.util.arrays import ComplexArray, FloatArray


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
