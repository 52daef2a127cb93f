"""Read lists of numbers: lines separated by blanks, commas or semicolons, in any usual notation."""

from __future__ import annotations

import os

from quasiharmonic.io.errors import MeshFileError
from quasiharmonic.io.textual import is_number, number, read_text, shown


def read_rows(path: str | os.PathLike[str], columns: int) -> list[tuple[int, list[float]]]:
    """Read lines with a given count of numbers each.

    Blanks, tabs and commas separate numbers. In a line with semicolons, semicolons separate numbers and commas are
    decimal points, as in spreadsheets of many countries. Exponents have an e, or a d as in Fortran. A comment starts
    with ``#``. A first line without numbers is a heading.

    Parameters
    ----------
    path : str or path-like
    columns : int
        Count of numbers per line.

    Returns
    -------
    list of (int, list of float)
        For each line its line number, counted from 1, and its numbers.

    Raises
    ------
    MeshFileError
        If the file cannot be read, or a line has another count of numbers or anything but finite numbers.
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
