"""The protocol of all sparse solvers, with its errors and the residual test of every solution.

A backend implements four steps: `_analyse`, `_factor`, `_solve` and `_release`. The base class does the rest: checks,
the copy of the values, the residual test, one step of refinement, locking.
"""

from __future__ import annotations

import math
import threading
import time
from abc import ABC, abstractmethod
from functools import cache
from importlib.util import find_spec
from typing import ClassVar, Self

import numpy as np
from numpy.typing import ArrayLike, NDArray

from quasiharmonic.util.arrays import FloatArray, as_offsets, repeat_each
from quasiharmonic.util.kernels import compiled
from quasiharmonic.util.progress import heartbeat

# Maximum residual that a backward stable factorisation can cause, relative to |A||x| + |b| after scaling the diagonal
# to one. Cholesky stays near 1e-15; a wrong factor fails in the first digits.
BACKWARD = 1e-10
# Maximum residual relative to |b| alone. If x is so large that rounding in A x hides b, the matrix is singular up to
# rounding, and x is meaningless even if the backward error is small.
FORWARD = 1e-4
# Results of `wrong_pattern`.
_PATTERN_RIGHT = 0
_PATTERN_EMPTY_ROW = 1
_PATTERN_NO_DIAGONAL = 2
_PATTERN_NOT_ASCENDING = 3


class ResidualTest:
    """Test solutions of A x = b, with A given by its upper triangle in compressed sparse rows.

    Each row has its diagonal entry first. `read` reads the array ``values`` again. Sizes are compared after scaling A
    to a unit diagonal, S A S with S = diag(a_ii)^-1/2. Then Cholesky's error bound, |ΔA_ij| <= c n ε √(a_ii a_jj), is
    the same in every row for any units of A.
    """

    def __init__(self, indptr: NDArray[np.int32], indices: NDArray[np.int32], values: FloatArray) -> None:
        n = len(indptr) - 1
        self._matrix = indptr, indices, values
        self._signs = _random_signs(max(n - 1, 0).bit_length())[:n]
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

    def is_plausible(self, b: FloatArray, x: FloatArray) -> bool:
        """Whether all columns of x pass a test that needs no product with A.

        For the probe z = S·(random signs), zᵀ(b - A x) = zᵀb - (A z)ᵀx has the size of the scaled residual. A z is
        known from `read`, so the test takes 6 % of the time of a solve instead of 25 %. A residual that exceeds the
        limit by a factor q passes with probability about 1/q. A wrong factor exceeds the limit by at least 1e6.
        """
        sizes = np.empty((3, b.shape[1]))
        with np.errstate(all="ignore"):
            scaled_sizes(self._root, self._probe, self._image, b.T, np.ascontiguousarray(x.T), sizes)
        # For a few numbers, Python is faster than NumPy.
        for found, of_b, of_x in zip(*sizes.tolist(), strict=True):
            limit = min(BACKWARD * (of_x + of_b), FORWARD * of_b)
            if not (math.isfinite(limit) and found <= limit):
                return False
        return True

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


@cache
def _random_signs(exponent: int) -> FloatArray:
    """Return 2^exponent random signs, always the same ones."""
    signs = np.random.default_rng(0).integers(2, size=1 << exponent) * np.float64(2) - 1
    signs.flags.writeable = False
    return signs


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


class NotPositiveDefinite(ArithmeticError):  # noqa: N818  (the name says what happened to the matrix, not to the program)
    """Raised if a matrix is not numerically positive definite, or if no solution is accurate enough.

    Callers are expected to handle it with a shorter step, an addition to the diagonal, or another backend.
    """


Pattern = NDArray[np.int32]


