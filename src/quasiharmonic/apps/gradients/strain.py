"""The change of rest triangles for displacements of the surface's vertices, and its transpose.

Lay a triangle into the plane, with vertex 0 at the origin and vertex 1 on the positive x axis. It changes by the
linear field ``dz = a z + b z̄``: a is its growth and b its shear. Vertex 1 stays on the axis, so ``Im (a + b) = 0``.
If the corners of its image do not move, the derivatives p and q of the map change by

    dp = −(p a + q b̄),    dq = −(p b + q ā),    and the triangle's area m by  dm = 2 m Re a.
"""

from __future__ import annotations

from abc import ABC, abstractmethod

import numpy as np

from quasiharmonic.geometry.mesh.reference import rest_frames
from quasiharmonic.util.arrays import ComplexArray, FloatArray, IntArray, names_of

# The same minimum angle as in `mesh.reference` (§F.1).
_MIN_ANGLE = np.pi / 6


class Strain(ABC):
    """The triangles in which gradients are computed, as functions of the rest positions."""

    @abstractmethod
    def of(self, dV: FloatArray) -> tuple[ComplexArray, ComplexArray]:
        """Return the growth and shear (f,) of each triangle for displacements (n, d) of the vertices."""

    @abstractmethod
    def pull(self, by_a: ComplexArray, by_b: ComplexArray) -> FloatArray:
        """Return the gradient by positions (n, d) from the gradients (f,), ``∂/∂Re + i ∂/∂Im``, by a and b."""


class RestStrain(Strain):
    """The strain of the rest triangles ``F`` of ``V``; ValueError names triangles without positive finite area.

    With ``signed``, planar triangles may be clockwise, as in a `ReferenceMesh`. Triangles in space are always
    counterclockwise, and so are those of a planar surface in `mesh.triangle_shapes`. ``m`` (f,) are areas, ``half`` (3,
    f) complex half the gradients of the hat functions.
    """

    def __init__(self, V: FloatArray, F: IntArray, *, signed: bool = True) -> None:
        self._corners, self._shape = np.ascontiguousarray(F.T), V.shape
        z1, z2 = rest_frames(V, F)
        if not signed:
            z2 = z2.real + 1j * np.abs(z2.imag)
        self.sides: ComplexArray = np.stack([z1 + 0j, z2 - z1, -z2])
        with np.errstate(all="ignore"):
            self.m: FloatArray = 0.5 * z1 * z2.imag
            self.half: ComplexArray = 0.25j * self.sides[(1, 2, 0), :] / self.m
        lost = np.flatnonzero(~(np.isfinite(self.m) & np.isfinite(self.half).all(axis=0)))
        if lost.size:
            raise ValueError(
                f"the areas of {names_of('triangle', 'triangles', lost)} at rest are outside the "
                f"range of doubles: scale the "
                "surface to about unit size"
            )
        # Unit vectors in the triangle's plane, (d, f): along the first side, and perpendicular to it.
        coordinates = np.ascontiguousarray(V.T)
        start, one, two = (coordinates[:, at] for at in self._corners)
        self._along = (one - start) / z1
        self._across = (two - start - z2.real * self._along) / z2.imag

    def of(self, dV: FloatArray) -> tuple[ComplexArray, ComplexArray]:
        a, b = np.zeros((2, self.m.size), dtype=np.complex128)
        coordinates = np.ascontiguousarray(dV.T)
        for at, g in zip(self._corners, self.half, strict=True):
            moved = coordinates[:, at]
            dz = np.sum(moved * self._along, axis=0) + 1j * np.sum(moved * self._across, axis=0)
            a += g.conj() * dz
            b += g * dz
        return a - 1j * (a + b).imag, b

    def pull(self, by_a: ComplexArray, by_b: ComplexArray) -> FloatArray:
        force: ComplexArray = by_a.real * self.half + (by_b - 1j * by_a.imag) * self.half.conj()
        at, n = self._corners.ravel(), self._shape[0]
        columns = zip(self._along, self._across, strict=True)
        by_axis = (force.real * along + force.imag * across for along, across in columns)
        return np.stack([np.bincount(at, column.ravel(), minlength=n) for column in by_axis], axis=1)


class CorrectedStrain(Strain):
    """The strain of triangles with corrected angles (§F.1), in whose frame only vertex 2 moves.

    Arguments are those of `RestStrain`, and half the gradients (3, f) of the hat functions in the corrected triangles.
    """

    def __init__(self, V: FloatArray, F: IntArray, half: ComplexArray) -> None:
        self._rest = RestStrain(V, F)
        sides, sign = self._rest.sides, np.sign(self._rest.m)
        angles = sign * np.angle(-sides[(2, 0, 1), :] / sides)
        raised = np.maximum(angles, _MIN_ANGLE)
        total = raised.sum(axis=0)
        self._share, self._per_angle = raised / total, np.pi / total
        # A shear b rotates the side e by Im (b ē/e), and an angle is the difference of two directions.
        turn = sides.conj() / sides
        self._by_shear: ComplexArray = np.where(angles > _MIN_ANGLE, sign, 0.0) * (turn[(2, 0, 1), :] - turn)
        # Vertex 2 is at sin θ₁ / sin θ₂ e^{iθ₀}.
        zero, one, two = np.pi * self._share
        self._cot_one, self._cot_two = 1 / np.tan(one), 1 / np.tan(two)
        self._z2: ComplexArray = np.sin(one) / np.sin(two) * np.exp(1j * zero)
        self._g2 = half[2]

    def of(self, dV: FloatArray) -> tuple[ComplexArray, ComplexArray]:
        _, b = self._rest.of(dV)
        change = (b * self._by_shear).imag
        zero, one, two = self._per_angle * (change - self._share * change.sum(axis=0))
        dz: ComplexArray = self._z2 * (self._cot_one * one - self._cot_two * two + 1j * zero)
        return self._g2.conj() * dz, self._g2 * dz

    def pull(self, by_a: ComplexArray, by_b: ComplexArray) -> FloatArray:
        by_log: ComplexArray = (by_a * self._g2 + by_b * self._g2.conj()) * self._z2.conj()
        by_angle = np.stack([by_log.imag, self._cot_one * by_log.real, -self._cot_two * by_log.real])
        by_change = self._per_angle * (by_angle - np.sum(self._share * by_angle, axis=0))
        by_shear: ComplexArray = 1j * np.sum(by_change * self._by_shear.conj(), axis=0)
        return self._rest.pull(np.zeros_like(by_shear), by_shear)
