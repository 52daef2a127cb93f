"""MKL PARDISO, called through ctypes from the library in the `mkl` wheel."""

from __future__ import annotations

import ctypes
import os
import platform
import re
import site
import sys
import weakref
from collections.abc import Iterator
from functools import cache
from pathlib import Path
from typing import NamedTuple

import numpy as np

from quasiharmonic.linsolve.base import LinearSolver, NotPositiveDefinite, Pattern
from quasiharmonic.util.arrays import FloatArray
from quasiharmonic.util.threads import read_limit


class PardisoPhases(NamedTuple):
    """PARDISO's phases."""

    analyse: int = 11
    factor: int = 22
    solve: int = 33
    forward_only: int = 331
    release: int = -1


_PHASES = PardisoPhases()


class PardisoOptions(NamedTuple):
    """Values of PARDISO's parameters."""

    # Values of iparm[1]: the elimination order.
    minimum_degree: int = 0
    parallel_dissection: int = 3
    # Values of iparm[23]: the parallel factorisation.
    classic_two_level: int = 1
    improved_two_level: int = 10
    # MKL's threading layer.
    intel_threads: int = 0


_OPTIONS = PardisoOptions()


# Below this number of unknowns: minimum degree ordering and one thread. Above: dissection and all threads. For 10,000
# unknowns METIS takes 25 ms to order instead of 10 ms and saves 1 ms of 4 ms in parallel factorisation. Small tasks on
# all threads are also slow on a busy machine, because MKL's threads spin while they wait for each other.
SEQUENTIAL_BELOW = 30_000

#: From this number of unknowns the improved two-level algorithm is more than twice as fast. For a planar mesh (MKL
#: 2024.2 and 2026.2), 9,801 unknowns take 9.8 ms to analyse and 7.6 ms to factor; 10,201 take 4.8 and 3.0 ms.
FAST_FROM = 10_000
#: From this number of unknowns, matrices are padded to FAST_FROM unknowns with ones on the diagonal. 9,801 unknowns
#: then take 5.0 and 2.9 ms.
PAD_FROM = 2_500

_NOT_POSITIVE_DEFINITE = {-4, -7}
_OUT_OF_MEMORY = {-2, -9}
_ERRORS = {
    -1: "input inconsistent",
    -2: "not enough memory",
    -3: "reordering problem",
    -5: "unclassified internal error",
    -6: "reordering failed",
    -8: "32-bit integer overflow",
    -9: "not enough memory for out-of-core work",
}


class MKL(LinearSolver):
    """Supernodal Cholesky factorisation of the upper triangle, multi-threaded for large matrices."""

    name = "mkl"
    requirement = "pip install mkl (x86-64 Linux and Windows)"

    @classmethod
    def is_installed(cls) -> bool:
        """Whether MKL's runtime library is found."""
        return find_mkl() is not None

    def _analyse(self) -> None:
        indptr, indices, values = self._indptr, self._indices, self._values
        self._size = FAST_FROM if PAD_FROM <= self.n < FAST_FROM else self.n
        if self._size > self.n:
            extra = np.arange(self.n, self._size, dtype=np.int32)
            indptr = np.append(indptr, self.nnz + 1 + extra - self.n)
            indices = np.append(indices, extra)
            values = np.ones(indices.size)
        self._entries = values[: self.nnz]
        sequential = self.n < SEQUENTIAL_BELOW
        self.handle = self._begin(indptr, indices, values, sequential)
        # With several threads and any ordering except METIS's, the improved two-level algorithm solves a single
        # right-hand side incorrectly; two or more are correct. A solve on one thread then corrupts or crashes the next
        # factorisation on several threads (MKL 2026.2). So at least two right-hand sides are always passed.
        self._min_columns = 1 if sequential or not self.handle.improved else 2
        self._ones = np.ones((self._size, self._min_columns), order="F")

    def _begin(self, indptr: Pattern, indices: Pattern, values: FloatArray, sequential: bool) -> Handle:
        """Analyse a pattern with the number of threads that is currently allowed."""
        handle = Handle(indptr, indices, values, sequential=sequential, ordered=self._ordered)
        self._release_once = weakref.finalize(self, handle.release)
        handle.check(_PHASES.analyse)
        return handle

    def _factor(self) -> None:
        if self.handle.threads != self.handle.threads_now:
            # An instance crashes if the number of threads changes (MKL 2026.2), so a new one is made.
            self._release_once()
            self.handle.threads = 0  # if memory runs out now, the next call analyses again
            self.handle = self._begin(*self.handle.pattern, self.handle.sequential)
        if self._size > self.n:
            self._entries[:] = self._values
        self.handle.check(_PHASES.factor)
        # The improved two-level algorithm takes the square root of a negative pivot and continues. The NaN spreads to
        # all dependent entries. A forward solve with one right-hand side detects it, in 5 % of the factorisation time.
        if self.handle.improved:
            forward = np.empty_like(self._ones)
            self.handle.check(_PHASES.forward_only, self._ones, forward)
            if not np.isfinite(forward.sum()):
                raise NotPositiveDefinite("the matrix is not positive definite: PARDISO found a negative pivot")

    def _solve(self, b: FloatArray) -> FloatArray:
        if self._size > self.n:
            b = np.asfortranarray(np.concatenate([b, np.zeros((self._size - self.n, b.shape[1]))]))
        columns = b.shape[1]
        if columns < self._min_columns:
            b = np.asfortranarray(np.repeat(b, self._min_columns, axis=1))
        x = np.empty_like(b, order="F")
        self.handle.check(_PHASES.solve, b, x)
        return np.asfortranarray(x[: self.n, :columns])

    def _release(self) -> None:
        self._release_once()


