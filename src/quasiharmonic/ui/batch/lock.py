"""One run at a time in a folder."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from quasiharmonic.io.errors import OutputError

#: The file that a run holds locked in its folder; it stays, and means nothing when nobody holds it.
FILE = "qhm-batch.lock"


@contextmanager
def alone(folder: Path) -> Iterator[None]:
    """Keep other runs out of a folder; the system lets them in again when this one ends, however that is.

    Where the system (Windows) or the file system knows no such locks, nobody is kept out.

    Raises
    ------
    OutputError
        When another run is there, or the folder cannot be written to.
    """
    try:
        import fcntl
    except ImportError:
        yield
        return
    try:
        file = open(folder / FILE, "ab")  # noqa: SIM115
    except OSError as error:
        raise OutputError(f"cannot write to {folder}: {error.strerror or error}") from error
    with file:
        try:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            raise OutputError(
                f"another run is writing to {folder}: wait for its end, or choose another folder"
            ) from None
        except OSError:
            pass  # a file system without locks
        yield
