"""Newton steps down a deformation energy that keep a map near others: those before and after it in a sequence.

To the mean energy E is added what vertices do that are further than ``s`` of their lengths r from where another map a
has them, the mean over all n vertices::

    E(w) + (k/n) Σₐ Σᵥ max(0, |wᵥ − aᵥ| / rₐ − s)²

Nothing is asked of a vertex that has not gone so far, so a map that need not hurry is the one of least energy. The
term is convex and separate for each vertex: its second derivative, ``2k/(n r²)`` along the way that the vertex has gone
and ``1 − s r/|w − a|`` of that across, is a 2×2 block of the matrix that is there.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from quasiharmonic.energies.deformation import DeformationEnergy
from quasiharmonic.energies.newton.newton_descent import NewtonDescent, in_units
from quasiharmonic.energies.newton.newton_system import NewtonSystem
from quasiharmonic.geometry.exact.certificate import is_injective
from quasiharmonic.util.arrays import ComplexArray, FloatArray, IntArray


@dataclass(frozen=True, eq=False)
class Neighbour:
    """A map to keep near to.

    Attributes
    ----------
    uv : (n, 2) float64
    length : float
        What counts as one length between the two maps; positive.
    """

    uv: FloatArray
    length: float


@dataclass(frozen=True)
class Nearness:
    """How much nearness counts.

    Attributes
    ----------
    weight : float
        k, beside a mean energy.
    within : float
        s: as many lengths as a vertex may go for nothing.
    """

    weight: float
    within: float

    def value(self, away: ComplexArray) -> float:
        """The term for displacements (n,) in lengths."""
        return self.weight * float(np.mean(self._excess(np.abs(away)) ** 2))

    def gradient(self, away: ComplexArray) -> ComplexArray:
        """Its derivative by the displacements, ``∂/∂u + i ∂/∂v``; (n,) complex128."""
        far = np.abs(away)
        return 2 * self.weight / away.size * self._excess(far) * _direction(away, far)

    def blocks(self, away: ComplexArray) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Its second derivatives by the displacements, xx, xy and yy of each vertex's block; (n,) float64 each."""
        far = np.abs(away)
        along = 2 * self.weight / away.size * (far > self.within)
        across = along * self._excess(far) / np.where(far > 0, far, 1)
        way = _direction(away, far)
        xx = along * way.real**2 + across * way.imag**2
        yy = along * way.imag**2 + across * way.real**2
        return xx, (along - across) * way.real * way.imag, yy

    def _excess(self, far: FloatArray) -> FloatArray:
        return np.maximum(0.0, far - self.within)


class NearDescent(NewtonDescent):
    """The descent of `NewtonDescent`, near to other maps.

    Parameters
    ----------
    energy, uv, fixed, exponent
        As of `NewtonDescent`.
    system : NewtonSystem
        Of that mesh and those vertices that move; maps of a sequence share it, one after another. Changed.
    neighbours : sequence of Neighbour
    nearness : Nearness
    """

    def __init__(
        self,
        energy: DeformationEnergy,
        uv: FloatArray,
        fixed: IntArray,
        exponent: int,
        system: NewtonSystem,
        neighbours: Sequence[Neighbour],
        nearness: Nearness,
    ) -> None:
        self._shared = system
        super().__init__(energy, uv, fixed, exponent, system.solver.name)
        self.nearness = nearness
        self._others = [
            (in_units(other.uv, exponent), float(np.ldexp(other.length, -exponent))) for other in neighbours
        ]
        self.value = self.first = self.value + self._apart(self.w)

    def _system(self, n: int, linear_solver: str) -> NewtonSystem:
        self._shared.take_gradients(self.energy.g)
        return self._shared

    def _apart(self, w: ComplexArray) -> float:
        return sum(self.nearness.value((w - other) / length) for other, length in self._others)

    def gradient(self) -> ComplexArray:
        """That of the energy, and of the distance to the others."""
        gradient = super().gradient()
        for other, length in self._others:
            gradient += self.nearness.gradient((self.w - other) / length)[self.system.free] / length
        return gradient

    def assemble(self, negative: float) -> None:
        """The energy's matrix, and each vertex's own block."""
        super().assemble(negative)
        for other, length in self._others:
            blocks = self.nearness.blocks((self.w - other) / length)
            xx, xy, yy = (block[self.system.free] / length**2 for block in blocks)
            self.system.add_blocks(xx, xy, yy)

    def evaluate_trial(self, w: ComplexArray, bound: float) -> tuple[float, tuple[ComplexArray, Any] | None]:
        """As `NewtonDescent.evaluate_trial`, of the energy with the distance to the others."""
        deformation = self.energy.deform(w)
        mean = self.energy.value_of(deformation)
        value = mean + self._apart(w)
        accepted = value < bound and is_injective(self.energy.F, self.positions(w))
        return value, (w, deformation) if accepted else None

    @property
    def lowered(self) -> float:
        """The mean energy of the map at hand, alone."""
        return self.energy.value_of(self._deformation)


def _direction(away: ComplexArray, far: FloatArray) -> ComplexArray:
    return np.where(far > 0, away / np.where(far > 0, far, 1), 0)
