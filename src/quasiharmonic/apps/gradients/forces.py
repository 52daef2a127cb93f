"""Forces at the vertices of a map, and their derivatives by the map and by its rest triangles.

The forces are the derivative of ``E = Σⱼ sⱼ φ(pⱼ, qⱼ)`` by the positions w, with ``p = Σ conj(gᵢ) wᵢ`` and
``q = Σ gᵢ wᵢ``. At the maps that are differentiated, the forces vanish at free vertices. This module computes their
derivatives by w, sⱼ and gⱼ. A transpose takes a displacement ℓ of the vertices to the gradient of the work
``⟨ℓ, force⟩``.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import numpy as np

from quasiharmonic.energies.energies import QuadraticForm
from quasiharmonic.solver.field.tensor import TensorField
from quasiharmonic.util.arrays import ComplexArray, FloatArray, IntArray


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
        at = self.corners.ravel()
        real, imaginary = (np.bincount(at, part.ravel(), minlength=self.n) for part in (pull.real, pull.imag))
        return real + 1j * imaginary


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
