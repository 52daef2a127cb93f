"""Pools of threads, also where threads cannot be started (Pyodide, Python in a browser), and input for a thread."""

from __future__ import annotations

import os
import sys
from collections.abc import Callable, Iterable
from concurrent.futures import Executor, Future, ThreadPoolExecutor
from typing import Any, BinaryIO, TypeVar

T = TypeVar("T")
#: Whether threads can be started.
HAS_THREADS = sys.platform not in ("emscripten", "wasi")


def count_cores() -> int:
    """Number of cores that this process may use; 1 if threads cannot be started."""
    if not HAS_THREADS:
        return 1
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1


def read_limit(names: Iterable[str]) -> int:
    """Smallest number of threads that one of some environment variables allows; very large if none does."""
    given = (os.environ.get(name, "").strip() for name in names)
    return min((int(text) for text in given if text.isdecimal()), default=sys.maxsize)


def make_executor(jobs: int, name: str) -> Executor:
    """Return a pool of threads, or without threads an executor that calls functions when they are submitted."""
    return ThreadPoolExecutor(jobs, thread_name_prefix=name) if HAS_THREADS else _Immediate()


class _Immediate(Executor):
    """Executor that calls each function at once, in the caller's thread."""

    def submit(self, fn: Callable[..., T], /, *args: Any, **kwargs: Any) -> Future[T]:
        future = Future[T]()
        try:
            future.set_result(fn(*args, **kwargs))
        except Exception as error:
            future.set_exception(error)
        return future


def detach_input() -> BinaryIO:
    """Return the process's standard input as a binary file, and leave the null device in its place.

    A thread may then read the file while other threads work: on Windows, a library's start-up code waits for standard
    input while a thread reads it, and the interpreter cannot close `sys.stdin` at exit.
    """
    source = os.fdopen(os.dup(0), "rb")
    with open(os.devnull, "rb") as nothing:
        os.dup2(nothing.fileno(), 0)
    return source
