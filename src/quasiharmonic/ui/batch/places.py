"""Files on this machine, and objects by URL through fsspec, with retries."""

from __future__ import annotations

import os
import time
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import Any, TypeVar

from quasiharmonic.io.atomic import writing
from quasiharmonic.util.hints import explain_missing

T = TypeVar("T")
# Number of attempts, and seconds before the second one; each further pause is twice as long.
ATTEMPTS = 5
FIRST_PAUSE = 0.5
# Errors that a further attempt does not resolve.
_FINAL = FileNotFoundError, PermissionError, IsADirectoryError, NotADirectoryError


def is_url(location: str | os.PathLike[str]) -> bool:
    """Whether a location is a URL, such as ``s3://BUCKET/FOLDER``."""
    return isinstance(location, str) and "://" in location


def join(location: str | os.PathLike[str], name: str) -> str:
    """Return the location of a name in a folder or below a URL."""
    text = os.fspath(location)
    return f"{text.rstrip('/')}/{name}" if is_url(text) else os.path.join(text, name)


def find(location: str) -> list[str]:
    """Return the paths of all files below a location, relative to it, in order."""
    if is_url(location):
        system, path = _open(location)
        return sorted(one[len(path) :].lstrip("/") for one in _retry(lambda: system.find(path), location))
    return sorted(one.relative_to(location).as_posix() for one in Path(location).rglob("*") if not one.is_dir())


def stamp(location: str) -> str:
    """Return a text that changes with the contents of a file: its size, and the time or tag of its last change."""
    if not is_url(location):
        status = os.stat(location)
        return f"{status.st_size} {status.st_mtime_ns}"
    system, path = _open(location)
    # Lists of objects are cached; another program may have replaced the object.
    system.invalidate_cache()
    info = _retry(lambda: system.info(path), location)
    names = "ETag", "etag", "mtime", "LastModified", "last_modified", "created"
    return f"{info['size']} {next((info[name] for name in names if name in info), '')}"


def fetch(location: str, folder: Path) -> Path:
    """Return the path of a file; one by URL is copied into the folder. OSError if it cannot be read."""
    if not is_url(location):
        return Path(location)
    system, path = _open(location)
    copy = folder / location.rstrip("/").rpartition("/")[2]
    _retry(lambda: system.get_file(path, str(copy)), location)
    return copy


def send(path: Path, location: str) -> None:
    """Copy a file to a URL. OutputError if it cannot be written."""
    with writing(location):
        system, target = _open(location)
        # A folder of an object store needs not exist.
        _retry(lambda: system.makedirs(target.rpartition("/")[0], exist_ok=True), location)
        _retry(lambda: system.put_file(str(path), target), location)


def read_start(location: str, size: int) -> bytes | None:
    """Return the first bytes of a file; None if there is none."""
    if not is_url(location):
        with suppress(OSError), open(location, "rb") as file:
            return file.read(size)
        return None
    try:
        system, path = _open(location)
        return _retry(lambda: system.cat_file(path, start=0, end=size), location)
    except FileNotFoundError:
        return None


def _open(location: str) -> tuple[Any, str]:
    """Return the file system of a URL and the path in it; ImportError if a package is missing."""
    with explain_missing("URLs need fsspec", extra="remote"):
        from fsspec.core import url_to_fs
    with explain_missing(location, extra="remote", hint=" for S3"):
        return url_to_fs(location)


def _retry(action: Callable[[], T], location: str) -> T:
    """Call a function; repeat it after errors that may pass, such as a lost connection."""
    pause = FIRST_PAUSE
    for attempt in range(ATTEMPTS):
        try:
            return action()
        except _FINAL:
            raise
        except Exception as error:
            if attempt == ATTEMPTS - 1:
                raise OSError(f"{location}: {error} ({ATTEMPTS} attempts)") from error
        time.sleep(pause)
        pause *= 2
    raise AssertionError
