"""Problems solved by the workers of a Dask cluster, each in a process that the worker keeps for that."""

from __future__ import annotations

import threading
import time
from collections.abc import Generator, Iterator
from queue import Empty, SimpleQueue
from typing import Any

from quasiharmonic.ui.batch.problems import MARKER, ProblemFiles
from quasiharmonic.ui.batch.settings import Orders
from quasiharmonic.ui.batch.supervisor import Finished, Supervisor, lost

# Problems given out for every thread of the cluster: enough that none waits for the next, few to be lost with a driver.
_AHEAD = 3
_TICK = 0.2
# Seconds between two looks at how large the cluster is, which may change.
_LOOK = 2.0

_GONE = "the Dask scheduler ended or dropped a problem; finished results are kept: run the same call again to continue"

_mine = threading.local()


def on_cluster(todo: Iterator[ProblemFiles], orders: Orders, scheduler: Any) -> Generator[Finished | None]:
    """Solve problems on a cluster; yields None now and then while nothing is finished.

    A problem whose worker is lost goes to another one. What has been on so many lost workers that the scheduler gives
    it up (``distributed.scheduler.allowed-failures``) is tried once more by itself when all else is done; if workers
    die of it again, it is recorded as a crash.

    Parameters
    ----------
    todo : iterator of ProblemFiles
    orders : Orders
    scheduler : str, distributed.Client or cluster
        Address of the scheduler, or a client or a cluster of it.

    Raises
    ------
    ImportError
        When ``distributed`` is not installed.
    ValueError
        When an address is none.
    ConnectionError
        When the scheduler is not there or not there any more.
    OutputError, WorkerError
        As a `Supervisor` on a worker raised it.
    """
    try:
        from distributed import Client
        from distributed.comm import resolve_address
    except ImportError as error:
        raise ImportError("a Dask cluster needs distributed: pip install 'quasiharmonic[dask]'") from error
    if isinstance(scheduler, Client):
        yield from _through(scheduler, todo, orders)
        return
    try:
        if isinstance(scheduler, str):
            # A client that is given a wrong one hangs for a minute when it is disposed of.
            resolve_address(scheduler)
        client = Client(scheduler, set_as_default=False)
    except ValueError as error:
        wanted = "the address of a Dask scheduler, such as tcp://HOST:8786"
        raise ValueError(f"{scheduler!r} is not {wanted}: {error}") from error
    except (OSError, TimeoutError) as error:
        raise ConnectionError(f"there is no Dask scheduler at {scheduler}: {error}") from error
    with client:
        yield from _through(client, todo, orders)


def _through(client: Any, todo: Iterator[ProblemFiles], orders: Orders) -> Generator[Finished | None]:
    from distributed.scheduler import KilledWorker

    pending: dict[str, tuple[ProblemFiles, Any]] = {}
    ended: SimpleQueue[str] = SimpleQueue()
    suspects: list[ProblemFiles] = []
    alone = None

    def submit(files: ProblemFiles) -> None:
        future = client.submit(attend, files, orders, pure=False)
        pending[future.key] = (files, future)
        future.add_done_callback(lambda done: ended.put(done.key))

    room, looked = 0, -_LOOK
    try:
        while True:
            if time.monotonic() - looked > _LOOK:
                room, looked = _AHEAD * max(sum(client.nthreads().values()), 1), time.monotonic()
            while len(pending) < room and (files := next(todo, None)) is not None:
                submit(files)
            if not pending:
                if not suspects:
                    return
                alone = suspects.pop()
                submit(alone)
            try:
                key = ended.get(timeout=_TICK)
            except Empty:
                if client.status != "running":
                    raise ConnectionError(_GONE) from None
                yield None
                continue
            files, future = pending.pop(key)
            if future.status == "finished":
                result = future.result()
                if isinstance(result, Exception):
                    raise result
                yield result
            elif future.status != "error":
                raise ConnectionError(_GONE)
            elif not isinstance(error := future.exception(), KilledWorker):
                raise error
            elif files is alone:
                yield lost(files, orders, f"the cluster's workers that it was given to died: {error}")
            else:
                # Several workers have died while they had this problem, and others. Which one was it?
                suspects.append(files)
    finally:
        # Those that run go on to their end; the others are not started.
        client.cancel([future for _, future in pending.values()])


def attend(files: ProblemFiles, orders: Orders) -> Finished | Exception:
    """Solve a problem on a worker of the cluster; what must end the run is returned, for it may be hard to raise there.

    An exception that is raised travels with its traceback, and is not heard of any more if that cannot be pickled.
    """
    if not (orders.output / MARKER).exists():
        return OSError(
            f"a worker of the cluster cannot see {orders.output}: data set and output must lie on "
            f"a file system that all "
            "machines share, under the same paths"
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
