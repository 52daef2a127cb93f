"""Results of an archive that is not finished, in the order in which they were found."""

from __future__ import annotations

import io
import os
from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path
from typing import BinaryIO, NamedTuple

from quasiharmonic.io.lowlevel.atomic import writing
from quasiharmonic.ui.batch.archives import results
from quasiharmonic.ui.batch.records import Record

# Keys of a record that are kept, to decide whether it is still valid, and to count it in the archive's metadata.
_KEPT = "key", "outcome", "time_limit", "memory_limit", "seconds"


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
        self.part = path.with_name(path.name + results.PART)
        self.entries: dict[str, _Entry] = {}
        with writing(self.part):
            path.parent.mkdir(parents=True, exist_ok=True)
            if not self.part.exists() and path.exists():
                if not results.is_parquet(path):
                    os.replace(path, self.part)
                else:
                    for result in results.read_results(path):
                        self.add(*result)
            self._repair()

    def record(self, key: str) -> Record | None:
        """Return the kept values of the newest record of a problem; None if there is none."""
        entry = self.entries.get(key)
        return None if entry is None else entry.record

    def add(self, key: str, record: Record, data: bytes | None) -> None:
        """Append a result; OutputError if it cannot be written."""
        packed = results.pack_result(key, record, data)
        with writing(self.part), open(self.part, "ab") as file:
            start = file.tell()
            file.write(packed)
        self._note(key, start, start + len(packed), record)

    def finish(self, order: Sequence[str], stamp: str, settings: str) -> None:
        """Write the finished archive, in the given order of names, and delete the journal."""
        entries = [self.entries[key] for key in order]
        about = results.describe((entry.record for entry in entries), stamp, settings)
        with writing(self.path):
            # An archive without problems has no journal.
            with open(self.part, "a+b") as file:
                results.write_results(self.path, about, _read_entries(file, entries))
            self.part.unlink()

    def _note(self, key: str, start: int, end: int, record: Record) -> None:
        self.entries[key] = _Entry(start, end, {name: record[name] for name in _KEPT if name in record})

    def _repair(self) -> None:
        """Read the journal and cut off the bytes after the last complete result."""
        if not self.part.exists():
            return
        with open(self.part, "r+b") as file:
            end = 0
            for one in results.read_tar_results(file, maps=False):
                if one.result is None:
                    break
                self._note(one.result.key, one.start, one.end, one.result.record)
                end = one.end
            file.truncate(end)


def _read_entries(file: BinaryIO, entries: Iterable[_Entry]) -> Iterator[results.Result]:
    for entry in entries:
        file.seek(entry.start)
        packed = io.BytesIO(file.read(entry.end - entry.start))
        yield from (one.result for one in results.read_tar_results(packed) if one.result is not None)
