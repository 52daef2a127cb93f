"""Writers of a data set keep the results of its problems: in folders (`FolderWriter`) or archives (`ArchiveWriter`).

Both are a `ResultWriter`, which states the order of the calls. Results of an archive that is not finished are in a
`Journal`, in the order in which they were found.
"""

from __future__ import annotations

import io
import os
import posixpath
import re
import tempfile
from collections import Counter
from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import BinaryIO, NamedTuple

from quasiharmonic.io.atomic import writing
from quasiharmonic.ui.batch import places, records
from quasiharmonic.ui.batch.problems import ProblemFiles
from quasiharmonic.ui.batch.readers import ArchiveReader, FolderReader
from quasiharmonic.ui.batch.records import Record
from quasiharmonic.ui.batch.results import (
    PART,
    Result,
    pack_result,
    read_about,
    read_results,
    read_tar_results,
    write_results,
)
from quasiharmonic.ui.batch.samples import is_parquet, results_name
from quasiharmonic.ui.batch.settings import Orders
from quasiharmonic.ui.batch.supervisor import is_valid

# Keys of a record that are kept, to decide whether it is still valid, and to count it in the archive's metadata.
_KEPT = "key", "outcome", "time_limit", "memory_limit", "seconds"


class ResultWriter:
    """Writer of the results of the problems that one reader reads. Here most methods do nothing.

    The methods are called in this order:

    1. `find_finished`. If it returns outcomes, only `records` follows.
    2. `open`.
    3. `resume` once for each problem, in the order of the reader. Later `add` for each problem with a new result, in
       the order in which these problems are finished; the calls of `resume` for other problems may come between.
    4. `fail`, at most once, if the reader, `find_finished` or `open` raises an OSError other than `OutputError`. Then
       `resume` is not called again.
    5. `finish`, after the last `add`, but only if `open` has succeeded.
    6. `records`, at the end of the run.

    An interrupted run ends without `finish` and `records`.
    """

    def find_finished(self) -> Counter[str] | None:
        """Return the numbers of outcomes if all problems are known to be finished, before they are read; else None.

        Results may be moved to where they belong now, and what a killed run left may be deleted.
        """
        return None

    def open(self) -> None:
        """Prepare for results."""

    def resume(self, files: ProblemFiles) -> Record | None:
        """Note the next problem; return its record of an earlier run, if the supervisor does not read this itself."""
        return None

    def add(self, files: ProblemFiles, record: Record | None) -> None:
        """Keep the results of a problem; it has no record if that could not be written."""

    def fail(self, error: OSError) -> None:
        """Note that the problems cannot be read; raise the error if the run cannot continue."""
        raise error

    def finish(self) -> None:
        """Complete the results after the last problem."""

    def records(self) -> Iterator[Record]:
        """Yield the records of the finished problems, in order."""
        raise NotImplementedError


class FolderWriter(ResultWriter):
    """Results in the folders of the problems, where workers write them.

    Parameters
    ----------
    reader : FolderReader
        The problems.
    orders : Orders
        Parameters of the run.
    """

    def __init__(self, reader: FolderReader, orders: Orders) -> None:
        self._reader, self._orders = reader, orders

    def records(self) -> Iterator[Record]:
        for files in self._reader.problems(self._orders):
            record = records.read_record(self._orders.folder(files))
            if record is not None:
                yield record


