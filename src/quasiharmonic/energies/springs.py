"""Springs along the edges of a mesh: the only energy of §11 that is not isotropic."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from quasiharmonic.energies.energies import Deformation, Energy, QuadraticForm, damp, inverse
from quasiharmonic.geometry.mesh.reference import rest_shapes
from quasiharmonic.geometry.mesh.topology import boundary_edges
from quasiharmonic.util.arrays import ComplexArray, FloatArray, own_triangles


class MassSpring(Energy):
    """Springs along the edges, ``Σ (l − l⁰)²`` over the edges of the mesh (E₃, §11.1.3).

    Unlike the other energies, this sum over edges depends on the triangulation, and zigzag folds cost no energy. Each
    triangle carries half of its interior edges and all of its boundary edges.

    Parameters
    ----------
    V : (n, 2) or (n, 3) array
        Rest positions.
    F : (f, 3) array of int
        Triangles, in the order of the rows of `Deformation`.

    Raises
    ------
    ValueError
        When rest triangles have no area.
    """

    def __init__(self, V: ArrayLike, F: ArrayLike) -> None:
        F = own_triangles(F)
        shapes = rest_shapes(V, F)
        shapes.check_areas("spring constants depend on the areas")
        self._sides, self._lengths = shapes.sides, np.abs(shapes.sides)
        n = int(F.max()) + 1
        boundary = boundary_edges(F, n)
        single = np.isin(F.T * n + F.T[(1, 2, 0), :], boundary[:, 0] * n + boundary[:, 1])
        self._stiffness = np.where(single, 1.0, 0.5) / shapes.m

    def density(self, d: Deformation) -> FloatArray:
        """``Σ (l − l⁰)²/m`` over the sides of each triangle, weighted by the triangle's share of each side."""
        _, length = self._images(d)
        return np.sum(self._stiffness * (length - self._lengths) ** 2, axis=0)

    def gradient(self, d: Deformation) -> tuple[ComplexArray, ComplexArray]:
        """Derivatives with respect to p and q; a side of zero length, where the energy has a kink, contributes 0."""
        side, length = self._images(d)
        pull = 2 * self._stiffness * (1 - self._lengths * inverse(length)) * side
        return np.sum(pull * self._sides.conj(), axis=0), np.sum(pull * self._sides, axis=0)

    def curvature(self, d: Deformation, *, negative: float = 0.0) -> QuadraticForm:
        """Second derivative; the negative eigenvalues are those of compressed springs, across their direction."""
        side, length = self._images(d)
        along, across = 2 * self._stiffness, 2 * self._stiffness * (1 - self._lengths * inverse(length))
        across = damp(across, negative)
        # With ds = dp z + dq z̄, ``along`` weights the part of ds along the side and ``across`` the part across it.
        z, zz = self._sides, self._lengths**2
        both, turn = 0.5 * (along + across), 0.5 * (along - across) * (np.conj(side) * inverse(length)) ** 2
        return QuadraticForm(
            pp=np.sum(both * zz, axis=0),
            qq=np.sum(both * zz, axis=0),
            p2=np.sum(turn * z**2, axis=0),
            q2=np.sum(turn * z.conj() ** 2, axis=0),
            pq=np.sum(2 * turn * zz, axis=0),
            pqc=np.sum(2 * both * z**2, axis=0),
        )

    def _images(self, d: Deformation) -> tuple[ComplexArray, FloatArray]:
        side = d.p * self._sides + d.q * self._sides.conj()
        return side, np.abs(side)
