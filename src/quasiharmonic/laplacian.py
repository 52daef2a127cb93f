"""The anisotropic Laplacian ``Gᵀ A G`` and the map it determines: A ↦ (u, v) (§6.2, eq. 12).

The pattern of ``Sᵀ Gᵀ A G S`` is that of the mesh's edges and never changes, so it is found and
analysed once. An assembly is then one gather of the triangles' edge stiffnesses into the values that
the factorisation reads.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from quasiharmonic.linsolve import make_solver

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]
ComplexArray = NDArray[np.complex128]


class Laplacian:
    """``Gᵀ A G`` restricted to the free vertices, for changing A.

    Parameters
    ----------
    F : (f, 3) int64
        Triangles.
    n : int
        Number of vertices.
    fixed : (k,) int
        Vertices whose positions are given; the others are solved for.
    linear_solver : str
        A name of `quasiharmonic.linsolve`, or ``"auto"``.

    Attributes
    ----------
    free : (n - k,) int64
        The other vertices, ascending: the columns of the paper's ``S``.
    """

    def __init__(self, F: IntArray, n: int, fixed: IntArray, linear_solver: str = "auto") -> None:
        from scipy.sparse import csr_array

        self.n = n
        self._tail, self._head = F.T.ravel(), F.T[(1, 2, 0), :].ravel()
        is_free = np.ones(n, dtype=bool)
        is_free[fixed] = False
        self.free = np.flatnonzero(is_free)
        size = self.free.size
        place = np.full(n, -1, dtype=np.int64)
        place[self.free] = np.arange(size)

        # Half-edge e·f + t is edge e of triangle t, the layout of ReferenceMesh.edge_stiffness.
        tail, head = place[self._tail], place[self._head]
        count = tail.size
        ones = np.ones(count)

        # Entries above the diagonal: every half-edge between two free vertices, sorted by (row, column).
        inner = np.flatnonzero((tail >= 0) & (head >= 0))
        key = np.minimum(tail[inner], head[inner]) * size + np.maximum(tail[inner], head[inner])
        order = np.argsort(key)
        inner, key = inner[order], key[order]
        first = np.flatnonzero(np.diff(key, prepend=-1))
        row, column = np.divmod(key[first], max(size, 1))
        self._gather = csr_array((ones[: inner.size], inner, np.append(first, inner.size)), shape=(first.size, count))
        # A row of the upper triangle is its diagonal entry followed by those entries.
        indptr = np.arange(size + 1) + np.append(0, np.cumsum(np.bincount(row, minlength=size)))
        self._diagonal = indptr[:-1]
        self._above = np.arange(first.size) + row + 1
        indices = np.empty(indptr[-1], dtype=np.int32)
        indices[self._diagonal] = np.arange(size)
        indices[self._above] = column
        self._values = np.empty(indptr[-1])

        # Rows of Gᵀ A G sum to zero, so each half-edge is taken off the diagonal at both of its ends.
        ends = np.stack([tail, head], axis=1).ravel()
        self._spread = csr_array(
            (-np.ones(np.count_nonzero(ends >= 0)), ends[ends >= 0], _offsets((tail >= 0) * 1 + (head >= 0))),
            shape=(count, size),
        ).T

        # Half-edges between a free and a fixed vertex carry the boundary's positions into the right-hand side.
        mixed = np.flatnonzero((tail >= 0) != (head >= 0))
        outward = tail[mixed] >= 0
        self._border = mixed
        self._border_row = np.where(outward, tail[mixed], head[mixed])
        self._border_fixed = np.where(outward, self._head[mixed], self._tail[mixed])
        self._rim = np.flatnonzero((tail < 0) | (head < 0))
        self.solver = make_solver(indptr.astype(np.int32), indices, name=linear_solver)

    def factor(self, stiffness: FloatArray) -> None:
        """Assemble and factor.

        Parameters
        ----------
        stiffness : (3, f) float64
            Off-diagonal entries of every triangle's ``Gᵀ A G``, from `ReferenceMesh.edge_stiffness`.

        Raises
        ------
        quasiharmonic.linsolve.NotPositiveDefinite
            When rounding leaves no positive definite matrix.
        """
        self._stiffness = stiffness.ravel()
        self._values[self._diagonal] = self._spread @ self._stiffness
        self._values[self._above] = self._gather @ self._stiffness
        self.solver.factor(self._values)

    def extend(self, w: ComplexArray) -> ComplexArray:
        """The quasi-harmonic map with ``w``'s values at the fixed vertices (eq. 12).

        Parameters
        ----------
        w : (n,) complex128
            ``u + i v``; only the fixed vertices' values are read.

        Returns
        -------
        (n,) complex128
            Equal to ``w`` at the fixed vertices, to the last bit.
        """
        pull = -self._stiffness[self._border] * w[self._border_fixed]
        load = np.zeros(self.free.size, dtype=np.complex128)
        np.add.at(load, self._border_row, pull)
        out = w.copy()
        out[self.free] = self._solve(load)
        return out

    def respond(self, load: ComplexArray) -> ComplexArray:
        """Solve ``Sᵀ Gᵀ A G S x = Sᵀ load``: the response to a load, zero at the fixed vertices.

        Parameters
        ----------
        load : (n,) complex128

        Returns
        -------
        (n,) complex128
        """
        out = np.zeros(load.shape, dtype=np.complex128)
        out[self.free] = self._solve(load[self.free])
        return out

    def flux(self, w: ComplexArray) -> ComplexArray:
        """``Gᵀ A G w`` at the fixed vertices, the discrete Neumann data (§6.2), and zero elsewhere.

        Parameters
        ----------
        w : (n,) complex128

        Returns
        -------
        (n,) complex128
        """
        tail, head = self._tail[self._rim], self._head[self._rim]
        # Rows sum to zero, so an off-diagonal entry k of edge (i, j) adds k (wⱼ − wᵢ) to row i.
        pull = self._stiffness[self._rim] * (w[head] - w[tail])
        out = np.zeros(self.n, dtype=np.complex128)
        np.add.at(out, tail, pull)
        np.subtract.at(out, head, pull)
        out[self.free] = 0
        return out

    def _solve(self, load: ComplexArray) -> ComplexArray:
        """One solve for both coordinates with the factor at hand; (n - k,) complex128."""
        rhs = np.empty((load.size, 2), order="F")
        rhs[:, 0], rhs[:, 1] = load.real, load.imag
        solution = self.solver.solve(rhs)
        return solution[:, 0] + 1j * solution[:, 1]


def _offsets(counts: NDArray[np.integer]) -> NDArray[np.int64]:
    return np.append(0, np.cumsum(counts))
