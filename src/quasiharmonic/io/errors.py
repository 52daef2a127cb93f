"""What goes wrong with files."""

from __future__ import annotations

import os

# Letters of what is wrong at most: what a file says is told, but not all that it has in place of a number.
_MOST = 300


class MeshFileError(ValueError):
    """A file that cannot be read as what it should be; the message says where, why and what to do.

    Parameters
    ----------
    path : str or path-like
        The file.
    what : str
        What is wrong, without place and remedy.
    line : int, optional
        Line the fault lies in, counted from 1.
    remedy : str, optional
        What the user can do about it.
    """

    def __init__(self, path: str | os.PathLike[str], what: str, line: int | None = None, remedy: str = "") -> None:
        # All arguments go to the base class, so that the exception survives pickling between processes.
        if len(what) > _MOST:
            what = f"{what[: _MOST // 2]} … {what[-_MOST // 2 :]}"
        super().__init__(path, what, line, remedy)
        self.path = path
        self.what = what
        self.line = line
        self.remedy = remedy

    def __str__(self) -> str:
        at = "" if self.line is None else f" at line {self.line}"
        then = f"; {self.remedy}" if self.remedy else ""
        text = f"{os.fspath(self.path)}: {self.what}{at}{then}"
        # A file name that is not valid Unicode must not make the message unprintable.
        return text.encode("utf-8", "backslashreplace").decode()


class OutputError(OSError):
    """A file that could not be written; whatever stood at its path before still stands there."""
