"""Data sets whose problems are in archives: stream them through a scratch folder, and the results into archives."""

from __future__ import annotations

import shutil
import tempfile
import threading
from collections.abc import Iterable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field
from itertools import count
from pathlib import Path
from typing import NamedTuple

from quasiharmonic.io.errors import OutputError
from quasiharmonic.io.lowlevel.atomic import writing
from quasiharmonic.ui.batch import records
from quasiharmonic.ui.batch.archives import places, results
from quasiharmonic.ui.batch.archives.finding import Archive
from quasiharmonic.ui.batch.archives.outputs import Outputs
from quasiharmonic.ui.batch.archives.results import Journal
from quasiharmonic.ui.batch.archives.samples import Sample, read_samples
from quasiharmonic.ui.batch.problems import ProblemFiles
from quasiharmonic.ui.batch.settings import Orders
from quasiharmonic.ui.batch.shards import Shard
from quasiharmonic.ui.batch.supervisor import Finished, find_resumed, is_valid

# What messages call the folder of unpacked problems.
_SCRATCH = "to the folder for temporary files"
_PREFIX = "qhm-batch-"


@dataclass
class _OpenArchive:
    """Archive that is being solved."""

    archive: Archive
    stamp: str
    journal: Journal
    copy: Path | None  # Folder with the local copy of an archive by URL
    order: list[str] = field(default_factory=list)  # Names of the problems read so far
    waiting: int = 0  # Number of problems that are read but not finished
    read: bool = False  # Whether all problems are read
    lost: bool = False  # Whether a problem has no record


class _Extracted(NamedTuple):
    """Problem in the scratch folder."""

    opened: _OpenArchive
    key: str
    folder: Path


