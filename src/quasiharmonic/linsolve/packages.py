"""Solvers of packages that take SciPy's matrices: CHOLMOD, QDLDL and SuperLU.

- CHOLMOD, through scikit-sparse, is used if it is installed. It is not a dependency, because its supernodal part is
  under the GPL.
- QDLDL is a small LDLᵀ factorisation with wheels for every platform; for small systems without MKL.
- SuperLU, which is part of SciPy, is the fallback, slower than the others but always available.
"""

from __future__ import annotations

import warnings
from typing import Any

import numpy as np

from quasiharmonic.linsolve.base import LinearSolver, NotPositiveDefinite
from quasiharmonic.util.arrays import FloatArray, repeat_each

# Number of unknowns of a planar mesh below which the simplicial code is faster (18 against 30 ms at 20,000).
SIMPLICIAL_BELOW = 50_000


class Cholmod(LinearSolver):
    """CHOLMOD through the interfaces of scikit-sparse 0.4 and 0.5."""

    name = "cholmod"
    requirement = "pip install scikit-sparse (which needs SuiteSparse and a C compiler)"
    package = "sksparse"

    def _analyse(self) -> None:
        from scipy.sparse import csc_matrix
        from sksparse import cholmod

        self._errors = cholmod.CholmodError
        # The upper triangle by rows is the lower triangle by columns, which CHOLMOD reads by default. The matrix is a
        # view of the solver's values.
        self._matrix = csc_matrix((self._values, self._indices, self._indptr), shape=(self.n, self.n))
        self._values[self._indptr[:-1]] = 1.0  # version 0.5 rejects a zero matrix
        small = self.n < SIMPLICIAL_BELOW
        mode, ordering = ("simplicial", "amd") if small else ("auto", "default")
        if self._ordered:
            ordering = "natural"
        self._has_old_interface = hasattr(cholmod, "analyze")
        if self._has_old_interface:
            self._symbolic: Any = cholmod.analyze(self._matrix, mode=mode, ordering_method=ordering)
        else:
            self._symbolic = cholmod.CholeskyFactor(self._matrix, lower=True, order=ordering, supernodal_mode=mode)
        self._numeric: Any = None

    def _factor(self) -> None:
        try:
            if self._has_old_interface:
                self._numeric = self._symbolic
                self._numeric.cholesky_inplace(self._matrix)
                # The simplicial code computes LDLᵀ, which exists for indefinite matrices as well.
                positive = bool(self._numeric.D().min() > 0)
            else:
                # Factoring always leaves a simplicial factor, so each factorisation starts from a copy of the analysis.
                # It requests LLᵀ, which raises for indefinite matrices.
                self._numeric = self._symbolic.copy()
                self._numeric.factorize(self._matrix)
                positive = self._numeric.rcond > 0
        except self._errors as error:
            raise NotPositiveDefinite(f"the matrix is not positive definite: CHOLMOD says {error}") from None
        if not positive:
            raise NotPositiveDefinite("the matrix is not positive definite: CHOLMOD found a pivot that is not positive")

    def _solve(self, b: FloatArray) -> FloatArray:
        x: FloatArray
        if self._has_old_interface:
            x = self._numeric(b)
        elif self._numeric.rcond >= self.n * np.finfo(np.float64).eps:
            x = self._numeric.solve(b)
        else:
            # CHOLMOD would warn about a poorly conditioned diagonal. The residual test is more reliable.
            with warnings.catch_warnings():
                warnings.simplefilter("ignore")
                x = self._numeric.solve(b)
        return x

    def _release(self) -> None:
        self._symbolic = self._numeric = None


class Qdldl(LinearSolver):
    """LDLᵀ with an approximate minimum degree ordering, single-threaded."""

    name = "qdldl"
    requirement = "pip install qdldl"
    package = "qdldl"
    # QDLDL always orders by minimum degree, which breaks ties by index. A regular mesh numbered by dissection takes 1.5
    # to 2.5 times as long to factor as the same mesh numbered row by row.
    takes_order = False
    _library: Any
    _solver: Any

    def _analyse(self) -> None:
        import qdldl
        from scipy.sparse import csc_matrix, csr_array

        # QDLDL reads the upper triangle by columns, so the entries must be reordered.
        entries = np.arange(self.nnz, dtype=np.float64)
        by_columns = csr_array((entries, self._indices, self._indptr), shape=(self.n, self.n)).tocsc()
        self._source = by_columns.data.astype(np.intp)
        # The package accepts sparse matrices and rejects sparse arrays.
        data = np.empty(self.nnz)
        self._matrix = csc_matrix((data, by_columns.indices, by_columns.indptr), shape=(self.n, self.n))
        # QDLDL's analysis includes a factorisation, so it gets the first matrix.
        self._library, self._solver = qdldl, None

    def _factor(self) -> None:
        np.take(self._values, self._source, out=self._matrix.data, mode="clip")  # the mode that needs no buffer
        try:
            if self._solver is None:
                self._solver = self._library.Solver(self._matrix, upper=True)
            else:
                self._solver.update(self._matrix, upper=True)
        except RuntimeError:
            raise NotPositiveDefinite("the matrix is not positive definite: QDLDL found a pivot that is zero") from None
        # LDLᵀ exists for indefinite matrices as well, and QDLDL may continue after a zero pivot without an error. Only
        # the signs of D are a reliable test. QDLDL returns D with a copy of L, which takes as long as the factorisation
        # of a small matrix.
        if self._semidefinite:
            return
        pivots = self._solver.factors()[1]
        if not pivots.min() > 0:
            raise NotPositiveDefinite("the matrix is not positive definite: QDLDL found a pivot that is not positive")

    def _solve(self, b: FloatArray) -> FloatArray:
        x = np.empty_like(b, order="F")
        for j in range(b.shape[1]):
            x[:, j] = self._solver.solve(b[:, j])
        return x

    def _release(self) -> None:
        self._solver = None


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
