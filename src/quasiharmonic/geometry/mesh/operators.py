"""The operators of §6.2 as sparse matrices, for study, tests and experiments.

The solver assembles from the triangles (§F.1) and does not use these matrices. They relate its formulas to
those of the paper.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csr_array, diags, vstack

from quasiharmonic.geometry.mesh.reference import Reference, ReferenceMesh
from quasiharmonic.geometry.mesh.topology import boundary_edges
from quasiharmonic.util.arrays import FloatArray, own_triangles


@dataclass(frozen=True)
class Operators:
    """Discrete operators of a mesh (Table 1).

    Attributes
    ----------
    G : (2f, n) sparse
        Intrinsic gradient: f rows of x derivatives, then f rows of y derivatives.
    m : (f,) float64
        Triangle areas.
    D : (n, n) sparse, antisymmetric
        Circular boundary gradient (eq. 15 with the signs of §A.1): ``uᵀ D v`` is the signed area.
    R, S : (n, k) and (n, n - k) sparse
        Selection of the boundary and of the interior vertices.
    C : (k, k) sparse
        ``Rᵀ D R`` (eq. 16).
    """

    G: csr_array
    m: FloatArray
    D: csr_array
    R: csr_array
    S: csr_array
    C: csr_array

    def laplacian(self, a: FloatArray | None = None) -> csr_array:
        """``Gᵀ A G`` for a tensor field; the cotangent Laplacian by default.

        ``a`` (f, 3) has the entries a11, a12, a22 of ``mⱼ⁻¹ A₍ⱼ₎`` by triangle.
        """
        if a is None:
            a = np.tile([1.0, 0.0, 1.0], (self.m.size, 1))
        a11, a12, a22 = (csr_array(diags(self.m * entry)) for entry in a.T)
        f = self.m.size
        Gx, Gy = self.G[:f], self.G[f:]
        return csr_array(Gx.T @ (a11 @ Gx + a12 @ Gy) + Gy.T @ (a12 @ Gx + a22 @ Gy))


def operators(V: NDArray[np.floating], F: NDArray[np.integer], reference: Reference = "rest") -> Operators:
    """Build the operators of a mesh; ``reference`` selects the triangles of gradients and areas."""
    triangles = own_triangles(F)
    mesh = ReferenceMesh(np.asarray(V, dtype=np.float64), triangles, reference)
    f, n = len(triangles), len(V)
    shape, offsets = (f, n), np.arange(0, 3 * f + 1, 3)
    Gx, Gy = (
        csr_array((part.T.ravel(), triangles.ravel(), offsets), shape=shape)
        for part in (mesh.gamma.real, mesh.gamma.imag)
    )
    edge = boundary_edges(triangles, n)
    half = csr_array((np.full(len(edge), 0.5), (edge[:, 0], edge[:, 1])), shape=(n, n))
    D = csr_array(half - half.T)
    boundary = np.unique(edge)
    R = _selection(boundary, n)
    S = _selection(np.setdiff1d(np.arange(n), boundary), n)
    return Operators(csr_array(vstack([Gx, Gy])), np.array(mesh.m), D, R, S, csr_array(R.T @ D @ R))


def _selection(rows: NDArray[np.integer], n: int) -> csr_array:
    return csr_array((np.ones(rows.size), (rows, np.arange(rows.size))), shape=(n, rows.size))
