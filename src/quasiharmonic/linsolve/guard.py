"""Residual test of every solution that a solver returns."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from quasiharmonic.linsolve.errors import NotPositiveDefinite
from quasiharmonic.util.arrays import FloatArray, as_offsets, repeat_each
from quasiharmonic.util.kernels import compiled

# Maximum residual that a backward stable factorisation can cause, relative to |A||x| + |b| after scaling the diagonal
# to one. Cholesky stays near 1e-15; a wrong factor fails in the first digits.
BACKWARD = 1e-10
# Maximum residual relative to |b| alone. If x is so large that rounding in A x hides b, the matrix is singular up to
# rounding, and x is meaningless even if the backward error is small.
FORWARD = 1e-4


class ResidualTest:
    """Test solutions of A x = b, with A given by its upper triangle in compressed sparse rows.

    Each row has its diagonal entry first. `read` reads the array ``values`` again. Sizes are compared after scaling A
    to a unit diagonal, S A S with S = diag(a_ii)^-1/2. Then Cholesky's error bound, |ΔA_ij| <= c n ε √(a_ii a_jj), is
    the same in every row for any units of A.
    """

    def __init__(self, indptr: NDArray[np.int32], indices: NDArray[np.int32], values: FloatArray) -> None:
        n = len(indptr) - 1
        self._matrix = indptr, indices, values
        self._signs: FloatArray = np.random.default_rng(0).integers(2, size=n) * np.float64(2) - 1
        self._root, self._probe, self._image = np.empty(n), np.empty(n), np.empty(n)

    def read(self) -> None:
        """Read the current values.

        Raises NotPositiveDefinite if a diagonal entry is not positive or an entry is not finite.
        """
        indptr, indices, values = self._matrix
        with np.errstate(all="ignore"):
            worst = probe_matrix(indptr, indices, values, self._signs, self._root, self._probe, self._image)
        if worst >= 0:
            raise NotPositiveDefinite(
                f"the matrix is not positive definite: diagonal entry {worst} is {values[indptr[worst]]:g}"
            )
        # Every entry contributes to the image. If A is positive definite, no product in it exceeds √a_ii.
        if not (np.isfinite(self._image.min()) and np.isfinite(self._image.max())):
            raise NotPositiveDefinite("the matrix is not positive definite: it has entries that are NaN or too large")

    def multiply(self, x: FloatArray) -> FloatArray:
        """A @ x for x of shape (n, k)."""
        return np.stack([_product(*self._matrix, column) for column in x.T], axis=1)

    def plausible(self, b: FloatArray, x: FloatArray) -> bool:
        """Whether all columns of x pass a test that needs no product with A.

        For the probe z = S·(random signs), zᵀ(b - A x) = zᵀb - (A z)ᵀx has the size of the scaled residual. A z is
        known from `read`, so the test takes 6 % of the time of a solve instead of 25 %. A residual that exceeds the
        limit by a factor q passes with probability about 1/q. A wrong factor exceeds the limit by at least 1e6.
        """
        residual, size_b, size_x = sizes = np.empty((3, b.shape[1]))
        with np.errstate(all="ignore"):
            scaled_sizes(self._root, self._probe, self._image, b.T, np.ascontiguousarray(x.T), sizes)
            limit = np.minimum(BACKWARD * (size_x + size_b), FORWARD * size_b)
            return bool(np.all((residual <= limit) & np.isfinite(limit)))

    def excess(self, b: FloatArray, x: FloatArray) -> float:
        """Maximum true residual of the columns of x relative to the limit; infinite if a value is not finite.

        It uses the maximum norm, which neither overflows nor underflows.
        """
        with np.errstate(all="ignore"):
            size_x = np.abs(self._root[:, None] * x).max(axis=0)
            size_b = np.abs(self._probe[:, None] * b).max(axis=0)
            residual = np.abs(self._probe[:, None] * (b - self.multiply(x))).max(axis=0)
            limit = np.minimum(BACKWARD * (size_x + size_b), FORWARD * size_b)
            if not (np.isfinite(residual).all() and np.isfinite(limit).all()):
                return float("inf")
            return float(np.max(np.where(residual > 0, residual / limit, 0.0)))


@compiled
def probe_matrix(
    indptr: NDArray[np.int32],
    indices: NDArray[np.int32],
    values: FloatArray,
    signs: FloatArray,
    root: FloatArray,
    probe: FloatArray,
    image: FloatArray,
) -> int:
    """Fill in S⁻¹ as ``root``, z = S·signs and A z; return -1, or the first row with a non-positive diagonal entry."""
    diagonal = values[indptr[:-1]]
    if not diagonal.min() > 0:
        return int(np.flatnonzero(~(diagonal > 0))[0])
    np.sqrt(diagonal, out=root)
    np.divide(signs, root, out=probe)
    image[:] = _product(indptr, indices, values, probe)
    return -1


def _product(indptr: NDArray[np.int32], indices: NDArray[np.int32], values: FloatArray, x: FloatArray) -> FloatArray:
    """A @ x for x of shape (n,)."""
    product: FloatArray = np.add.reduceat(values * x[indices], as_offsets(indptr[:-1]))
    product += np.bincount(indices, values * repeat_each(x, np.diff(indptr)), x.size)
    product -= values[indptr[:-1]] * x
    return product


@compiled
def scaled_sizes(
    root: FloatArray, probe: FloatArray, image: FloatArray, b: FloatArray, x: FloatArray, sizes: FloatArray
) -> None:
    """Fill in ``|zᵀb - (A z)ᵀx|`` and the sizes of S b and S⁻¹ x, (3, k), for each row of b and x, (k, n)."""
    scaled_b, scaled_x = probe * b, root * x
    # Avoid `@`: BLAS would wake its threads for a few microseconds of work.
    sizes[0] = np.abs(np.einsum("i,ji->j", image, x) - scaled_b.sum(axis=1))
    sizes[1] = np.sqrt(np.einsum("ji,ji->j", scaled_b, scaled_b))
    sizes[2] = np.sqrt(np.einsum("ji,ji->j", scaled_x, scaled_x))
