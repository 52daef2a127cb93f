"""Split a data set into disjoint shards, one for each job of an array.

A lock on the output folder ensures that only one run writes a shard.
"""

from __future__ import annotations

import re
from collections.abc import Iterator
from contextlib import contextmanager
from hashlib import blake2b
from pathlib import Path
from typing import NamedTuple

from quasiharmonic.io.errors import OutputError
from quasiharmonic.io.lowlevel.atomic import writing
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
