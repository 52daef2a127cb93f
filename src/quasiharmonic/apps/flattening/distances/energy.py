"""An energy of the distances between vertices some rings apart, as a function of the map.

The mean over pairs of how far their distance in the plane is off, relative to that along the surface, and a small share
of a barrier that keeps every triangle positive and what lies between the pairs smooth::

    E(w) = mean √(r² + δ²) − δ  +  λ B(w),    r = |wᵢ − wⱼ| / dᵢⱼ − 1

Errors well above δ count by their size and not by its square: without this the few pairs that no map can please, those
on both sides of a fold or around the end of a cut, spoil the others. Newton's model of a pair keeps the second
derivative along it, ``δ² (r² + δ²)^(−3/2) / d²``, which is positive, and of pairs that are too long that across it,
``r (r² + δ²)^(−1/2) / (d |w|)``, which is positive then.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import numpy as np
from scipy.sparse import csr_array

from quasiharmonic.energies.deformation import DeformationEnergy
from quasiharmonic.energies.distances import SurfaceDistances
from quasiharmonic.energies.energies import Deformation, QuadraticForm
from quasiharmonic.util.arrays import ComplexArray, FloatArray

# Errors below this count by their squares, larger ones by their size (δ). On a cortex 0.1 has 3 % less of a mean error
# and 11 % more of a root mean square.
_SOFT = 0.3
# The barrier's weight (λ). A third or three times of it leave the error the same to 0.002 of the distances.
_SHARE = 3e-3


class _Moment(NamedTuple):
    """A map as the energy reads it."""

    deformation: Deformation
    #: From targets to sources, (k,) complex128.
    apart: ComplexArray
    #: ``|apart| / length − 1``, (k,) float64.
    off: FloatArray


@dataclass(frozen=True, eq=False)
class PairForm:
    """A quadratic form in what happens to the pairs, ``Σ ½ (c |dv|² + Re c̄₂ dv²)`` with ``dv = dwᵢ − dwⱼ``.

    Attributes
    ----------
    c : (k,) float64
    c2 : (k,) complex128
    energy : DistanceEnergy
        Whose pairs they are.
    """

    c: FloatArray
    c2: ComplexArray
    energy: DistanceEnergy

    @cached_property
    def diagonal(self) -> tuple[FloatArray, FloatArray, FloatArray]:
        """The blocks xx, xy and yy of the matrix at every vertex; (n,) float64 each."""
        c, real, imag = self.energy.shared(np.stack([self.c, self.c2.real, self.c2.imag], axis=1)).T
        return c + real, imag, c - real

    def apply(self, dw: ComplexArray) -> ComplexArray:
        """The form's matrix times a displacement (n,) complex128."""
        dv = self.energy.between(dw)
        return self.energy.gathered(self.c * dv + self.c2 * dv.conj())

    def apply_off_diagonal(self, dw: ComplexArray) -> ComplexArray:
        """The same without the blocks on the diagonal."""
        xx, xy, yy = self.diagonal
        return self.apply(dw) - (xx * dw.real + xy * dw.imag + 1j * (xy * dw.real + yy * dw.imag))


class DistanceEnergy:
    """The energy of a surface, as `NewtonDescent` asks for it.

    Second derivatives come in two parts, `curvature_of` on the triangles and `pairs_at` on the pairs.

    Parameters
    ----------
    distances : SurfaceDistances
    barrier : DeformationEnergy
        Of the same surface in the same unit, infinite where a triangle collapses.
    n : int
        Number of vertices.

    Attributes
    ----------
    F, g
        As `DeformationEnergy` has them.
    """

    def __init__(self, distances: SurfaceDistances, barrier: DeformationEnergy, n: int) -> None:
        self.barrier = barrier
        self.F, self.g = barrier.F, barrier.g
        self._source, self._target, self._length = distances.source, distances.target, distances.length
        k = distances.length.size
        ends, ones = np.concatenate([self._source, self._target]), np.ones(k)
        at = ends, np.tile(np.arange(k), 2)
        self._pull = csr_array((np.concatenate([ones, -ones]), at), shape=(n, k))
        self._share = abs(self._pull)

    def between(self, w: ComplexArray) -> ComplexArray:
        """From each target to its source, (k,), given the vertices (n,)."""
        apart: ComplexArray = w.take(self._source) - w.take(self._target)
        return apart

    def gathered(self, pull: ComplexArray) -> ComplexArray:
        """Sum up at every vertex (n,) what pulls the sources, and against it the targets, of the pairs (k,)."""
        sums: FloatArray = self._pull @ pull.view(np.float64).reshape(-1, 2)
        return sums.view(np.complex128).ravel()

    def shared(self, values: FloatArray) -> FloatArray:
        """Sum up at every vertex, (n, c), what its pairs have, (k, c)."""
        sums: FloatArray = self._share @ values
        return sums

    def deform(self, w: ComplexArray) -> _Moment:
        """What the other methods read of a map."""
        apart = self.between(w)
        return _Moment(self.barrier.deform(w), apart, np.abs(apart) / self._length - 1)

    def value_of(self, moment: _Moment) -> float:
        """The softened mean error, and the barrier's share."""
        error = float(np.mean(np.hypot(moment.off, _SOFT))) - _SOFT
        return error + _SHARE * self.barrier.value_of(moment.deformation)

    def gradient_of(self, moment: _Moment, n: int) -> ComplexArray:
        """The derivative by ``n`` positions; (n,) complex128."""
        slope = moment.off / np.hypot(moment.off, _SOFT) / (self._length * moment.off.size)
        pull = slope * moment.apart / np.abs(moment.apart)
        return self.gathered(pull) + _SHARE * self.barrier.gradient_of(moment.deformation, n)

    def curvature_of(self, moment: _Moment, *, negative: float = 0.0) -> QuadraticForm:
        """Second derivatives of the barrier's share on the triangles."""
        form = self.barrier.curvature_of(moment.deformation, negative=negative)
        return form.scaled(np.full(len(self.F), _SHARE))

    def pairs_at(self, w: ComplexArray) -> PairForm:
        """Second derivatives of the error at a map, but for what is negative in them."""
        apart = self.between(w)
        distance = np.abs(apart)
        off = distance / self._length - 1
        soft = np.hypot(off, _SOFT)
        along = _SOFT**2 / soft**3 / (self._length**2 * soft.size)
        across = np.maximum(off / soft, 0) / (self._length * distance * soft.size)
        direction = apart / distance
        return PairForm(0.5 * (along + across), 0.5 * (along - across) * direction**2, self)

    def steps_to_collapse(self, w: ComplexArray, direction: ComplexArray) -> FloatArray:
        """How far along a direction each triangle's area first vanishes."""
        return self.barrier.steps_to_collapse(w, direction)
