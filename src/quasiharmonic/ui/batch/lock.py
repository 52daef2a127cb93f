"""Lock an output folder so that only one run writes to it."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from quasiharmonic.io.errors import OutputError
from quasiharmonic.io.lowlevel.atomic import writing
from quasiharmonic.ui.batch.shards import WHOLE, Shard


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
