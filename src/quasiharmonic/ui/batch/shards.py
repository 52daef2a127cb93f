"""Split a data set into disjoint shards, one for each job of an array, and merge the tables of their records.

A lock on the output folder ensures that only one run writes a shard.
"""

from __future__ import annotations

import os
import re
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from hashlib import blake2b
from pathlib import Path
from typing import Any, NamedTuple

from quasiharmonic.io.atomic import new_folder, write_whole, writing
from quasiharmonic.io.errors import OutputError, check_path
from quasiharmonic.io.untrusted import parse_json
from quasiharmonic.ui.batch import records
from quasiharmonic.ui.batch.problems import MARKER
from quasiharmonic.util.arrays import describe


class Shard(NamedTuple):
    """Part of a data set: the problems or archives whose names have this remainder."""

    number: int  # 1 to total
    total: int

    @property
    def label(self) -> str:
        """Text for file names, of constant length for all shards of an array."""
        return f"{self.number:0{len(str(self.total))}d}-of-{self.total}"

    def contains(self, name: str) -> bool:
        """Whether a problem or archive belongs to this shard; the same on all machines and in all runs."""
        digest = blake2b(name.encode("utf-8", "surrogateescape"), digest_size=8).digest()
        return int.from_bytes(digest, "little") % self.total == self.number - 1


#: The whole data set.
WHOLE = Shard(1, 1)


def read_shard(text: str | None) -> Shard:
    """Return the shard for ``"i/n"``, with i from 1 to n; the whole data set for None. ValueError if it is invalid."""
    if text is None:
        return WHOLE
    found = re.fullmatch(r"([0-9]{1,9})/([0-9]{1,9})", text) if isinstance(text, str) else None
    if found is None:
        raise ValueError(
            f"shard must be 'i/n', such as '3/16', not {text if isinstance(text, str) else describe(text)}"
        )
    shard = Shard(int(found[1]), int(found[2]))
    if not 1 <= shard.number <= shard.total:
        raise ValueError(f"shard {text}: the first number counts from 1 to the second")
    return shard


def table_name(shard: Shard, kind: str) -> str:
    """Return the file name of the table of records of a shard (its manifest), or of the whole data set."""
    return f"records.{kind}" if shard == WHOLE else f"records-{shard.label}.{kind}"


def shard_of(name: str) -> Shard | None:
    """Return the shard of a manifest's file name, `WHOLE` for that of the whole data set; None for other files."""
    found = re.fullmatch(r"records(?:-([0-9]+)-of-([0-9]+))?\.(?:csv|parquet)", name)
    return None if found is None else Shard(int(found[1] or 1), int(found[2] or 1))


def marker_name(shard: Shard) -> str:
    """Return the name of the marker file of a shard, or of the whole data set, in the run's folder."""
    return MARKER if shard == WHOLE else MARKER.replace(".json", f"-{shard.label}.json")


def lock_name(part: Shard) -> str:
    """Return the name of the lock file in the output folder; every shard has its own.

    The file is not deleted after the run; only the system's lock on it counts.
    """
    return "qhm-batch.lock" if part == WHOLE else f"qhm-batch-{part.label}.lock"


@contextmanager
def lock_folder(folder: Path, name: str) -> Iterator[None]:
    """Lock a folder against other runs with the same lock file; the system releases the lock when this process ends.

    If the system or the file system has no such locks, the folder is not locked. OutputError if another run has locked
    the folder, or the folder cannot be written to.
    """
    with writing(f"to {folder}"):
        file = open(folder / name, "ab")  # noqa: SIM115
    with file:
        try:
            _lock(file.fileno())
        except (BlockingIOError, PermissionError):
            raise OutputError(
                f"another run is writing to {folder}: wait for its end, or choose another folder"
            ) from None
        except OSError:
            pass  # a file system without locks
        yield


def _lock(descriptor: int) -> None:
    """Lock an open file; BlockingIOError (POSIX) or PermissionError (Windows) if another process has locked it."""
    try:
        import fcntl
    except ImportError:
        _lock_on_windows(descriptor)
    else:
        fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)


def _lock_on_windows(descriptor: int) -> None:
    try:
        import msvcrt
    except ImportError:
        return  # a system without locks
    msvcrt.locking(descriptor, msvcrt.LK_NBLCK, 1)  # type: ignore[attr-defined,unused-ignore]


class Merged(NamedTuple):
    """Result of a merge.

    Attributes
    ----------
    total : int
        Number of records.
    solved : int
        Number of problems with a map certified as requested.
    missing : tuple of str
        Shards without a table, as ``"i/n"``.
    """

    total: int
    solved: int
    missing: tuple[str, ...]