class ArchiveWriter(ResultWriter):
    """Results in an archive, which is written from a journal when all problems are finished.

    Parameters
    ----------
    archive : ArchiveReader
        The problems.
    orders : Orders
        Parameters of the run.
    url : str or None
        Where finished archives are sent. If None, they are kept in the run's folder.
    present : frozenset of str
        Names of the results of all archives of the data set.
    key : str
        Digest of the settings.
    """

    def __init__(
        self, archive: ArchiveReader, orders: Orders, url: str | None, present: frozenset[str], key: str
    ) -> None:
        self._archive, self._orders, self._present, self._sent = archive, orders, present, url is not None
        self._name = results_name(archive.name)
        self._folder = orders.output / "results"
        self._path = self._folder / self._name
        # Where the finished archive is.
        self._location = str(self._path) if url is None else places.join(url, f"results/{self._name}")
        self._key, self._form = key, orders.settings.map_format
        self._stamp = ""  # Stamp of the archive of problems, from `find_finished` on
        self._journal: Journal | None = None  # From `open` until `finish`
        self._order: list[str] = []  # Names of the problems so far; empty after `finish`
        self._lost = False  # Whether a problem has no record
        self._failure: str | None = None  # Message of the error of `fail`

    def find_finished(self) -> Counter[str] | None:
        self._stamp = places.stamp(self._archive.location)
        self._adopt()
        about = read_about(self._location)
        if about is None or (about["stamp"], about["settings"]) != (self._stamp, self._key):
            return None
        found: Counter[str] = Counter()
        for outcome, time_limit, memory_limit, number in about["outcomes"]:
            record = {"outcome": outcome, "time_limit": time_limit, "memory_limit": memory_limit}
            if not is_valid(record, self._orders):
                return None
            found[outcome] += number
        # A run may have been killed after it finished the results.
        self._part.unlink(missing_ok=True)
        return found

    def open(self) -> None:
        if self._sent and places.read_start(self._location, 1) is not None:
            self._path.parent.mkdir(parents=True, exist_ok=True)
            places.fetch(self._location, self._path.parent)
        self._journal = Journal(self._path)

    def resume(self, files: ProblemFiles) -> Record | None:
        assert self._journal is not None, "open was not called"
        self._order.append(self._key_of(files))
        return self._journal.record(self._order[-1])

    def add(self, files: ProblemFiles, record: Record | None) -> None:
        if record is None:
            self._lost = True
            return
        assert self._journal is not None, "open was not called"
        if record.get("error"):
            record["error"] = record["error"].replace(str(files.results), record["source"])
        folder, key = self._orders.folder(files), self._key_of(files)
        data = None if record.get("map_bytes") is None else records.read_map(self._orders.map_path(folder))
        library: dict[str, bytes] = {}
        if data is not None:
            # In OBJ files a blank ends a name. Different problems get different names.
            stem = re.sub(r"[\s%]", lambda match: f"%{ord(match[0]):02X}", posixpath.basename(key))
            data, library = records.read_library(folder, data, f"{stem}.texture")
            record |= records.describe_contents(data)
        self._journal.add(Result(key, record, data, self._form, library))

    def fail(self, error: OSError) -> None:
        # Without an archive of results the next run tries again.
        self._lost, self._failure = True, str(error)

    def finish(self) -> None:
        journal, order = self._journal, self._order
        assert journal is not None, "open was not called"
        # The names and entries of a finished archive are not kept: memory must not grow with the number of problems.
        self._journal, self._order = None, []
        if self._lost:
            return
        journal.finish(order, self._stamp, self._key, self._form)
        if self._sent:
            places.send(self._path, self._location)
            self._path.unlink()

    def records(self) -> Iterator[Record]:
        if self._failure is not None:
            failure = {"outcome": "error", "certified": False, "error": self._failure}
            yield {"problem": self._archive.name, "source": self._archive.location, **failure}
            return
        with self._reading() as path:
            for one in () if path is None else read_results(path, maps=False):
                yield one.record | self._archive.names(one.key)

    @property
    def _part(self) -> Path:
        return self._path.with_name(self._path.name + PART)

    def _key_of(self, files: ProblemFiles) -> str:
        return files.name.removeprefix(self._archive.name + "/")

    @contextmanager
    def _reading(self) -> Iterator[Path | None]:
        """Return the path of the finished archive, or of the journal; None if there is neither."""
        with tempfile.TemporaryDirectory(prefix="qhm-batch-") as folder:
            paths = [self._path, self._part]
            if self._sent and places.read_start(self._location, 1) is not None:
                paths = [places.fetch(self._location, Path(folder))]
            yield next((path for path in paths if path.is_file()), None)

    def _adopt(self) -> None:
        """Use the results of an archive that was moved within the data set.

        These results have the same file name, belong to no archive of the data set, and have the same stamp in their
        metadata. Unfinished results have no stamp, but each record has the key of its problem.
        """
        if self._sent or self._path.exists() or self._part.exists():
            return
        for part in ("", PART):
            found = []
            for path in self._folder.rglob(self._path.name + part):
                old = path.relative_to(self._folder).as_posix().removesuffix(PART)
                if old not in self._present and (part or (read_about(str(path)) or {}).get("stamp") == self._stamp):
                    found.append(path)
            if len(found) == 1:
                self._path.parent.mkdir(parents=True, exist_ok=True)
                os.replace(found[0], self._path.with_name(self._path.name + part))
                return


