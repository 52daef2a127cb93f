"""What goes wrong with files."""

from __future__ import annotations

import os

# Letters of what is wrong at most: what a file says is told, but not all that it has in place of a number.
_MOST = 300


def printable(path: str | bytes | os.PathLike[str]) -> str:
    """A file name as messages show it: what no terminal can show is escaped."""
    text = os.fsdecode(path)
    return "".join(c if c.isprintable() else c.encode("unicode_escape", "backslashreplace").decode() for c in text)


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
        text = f"{self.what}{at}{then}"
        # What is not valid Unicode must not make the message unprintable.
        return f"{printable(self.path)}: {text.encode('utf-8', 'backslashreplace').decode()}"


class OutputError(OSError):
    """A file that could not be written; whatever stood at its path before still stands there."""