class ArchivedProblems:
    """Problems of archives, with the methods of `LooseProblems`.

    Parameters
    ----------
    archives : sequence of Archive
        The whole data set.
    orders : Orders
        Parameters of the run.
    shard : Shard
        Which archives to solve, by their names.
    outputs : Outputs
        Archives of results.
    scratch : Path
        Folder for files of the problems that are being solved.

    Attributes
    ----------
    total : int
        Number of problems; an estimate until all archives have been opened.
    """

    def __init__(
        self, archives: Iterable[Archive], orders: Orders, shard: Shard, outputs: Outputs, scratch: Path
    ) -> None:
        self.orders = orders
        self._present = frozenset(results.results_name(archive.name) for archive in archives)
        self._archives = [archive for archive in archives if shard.contains(archive.name)]
        self._outputs, self._scratch = outputs, scratch
        self._settings_key, self._form = orders.settings.key_of(b"", b""), orders.settings.map_format
        self._lock = threading.RLock()  # `problems` runs in other threads than the other methods
        self._numbers = count()
        self._extracted: dict[str, _Extracted] = {}
        self._free: list[Path] = []  # Folders of finished problems; a new one takes longer than a file
        self._opened: list[_OpenArchive] = []
        self._ready: list[Finished] = []
        self._failed: dict[str, str] = {}
        self._known = self._in_read = self._read = 0

    @property
    def total(self) -> int:
        """Number of problems; an estimate until all archives have been opened."""
        with self._lock:
            unread = len(self._archives) - self._read
            return max(self._known, self._in_read + round(unread * self._in_read / max(self._read, 1)))

    def problems(self) -> Iterator[ProblemFiles]:
        """Yield the problems to solve; their files are written when they are asked for."""
        for archive in self._archives:
            try:
                yield from self._problems_of(archive)
            except OutputError:
                raise
            except OSError as error:
                with self._lock:
                    # Without an archive of results the next run tries again.
                    self._failed[archive.name] = str(error)
                    self._ready.append(Finished(archive.name, "error", 0.0))
                    self._known += 1
            with self._lock:
                self._read += 1
                self._in_read = self._known

    def collect(self, item: Finished | None) -> list[Finished]:
        """Move a finished problem's results from the scratch folder into the journal, and finish archives.

        Return the finished items.
        """
        with self._lock:
            if item is not None:
                self._journal(item.name)
                self._ready.append(item)
            for opened in [one for one in self._opened if one.read and not one.waiting]:
                self._finish(opened)
            ready, self._ready = self._ready, []
            return ready

    def close(self) -> None:
        """Keep the results that are finished but not collected, as after an interrupt."""
        with self._lock:
            for name, extracted in list(self._extracted.items()):
                if records.read_record(extracted.folder) is not None:
                    self._journal(name)

    def records(self) -> Iterator[records.Record]:
        """Yield the records of all finished problems, in the order of the archives."""
        for archive in self._archives:
            if archive.name in self._failed:
                failure = {"outcome": "error", "certified": False, "error": self._failed[archive.name]}
                yield {"problem": archive.name, "source": archive.location, **failure}
                continue
            with self._outputs.reading(results.results_name(archive.name)) as path:
                for one in () if path is None else results.read_results(path, maps=False):
                    yield one.record | _names(archive, one.key)

    def _problems_of(self, archive: Archive) -> Iterator[ProblemFiles]:
        name = results.results_name(archive.name)
        stamp = places.stamp(archive.location)
        self._outputs.adopt(name, self._present, stamp)
        if self._is_finished(name, stamp):
            return
        copy = self._new_folder() if places.is_url(archive.location) else None
        path = places.fetch(archive.location, copy or self._scratch)
        self._outputs.bring(name)
        with self._lock:
            opened = _OpenArchive(archive, stamp, Journal(self._outputs.path(name)), copy)
            self._opened.append(opened)
        try:
            for sample in read_samples(path, self.orders.memory_limit):
                files = self._extract(opened, sample)
                if files is not None:
                    yield files
        except OSError:
            opened.lost = True
            raise
        finally:
            with self._lock:
                opened.read = True

    def _is_finished(self, name: str, stamp: str) -> bool:
        """Whether all results of an archive are valid; if so, count them."""
        about = self._outputs.about(name)
        if about is None or (about["stamp"], about["settings"]) != (stamp, self._settings_key):
            return False
        found = list(results.outcomes(about))
        if not all(is_valid(record, self.orders) for record, _ in found):
            return False
        # A run may have been killed after it finished the results.
        self._outputs.path(name + results.PART).unlink(missing_ok=True)
        with self._lock:
            for record, number in found:
                self._ready += [Finished(name, record["outcome"], 0.0, resumed=True)] * number
                self._known += number
        return True

    def _extract(self, opened: _OpenArchive, sample: Sample) -> ProblemFiles | None:
        """Write the files of a problem into the scratch folder; None if it is finished."""
        with self._lock:
            self._known += 1
            opened.order.append(sample.key)
            names = _names(opened.archive, sample.key)
            mesh, fixed = sample.mesh, None if self.orders.settings.plain else sample.fixed
            if sample.error is not None or mesh is None:
                record = names | {"outcome": "invalid", "certified": False, "error": sample.error}
                opened.journal.add(results.Result(sample.key, record, None, self._form))
                self._ready.append(Finished(names["problem"], "invalid", 0.0))
                return None
            key = self.orders.settings.key_of(sample.files[mesh], b"" if fixed is None else sample.files[fixed])
            before = opened.journal.record(sample.key)
            finished = None if before is None else find_resumed(names["problem"], before, key, self.orders)
            if finished is not None:
                self._ready.append(finished)
                return None
            folder = self._free.pop() if self._free else self._new_folder()
            self._extracted[names["problem"]] = _Extracted(opened, sample.key, folder)
            opened.waiting += 1
        # The name of the member may be unsuitable for this system.
        mesh_path = folder / f"mesh.{mesh.rpartition('.')[2]}"
        fixed_path = None if fixed is None else folder / "fixed.txt"
        with writing(_SCRATCH):
            mesh_path.write_bytes(sample.files[mesh])
            if fixed is not None and fixed_path is not None:
                fixed_path.write_bytes(sample.files[fixed])
        return ProblemFiles(names["problem"], mesh_path, fixed_path, results=folder, source=names["source"])

    def _journal(self, name: str) -> None:
        opened, key, folder = self._extracted[name]
        record = records.read_record(folder)
        if record is None:
            opened.lost = True
        else:
            if record.get("error"):
                record["error"] = record["error"].replace(str(folder), record["source"])
            path = records.map_path(folder, self._form)
            data = None if record.get("map_bytes") is None else records.read_map(path)
            opened.journal.add(results.Result(key, record, data, self._form))
        del self._extracted[name]
        opened.waiting -= 1
        with suppress(OSError):  # in use by another program: the folder is not used again
            records.remove_results(folder)
            self._free.append(folder)

    def _new_folder(self) -> Path:
        folder = self._scratch / str(next(self._numbers))
        with writing(_SCRATCH):
            folder.mkdir()
        return folder

    def _finish(self, opened: _OpenArchive) -> None:
        self._opened.remove(opened)
        if opened.copy is not None:
            shutil.rmtree(opened.copy, ignore_errors=True)
        if not opened.lost:
            opened.journal.finish(opened.order, opened.stamp, self._settings_key, self._form)
            self._outputs.publish(opened.journal.path.relative_to(self._outputs.path("")).as_posix())


def _names(archive: Archive, key: str) -> records.Record:
    """Return the columns of a record that name its problem."""
    return {"problem": f"{archive.name}/{key}", "source": f"{archive.location}/{key}"}


@contextmanager
def scratch_folder(output: Path, part: Shard, *, shared: bool) -> Iterator[Path]:
    """Make a folder for the block: in the run's folder if other machines must see it, else for temporary files.

    The folder of a killed run of the same shard is deleted first; a file in the run's folder has its path.
    """
    note = output / f"{_PREFIX}{part.label}.scratch"
    with suppress(OSError, ValueError):
        left = Path(note.read_text(encoding="utf-8"))
        if left.name.startswith(_PREFIX):
            shutil.rmtree(left, ignore_errors=True)
    folder = Path(tempfile.mkdtemp(prefix=_PREFIX, dir=output if shared else None))
    try:
        note.write_text(str(folder), encoding="utf-8")
        yield folder
    finally:
        shutil.rmtree(folder, ignore_errors=True)
        note.unlink(missing_ok=True)