class _Entry(NamedTuple):
    start: int
    end: int
    record: Record  # The values `_KEPT`


class Journal:
    """Tar file to which results are appended, and which a killed process leaves behind.

    When the journal is opened, any bytes after the last complete result are cut off.

    Parameters
    ----------
    path : Path
        The finished archive; the journal has the same name with the suffix ``.part``. A finished archive without a
        journal becomes the journal.

    Attributes
    ----------
    entries : dict of str to _Entry
        The newest result of each problem.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self.part = path.with_name(path.name + PART)
        self.entries: dict[str, _Entry] = {}
        self._end = 0  # Offset after the last whole result
        with writing(self.part):
            path.parent.mkdir(parents=True, exist_ok=True)
            if path.exists() and not is_parquet(path) and not self.part.exists():
                os.replace(path, self.part)
            self._repair()
            if path.exists() and is_parquet(path):
                # An earlier run may have been killed while it copied some.
                for result in read_results(path):
                    if result.key not in self.entries and records.is_intact(result.record, result.data):
                        self.add(result)

    def record(self, key: str) -> Record | None:
        """Return the kept values of the newest record of a problem; None if there is none."""
        entry = self.entries.get(key)
        return None if entry is None else entry.record

    def add(self, result: Result) -> None:
        """Append a result; OutputError if it cannot be written."""
        packed = pack_result(*result)
        with writing(self.part), open(self.part, "ab") as file:
            # An interrupt may have left a part of a result.
            file.truncate(self._end)
            file.write(packed)
        start, self._end = self._end, self._end + len(packed)
        self._note(result.key, start, self._end, result.record)

    def finish(self, order: Sequence[str], stamp: str, settings: str, form: str) -> None:
        """Write the finished archive with maps of a format, in the given order of names, and delete the journal."""
        entries = [self.entries[key] for key in order]
        kinds = ("outcome", "time_limit", "memory_limit")
        counts = Counter(tuple(map(entry.record.get, kinds)) for entry in entries)
        outcomes = [[*kind, number] for kind, number in counts.items()]
        about = {"stamp": stamp, "settings": settings, "outcomes": outcomes}
        with writing(self.path):
            # An archive without problems has no journal.
            with open(self.part, "a+b") as file:
                write_results(self.path, about, _read_entries(file, entries), form)
            self.part.unlink()

    def _note(self, key: str, start: int, end: int, record: Record) -> None:
        self.entries[key] = _Entry(start, end, {name: record[name] for name in _KEPT if name in record})

    def _repair(self) -> None:
        """Read the journal, without results whose maps are damaged, and cut off the bytes after the last whole one."""
        if not self.part.exists():
            return
        with open(self.part, "r+b") as file:
            for one in read_tar_results(file):
                if one.result is None:
                    break
                if records.is_intact(one.result.record, one.result.data):
                    self._note(one.result.key, one.start, one.end, one.result.record)
                self._end = one.end
            file.truncate(self._end)


def _read_entries(file: BinaryIO, entries: Iterable[_Entry]) -> Iterator[Result]:
    for entry in entries:
        file.seek(entry.start)
        packed = io.BytesIO(file.read(entry.end - entry.start))
        yield from (one.result for one in read_tar_results(packed) if one.result is not None)
