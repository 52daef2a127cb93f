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
from quasiharmonic.util.arrays import ComplexArray, FloatArray, IntArray


class Felt(NamedTuple):
    """The response of triangles to a displacement of the vertices.

    Attributes
    ----------
    dp, dq : (f,) complex128
        The change of p and q.
    hp, hq : (f,) complex128
        The change of φ's derivatives by p and q.
    """

    dp: ComplexArray
    dq: ComplexArray
    hp: ComplexArray
    hq: ComplexArray


@dataclass(frozen=True, eq=False)
class Forces:
    """Forces at a map and their derivatives.

    Attributes
    ----------
    corners : (3, f) int64
        Vertices of the triangles, one column per triangle.
    n : int
        Number of vertices.
    g : (3, f) complex128
        Half the gradients of the hat functions, in the map's scale.
    share : (f,) float64
        sⱼ.
    p, q : (f,) complex128
        Derivatives of the map.
    by_p, by_q : (f,) complex128
        Derivatives of φ, ``∂/∂Re + i ∂/∂Im``.
    form : QuadraticForm
        Exact second derivatives of φ.
    """

    corners: IntArray
    n: int
    g: ComplexArray
    share: FloatArray
    p: ComplexArray
    q: ComplexArray
    by_p: ComplexArray
    by_q: ComplexArray
    form: QuadraticForm

    def derivatives(self, dw: ComplexArray) -> tuple[ComplexArray, ComplexArray]:
        """The change (f,) of p and of q for displacements (n,) of the vertices."""
        moved = dw[self.corners]
        return np.sum(self.g.conj() * moved, axis=0), np.sum(self.g * moved, axis=0)

    def by_places(self, dw: ComplexArray) -> ComplexArray:
        """The change of the forces (n,) for displacements (n,) of the vertices; a symmetric operator."""
        return self.gathered(*self.form.apply(*self.derivatives(dw)))

    def by_strain(self, a: ComplexArray, b: ComplexArray) -> ComplexArray:
        """The change of the forces (n,) for growth and shear (f,) of the rest triangles; sⱼ changes with the area."""
        more = 2 * a.real
        by_p, by_q = self.form.apply(-(self.p * a + self.q * b.conj()), -(self.p * b + self.q * a.conj()))
        by_p += more * self.by_p
        by_q += more * self.by_q
        # The gradients of the hat functions change as p and q do.
        by_p -= self.by_p * a.conj() + self.by_q * b.conj()
        by_q -= self.by_p * b + self.by_q * a
        return self.gathered(by_p, by_q)

    def felt(self, dw: ComplexArray) -> Felt:
        """The response of the triangles to a displacement (n,)."""
        changes = self.derivatives(dw)
        return Felt(*changes, *self.form.apply(*changes))

    def strain_of(self, felt: Felt) -> tuple[ComplexArray, ComplexArray]:
        """The transpose of `by_strain`: gradients (f,) by a and b of the work along a displacement."""
        dp, dq, hp, hq = felt
        along: FloatArray = (self.by_p.conj() * dp + self.by_q.conj() * dq).real
        by_a = 2 * along - (hp * self.p.conj() + hq.conj() * self.q + self.by_p * dp.conj() + self.by_q.conj() * dq)
        by_b = -(hp.conj() * self.q + hq * self.p.conj() + self.by_p.conj() * dq + self.by_q * dp.conj())
        return self.share * by_a, self.share * by_b

    @cached_property
    def by_scale(self) -> ComplexArray:
        """The change of the forces (n,) with the logarithm of a common factor of all g."""
        hp, hq = self.form.apply(self.p, self.q)
        return self.gathered(hp + self.by_p, hq + self.by_q)

    def gathered(self, by_p: ComplexArray, by_q: ComplexArray) -> ComplexArray:
        """Sum forces of triangles (f,) on p and q at the vertices."""
        pull: ComplexArray = (self.share * by_p) * self.g + (self.share * by_q) * self.g.conj()
        at = self.corners.ravel()
        real, imaginary = (np.bincount(at, part.ravel(), minlength=self.n) for part in (pull.real, pull.imag))
        return real + 1j * imaginary
