"""SuperLU, which is part of SciPy: the fallback, slower than the others but always available."""

from __future__ import annotations

from typing import Any

import numpy as np

from quasiharmonic.linsolve.base import LinearSolver, NotPositiveDefinite
from quasiharmonic.util.arrays import FloatArray, repeat_each


class SuperLU(LinearSolver):
    """LU factorisation of both triangles, with pivots on the diagonal."""

    name = "superlu"
    requirement = "pip install scipy"

    def _analyse(self) -> None:
        from scipy.sparse import csc_array, csr_array

        # SciPy cannot reuse SuperLU's ordering between factorisations. So the ordering is computed once, on a matrix
        # with the same pattern that is positive definite. Later matrices are permuted before factoring, which takes a
        # third of the time of ordering again.
        entries = np.arange(1, self.nnz + 1)
        upper = csr_array((entries, self._indices, self._indptr), shape=(self.n, self.n))
        lower = upper.T.tocsr()
        lower.setdiag(0)
        lower.eliminate_zeros()
        full = csc_array(upper + lower)
        filler = np.where(full.indices == repeat_each(np.arange(self.n), np.diff(full.indptr)), self.n + 1.0, -1.0)
        if self._ordered:
            self._order = np.arange(self.n)
        else:
            ordering = self._splu(csc_array((filler, full.indices, full.indptr), shape=full.shape), "MMD_AT_PLUS_A")
            self._order = np.argsort(ordering.perm_c)
        permuted = full[self._order][:, self._order].tocsc()
        permuted.sort_indices()
        # Index in the upper triangle of each entry of the permuted full matrix.
        self._source = permuted.data - 1
        self._permuted = csc_array((np.zeros(permuted.nnz), permuted.indices, permuted.indptr), shape=full.shape)
        self._lu: Any = None

    @staticmethod
    def _splu(matrix: Any, ordering: str) -> Any:
        from scipy.sparse.linalg import splu

        return splu(matrix, permc_spec=ordering, diag_pivot_thresh=0.0, options={"SymmetricMode": True})

    def _factor(self) -> None:
        np.take(self._values, self._source, out=self._permuted.data, mode="clip")  # the mode that needs no buffer
        self._lu = None
        try:
            lu = self._splu(self._permuted, "NATURAL")
        except RuntimeError as error:
            raise NotPositiveDefinite(f"the matrix is not positive definite: SuperLU says {error}") from None
        # With all pivots on the diagonal U = D Lᵀ, and A has as many positive eigenvalues as D has positive entries.
        # SuperLU leaves the diagonal only if a pivot is exactly zero.
        if not (np.array_equal(lu.perm_r, lu.perm_c) and lu.U.diagonal().min() > 0):
            raise NotPositiveDefinite("the matrix is not positive definite: SuperLU found a pivot that is not positive")
        self._lu = lu

    def _solve(self, b: FloatArray) -> FloatArray:
        x = np.empty_like(b, order="F")
        x[self._order] = self._lu.solve(b[self._order])
        return x

    def _release(self) -> None:
        self._lu = None