class LinearSolver(ABC):
    """Solve A x = b for symmetric positive definite A with a fixed sparsity pattern.

    The constructor analyses the pattern. `factor` takes new values for it, and `solve` any number of right-hand
    sides. Threads may share a solver; each call is atomic.

    Parameters
    ----------
    indptr : (n+1,) integer array
        Row starts of the upper triangle of A in compressed sparse rows, as in ``scipy.sparse.triu(A, format="csr")``.
    indices : (nnz,) integer array
        Column indices, ascending within each row. Every row starts with its diagonal entry.
    ordered : bool
        Whether the unknowns are numbered such that elimination in this order gives a sparse factor. If so, the
        backend does not compute an order. No effect if `takes_order` is False.
    semidefinite : bool
        Whether the matrices are sums of positive semidefinite ones, so that only rounding or a singular matrix gives
        pivots that are not positive. The backend may then rely on the test of the residual.

    Raises
    ------
    ValueError
        If the pattern is not valid.
    ImportError
        If the library of the backend cannot be loaded.
    """

    # The matrix is not scaled before factoring. Cholesky without pivoting commutes with scaling by powers of two:
    # except for underflow and overflow, the factor of S A S is the scaled factor of A in every bit. So scaling would
    # not prevent any failure. Only the residual test compares sizes, and it scales the diagonal to one.

    name: ClassVar[str]
    requirement: ClassVar[str]
    #: Python package that contains the library; None if `is_installed` does not depend on a package.
    package: ClassVar[str | None] = None
    #: Whether the backend can use a given numbering instead of computing an order.
    takes_order: ClassVar[bool] = True

    def __init__(
        self, indptr: ArrayLike, indices: ArrayLike, *, ordered: bool = False, semidefinite: bool = False
    ) -> None:
        self._ordered, self._semidefinite = ordered, semidefinite
        self._indptr, self._indices = _check_pattern(indptr, indices)
        self.n = len(self._indptr) - 1
        self.nnz = len(self._indices)
        # The backend reads only from this buffer. So the caller may reuse its array, and a backend that stores
        # addresses can prepare them once.
        self._values: FloatArray = np.zeros(self.nnz)
        self._lock = threading.Lock()
        self._ready = False
        self._closed = False
        began = time.monotonic()
        if self.n:
            heartbeat()
            self._test = ResidualTest(self._indptr, self._indices, self._values)
            self._analyse()
        # Expected seconds of the next factorisation. The first takes about as long as the analysis.
        self._expected = time.monotonic() - began

    @classmethod
    def is_installed(cls) -> bool:
        """Whether the library of this backend is installed; does not load it."""
        return cls.package is None or _is_installed(cls.package)

    def factor(self, values: ArrayLike) -> None:
        """Factor the matrix with these values.

        Parameters
        ----------
        values : (nnz,) array
            Entries of the upper triangle, aligned with the pattern passed to the constructor. They are copied.

        Raises
        ------
        NotPositiveDefinite
            If a diagonal entry is not positive, or an entry is not finite. If a pivot is not positive, unless the
            matrix is ``semidefinite``: then `solve` may raise it.
        ValueError
            If the array has the wrong shape, or the solver is closed.
        """
        values = np.asarray(values)
        if values.shape != (self.nnz,):
            raise ValueError(f"values has shape {values.shape}; the analysed pattern has {self.nnz} entries")
        heartbeat(self._expected)
        began = time.monotonic()
        with self._lock:
            self._require_open()
            analysed_now = self.n > 0 and self._analyse_late()
        if analysed_now:
            heartbeat(time.monotonic() - began)
        with self._lock:
            self._require_open()
            self._ready = False
            np.copyto(self._values, values)
            began = time.monotonic()
            if self.n:
                self._test.read()
                self._factor()
            self._expected = time.monotonic() - began
            self._ready = True

    def solve(self, rhs: ArrayLike) -> FloatArray:
        """Solve for one or several right-hand sides with the last factor.

        Parameters
        ----------
        rhs : (n,) or (n, k) array
            Right-hand sides; not modified.

        Returns
        -------
        (n,) or (n, k) float64 array
            Solution, a new array. With several columns it is Fortran-ordered.

        Raises
        ------
        NotPositiveDefinite
            If the residual is too large, also after one step of iterative refinement. Then the matrix is singular to
            working precision, or the factor is wrong. Also if ``rhs`` is not finite.
        ValueError
            If ``rhs`` has the wrong shape, or the solver is closed.
        RuntimeError
            If there is no factor: `factor` was not called or failed.
        """
        array = np.asarray(rhs, dtype=np.float64)
        if array.ndim not in (1, 2) or array.shape[0] != self.n:
            raise ValueError(f"right-hand side has shape {array.shape}; expected ({self.n},) or ({self.n}, k)")
        heartbeat()
        b = np.asfortranarray(array.reshape(self.n, -1) if array.size else np.zeros((self.n, 0)))
        with self._lock:
            self._require_open()
            if not self._ready:
                raise RuntimeError("the matrix has no factorisation: factor() was not called or failed")
            if not array.size:
                return np.zeros(array.shape)
            x = self._solve(b)
            if not self._test.is_plausible(b, x):
                x = self._check_residual(b, x)
        return x[:, 0] if array.ndim == 1 else x

    def close(self) -> None:
        """Release the factor and the memory of the library. Repeated calls have no effect."""
        with self._lock:
            if not self._closed:
                self._closed = True
                self._ready = False
                if self.n:
                    self._release()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def _require_open(self) -> None:
        if self._closed:
            raise ValueError("the solver is closed")

    def _check_residual(self, b: FloatArray, x: FloatArray) -> FloatArray:
        """Check the true residual, refine once if it is too large, and raise if it is still too large."""
        excess = self._test.excess(b, x)
        if excess > 1:
            with np.errstate(all="ignore"):
                x = x + self._solve(np.asfortranarray(b - self._test.multiply(x)))
            excess = self._test.excess(b, x)
        if excess <= 1:
            return x
        if not np.isfinite(b).all():
            raise NotPositiveDefinite("there is no solution: the right-hand side has NaN or infinite entries")
        raise NotPositiveDefinite(
            "the matrix is not numerically positive definite: the residual of the solution found by "
            f"{self.name} is {excess:.1e} times the allowed value"
        )

    # ---- implemented by backends ------------------------------------------------------------------------------------

    @abstractmethod
    def _analyse(self) -> None:
        """Find an ordering for the pattern; called once, with n > 0."""

    def _analyse_late(self) -> bool:
        """Do the part of the analysis that the first factorisation needs; return whether there was one to do."""
        return False

    @abstractmethod
    def _factor(self) -> None:
        """Factor `self._values`, or raise `NotPositiveDefinite` if any pivot is not positive."""

    @abstractmethod
    def _solve(self, b: FloatArray) -> FloatArray:
        """Solve for (n, k) Fortran-ordered `b` without modifying it; return a new Fortran-ordered array."""

    @abstractmethod
    def _release(self) -> None:
        """Release the factor and the memory of the library."""


