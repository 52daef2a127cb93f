"""Write files and folders so that an error leaves no partial output."""

from __future__ import annotations

import contextlib
import os
import stat
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import BinaryIO

from quasiharmonic.io.errors import FileInUseError, OutputError, check_path, printable_path

# Windows refuses to replace or delete a file that another program has open, for example a virus scanner, with one of
# these errors (access denied, sharing violation, lock violation). Seconds to try again, and between attempts.
_IN_USE = 5, 32, 33
PATIENCE, _PAUSE = 2.0, 0.05


def check_writable(path: str | os.PathLike[str]) -> Path:
    """Check before a computation whether a file could be written to ``path``.

    Parameters
    ----------
    path : str or path-like
        The file to write, new or existing.

    Returns
    -------
    Path
        The path with symbolic links resolved, so that writing through a link keeps the link.

    Raises
    ------
    OutputError
        If the directory is missing or not writable, or if ``path`` exists and is not a regular file or is
        write-protected.
    """
    check_path("path", path)
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
        raise OutputError(f"cannot write {printable_path(path)}: {_reason(error)}") from error
    return target


def write_whole(
    path: str | os.PathLike[str], data: bytes | Callable[[BinaryIO], object], *, durable: bool = True
) -> None:
    """Write a file atomically: readers see the old file or the complete new one.

    The bytes go to a temporary file in the same directory, which replaces ``path`` when it is complete and on the disk.
    An error or an interrupt removes the temporary file. A killed process can leave it (``.qhm-*.tmp``), but never a
    partial ``path``. The new file keeps the permissions of the file that it replaces.

    Parameters
    ----------
    path : str or path-like
        The file to write.
    data : bytes or callable
        The contents, or a function that writes them to the binary file in its argument.
    durable : bool
        Wait until the file is on the disk. If False, a power failure may lose or empty the file; a crash of the process
        does not.

    Raises
    ------
    OutputError
        If the file cannot be written: no such directory, no permission, disk full.
    FileInUseError
        If another program keeps the old file open for two seconds (Windows).
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
        retry_in_use(os.replace, part, target)
    except BaseException as error:
        with contextlib.suppress(OSError):
            part.unlink(missing_ok=True)
        if isinstance(error, FileInUseError):
            raise FileInUseError(f"cannot write {path}: another program has it open") from error
        if isinstance(error, OSError):
            raise OutputError(f"cannot write {path}: {_reason(error)}") from error
        raise


@contextlib.contextmanager
def writing(place: str | Path) -> Iterator[None]:
    """Raise errors of the system as `OutputError`, which names the place: a file, or "to" and a folder."""
    try:
        yield
    except OutputError:
        raise
    except OSError as error:
        raise OutputError(f"cannot write {place}: {_reason(error)}") from error


def encode_by(name: str, write: Callable[[str], object]) -> bytes:
    """Return the bytes that ``write``, a function of another library, writes to a file of this name."""
    with TemporaryDirectory() as folder:
        part = Path(folder, name)
        write(str(part))
        return part.read_bytes()


def retry_in_use(action: Callable[..., object], *paths: Path) -> None:
    """Replace or delete a file; while another program has it open (Windows), try again for two seconds.

    Raises
    ------
    FileInUseError
        If the file is still open then.
    OSError
        Other errors of ``action``, at once.
    """
    end = time.monotonic() + PATIENCE
    while True:
        try:
            action(*paths)
            return
        except PermissionError as error:
            if getattr(error, "winerror", None) not in _IN_USE:
                raise
            if time.monotonic() > end:
                raise FileInUseError(f"another program has {paths[-1]} open") from error
            time.sleep(_PAUSE)


def remove_file(path: Path) -> None:
    """Delete a file, if it exists, with the patience and the errors of `retry_in_use`."""
    retry_in_use(lambda old: old.unlink(missing_ok=True), path)


@contextlib.contextmanager
def new_folder(path: str | os.PathLike[str], *, leftovers: frozenset[str] = frozenset()) -> Iterator[None]:
    """Make a folder and its missing parents; remove the new folders if the block fails and leaves them empty.

    Parameters
    ----------
    path : str or path-like
        The folder, which may already exist.
    leftovers : frozenset of str
        Names of files to ignore and to remove with the folder.

    Raises
    ------
    OutputError
        If the folder cannot be made.
    """
    folder = Path(os.path.abspath(path))
    missing = [place for place in (folder, *folder.parents) if not os.path.lexists(place)]
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        _remove_empty(missing)
        raise OutputError(f"cannot create the folder {printable_path(path)}: {_reason(error)}") from error
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
    """Remove folders, the innermost first, until one cannot be removed."""
    with contextlib.suppress(OSError):
        for folder in folders:
            folder.rmdir()


@contextlib.contextmanager
def no_remains(*paths: Path) -> Iterator[None]:
    """Remove those of some files that did not exist before, if the block fails."""
    new = [path for path in paths if not os.path.lexists(path)]
    try:
        yield
    except BaseException:
        for path in new:
            with contextlib.suppress(OSError):
                path.unlink(missing_ok=True)
        raise


def _mode(path: Path) -> int | None:
    """Return type and permissions of the file at ``path``, or None if there is no such file."""
    try:
        return path.stat().st_mode
    except FileNotFoundError:
        return None


def _reason(error: OSError | ValueError) -> str:
    return getattr(error, "strerror", None) or str(error)
