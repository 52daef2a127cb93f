"""Forces at the vertices of a map, and their derivatives by the map and by its rest triangles.

The forces are the derivative of ``E = Σⱼ sⱼ φ(pⱼ, qⱼ)`` by the positions w, with ``p = Σ conj(gᵢ) wᵢ`` and
``q = Σ gᵢ wᵢ``. At the maps that are differentiated, the forces vanish at free vertices. This module computes their
derivatives by w, sⱼ and gⱼ. A transpose takes a displacement ℓ of the vertices to the gradient of the work
``⟨ℓ, force⟩``.

Displacements of the surface's vertices change the rest triangles. Lay a triangle into the plane, with vertex 0 at the
origin and vertex 1 on the positive x axis. It changes by the linear field ``dz = a z + b z̄``: a is its growth and b
its shear. Vertex 1 stays on the axis, so ``Im (a + b) = 0``. If the corners of its image do not move, the derivatives p
and q of the map change by

    dp = −(p a + q b̄),    dq = −(p b + q ā),    and the triangle's area m by  dm = 2 m Re a.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import numpy as np

from quasiharmonic.energies.energies import QuadraticForm
from quasiharmonic.geometry.mesh.reference import rest_frames
from quasiharmonic.solver.field.tensor import TensorField
from quasiharmonic.util.arrays import ComplexArray, FloatArray, IntArray, reject, sum_at

# The same minimum angle as in `mesh.reference` (§F.1).
_MIN_ANGLE = np.pi / 6


class TriangleResponse(NamedTuple):
    """The change (f,) of p and q and of φ's derivatives by p and q, for a displacement of the vertices."""

    dp: ComplexArray
    dq: ComplexArray
    hp: ComplexArray
    hq: ComplexArray


@dataclass(frozen=True, eq=False)
class Forces:
    """Forces at a map and their derivatives."""

    corners: IntArray  # (3, f): vertices of the triangles, one column per triangle
    n: int  # Number of vertices
    g: ComplexArray  # (3, f): half the gradients of the hat functions, in the map's scale
    share: FloatArray  # (f,): sⱼ
    # ``p``, ``q``: (f,): derivatives of the map
    p: ComplexArray
    q: ComplexArray
    # ``by_p``, ``by_q``: (f,): derivatives of φ, ``∂/∂Re + i ∂/∂Im``
    by_p: ComplexArray
    by_q: ComplexArray
    form: QuadraticForm  # Exact second derivatives of φ

    def derivatives(self, dw: ComplexArray) -> tuple[ComplexArray, ComplexArray]:
        """The change (f,) of p and of q for displacements (n,) of the vertices."""
        moved = dw[self.corners]
        return np.sum(self.g.conj() * moved, axis=0), np.sum(self.g * moved, axis=0)

    def by_places(self, dw: ComplexArray) -> ComplexArray:
        """The change of the forces (n,) for displacements (n,) of the vertices; a symmetric operator."""
        return self.gather(*self.form.apply(*self.derivatives(dw)))

    def by_strain(self, a: ComplexArray, b: ComplexArray) -> ComplexArray:
        """The change of the forces (n,) for growth and shear (f,) of the rest triangles; sⱼ changes with the area."""
        more = 2 * a.real
        by_p, by_q = self.form.apply(-(self.p * a + self.q * b.conj()), -(self.p * b + self.q * a.conj()))
        by_p += more * self.by_p
        by_q += more * self.by_q
        # The gradients of the hat functions change as p and q do.
        by_p -= self.by_p * a.conj() + self.by_q * b.conj()
        by_q -= self.by_p * b + self.by_q * a
        return self.gather(by_p, by_q)

    def respond(self, dw: ComplexArray) -> TriangleResponse:
        """The response of the triangles to a displacement (n,)."""
        changes = self.derivatives(dw)
        return TriangleResponse(*changes, *self.form.apply(*changes))

    def pull_strain(self, response: TriangleResponse) -> tuple[ComplexArray, ComplexArray]:
        """The transpose of `by_strain`: gradients (f,) by a and b of the work along a displacement."""
        dp, dq, hp, hq = response
        along: FloatArray = (self.by_p.conj() * dp + self.by_q.conj() * dq).real
        by_a = 2 * along - (hp * self.p.conj() + hq.conj() * self.q + self.by_p * dp.conj() + self.by_q.conj() * dq)
        by_b = -(hp.conj() * self.q + hq * self.p.conj() + self.by_p.conj() * dq + self.by_q * dp.conj())
        return self.share * by_a, self.share * by_b

    @cached_property
    def by_scale(self) -> ComplexArray:
        """The change of the forces (n,) with the logarithm of a common factor of all g."""
        hp, hq = self.form.apply(self.p, self.q)
        return self.gather(hp + self.by_p, hq + self.by_q)

    def gather(self, by_p: ComplexArray, by_q: ComplexArray) -> ComplexArray:
        """Sum forces of triangles (f,) on p and q at the vertices."""
        pull: ComplexArray = (self.share * by_p) * self.g + (self.share * by_q) * self.g.conj()
        return sum_at(self.corners.ravel(), pull.ravel(), self.n)


@dataclass(frozen=True, eq=False)
class TensorForces:
    """The tensors of a map with the energy density ``φ = c (|p|² + |q|²) − 2 Re (ω p q̄)`` on each triangle."""

    field: TensorField

    def by_mu(self, forces: Forces, dmu: ComplexArray) -> ComplexArray:
        """The change of the forces (n,) for a change of the Beltrami coefficients (f,)."""
        double = 2.0 / self.field.defect
        dc = double**2 * (self.field.mu.conj() * dmu).real
        dtwist: ComplexArray = double * dmu + dc * self.field.mu
        p, q = forces.p, forces.q
        return forces.gather(2 * (dc * p - dtwist.conj() * q), 2 * (dc * q - dtwist * p))

    def of(self, forces: Forces, response: TriangleResponse) -> ComplexArray:
        """The transpose of `by_mu`: the gradient (f,) by the coefficients of the work along a displacement."""
        dp, dq = response.dp, response.dq
        by_c = 2 * forces.share * (forces.p.conj() * dp + forces.q.conj() * dq).real
        by_twist: ComplexArray = -2 * forces.share * (forces.q * dp.conj() + forces.p.conj() * dq)
        return self.field.pull_twist(by_c, by_twist)


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
    counterclockwise, and so are those of a planar surface in `mesh.reference`. ``m`` (f,) are areas, ``half`` (3,
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
        lost = ~(np.isfinite(self.m) & np.isfinite(self.half).all(axis=0))
        remedy = "scale the surface to about unit size"
        reject(lost, "triangle", "triangles", f"the areas of {{}} at rest are outside the range of doubles: {remedy}")
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
