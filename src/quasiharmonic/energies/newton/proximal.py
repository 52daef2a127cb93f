"""Newton steps on a deformation energy with a proximal term, which keeps a map near its neighbours in a sequence.

A penalty is added to the mean energy E for vertices further than ``s`` lengths r from their positions in another map a.
It is the mean over all n vertices::

    E(w) + (k/n) Σₐ Σᵥ max(0, |wᵥ − aᵥ| / rₐ − s)²

Vertices within this distance are not penalised, so the result is the minimum of the energy if that is near enough. The
term is convex and separate for each vertex. Its second derivative is ``2k/(n r²)`` along the vertex's displacement, and
``1 − s r/|w − a|`` of that across. It is a 2×2 block in the existing matrix pattern.
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
    """A neighbouring map in the sequence.

    Attributes
    ----------
    uv : (n, 2) float64
    length : float
        Length unit r for displacements between the two maps; positive.
    """

    uv: FloatArray
    length: float


@dataclass(frozen=True)
class Nearness:
    """The proximal penalty.

    Attributes
    ----------
    weight : float
        k, relative to a mean energy.
    within : float
        s: displacement without penalty, in lengths.
    """

    weight: float
    within: float

    def value(self, away: ComplexArray) -> float:
        """Value of the penalty for displacements (n,) in lengths."""
        return self.weight * float(np.mean(self._excess(np.abs(away)) ** 2))

    def gradient(self, away: ComplexArray) -> ComplexArray:
        """Derivative with respect to the displacements, ``∂/∂u + i ∂/∂v``; (n,) complex128."""
        far = np.abs(away)
        return 2 * self.weight / away.size * self._excess(far) * _direction(away, far)

    def blocks(self, away: ComplexArray) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Second derivatives by the displacements: xx, xy and yy of each vertex's block; (n,) float64 each."""
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
    """`NewtonDescent` with a proximal penalty towards other maps.

    Parameters
    ----------
    energy, uv, fixed, exponent
        As in `NewtonDescent`.
    system : NewtonSystem
        For this mesh and these free vertices. Maps of a sequence share it, one after another; it is modified.
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
        """Gradient of the energy plus the penalty."""
        gradient = super().gradient()
        for other, length in self._others:
            gradient += self.nearness.gradient((self.w - other) / length)[self.system.free] / length
        return gradient

    def assemble(self, negative: float) -> None:
        """Assemble the energy's matrix and add the penalty's block at each vertex."""
        super().assemble(negative)
        for other, length in self._others:
            blocks = self.nearness.blocks((self.w - other) / length)
            xx, xy, yy = (block[self.system.free] / length**2 for block in blocks)
            self.system.add_blocks(xx, xy, yy)

    def evaluate_trial(self, w: ComplexArray, bound: float) -> tuple[float, tuple[ComplexArray, Any] | None]:
        """Like `NewtonDescent.evaluate_trial`, for the energy plus the penalty."""
        deformation = self.energy.deform(w)
        mean = self.energy.value_of(deformation)
        value = mean + self._apart(w)
        accepted = value < bound and is_injective(self.energy.F, self.positions(w))
        return value, (w, deformation) if accepted else None

    @property
    def lowered(self) -> float:
        """Mean energy of the current map, without the penalty."""
        return self.energy.value_of(self._deformation)


def _direction(away: ComplexArray, far: FloatArray) -> ComplexArray:
    return np.where(far > 0, away / np.where(far > 0, far, 1), 0)
