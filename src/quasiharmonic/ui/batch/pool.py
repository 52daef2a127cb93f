"""Solve problems in processes of this machine, or on the workers of a Dask cluster.

On this machine, fewer worker processes run at a time after one of them lacked memory, more again after some time. Each
worker of a cluster reuses a separate process.
"""

from __future__ import annotations

import threading
import time
from collections import deque
from collections.abc import Callable, Generator, Iterator
from contextlib import closing, contextmanager
from queue import Empty, SimpleQueue
from typing import Any

from quasiharmonic.ui.batch.problems import MARKER, ProblemFiles
from quasiharmonic.ui.batch.settings import Orders
from quasiharmonic.ui.batch.supervisor import ClosedError, Finished, Supervisor, record_crash
from quasiharmonic.util.hints import explain_missing

# Number of groups of problems that must succeed before another worker process may run.
_STEADY = 20
# Seconds between two values None while nothing is finished.
_POLL_INTERVAL = 0.2
# From this number of problems that wait to be solved alone, they are solved before the end of the data set.
_MANY_STARVED = 16
# Problems submitted per thread of the cluster: enough to keep threads busy, few to lose if the driver dies.
_PER_THREAD = 3
# Seconds between two queries of the cluster's size, which may change.
_SIZE_INTERVAL = 2.0

_CONNECTION_LOST = (
    "the Dask scheduler ended or dropped a problem; finished results are kept: run the same call again to continue"
)

_mine = threading.local()


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
    with closing(_WorkerPool(groups, orders, jobs)) as workers:
        yield from workers.finished()


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


def solve_on_cluster(todo: Iterator[ProblemFiles], orders: Orders, scheduler: Any) -> Generator[Finished | None]:
    """Solve problems on a cluster; yield None regularly while no problem is finished.

    The scheduler is an address, or a client or a cluster. If a worker is lost, its problem goes to another worker. The
    scheduler gives a problem up after several lost workers (``distributed.scheduler.allowed-failures``). Such problems
    are tried once more, one at a time, after all others. If workers die again, the problem is recorded as a crash.
    ImportError if ``distributed`` is not installed, ValueError if the address is malformed, ConnectionError if the
    connection fails, and errors of a `Supervisor` on a worker.
    """
    with explain_missing("a Dask cluster needs distributed", extra="dask"):
        from distributed import Client
        from distributed.comm import resolve_address
    if isinstance(scheduler, Client):
        yield from _solve_on_cluster(scheduler, todo, orders)
        return
    try:
        if isinstance(scheduler, str):
            # A client with a malformed address blocks for a minute when it is closed.
            resolve_address(scheduler)
        client = Client(scheduler, set_as_default=False)
    except ValueError as error:
        wanted = "the address of a Dask scheduler, such as tcp://HOST:8786"
        raise ValueError(f"{scheduler!r} is not {wanted}: {error}") from error
    except (OSError, TimeoutError) as error:
        raise ConnectionError(f"there is no Dask scheduler at {scheduler}: {error}") from error
    with client:
        yield from _solve_on_cluster(client, todo, orders)


def _solve_on_cluster(client: Any, todo: Iterator[ProblemFiles], orders: Orders) -> Generator[Finished | None]:
    from distributed.scheduler import KilledWorker

    pending: dict[str, tuple[ProblemFiles, Any]] = {}
    ended: SimpleQueue[str] = SimpleQueue()
    suspects: list[ProblemFiles] = []
    alone = None

    def submit(files: ProblemFiles) -> None:
        future = client.submit(attend, files, orders, pure=False)
        pending[future.key] = (files, future)
        future.add_done_callback(lambda done: ended.put(done.key))

    free_slots, asked_at = 0, -_SIZE_INTERVAL
    try:
        while True:
            if time.monotonic() - asked_at > _SIZE_INTERVAL:
                free_slots, asked_at = _PER_THREAD * max(sum(client.nthreads().values()), 1), time.monotonic()
            while len(pending) < free_slots and (files := next(todo, None)) is not None:
                submit(files)
            if not pending:
                if not suspects:
                    return
                alone = suspects.pop()
                submit(alone)
            try:
                key = ended.get(timeout=_POLL_INTERVAL)
            except Empty:
                if client.status != "running":
                    raise ConnectionError(_CONNECTION_LOST) from None
                yield None
                continue
            files, future = pending.pop(key)
            if future.status == "finished":
                result = future.result()
                if isinstance(result, Exception):
                    raise result
                yield result
            elif future.status != "error":
                raise ConnectionError(_CONNECTION_LOST)
            elif not isinstance(error := future.exception(), KilledWorker):
                raise error
            elif files is alone:
                yield record_crash(files, orders, f"the cluster's workers that it was given to died: {error}")
            else:
                # Several workers died with this problem, but they had others too. Try it alone later.
                suspects.append(files)
    finally:
        # Running problems continue to their end; the others are not started.
        client.cancel([future for _, future in pending.values()])


def attend(files: ProblemFiles, orders: Orders) -> Finished | Exception:
    """Solve a problem on a worker of the cluster; errors that must end the run are returned, not raised.

    A raised exception is pickled with its traceback. If the traceback cannot be pickled, the exception is lost.
    """
    if not (orders.output / MARKER).exists():
        return OSError(
            f"a worker of the cluster cannot see {orders.output}: data set and output must lie on a file system that "
            "all machines share, under the same paths"
        )
    try:
        supervisor = getattr(_mine, "supervisor", None)
        if supervisor is None or supervisor.orders != orders:
            if supervisor is not None:
                supervisor.close()
            supervisor = _mine.supervisor = Supervisor(orders)
        return supervisor.attend(files)
    except OSError as error:
        return type(error)(str(error))
    except Exception as error:
        return RuntimeError(f"{type(error).__name__} in a worker of the cluster: {error}")