def merge(sources: Sequence[str | os.PathLike[str]], output: str | os.PathLike[str], *, table: str = "csv") -> Merged:
    """Join the tables of the shards of a data set, or of several runs, into the table of one run.

    Parameters
    ----------
    sources : sequence of paths
        Folders of runs. Each has tables of shards, ``records-i-of-n.csv`` or ``.parquet``, or one table ``records``.
    output : path
        Folder for the table, ``records.csv`` or ``.parquet``; created if necessary. It may be one of the sources,
        if that has tables of shards.
    table : {"csv", "parquet"}
        Format of the table.

    Returns
    -------
    Merged
        Number of records, and the shards whose tables are missing.

    Raises
    ------
    ValueError
        If there is no folder, a folder has no tables or only that which would be overwritten, the tables have different
        settings or belong to different numbers of shards, or two of them belong to the same shard.
    MeshFileError
        If a table cannot be read.
    OutputError
        If the table cannot be written.
    ImportError
        If a table is Parquet and pyarrow is not installed.
    """
    check_path("output", output)
    folders = [Path(os.path.abspath(one)) for one in sources]
    folder = Path(os.path.abspath(output))
    target = folder / table_name(WHOLE, table)
    records.check_table(target)
    tables, missing = _find_tables(folders, target)
    marker = _common_marker(tables)
    found = {"total": 0, "solved": 0}

    def rows() -> Iterator[records.Record]:
        for path in tables:
            for record in records.read_table(path):
                found["total"] += 1
                found["solved"] += record.get("outcome") in records.SOLVED
                yield record

    lock = lock_name(WHOLE)
    with new_folder(folder, leftovers=frozenset({lock})), lock_folder(folder, lock):
        if not (folder / MARKER).exists():
            write_whole(folder / MARKER, marker)
        records.write_table(target, rows())
    return Merged(found["total"], found["solved"], missing)


def _find_tables(folders: Sequence[Path], target: Path) -> tuple[list[Path], tuple[str, ...]]:
    """Return the tables of some folders, in the order of the shards, and the shards that have none."""
    shards: dict[Shard, Path] = {}
    others = []
    for folder in folders:
        here = {shard: path for path in sorted(folder.glob("records-*")) if (shard := shard_of(path.name)) is not None}
        whole = [folder / name for name in records.TABLES if (folder / name).exists()]
        if not here and whole and folder == target.parent:
            raise ValueError(f"{folder} has one table, which the new one would replace: choose another output")
        if not here and not whole:
            raise ValueError(f"{folder}: there is no table of records of a finished run or shard")
        for shard, path in here.items():
            if shard in shards:
                raise ValueError(f"{shards[shard]} and {path} belong to the same shard: omit one of the folders")
            shards[shard] = path
        others += [] if here else whole[:1]
    if not folders:
        raise ValueError("there is no folder with tables to merge")
    counts = {shard.total for shard in shards}
    if len(counts) > 1:
        numbers = " and ".join(map(str, sorted(counts)))
        raise ValueError(f"the tables belong to {numbers} shards: delete those of one number")
    missing = [Shard(i, n) for n in counts for i in range(1, n + 1) if Shard(i, n) not in shards]
    ordered = [shards[shard] for shard in sorted(shards)]
    return ordered + others, tuple(f"{shard.number}/{shard.total}" for shard in missing)


def _common_marker(tables: Sequence[Path]) -> bytes:
    """Return the contents of the marker files of the tables; ValueError if their settings differ."""
    first: tuple[Path, dict[str, Any]] | None = None
    contents = b""
    for table in tables:
        marker = table.with_name(marker_name(shard_of(table.name) or WHOLE))
        if not marker.exists():
            marker = table.with_name(MARKER)
        try:
            here = marker.read_bytes()
            settings = parse_json(here)["settings"]
            settings.items()
        except (OSError, ValueError, KeyError, TypeError, AttributeError) as error:
            raise ValueError(f"{table.parent} is not the folder of a run: it has no valid {marker.name}") from error
        if first is None:
            first, contents = (table, settings), here
        others = first[1]
        differing = [name for name in {**others, **settings} if others.get(name) != settings.get(name)]
        if differing:
            listed = ", ".join(f"{name} ({others.get(name)} and {settings.get(name)})" for name in differing)
            raise ValueError(
                f"{first[0]} and {table} have different settings, {listed}: solve one of them again with the settings "
                "of the other"
            )
    return contents
