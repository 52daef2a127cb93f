"""CHOLMOD through scikit-sparse, if installed. It is not a dependency, because its supernodal part is under the GPL."""

from __future__ import annotations

import warnings
from typing import Any

import numpy as np

from quasiharmonic.linsolve.base import LinearSolver, NotPositiveDefinite
from quasiharmonic.util.arrays import FloatArray

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
