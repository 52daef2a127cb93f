"""Lists of numbers as people keep them: lines with blanks, commas or semicolons between, in any usual notation."""

from __future__ import annotations

import os

from quasiharmonic.io.errors import MeshFileError
from quasiharmonic.io.textual import is_number, number, read_text, shown


def read_rows(path: str | os.PathLike[str], columns: int) -> list[tuple[int, list[float]]]:
    """Read lines of so many numbers each.

    Blanks, tabs and commas separate numbers; where a line has semicolons these do, and commas are decimal points, as
    spreadsheets write them in half of the world. Exponents have an e or, as Fortran writes them, a d. A comment begins
    with ``#``. A first line of words is a heading.

    Parameters
    ----------
    path : str or path-like
    columns : int

    Returns
    -------
    list of (int, list of float)
        Each line's number, from 1 on, and what is in it.

    Raises
    ------
    MeshFileError
        When the file cannot be read, a line has another count of numbers, or something else than finite ones.
    """
    rows = []
    for at, line in enumerate(read_text(path).split(b"\n"), 1):
        text = line.partition(b"#")[0].strip()
        if not text:
            continue
        if b";" in text:
            words = [word.strip().replace(b",", b".") for word in text.split(b";")]
        else:
            words = text.replace(b",", b" ").split()
        if at == 1 and not any(is_number(word) for word in words):
            continue
        if len(words) != columns:
            plural = "number" if columns == 1 else "numbers"
            raise MeshFileError(path, f"not {columns} {plural}: {shown(text)}", at)
        try:
            rows.append((at, [number(word) for word in words]))
        except ValueError as error:
            raise MeshFileError(path, str(error), at) from None
    return rows
