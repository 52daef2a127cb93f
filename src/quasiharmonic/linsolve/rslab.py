"""rslab, a supernodal LDLᵀ factorisation in Rust with wheels for every platform: for large systems where MKL is not.

It is young, so it is never alone. What it fails at in any other way than by finding the matrix indefinite, an error of
its own or a solution whose residual is wrong, is done again by QDLDL, or by SuperLU where that is not installed either.

It is loaded by a thread of its own that never ends. rslab 1.7 brings an allocator, mimalloc 3.3, that keeps the heap of
the thread that loads it under that thread's identifier, and frees the heap, but not the identifier, when the thread
ends. The system gives the identifier to a later thread, which then takes the heap that is gone, and the process crashes
(microsoft/mimalloc#1287; on Linux and macOS). An identifier that stays in use is given to no other thread.
"""

from __future__ import annotations

import os
import sys
import threading
from collections.abc import Callable
from concurrent.futures import Future
from functools import cache
from importlib.util import find_spec
from typing import Any, TypeVar

import numpy as np

from quasiharmonic.linsolve.base import LinearSolver
from quasiharmonic.linsolve.errors import NotPositiveDefinite
from quasiharmonic.linsolve.qdldl import Qdldl
from quasiharmonic.linsolve.superlu import SuperLU
from quasiharmonic.util.arrays import FloatArray

# Minimum fill. Left to itself rslab tries several orders. Its nested dissection takes five times as long to analyse
# (300,000 unknowns: 3.3 s against 0.3 to 0.6) for a factor that is never twice as quick. It takes no order of ours.
_ORDERING = "amf"
# Supernodes of fewer columns are merged: half of rslab's own number, up to a tenth off factor and solve of large ones.
_NEMIN = 8
# Below this many unknowns there is nothing to do in parallel, and from this many threads on no more is gained.
SEQUENTIAL_BELOW, _MOST_THREADS = 30_000, 4
# What limits the threads of other libraries limits rslab's in factoring, where it is told a number. Its solves, a tenth
# of the time, take what RAYON_NUM_THREADS allows, whatever they are told (1.7).
_LIMITS = "OMP_NUM_THREADS", "RAYON_NUM_THREADS"
# What rslab says of a pivot that is zero, by an exception of no class of its own.
_SINGULAR = "rank-deficient"

_Made = TypeVar("_Made")
# The process that rslab has worked in first. After a fork it waits for ever for threads that are not there (1.7).
_home: list[int] = []
# The thread that loads rslab, and what it loads: one entry at most. A forked process looks at neither, see `_home`.
_LOADER = "quasiharmonic: loads rslab"
_loading: list[Future[Any]] = []
_lock = threading.Lock()


class Rslab(LinearSolver):
    """LDLᵀ with a minimum fill ordering, multi-threaded for large matrices, the same in every bit on any number."""

    name = "rslab"
    requirement = "pip install rslab"
    takes_order = False

    @classmethod
    @cache
    def present(cls) -> bool:
        """Whether the package rslab is installed."""
        return find_spec("rslab") is not None

    def _analyse(self) -> None:
        from scipy.sparse import csc_matrix

        # The upper triangle by rows is the lower triangle by columns, which is what rslab reads.
        pattern = csc_matrix((np.ones(self.nnz), self._indices, self._indptr), shape=(self.n, self.n))
        threads = 1 if self.n < SEQUENTIAL_BELOW else _threads()
        self._symbolic: Any = self._tried(
            lambda: library().analyze(pattern, path="ldlt", ordering=_ORDERING, nemin=_NEMIN, threads=threads)
        )
        self._numeric: Any = None
        self._second: LinearSolver | None = None

    def _factor(self) -> None:
        self._numeric = None  # its memory may serve for the next
        self._numeric = self._tried(lambda: self._symbolic.factor(self._values)) if self._symbolic else None
        if self._numeric is None:
            self._factor_by_another()
        elif self._numeric.inertia != (self.n, 0, 0):
            raise NotPositiveDefinite("the matrix is not positive definite: rslab found a pivot that is not positive")

    def _solve(self, b: FloatArray) -> FloatArray:
        if self._numeric is not None:
            x = self._tried(
                lambda: self._numeric.solve_many(b) if b.shape[1] > 1 else self._numeric.solve(b[:, 0])[:, None]
            )
            if x is not None:
                return np.asfortranarray(x)
            self._factor_by_another()
        assert self._second is not None
        return np.asfortranarray(self._second.solve(b))

    def _examine(self, b: FloatArray, x: FloatArray) -> FloatArray:
        try:
            return super()._examine(b, x)
        except NotPositiveDefinite:
            if self._numeric is None:
                raise
        self._factor_by_another()
        return super()._examine(b, self._solve(b))

    def _release(self) -> None:
        self._symbolic = self._numeric = None
        if self._second is not None:
            self._second.close()

    def _factor_by_another(self) -> None:
        """Factor the matrix at hand by the backend that stands in for this one."""
        self._numeric = None
        if self._second is None:
            other = Qdldl if Qdldl.present() else SuperLU
            self._second = other(self._indptr, self._indices)
        self._second.factor(self._values)

    def _tried(self, step: Callable[[], _Made]) -> _Made | None:
        """What a step of rslab's comes to; None where it fails for no reason that lies in the matrix."""
        if not _home:
            _home.append(os.getpid())
        if os.getpid() != _home[0]:
            return None
        try:
            return step()
        except RuntimeError as error:
            if _SINGULAR in str(error):
                raise NotPositiveDefinite(
                    "the matrix is not positive definite: rslab found a pivot that is zero"
                ) from None
        except BaseException as error:
            # A panic, as Rust calls an assertion that does not hold. Its class cannot be imported.
            if type(error).__name__ != "PanicException":
                raise
        return None


def library() -> Any:
    """The package rslab, loaded by a thread that lives as long as the process.

    Raises
    ------
    ImportError
        It cannot be loaded, or something else has loaded it before, perhaps in a thread that has ended.
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
    threading.Thread(target=_import_and_stay, args=(loaded,), name=_LOADER, daemon=True).start()
    return loaded


def _import_and_stay(loaded: Future[Any]) -> None:
    """Import rslab, and never end."""
    try:
        import rslab

        loaded.set_result(rslab)
    except BaseException as error:
        loaded.set_exception(error)
    threading.Event().wait()


def _threads() -> int:
    """How many threads the machine and the environment allow, and are of use."""
    given = [os.environ.get(name, "").strip() for name in _LIMITS]
    here = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    return max(1, min(_MOST_THREADS, here, *(int(text) for text in given if text.isdecimal())))
