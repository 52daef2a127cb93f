"""Run all problems of a data set on this machine's cores or on a Dask cluster."""

from __future__ import annotations

import json
import os
import threading
import time
from collections.abc import Callable, Generator, Iterator
from contextlib import closing
from dataclasses import dataclass, field, replace
from pathlib import Path
from queue import Empty, SimpleQueue
from typing import Any

from quasiharmonic import __version__
from quasiharmonic.io.errors import OutputError, check_path
from quasiharmonic.io.lowlevel.atomic import new_folder, remove_file, write_whole
from quasiharmonic.ui.batch import records
from quasiharmonic.ui.batch.lock import FILE as LOCK
from quasiharmonic.ui.batch.lock import lock_folder
from quasiharmonic.ui.batch.problems import MARKER, ProblemFiles, find_problems, group_small
from quasiharmonic.ui.batch.settings import Orders, Settings
from quasiharmonic.ui.batch.supervisor import ClosedError, Finished, Supervisor, resident
from quasiharmonic.util.arrays import check_bool, check_callback, check_instance, check_integer, check_positive

# Seconds between two calls of a callback while nothing is finished.
_POLL_INTERVAL = 0.2


@dataclass
class Progress:
    """Progress of a run.

    Attributes
    ----------
    total : int
        Number of problems in the data set.
    outcomes : dict of str to int
        Number of finished problems per outcome; see `quasiharmonic.ui.batch.records.OUTCOMES`.
    resumed : int
        Number of finished problems that an earlier run had finished.
    seconds : float
        Wall time since the start of the run.
    """

    total: int
    outcomes: dict[str, int] = field(default_factory=dict)
    resumed: int = 0
    seconds: float = 0.0

    @property
    def done(self) -> int:
        """Number of problems with a record."""
        return sum(self.outcomes.values())

    @property
    def solved(self) -> int:
        """Number of problems with a map certified as requested."""
        return sum(self.outcomes.get(outcome, 0) for outcome in records.SOLVED)

    @property
    def failed(self) -> int:
        """Number of finished problems without a certified map."""
        return self.done - self.solved

    @property
    def rate(self) -> float:
        """Problems per second, without those of earlier runs."""
        return (self.done - self.resumed) / self.seconds if self.seconds > 0 else 0.0

    @property
    def seconds_left(self) -> float | None:
        """Estimated seconds until the end at the present rate; None if the rate is 0."""
        return (self.total - self.done) / self.rate if self.rate > 0 else None


def run(
    source: str | os.PathLike[str],
    output: str | os.PathLike[str],
    settings: Settings | None = None,
    *,
    jobs: int | None = None,
    threads: int = 1,
    time_limit: float | None = 600.0,
    memory_limit: int | None = None,
    retry: bool = False,
    table: str = "csv",
    scheduler: Any = None,
    callback: Callable[[Progress], object] | None = None,
) -> Progress:
    """Solve every problem of a data set in separate processes; a failure does not affect other problems.

    Every problem gets a folder in ``output/results`` with its map, ``map.obj``, and its record, ``record.json``. Both
    are written completely when the problem is finished. The same call resumes an interrupted run: a problem is skipped
    if its record has the same input and settings. At the end all records are collected in ``output/records.csv`` or
    ``.parquet``.

    Parameters
    ----------
    source : path
        As for `quasiharmonic.batch.find_problems`: a folder with problems at any depth, or a list.
    output : path
        The run's folder; created if necessary.
    settings : Settings, optional
        How problems are solved.
    jobs : int, optional
        Number of problems solved at a time, each in its own process; one per core by default. Not with a scheduler.
    threads : int
        Threads of the linear solver in each process.
    time_limit : float or None
        Seconds of wall time per problem, including reading and writing. A process that takes longer is killed, and the
        problem is recorded.
    memory_limit : int or None
        Bytes of resident memory per process. A process that uses more is killed, and the problem is recorded.
    retry : bool
        Try problems again that an earlier run recorded as an error, a crash, or over a limit. Problems over a lower
        limit than the present one are always tried again.
    table : {"csv", "parquet"}
        Format of the table of records.
    scheduler : str, distributed.Client or cluster, optional
        Address of a Dask scheduler, or a client or cluster. Its workers solve as many problems at a time as they have
        threads. They must see ``source`` and ``output`` under the same paths.
    callback : callable, optional
        Called with the `Progress` whenever a problem is finished, and a few times per second.

    Returns
    -------
    Progress
        Final counts.

    Raises
    ------
    ValueError
        If there are no problems, some lie in ``output``, or an argument is invalid.
    OutputError
        If results cannot be written, for example on a full disk, or another run is writing to ``output``. Finished
        results are kept.
    ImportError
        If a requested package is not installed.
    WorkerError
        If processes cannot be started.
    """
    check_callback(callback)
    check_path("source", source)
    check_path("output", output)
    check_bool("retry", retry)
    settings = Settings() if settings is None else settings
    check_instance("settings", settings, Settings)
    settings = _check_files(settings)
    _check(jobs, threads, time_limit, memory_limit, scheduler)
    folder = Path(os.path.abspath(output))
    table_path = folder / f"records.{table}"
    records.check_table(table_path)
    began = time.perf_counter()
    # The problems are enumerated twice, for counting and for solving, so that memory does not grow with their number.
    progress = Progress(_count(source, settings, folder))
    _check_folder(folder)
    with new_folder(folder, leftovers=frozenset({LOCK})), lock_folder(folder):
        _prepare(folder, source, settings)
        orders = Orders(folder, settings, threads, time_limit, memory_limit, retry)
        todo = find_problems(source, plain=settings.plain)
        if scheduler is None:
            finished = _local(todo, orders, min(jobs or _cores(), progress.total))
        else:
            from quasiharmonic.ui.batch.cluster import on_cluster

            finished = on_cluster(todo, orders, scheduler)
        with closing(finished):
            for item in finished:
                progress.seconds = time.perf_counter() - began
                if item is not None:
                    progress.outcomes[item.outcome] = progress.outcomes.get(item.outcome, 0) + 1
                    progress.resumed += item.resumed
                if callback is not None:
                    callback(progress)
        records.write_table(table_path, _records(source, orders))
    return progress


