"""A data set during a run: its readers hand over problems, and its writers keep their results.

A problem is *known* once its reader has named it, *pending* from when it is handed over until its results are kept, and
*ready* when it is finished but not yet reported. A stream is *open* from its first problem until the results of all its
problems are kept.
"""

from __future__ import annotations

import shutil
import tempfile
import threading
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path

from quasiharmonic.io.errors import OutputError
from quasiharmonic.ui.batch import records
from quasiharmonic.ui.batch.problems import ProblemFiles
from quasiharmonic.ui.batch.readers import ArchiveReader, FolderReader, Scratch
from quasiharmonic.ui.batch.settings import Orders
from quasiharmonic.ui.batch.shards import Shard
from quasiharmonic.ui.batch.supervisor import Finished, find_resumed
from quasiharmonic.ui.batch.writers import ResultWriter

_PREFIX = "qhm-batch-"


@dataclass
class Stream:
    """Reader and writer of the same problems: of an archive, or of all problems in folders."""

    reader: FolderReader | ArchiveReader
    writer: ResultWriter
    waiting: int = 0  # Number of problems that are read but not finished
    read: bool = False  # Whether all problems are read


class DataSet:
    """Problems of a run: files in folders, or archives.

    Parameters
    ----------
    streams : sequence of Stream
        Readers and their writers.
    orders : Orders
        Parameters of the run.
    scratch : Scratch
        Folders for the files of problems from archives that are being solved.
    count : int, optional
        Number of problems, if it is known.
    """

    def __init__(self, streams: Sequence[Stream], orders: Orders, scratch: Scratch, count: int | None = None) -> None:
        self.orders = orders
        self._streams, self._scratch, self._count = streams, scratch, count
        self._lock = threading.RLock()  # `problems` runs in other threads than the other methods
        self._pending: dict[str, tuple[Stream, ProblemFiles]] = {}  # Pending problems by name
        self._open: list[Stream] = []  # Streams whose writers are not complete
        self._ready: list[Finished] = []  # Reports that `collect` has not returned yet
        self._known = 0  # Number of problems so far
        self._read_streams = 0  # Number of streams that are read to their end
        self._known_in_read = 0  # Number of problems of these streams

    @property
    def total(self) -> int:
        """Number of problems; an estimate until all archives have been opened."""
        with self._lock:
            if self._count is not None:
                return self._count
            unread = len(self._streams) - self._read_streams
            expected = unread * self._known_in_read / max(self._read_streams, 1)
            return max(self._known, self._known_in_read + round(expected))

    def problems(self) -> Iterator[ProblemFiles]:
        """Yield the problems to solve; those of archives are unpacked when they are asked for."""
        for stream in self._streams:
            try:
                yield from self._problems_of(stream)
            except OutputError:
                raise
            except OSError as error:
                stream.writer.fail(error)
                with self._lock:
                    self._ready.append(Finished(stream.reader.name, "error", 0.0))
                    self._known += 1
            with self._lock:
                stream.read = True
                self._read_streams += 1
                self._known_in_read = self._known

    def collect(self, item: Finished | None) -> list[Finished]:
        """Keep the results of an item of the pool, if there is one, and complete archives; return what is finished."""
        with self._lock:
            if item is not None:
                self._keep(item.name)
                self._ready.append(item)
            for stream in [one for one in self._open if one.read and not one.waiting]:
                self._open.remove(stream)
                stream.writer.finish()
            ready, self._ready = self._ready, []
            return ready

    def close(self) -> None:
        """Keep the results of problems that are finished but not collected, as after an interrupt."""
        with self._lock:
            for name, (_, files) in list(self._pending.items()):
                if files.results is not None and records.read_record(files.results) is not None:
                    self._keep(name)

    def records(self) -> Iterator[records.Record]:
        """Yield the records of the finished problems."""
        for stream in self._streams:
            yield from stream.writer.records()

    def _problems_of(self, stream: Stream) -> Iterator[ProblemFiles]:
        found = stream.writer.find_finished()
        with self._lock:
            if found is not None:
                name = stream.reader.name
                self._ready += [Finished(name, outcome, 0.0, resumed=True) for outcome in found.elements()]
                self._known += found.total()
                return
            stream.writer.open()
            self._open.append(stream)
        for files in stream.reader.problems(self.orders, self._scratch):
            with self._lock:
                self._known += 1
                finished = self._find_finished(stream, files)
                if finished is None:
                    stream.waiting += 1
                    self._pending[files.name] = stream, files
                else:
                    self._ready.append(finished)
                    self._release(files)
            if finished is None:
                yield files

    def _find_finished(self, stream: Stream, files: ProblemFiles) -> Finished | None:
        """Return the report of a problem that an earlier run has finished, or that cannot be used; else None."""
        before = stream.writer.resume(files)
        if files.error is not None:
            names = {"problem": files.name, "source": files.source}
            stream.writer.add(files, names | {"outcome": "invalid", "certified": False, "error": files.error})
            return Finished(files.name, "invalid", 0.0)
        key = "" if before is None else self.orders.settings.key(files)
        return None if before is None else find_resumed(files.name, before, key, self.orders)

    def _keep(self, name: str) -> None:
        """Let the writer keep the results of a problem."""
        stream, files = self._pending[name]
        stream.writer.add(files, None if files.results is None else records.read_record(files.results))
        del self._pending[name]
        stream.waiting -= 1
        self._release(files)

    def _release(self, files: ProblemFiles) -> None:
        """Let another problem use the folder with the files of a problem from an archive."""
        if files.results is not None:
            with suppress(OSError):  # in use by another program: the folder is not used again
                records.remove_results(files.results)
                self._scratch.free(files.results)


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
