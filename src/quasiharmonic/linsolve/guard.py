"""The residual test that no solution leaves a solver without."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from quasiharmonic.arrays import FloatArray
from quasiharmonic.linsolve.errors import NotPositiveDefinite

# Largest residual that a backward stable factorisation can be held responsible for, relative to |A||x| + |b| after
# scaling the diagonal to one. Cholesky stays near 1e-15; a factor that is wrong is wrong in the first digits.
BACKWARD = 1e-10
# Largest residual relative to |b| alone. When x has become so large that rounding in A x hides b, the matrix is within
# rounding of a singular one and x means nothing, however small the backward error is.
FORWARD = 1e-4


class ResidualTest:
    """Judge solutions of A x = b, with A given by its upper triangle.

    Sizes are compared after scaling A to a unit diagonal, S A S with S = diag(a_ii)^-1/2, where Cholesky's own error
    bound, |ΔA_ij| <= c n ε √(a_ii a_jj), is the same number in every row whatever the units of A are.

    Parameters
    ----------
    indptr, indices : (n+1,) and (nnz,) int32 arrays
        Upper triangle in compressed sparse rows, the diagonal entry first in each row.
    values : (nnz,) float64 array
        Its entries. The array is kept and read anew by `read`.
    """

    def __init__(self, indptr: NDArray[np.int32], indices: NDArray[np.int32], values: FloatArray) -> None:
        from scipy.sparse import csr_array

        n = len(indptr) - 1
        self._upper = csr_array((values, indices, indptr), shape=(n, n))
        self._lower = self._upper.T  # the same arrays read by columns
        self._first = indptr[:-1]
        self._signs = np.random.default_rng(0).choice([-1.0, 1.0], size=n)

    def read(self) -> None:
        """Take up the values as they are now.

        Raises
        ------
        NotPositiveDefinite
            A diagonal entry is not positive, or an entry is not finite.
        """
        diagonal = self._upper.data[self._first]
        if not diagonal.min() > 0:
            worst = int(np.flatnonzero(~(diagonal > 0))[0])
            raise NotPositiveDefinite(
                f"the matrix is not positive definite: diagonal entry {worst} is {diagonal[worst]:g}"
            )
        with np.errstate(all="ignore"):
            self._diagonal = diagonal
            self._root = np.sqrt(diagonal)
            self._probe = self._signs / self._root
            self._image = self.multiply(self._probe)
        # Every entry went into the image, and if A is positive definite none of its products is larger than √a_ii.
        if not (np.isfinite(self._image.min()) and np.isfinite(self._image.max())):
            raise NotPositiveDefinite("the matrix is not positive definite: it has entries that are NaN or too large")

    def multiply(self, x: FloatArray) -> FloatArray:
        """A @ x for x of shape (n,) or (n, k)."""
        diagonal = self._diagonal if x.ndim == 1 else self._diagonal[:, None]
        product: FloatArray = self._upper @ x + self._lower @ x - diagonal * x
        return product

    def plausible(self, b: FloatArray, x: FloatArray) -> bool:
        """Whether all columns of x pass a test that needs no product with A.

        For the probe z = S·(random signs), zᵀ(b - A x) = zᵀb - (A z)ᵀx has the size of the scaled residual, and A z is
        known since `read`: 6 % of the time of a solve instead of 25. A residual that exceeds the limit by a factor q
        slips through with a chance of about 1/q, and a wrong factor exceeds it by 1e6 and more.
        """
        with np.errstate(all="ignore"):
            scaled_b = self._probe[:, None] * b
            scaled_x = self._root[:, None] * x
            # Not `@`: BLAS would wake its threads for a few microseconds of work.
            residual = np.abs(np.einsum("i,ij->j", self._image, x) - scaled_b.sum(axis=0))
            size_b = np.sqrt(np.einsum("ij,ij->j", scaled_b, scaled_b))
            size_x = np.sqrt(np.einsum("ij,ij->j", scaled_x, scaled_x))
            limit = np.minimum(BACKWARD * (size_x + size_b), FORWARD * size_b)
            return bool(np.all((residual <= limit) & np.isfinite(limit)))

    def excess(self, b: FloatArray, x: FloatArray) -> float:
        """Largest true residual of the columns of x in units of what is allowed; infinite if anything is not finite.

        In the maximum norm, which neither over- nor underflows.
        """
        with np.errstate(all="ignore"):
            size_x = np.abs(self._root[:, None] * x).max(axis=0)
            size_b = np.abs(self._probe[:, None] * b).max(axis=0)
            residual = np.abs(self._probe[:, None] * (b - self.multiply(x))).max(axis=0)
            limit = np.minimum(BACKWARD * (size_x + size_b), FORWARD * size_b)
            if not (np.isfinite(residual).all() and np.isfinite(limit).all()):
                return float("inf")
            return float(np.max(np.where(residual > 0, residual / limit, 0.0)))
