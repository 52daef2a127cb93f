"""rslab, a supernodal LDLᵀ factorisation in Rust with wheels for every platform; for large systems without MKL.

rslab is a young library, so another solver repeats a failed step: QDLDL, or SuperLU if QDLDL is not installed. A step
fails if rslab reports an error other than an indefinite matrix, or if the residual of its solution is too large.

A separate thread that never ends loads rslab. rslab 1.7 contains the allocator mimalloc 3.3, which stores the heap of
the loading thread under that thread's identifier. When the thread ends, it frees the heap and keeps the identifier. The
system may give the identifier to a later thread, which then uses the freed heap and crashes the process
(microsoft/mimalloc#1287; on Linux and macOS). The identifier of a live thread is not given to another thread.
"""

from __future__ import annotations

import os
import sys
import threading
from collections.abc import Callable
from concurrent.futures import Future
from typing import Any, TypeVar

import numpy as np

from quasiharmonic.linsolve.base import LinearSolver, NotPositiveDefinite
from quasiharmonic.linsolve.packages import Qdldl, SuperLU
from quasiharmonic.util.arrays import FloatArray
from quasiharmonic.util.threads import count_cores, make_executor, read_limit

# Minimum fill. By default rslab tries several orders. Its nested dissection takes five times as long to analyse
# (300,000 unknowns: 3.3 s against 0.3 to 0.6 s), and its factor is less than twice as fast. rslab accepts no given
# order.
_ORDERING = "amf"
#: Number of unknowns below which threads do not help.
SEQUENTIAL_BELOW = 30_000
# Variables that limit the threads of other libraries also limit rslab's.
_LIMITS = "OMP_NUM_THREADS", "RAYON_NUM_THREADS"
# Work from which rslab would divide one solve among threads. It does so less well than one thread for each column, and
# obeys only RAYON_NUM_THREADS (rslab 1.7).
_NEVER = 2**62
# Part of rslab's message for a zero pivot; the exception has no class of its own.
_SINGULAR = "rank-deficient"

_Result = TypeVar("_Result")
# The process in which rslab ran first. After a fork rslab waits forever for threads that do not exist (1.7).
_first_process: list[int] = []
# The thread that loads rslab, and the loaded module: at most one entry. A forked process uses neither.
_LOADER = "quasiharmonic: loads rslab"
_loading: list[Future[Any]] = []
_lock = threading.Lock()