@cache  # Searching for a missing package takes as long as solving for 100 unknowns.
def _is_installed(package: str) -> bool:
    return find_spec(package) is not None


def _check_pattern(indptr: ArrayLike, indices: ArrayLike) -> tuple[Pattern, Pattern]:
    """Check the pattern of an upper triangle and return private int32 copies."""
    starts, columns = np.array(indptr), np.array(indices)
    if starts.ndim != 1 or columns.ndim != 1 or starts.size == 0 or starts[0] != 0 or starts[-1] != columns.size:
        raise ValueError("indptr must be one-dimensional, start with 0 and end with the number of indices")
    if columns.size > np.iinfo(np.int32).max:
        raise ValueError(f"the matrix has {columns.size} entries; at most 2^31 - 1 are supported")
    n = starts.size - 1
    if columns.dtype != np.int32:
        # Clip indices that do not fit into 32 bits to values that are still out of range.
        columns = np.clip(columns, -1, n).astype(np.int32)
    pattern = starts.astype(np.int32, copy=False), columns
    wrong = wrong_pattern(*pattern)
    if wrong == _PATTERN_EMPTY_ROW:
        raise ValueError(f"row {int(np.argmin(np.diff(starts)))} has no entries; every row needs its diagonal entry")
    if wrong == _PATTERN_NO_DIAGONAL:
        row = np.flatnonzero(columns[starts[:-1]] != np.arange(n))[0]
        raise ValueError(f"row {row} does not start with its diagonal entry")
    if wrong == _PATTERN_NOT_ASCENDING:
        raise ValueError("column indices must be ascending within each row and smaller than the number of rows")
    return pattern


@compiled
def wrong_pattern(indptr: Pattern, indices: Pattern) -> int:
    """Check rows of an upper triangle, from 0 to the number of entries; return one of the constants above."""
    n = indptr.size - 1
    if n and np.diff(indptr).min() < 1:
        return _PATTERN_EMPTY_ROW
    if not np.array_equal(indices[indptr[:-1]], np.arange(n)):
        return _PATTERN_NO_DIAGONAL
    ascending = indices[1:] > indices[:-1]
    ascending[indptr[1:-1] - 1] = True
    return _PATTERN_RIGHT if ascending.all() and indices.max(initial=-1) < n else _PATTERN_NOT_ASCENDING
