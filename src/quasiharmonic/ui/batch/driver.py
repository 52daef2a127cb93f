"""Run all problems of a data set on this machine's cores or on a Dask cluster."""

from __future__ import annotations

import json
import os
import time
from collections.abc import Callable, Iterable
from contextlib import ExitStack, closing
from dataclasses import dataclass, field, replace
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

from quasiharmonic import __version__
from quasiharmonic.io.atomic import new_folder, remove_file, write_whole, writing
from quasiharmonic.io.errors import OutputError, check_path
from quasiharmonic.ui.batch import places, records
from quasiharmonic.ui.batch.dataset import DataSet, Stream, scratch_folder
from quasiharmonic.ui.batch.pool import solve_in_processes, solve_on_cluster
from quasiharmonic.ui.batch.problems import MARKER, group_small
from quasiharmonic.ui.batch.readers import FolderReader, Scratch, find_archives
from quasiharmonic.ui.batch.samples import results_name
from quasiharmonic.ui.batch.settings import NAMING_FILES, Orders, Settings
from quasiharmonic.ui.batch.shards import (
    WHOLE,
    Shard,
    lock_folder,
    lock_name,
    marker_name,
    read_shard,
    shard_of,
    table_name,
)
from quasiharmonic.ui.batch.supervisor import Finished, resident
from quasiharmonic.ui.batch.writers import ArchiveWriter, FolderWriter
from quasiharmonic.util.arrays import check_callback, check_instance, check_integer
from quasiharmonic.util.hints import with_extra
from quasiharmonic.util.threads import count_cores


@dataclass
class Progress:
    """Progress of a run.

    Attributes
    ----------
    total : int
        Number of problems in the data set or in the shard.
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
    shard: str | None = None,
    scheduler: Any = None,
    callback: Callable[[Progress], object] | None = None,
) -> Progress:
    """Solve every problem of a data set in separate processes; a failure does not affect other problems.

    If the problems are in archives, their results are in archives of the same names in ``output/results``. Otherwise
    every problem gets a folder in ``output/results`` with its map, ``map.obj`` or ``map.ply``, and its record,
    ``record.json``. Both are written completely when the problem is finished. The same call resumes an interrupted run:
    a problem is skipped if its record has the same input and settings. At the end all records are collected in
    ``output/records.csv`` or ``.parquet``.

    Parameters
    ----------
    source : path
        As for `quasiharmonic.batch.find_problems`: a folder with problems at any depth, or a list. Or archives, which
        are ``.tar``, ``.tar.gz`` and ``.parquet`` files: one of them, a folder without other problems, a list, a name
        with numbers such as ``data-{0000..0015}.tar``, or a URL.
    output : path or URL
        The run's folder; created if necessary. A URL is possible for archives: each archive of results is sent when it
        is finished. Runs with the same URL do not exclude each other.
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
    shard : str, optional
        ``"i/n"``, with i from 1 to n: solve only one of n disjoint shards of the data set, chosen by a hash of the
        problem's name. The table is then ``records-i-of-n.csv``. The n runs may have the same output folder at the same
        time. `quasiharmonic.batch.merge` joins their tables.
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
    settings = Settings() if settings is None else settings
    check_instance("settings", settings, Settings)
    settings = _check_files(settings)
    orders = Orders(Path(os.path.abspath(output)), settings, threads, time_limit, memory_limit, retry)
    _check(jobs, memory_limit, scheduler)
    part = read_shard(shard)
    url = os.fspath(output) if places.is_url(output) else None
    archives = find_archives(source, plain=settings.plain)
    if url is not None and (not archives or scheduler is not None):
        raise ValueError("results are sent to a URL only if the problems are in archives and solved on this machine")
    began = time.perf_counter()
    with ExitStack() as stack:
        if url is not None:
            orders = replace(orders, output=Path(stack.enter_context(TemporaryDirectory())))
        folder = orders.output
        table_path = folder / table_name(part, table)
        records.check_table(table_path)
        reader = FolderReader(source, part)
        count = None if archives else reader.count(orders)
        _check_folder(folder)
        lock = lock_name(part)
        stack.enter_context(new_folder(folder, leftovers=frozenset({lock})))
        stack.enter_context(lock_folder(folder, lock))
        _prepare(folder, source, settings, part)
        streams, scratch = [Stream(reader, FolderWriter(reader, orders))], folder
        if archives:
            names = frozenset(results_name(one.name) for one in archives)
            mine, key = [one for one in archives if part.contains(one.name)], settings.key_of(b"", b"")
            streams = [Stream(one, ArchiveWriter(one, orders, url, names, key)) for one in mine]
            scratch = stack.enter_context(scratch_folder(folder, part, shared=scheduler is not None))
        data = DataSet(streams, orders, Scratch(scratch), count)
        progress = _solve(data, jobs, scheduler, began, callback)
        records.write_table(table_path, data.records())
        if url is not None:
            for path in (folder / MARKER, table_path):
                places.send(path, places.join(url, path.name))
    return progress


