"""Files that appear whole or not at all."""

from __future__ import annotations

import contextlib
import os
import stat
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import BinaryIO

from quasiharmonic.io.errors import OutputError, printable


def check_writable(path: str | os.PathLike[str]) -> Path:
    """Say early whether a file could be written to ``path``.

    Parameters
    ----------
    path : str or path-like
        Where a file is going to be written, new or in place of another.

    Returns
    -------
    Path
        The same place with symbolic links resolved: a link to a file stays a link to the new one.

    Raises
    ------
    OutputError
        When the directory is missing or not writable, or something stands at ``path`` that is not
        a file or is write-protected.
    """
    try:
        target = Path(os.path.realpath(path))
        mode = _mode(target)
        folder = target.parent
        if not folder.is_dir():
            raise OutputError(f"cannot write {path}: there is no directory {folder}")
        if mode is not None and stat.S_ISDIR(mode):
            raise OutputError(f"cannot write {path}: it is a directory")
        if mode is not None and not stat.S_ISREG(mode):
            raise OutputError(f"cannot write {path}: it is not a regular file")
        if not os.access(folder, os.W_OK | os.X_OK):
            raise OutputError(f"cannot write {path}: the directory {folder} is not writable")
        if mode is not None and not os.access(target, os.W_OK):
            raise OutputError(f"cannot write {path}: it is write-protected")
    except OutputError:
        raise
    except (OSError, ValueError) as error:
        raise OutputError(f"cannot write {printable(path)}: {_reason(error)}") from error
    return target


def write_whole(
    path: str | os.PathLike[str], data: bytes | Callable[[BinaryIO], object], *, durable: bool = True
) -> None:
    """Write a file such that readers see the old one or the new one, never a part.

    The bytes go to a temporary file in the same directory, which takes the place of ``path`` when
    it is complete and on the disk. An error or an interrupt removes the temporary file; a process
    killed outright can leave it (``.qhm-*.tmp``), but never a half-written ``path``. A file that is
    replaced passes its permissions on, a new one gets the usual ones.

    Parameters
    ----------
    path : str or path-like
        Where the file is to be.
    data : bytes or callable
        The contents, or a function that writes them to the binary file it is given.
    durable : bool
        Wait until the file is on the disk. Without it the file may be lost, or empty, when the power fails; what
        becomes of the process makes no difference.

    Raises
    ------
    OutputError
        When it cannot be written: no such directory, no permission, disk full.
    """
    target = check_writable(path)
    part = target.with_name(f".qhm-{os.urandom(8).hex()}.tmp")
    try:
        with open(part, "xb") as file:
            if callable(data):
                data(file)
            else:
                file.write(data)
            file.flush()
            if durable:
                os.fsync(file.fileno())
        mode = _mode(target)
        if mode is not None:
            os.chmod(part, stat.S_IMODE(mode))
        os.replace(part, target)
    except BaseException as error:
        with contextlib.suppress(OSError):
            part.unlink(missing_ok=True)
        if isinstance(error, OSError):
            raise OutputError(f"cannot write {path}: {_reason(error)}") from error
        raise


@contextlib.contextmanager
def new_folder(path: str | os.PathLike[str], *, leftovers: frozenset[str] = frozenset()) -> Iterator[None]:
    """Make a folder with those above it that are missing; remove what was made if the block fails and leaves it empty.

    Parameters
    ----------
    path : str or path-like
        The folder, which may be there already.
    leftovers : frozenset of str
        Names of files that count as nothing.

    Raises
    ------
    OutputError
        When it cannot be made.
    """
    folder = Path(os.path.abspath(path))
    missing = [place for place in (folder, *folder.parents) if not os.path.lexists(place)]
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        _remove_empty(missing)
        raise OutputError(f"cannot create the folder {printable(path)}: {_reason(error)}") from error
    try:
        yield
    except BaseException:
        with contextlib.suppress(OSError):
            if missing and {entry.name for entry in folder.iterdir()} <= leftovers:
                for name in leftovers:
                    (folder / name).unlink(missing_ok=True)
        _remove_empty(missing)
        raise


def _remove_empty(folders: list[Path]) -> None:
    """Remove folders, the innermost first, up to the first one that cannot be removed."""
    with contextlib.suppress(OSError):
        for folder in folders:
            folder.rmdir()


@contextlib.contextmanager
def no_remains(*paths: Path) -> Iterator[None]:
    """Remove those of some files that are new, if the block fails."""
    new = [path for path in paths if not os.path.lexists(path)]
    try:
        yield
    except BaseException:
        for path in new:
            with contextlib.suppress(OSError):
                path.unlink(missing_ok=True)
        raise


def _mode(path: Path) -> int | None:
    """Type and permissions of what stands at ``path``, None where nothing does."""
    try:
        return path.stat().st_mode
    except FileNotFoundError:
        return None


def _reason(error: OSError | ValueError) -> str:
    return getattr(error, "strerror", None) or str(error)
