"""Solve problems on the workers of a Dask cluster, each in a separate process that the worker reuses."""

from __future__ import annotations

import threading
import time
from collections.abc import Generator, Iterator
from queue import Empty, SimpleQueue
from typing import Any

from quasiharmonic.ui.batch.problems import MARKER, ProblemFiles
from quasiharmonic.ui.batch.settings import Orders
from quasiharmonic.ui.batch.supervisor import Finished, Supervisor, record_crash
from quasiharmonic.util.hints import explain_missing

# Problems submitted per thread of the cluster: enough to keep threads busy, few to lose if the driver dies.
_PER_THREAD = 3
_POLL_INTERVAL = 0.2
# Seconds between two queries of the cluster's size, which may change.
_SIZE_INTERVAL = 2.0

_CONNECTION_LOST = (
    "the Dask scheduler ended or dropped a problem; finished results are kept: run the same call again to continue"
)

_mine = threading.local()


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