class Handle:
    """One PARDISO instance with prepared arguments, so that a call only sets the phase.

    It keeps the arrays alive whose addresses it stores. It has no reference to the solver, so it can outlive the solver
    until the memory is released.
    """

    def __init__(
        self, indptr: Pattern, indices: Pattern, values: FloatArray, *, sequential: bool, ordered: bool
    ) -> None:
        self.sequential = sequential
        self.pattern = indptr, indices, values
        order = np.arange(len(indptr) - 1, dtype=np.int32) if ordered else None
        self._library = load_mkl()
        self.threads = self.threads_now
        self._order = order
        self.memory = np.zeros(64, dtype=np.int64)
        self.iparm = np.zeros(64, dtype=np.int32)
        self.iparm[0] = 1  # use no defaults
        self.iparm[1] = _OPTIONS.minimum_degree if sequential else _OPTIONS.parallel_dissection
        self.iparm[4] = ordered
        # No iterative refinement: zero disables it for Cholesky (a negative count refines in extended precision).
        self.iparm[7] = 0
        # The plain algorithm factors more slowly and takes four times as long for two right-hand sides. The classic
        # two-level algorithm reports negative pivots but requires METIS's ordering. The improved one accepts any
        # ordering. On several threads it may crash at a negative pivot if the elimination order is a chain, as for a
        # mesh numbered row by row (MKL 2026.2). This did not happen in 1,000 indefinite matrices ordered by dissection.
        self.improved = sequential or ordered
        self.iparm[23] = _OPTIONS.improved_two_level if self.improved else _OPTIONS.classic_two_level
        self.iparm[34] = 1  # indices count from zero

        self._phase = ctypes.c_int(0)
        self._columns = ctypes.c_int(1)
        self._error = ctypes.c_int(0)
        constant = [ctypes.byref(ctypes.c_int(value)) for value in (1, 1, 2)]  # factors, which, positive definite
        self.arguments = (
            _address(self.memory),
            *constant,
            ctypes.byref(self._phase),
            ctypes.byref(ctypes.c_int(len(indptr) - 1)),
            _address(values),
            _address(indptr),
            _address(indices),
            _address(order),
            ctypes.byref(self._columns),
            _address(self.iparm),
            ctypes.byref(ctypes.c_int(0)),  # print nothing
        )

    @property
    def threads_now(self) -> int:
        """Number of threads that the environment, threadpoolctl or MKL currently allows."""
        return 1 if self.sequential else min(int(self._library.MKL_Get_Max_Threads()), _largest_team())

    def check(self, phase: int, b: FloatArray | None = None, x: FloatArray | None = None) -> None:
        """Run one phase and turn its error code into an exception."""
        code = self.call(phase, b, x)
        # Positive codes are not documented; they occur when a pivot is negative.
        if code in _NOT_POSITIVE_DEFINITE or (code > 0 and phase == _PHASES.factor):
            raise NotPositiveDefinite("the matrix is not positive definite: PARDISO found a pivot that is not positive")
        if code:
            text = f"MKL PARDISO failed in phase {phase} with error {code}: {_ERRORS.get(code, 'unknown error')}"
            raise MemoryError(text) if code in _OUT_OF_MEMORY else RuntimeError(text)

    def release(self) -> None:
        """Release the memory of PARDISO."""
        self.call(_PHASES.release, None, None)

    def call(self, phase: int, b: FloatArray | None, x: FloatArray | None) -> int:
        self._phase.value = phase
        self._columns.value = 1 if b is None else b.shape[1]
        self._error.value = 0
        # The setting is local to the calling thread and overrides the environment's; zero removes it.
        before = self._library.MKL_Set_Num_Threads_Local(self.threads)
        try:
            self._library.pardiso(*self.arguments, _address(b), _address(x), ctypes.byref(self._error))
        finally:
            self._library.MKL_Set_Num_Threads_Local(before)
        return self._error.value


