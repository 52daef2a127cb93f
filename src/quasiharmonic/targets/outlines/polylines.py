"""Outlines from text files of points."""

from __future__ import annotations

import os

import numpy as np

from quasiharmonic.geometry.exact.loops import join_items
from quasiharmonic.io.errors import MeshFileError, reading
from quasiharmonic.io.lowlevel.textual import is_number, number, read_text
from quasiharmonic.targets.outlines.contours import MAX_POINTS, distinct
from quasiharmonic.targets.outlines.nesting import arrange, collinear
from quasiharmonic.util.arrays import FloatArray


def read_polylines(path: str | os.PathLike[str]) -> list[FloatArray]:
    """Read contours from a text file of points.

    Parameters
    ----------
    path : str or path-like
        One point per line: x and y, separated by blanks, tabs, commas or semicolons. A blank line ends a contour, ``#``
        begins a comment, and the first line may be a heading such as ``x,y``. Contours are closed automatically; the
        first point may be repeated at the end.

    Returns
    -------
    list of (k, 2) float64
        The contours by decreasing area. Each keeps its first point and its orientation from the file; `nested` orients
        contours.

    Raises
    ------
    MeshFileError
        With the line number, when a line does not have two numbers, a contour has fewer than three points or no area,
        or the file has more than a million points or none. As `nested` for contours that meet themselves or each other.
    """
    loops: list[list[tuple[float, float]]] = [[]]
    starts, count = [0], 0
    for line, raw in enumerate(read_text(path).split(b"\n"), 1):
        text, comment, _ = raw.partition(b"#")
        words = text.replace(b",", b" ").replace(b";", b" ").split()
        if not words:
            # A comment line does not end a contour.
            if loops[-1] and not comment:
                loops.append([])
                starts.append(line)
            continue
        if line == 1 and not any(map(is_number, words)):
            continue
        if len(words) != 2:
            raise MeshFileError(path, f"{len(words)} values instead of two, x and y,", line)
        try:
            x, y = map(number, words)
        except ValueError as error:
            raise MeshFileError(path, str(error), line) from None
        if not loops[-1]:
            starts[-1] = line
        loops[-1].append((x, y))
        count += 1
        if count > MAX_POINTS:
            raise MeshFileError(path, f"more than {MAX_POINTS:,} points", line, "use fewer points")
    contours, begins = [], []
    for loop, start in zip(loops, starts, strict=True):
        if not loop:
            continue
        contour = distinct(np.array(loop), 0.0)
        if len(contour) < 3 or collinear(contour):
            what = f"a contour of {len(contour)} different points that encloses no area begins"
            raise MeshFileError(path, what, start, "use blank lines only between contours")
        contours.append(contour)
        begins.append(start)
    if not contours:
        raise MeshFileError(path, "has no points")
    plural = "contour begins at line" if len(begins) == 1 else "contours begin at lines"
    with reading(path, describe=lambda error: f"{error} (the {plural} {join_items(begins)})"):
        return [one.points for one in arrange(contours)]
