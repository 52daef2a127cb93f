"""Exceptions of file input and output."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator
from contextlib import contextmanager

# Longest description of a fault, in characters. A file may have very long text in place of a number.
_MAX_LENGTH = 300


def printable_path(path: str | bytes | os.PathLike[str]) -> str:
    """Return a file name for messages, with unprintable characters escaped."""
    text = os.fsdecode(path)
    return "".join(c if c.isprintable() else c.encode("unicode_escape", "backslashreplace").decode() for c in text)


def check_path(name: str, value: object) -> None:
    """Raise a ValueError unless the value of the parameter ``name`` is text or a path."""
    if not isinstance(value, str | os.PathLike):
        raise ValueError(f"{name} must be the name of a file, not {repr(value)[:80]}")


class MeshFileError(ValueError):
    """A mesh file cannot be read; the message has the location, the cause and the remedy.

    Parameters
    ----------
    path : str or path-like
        The file.
    what : str
        The fault, without location and remedy.
    line : int, optional
        Line of the fault, counted from 1.
    remedy : str, optional
        What the user can do about it.
    """

    def __init__(self, path: str | os.PathLike[str], what: str, line: int | None = None, remedy: str = "") -> None:
        # Pickling between processes needs all arguments in the base class.
        if len(what) > _MAX_LENGTH:
            what = f"{what[: _MAX_LENGTH // 2]} … {what[-_MAX_LENGTH // 2 :]}"
        super().__init__(path, what, line, remedy)
        self.path = path
        self.what = what
        self.line = line
        self.remedy = remedy

    def __str__(self) -> str:
        at = "" if self.line is None else f" at line {self.line}"
        then = f"; {self.remedy}" if self.remedy else ""
        text = f"{self.what}{at}{then}"
        # Escape invalid Unicode, so that the message stays printable.
        return f"{printable_path(self.path)}: {text.encode('utf-8', 'backslashreplace').decode()}"


@contextmanager
def report_damage(
    path: str | os.PathLike[str],
    fault: str = "",
    damage: type[Exception] | tuple[type[Exception], ...] = ValueError,
    *,
    describe: Callable[[Exception], str] = str,
    line: int | None = None,
    remedy: str = "",
) -> Iterator[None]:
    """Raise errors about the contents of a file, of the types ``damage``, as `MeshFileError`.

    Its fault is ``fault`` and the description of the error. A `MeshFileError` is not changed: it names its own file.
    """
    try:
        yield
    except MeshFileError:
        raise
    except damage as error:
        raise MeshFileError(path, f"{fault}{describe(error)}", line, remedy) from error


class OutputError(OSError):
    """A file could not be written; an existing file at its path is unchanged."""


class FileInUseError(OutputError):
    """A file could not be replaced because another program has it open (Windows)."""