def _address(array: FloatArray | Pattern | np.ndarray[tuple[int, ...], np.dtype[np.int64]] | None) -> ctypes.c_void_p:
    return ctypes.c_void_p(None if array is None else array.ctypes.data)


# Environment variables by which OpenMP gives fewer threads than requested; MKL ignores them.
_TEAM_LIMITS = "OMP_THREAD_LIMIT", "KMP_DEVICE_THREAD_LIMIT", "KMP_ALL_THREADS"
_NO = "", "0", "false", ".false.", "f", ".f.", "no", "n", "off", "disabled"


@cache
def _largest_team() -> int:
    """Number of threads that OpenMP is certain to give. With fewer than requested PARDISO hangs (MKL 2026.2).

    The environment is read once, as OpenMP does.
    """
    if os.environ.get("OMP_DYNAMIC", "").strip().lower() not in _NO:
        return 1
    if os.environ.get("OMP_MAX_ACTIVE_LEVELS", "").strip() == "0":
        return 1
    return max(1, read_limit(_TEAM_LIMITS))


@cache
def load_mkl() -> ctypes.CDLL:
    """Load MKL's runtime library once; raise ImportError if no suitable library is found."""
    path = find_mkl()
    if path is None:
        raise ImportError("MKL's runtime library mkl_rt was not found; install it with: pip install mkl")
    try:
        library = ctypes.CDLL(path)
        layer = library.MKL_Set_Interface_Layer(0)
    except (OSError, AttributeError) as error:
        raise ImportError(f"cannot load MKL's runtime library {path}: {error}") from error
    # The environment or another package may have switched MKL to 64-bit integers for the whole process.
    if layer & 1:
        raise ImportError(
            "MKL uses 64-bit integers (ILP64) in this process, but this package needs 32-bit integers: set "
            "MKL_INTERFACE_LAYER=LP64, or choose another linear solver"
        )
    # By default MKL uses GNU threads if another package, such as gmsh, has loaded them, and PARDISO then crashes.
    library.MKL_Set_Threading_Layer(_OPTIONS.intel_threads)
    library.pardiso.restype = None
    return library


@cache
def find_mkl() -> str | None:
    """Path of MKL's runtime library, or None."""
    if ctypes.sizeof(ctypes.c_void_p) != 8 or platform.machine().lower() not in ("x86_64", "amd64"):
        return None
    return next(candidates(), None)


def candidates() -> Iterator[str]:
    """Yield candidate paths of MKL's runtime library, likeliest first, newer versions before older ones."""
    for prefix in (sys.prefix, site.getuserbase()):
        found = [
            path
            for folder in ("lib", "Library/bin")
            for path in Path(prefix, folder).glob("*mkl_rt*")
            if _is_runtime_library(path)
        ]
        yield from map(str, sorted(found, key=_version, reverse=True))
    # Environments that use the packages of another environment.
    from importlib.metadata import PackageNotFoundError, files

    try:
        found = [Path(str(file.locate())) for file in files("mkl") or () if _is_runtime_library(Path(file.name))]
        yield from map(str, sorted((path for path in found if path.exists()), key=_version, reverse=True))
    except PackageNotFoundError:
        pass
    from ctypes.util import find_library

    for name in ("mkl_rt", "mkl_rt.3", "mkl_rt.2", "mkl_rt.1"):
        if path := find_library(name):
            yield path


def _is_runtime_library(path: Path) -> bool:
    """Whether the file name is that of a runtime library: libmkl_rt.so.3, libmkl_rt.2.dylib or mkl_rt.3.dll."""
    return re.fullmatch(r"(lib)?mkl_rt(\.\d+)?\.(so(\.\d+)*|dylib|dll)", path.name) is not None


def _version(path: Path) -> int:
    numbers = re.findall(r"\d+", path.name)
    return int(numbers[0]) if numbers else 0