def _check_files(settings: Settings) -> Settings:
    """Read the outline and the corners as a check; return the settings with absolute paths of files."""
    if settings.to is None:
        return settings
    from quasiharmonic.targets import outline
    from quasiharmonic.targets.boundary.corner_spec import read_corners

    outline(settings.to, font=settings.font)
    if settings.corners is not None:
        read_corners(settings.corners)
    return replace(
        settings,
        to=_anywhere(settings.to),
        font=_anywhere(settings.font),
        corners=_anywhere(settings.corners),
        pieces=_anywhere(settings.pieces),
    )


def _anywhere(name: str | None) -> str | None:
    """Return the absolute path if the name is that of a file, else the name."""
    return os.path.abspath(name) if name is not None and os.path.isfile(name) else name


def _check(jobs: int | None, threads: int, time_limit: float | None, memory_limit: int | None, scheduler: Any) -> None:
    if scheduler is not None and jobs is not None:
        raise ValueError("jobs applies only to processes on this machine, not to a Dask cluster: omit one of them")
    if jobs is not None:
        check_integer("jobs", jobs, minimum=1)
    check_integer("threads", threads, minimum=1)
    if time_limit is not None:
        check_positive(time_limit=time_limit)
    if memory_limit is not None:
        check_positive(memory_limit=memory_limit)
    if memory_limit is not None and scheduler is None and resident(os.getpid()) is None:
        raise ValueError("a limit of memory needs psutil on this system: pip install 'quasiharmonic[batch]'")


def _count(source: str | os.PathLike[str], settings: Settings, folder: Path) -> int:
    """Return the number of problems; raise ValueError if there are none or if one lies in the output folder."""
    count, inside = 0, folder.is_relative_to(os.path.abspath(source))
    for files in find_problems(source, plain=settings.plain):
        if inside and files.mesh.is_relative_to(folder):
            raise ValueError(f"{folder} contains a problem, {files.mesh}: choose another folder for the results")
        count += 1
    if not count:
        raise ValueError(
            f"there are no problems in {source}: a problem is a folder with input.obj and handles.txt"
            + ("" if settings.plain else "; for plain meshes, give an outline or flatten them")
        )
    return count


def _check_folder(folder: Path) -> None:
    """Raise OutputError if the path exists but is not a run's folder."""
    if os.path.lexists(folder) and not folder.is_dir():
        raise OutputError(f"cannot write to {folder}: it is not a folder")
    try:
        tables = [name for name in records.TABLES if (folder / name).exists()]
    except OSError as error:
        raise OutputError(f"cannot write to {folder}: {error.strerror or error}") from error
    if tables and not (folder / MARKER).exists():
        raise OutputError(f"{folder} has a {tables[0]} that belongs to no run: choose another folder for the results")


def _prepare(folder: Path, source: str | os.PathLike[str], settings: Settings) -> None:
    """Write the marker file with source, settings and version into the run's folder, and delete old tables."""
    try:
        for name in records.TABLES:
            # The table of the last run must not be taken for that of this run.
            remove_file(folder / name)
    except OSError as error:
        raise OutputError(f"cannot write to {folder}: {error.strerror or error}") from error
    about = {"source": os.path.abspath(source), "settings": settings.to_dict(), "version": __version__}
    write_whole(folder / MARKER, json.dumps(about, indent=2).encode() + b"\n")


def _records(source: str | os.PathLike[str], orders: Orders) -> Iterator[records.Record]:
    for files in find_problems(source, plain=orders.settings.plain):
        record = records.read_record(orders.folder(files.name))
        if record is not None:
            yield record


def _cores() -> int:
    """Return the number of cores that this process may use."""
    try:
        return len(os.sched_getaffinity(0))
    except AttributeError:
        return os.cpu_count() or 1


def _local(todo: Iterator[ProblemFiles], orders: Orders, jobs: int) -> Generator[Finished | None]:
    """Solve problems in processes of this machine; yield None regularly while no problem is finished."""
    supervisors = [Supervisor(orders) for _ in range(jobs)]
    groups = group_small(todo) if orders.settings.together else ([files] for files in todo)
    lock, finished = threading.Lock(), SimpleQueue[Finished | BaseException | None]()

    def attend(supervisor: Supervisor) -> None:
        try:
            while True:
                with lock:
                    group = next(groups, None)
                if group is None:
                    break
                for item in supervisor.attend_all(group):
                    finished.put(item)
        except ClosedError:
            pass
        except BaseException as error:
            finished.put(error)
        finished.put(None)

    threads = [threading.Thread(target=attend, args=(supervisor,), daemon=True) for supervisor in supervisors]
    for thread in threads:
        thread.start()
    working = jobs
    try:
        while working:
            try:
                item = finished.get(timeout=_POLL_INTERVAL)
            except Empty:
                yield None
                continue
            if isinstance(item, BaseException):
                raise item
            if item is None:
                working -= 1
            else:
                yield item
    finally:
        for supervisor in supervisors:
            supervisor.close()
        for thread in threads:
            thread.join()
