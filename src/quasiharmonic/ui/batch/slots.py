"""How many worker processes run at a time: fewer after one of them lacked memory, more again after some time."""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager

# Number of groups of problems that must succeed before another worker process may run.
_STEADY = 20


class Slots:
    """Limit of the number of threads that solve problems at a time.

    Parameters
    ----------
    count : int
        Number of threads, the highest limit.

    Attributes
    ----------
    limit : int
        Present limit, from 1 to ``count``.
    """

    def __init__(self, count: int) -> None:
        self.limit = count
        self._count = count
        self._busy = 0
        self.reserved = False
        self._steady = 0
        self._closed = False
        self._changed = threading.Condition()
        self._one_alone = threading.Lock()

    @contextmanager
    def one(self, rest: Callable[[], object]) -> Iterator[None]:
        """Occupy a slot during the block. If none is free, call ``rest`` once, to release memory, and wait."""
        with self._changed:
            if not self._is_free():
                rest()
            self._changed.wait_for(self._is_free)
            self._busy += 1
        try:
            yield
        finally:
            with self._changed:
                self._busy -= 1
                self._changed.notify_all()

    @contextmanager
    def alone(self) -> Iterator[None]:
        """Run the block, which must not occupy a slot, while no slot is occupied."""
        with self._one_alone:
            with self._changed:
                self.reserved = True
                self._changed.wait_for(lambda: not self._busy or self._closed)
            try:
                yield
            finally:
                with self._changed:
                    self.reserved = False
                    self._changed.notify_all()

    def _is_free(self) -> bool:
        return self._closed or (not self.reserved and self._busy < self.limit)

    def record(self, *, starved: bool) -> None:
        """Halve the limit if a process lacked memory; otherwise raise it by one after some successes."""
        with self._changed:
            self._steady = 0 if starved else self._steady + 1
            if starved:
                self.limit = max(self.limit // 2, 1)
            elif self._steady >= _STEADY and self.limit < self._count:
                self.limit += 1
                self._steady = 0
                self._changed.notify_all()

    def close(self) -> None:
        """Let all waiting threads continue."""
        with self._changed:
            self._closed = True
            self._changed.notify_all()