class Rslab(LinearSolver):
    """LDLᵀ with a minimum fill ordering, multi-threaded for large matrices; bitwise equal for any thread count."""

    name = "rslab"
    requirement = "pip install rslab"
    package = "rslab"
    takes_order = False

    def _analyse(self) -> None:
        # Raises an ImportError here if rslab cannot be loaded. The first factorisation analyses, because the Laplacian
        # of a mesh that is searched on a coarse one is often never factored.
        self._try(library)
        self._symbolic: Any = None
        self._numeric: Any = None
        self._fallback: LinearSolver | None = None
        self._is_analysed = False

    def _analyse_late(self) -> bool:
        if self._is_analysed:
            return False
        # Supernodes with fewer columns are merged. Half of rslab's default saves up to a tenth of factor and solve
        # times.
        nemin = 8
        from scipy.sparse import csc_matrix

        # The upper triangle by rows is the lower triangle by columns, which rslab reads.
        pattern = csc_matrix((np.ones(self.nnz), self._indices, self._indptr), shape=(self.n, self.n))
        threads = 1 if self.n < SEQUENTIAL_BELOW else _threads()
        self._symbolic = self._try(
            lambda: library().analyze(
                pattern, path="ldlt", ordering=_ORDERING, nemin=nemin, threads=threads, solve_par_min_work=_NEVER
            )
        )
        self._is_analysed = True
        return True

    def _factor(self) -> None:
        self._numeric = None  # releases memory for the next factor
        self._numeric = self._try(lambda: self._symbolic.factor(self._values)) if self._symbolic else None
        if self._numeric is None:
            self._factor_by_fallback()
        elif self._numeric.inertia != (self.n, 0, 0):
            raise NotPositiveDefinite("the matrix is not positive definite: rslab found a pivot that is not positive")

    def _solve(self, b: FloatArray) -> FloatArray:
        if self._numeric is not None:
            x = self._try(lambda: self._solve_columns(b))
            if x is not None:
                return np.asfortranarray(x)
            self._factor_by_fallback()
        assert self._fallback is not None
        return np.asfortranarray(self._fallback.solve(b))

    def _solve_columns(self, b: FloatArray) -> Any:
        """Solve with rslab's factor, for large systems with a thread for each column."""
        if b.shape[1] == 1:
            return self._numeric.solve(b[:, 0])[:, None]
        if self.n < SEQUENTIAL_BELOW:
            return self._numeric.solve_many(b)
        with make_executor(min(b.shape[1], _threads()), "quasiharmonic: solves") as threads:
            return np.stack([*threads.map(self._numeric.solve, b.T)], axis=1)

    def _check_residual(self, b: FloatArray, x: FloatArray) -> FloatArray:
        try:
            return super()._check_residual(b, x)
        except NotPositiveDefinite:
            if self._numeric is None:
                raise
        self._factor_by_fallback()
        return super()._check_residual(b, self._solve(b))

    def _release(self) -> None:
        self._symbolic = self._numeric = None
        if self._fallback is not None:
            self._fallback.close()

    def _factor_by_fallback(self) -> None:
        """Factor the current matrix with the fallback backend.

        If that fails too, rslab's factor is kept, so that later solves fail in the same way.
        """
        if self._fallback is None:
            other = Qdldl if Qdldl.is_installed() else SuperLU
            self._fallback = other(self._indptr, self._indices)
        self._fallback.factor(self._values)
        self._numeric = None

    def _try(self, step: Callable[[], _Result]) -> _Result | None:
        """Run a step of rslab; return None if it fails for a reason other than the matrix."""
        if not _first_process:
            _first_process.append(os.getpid())
        if os.getpid() != _first_process[0]:
            return None
        try:
            return step()
        except RuntimeError as error:
            if _SINGULAR in str(error):
                raise NotPositiveDefinite(
                    "the matrix is not positive definite: rslab found a pivot that is zero"
                ) from None
        except BaseException as error:
            # Rust panics on a failed assertion. The exception class cannot be imported.
            if type(error).__name__ != "PanicException":
                raise
        return None


def library() -> Any:
    """Return the package rslab, loaded by a thread that lives as long as the process.

    Raises an ImportError if rslab cannot be loaded, or if other code loaded it before, perhaps in a thread that has
    ended.
    """
    with _lock:
        if not _loading:
            _loading.append(_load())
    return _loading[0].result()


def _load() -> Future[Any]:
    """Start the thread that loads rslab."""
    if "rslab" in sys.modules and all(thread.name != _LOADER for thread in threading.enumerate()):
        raise ImportError(
            "rslab was imported by other code before quasiharmonic used it: if the thread that imported it has ended, "
            "a later thread may crash in it. Solve with quasiharmonic before rslab is imported, or with another solver"
        )
    loaded: Future[Any] = Future()
    threading.Thread(target=_import_and_wait, args=(loaded,), name=_LOADER, daemon=True).start()
    return loaded


def _import_and_wait(loaded: Future[Any]) -> None:
    """Import rslab and wait forever."""
    try:
        import rslab

        loaded.set_result(rslab)
    except BaseException as error:
        loaded.set_exception(error)
    threading.Event().wait()


def _threads() -> int:
    """Number of threads that the machine and the environment allow, up to the useful maximum."""
    # More threads bring no gain.
    max_threads = 4
    return max(1, min(max_threads, count_cores(), read_limit(_LIMITS)))