def _solve(
    data: DataSet, jobs: int | None, scheduler: Any, began: float, callback: Callable[[Progress], object] | None
) -> Progress:
    """Solve the problems of a data set."""
    progress = Progress(data.total)
    todo = data.problems()
    if scheduler is None:
        groups = group_small(todo) if data.orders.settings.together else ([files] for files in todo)
        jobs = jobs or count_cores()
        # Not more workers than problems, if their number is known.
        finished = solve_in_processes(groups, data.orders, min(jobs, data.total or jobs))
    else:
        finished = solve_on_cluster(todo, data.orders, scheduler)

    def count(some: Iterable[Finished]) -> None:
        for one in some:
            progress.outcomes[one.outcome] = progress.outcomes.get(one.outcome, 0) + 1
            progress.resumed += one.resumed
        progress.total, progress.seconds = data.total, time.perf_counter() - began
        if callback is not None:
            callback(progress)

    with closing(data), closing(finished):
        for item in finished:
            count(data.collect(item))
        count(data.collect(None))
    return progress


def _check_files(settings: Settings) -> Settings:
    """Read the outline and the corners as a check; return the settings with absolute paths of files."""
    if settings.to is None:
        return settings
    from quasiharmonic.targets import outline
    from quasiharmonic.targets.boundary.corner_pins import read_corners

    outline(settings.to, font=settings.font)
    if settings.corners is not None:
        read_corners(settings.corners)
    named = {setting: getattr(settings, setting) for setting in NAMING_FILES}
    paths = {setting: os.path.abspath(name) for setting, name in named.items() if name and os.path.isfile(name)}
    return replace(settings, **paths)


def _check(jobs: int | None, memory_limit: int | None, scheduler: Any) -> None:
    if scheduler is not None and jobs is not None:
        raise ValueError("jobs applies only to processes on this machine, not to a Dask cluster: omit one of them")
    if jobs is not None:
        check_integer("jobs", jobs, minimum=1)
    if memory_limit is not None and scheduler is None and resident(os.getpid()) is None:
        raise ValueError(f"a limit of memory needs psutil on this system: pip install {with_extra('batch')}")


def _check_folder(folder: Path) -> None:
    """Raise OutputError if the path exists but is not a run's folder."""
    if os.path.lexists(folder) and not folder.is_dir():
        raise OutputError(f"cannot write to {folder}: it is not a folder")
    with writing(f"to {folder}"):
        tables = [name for name in records.TABLES if (folder / name).exists()]
    if tables and not (folder / MARKER).exists():
        raise OutputError(f"{folder} has a {tables[0]} that belongs to no run: choose another folder for the results")


def _prepare(folder: Path, source: str | os.PathLike[str], settings: Settings, part: Shard) -> None:
    """Write the marker files with source, settings and version into the run's folder, and delete old tables."""
    with writing(f"to {folder}"):
        for path in folder.glob("records*"):
            # The table of the last run must not be taken for that of this run, nor the tables of other shards.
            shard = shard_of(path.name)
            if shard is not None and (part == WHOLE or shard in (WHOLE, part)):
                remove_file(path)
                if part == WHOLE != shard:
                    remove_file(folder / marker_name(shard))
    location = os.fspath(source) if places.is_url(source) else os.path.abspath(source)
    about = {"source": location, "settings": settings.to_dict(), "version": __version__}
    contents = json.dumps(about, indent=2).encode() + b"\n"
    # Shards of the same run write the same contents; `merge` compares the markers of all shards.
    for marker in {folder / MARKER, folder / marker_name(part)}:
        if part == WHOLE or not marker.exists() or marker.read_bytes() != contents:
            write_whole(marker, contents)
