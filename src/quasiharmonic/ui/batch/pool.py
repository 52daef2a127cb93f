"""Solve problems in processes of this machine.

Fewer worker processes run at a time after one of them lacked memory, more again after some time.
"""

from __future__ import annotations

import threading
from collections import deque
from collections.abc import Callable, Generator, Iterator
from contextlib import contextmanager
from queue import Empty, SimpleQueue

from quasiharmonic.ui.batch.problems import ProblemFiles
from quasiharmonic.ui.batch.settings import Orders
from quasiharmonic.ui.batch.supervisor import ClosedError, Finished, Supervisor

# Number of groups of problems that must succeed before another worker process may run.
_STEADY = 20
# Seconds between two values None while nothing is finished.
_POLL_INTERVAL = 0.2
# From this number of problems that wait to be solved alone, they are solved before the end of the data set.
_MANY_STARVED = 16


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
    reserved : bool
        Whether a block of `alone` runs or waits. No slot is free then.
    """

    def __init__(self, count: int) -> None:
        self.limit = count
        self._count = count
        self.reserved = False
        self._busy = 0  # Number of occupied slots
        self._steady = 0  # Successes since the limit changed, or a process lacked memory
        self._closed = False
        self._changed = threading.Condition()  # guards the above, and signals that a slot may be free
        self._one_alone = threading.Lock()  # held by the only block of `alone` that runs

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


def solve_in_processes(groups: Iterator[list[ProblemFiles]], orders: Orders, jobs: int) -> Generator[Finished | None]:
    """Solve problems, several at a time; yield None regularly while no problem is finished.

    The problems of a group may be solved together. A problem whose process ran out of memory is solved again in a new
    process while no other is solved; only the result of that is yielded.
    """
    workers = _WorkerPool(groups, orders, jobs)
    try:
        yield from workers.finished()
    finally:
        workers.close()


class _WorkerPool:
    """Threads that each supervise one process."""

    def __init__(self, groups: Iterator[list[ProblemFiles]], orders: Orders, jobs: int) -> None:
        self._groups = groups
        self._lock = threading.Lock()  # of the groups, whose iterator must not run in two threads
        self._slots = Slots(jobs)
        self._starved: deque[ProblemFiles] = deque()
        self._answers = SimpleQueue[Finished | BaseException | None]()
        self._supervisors = [Supervisor(orders) for _ in range(jobs)]
        self._threads = [threading.Thread(target=self._work, args=(one,), daemon=True) for one in self._supervisors]
        for thread in self._threads:
            thread.start()

    def finished(self) -> Iterator[Finished | None]:
        """Yield finished problems until all threads have ended; raise the first error of a thread."""
        working = len(self._threads)
        while working:
            try:
                item = self._answers.get(timeout=_POLL_INTERVAL)
            except Empty:
                yield None
                continue
            if isinstance(item, BaseException):
                raise item
            if item is None:
                working -= 1
            else:
                yield item

    def close(self) -> None:
        """End all processes and threads."""
        for supervisor in self._supervisors:
            supervisor.close()
        self._slots.close()
        for thread in self._threads:
            thread.join()

    def _work(self, supervisor: Supervisor) -> None:
        try:
            while (group := self._next()) is not None:
                self._solve(supervisor, group)
                if len(self._starved) >= _MANY_STARVED:
                    self._solve_alone(supervisor)
            supervisor.rest()
            self._solve_alone(supervisor)
        except ClosedError:
            pass
        except BaseException as error:
            self._answers.put(error)
        self._answers.put(None)

    def _next(self) -> list[ProblemFiles] | None:
        with self._lock:
            return next(self._groups, None)

    def _solve(self, supervisor: Supervisor, group: list[ProblemFiles]) -> None:
        files = {one.name: one for one in group}
        starved = False
        with self._slots.one(supervisor.rest):
            for item in supervisor.attend_all(group):
                if item.starved:
                    starved = True
                    self._starved.append(files[item.name])
                else:
                    self._answers.put(item)
            self._slots.record(starved=starved)

    def _solve_alone(self, supervisor: Supervisor) -> None:
        """Solve the problems whose processes ran out of memory, while all other processes are ended or idle."""
        while self._starved:
            with self._slots.alone():
                try:
                    files = self._starved.popleft()
                except IndexError:
                    return
                self._answers.put(supervisor.attend(files, again=True))
                supervisor.rest()
