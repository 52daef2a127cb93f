"""Outlines of simple shapes: disks, rectangles, polygons, stars, rings, and polygons from text files of points."""

from __future__ import annotations

import os
from itertools import groupby
from operator import itemgetter

import numpy as np

from quasiharmonic.geometry.exact.loops import join_items
from quasiharmonic.io.errors import MeshFileError, report_damage
from quasiharmonic.io.untrusted import is_number, number, read_text
from quasiharmonic.targets.outlines.contours import MAX_POINTS, arrange, drop_close_points, is_collinear
from quasiharmonic.util.arrays import FloatArray, check_integer, check_numbers, check_positive

# Bytes between numbers in a file of points. Quotes count as such, too.
_SEPARATORS = bytes.maketrans(b',;"', b"   ")


def disk(radius: float = 1.0, points: int = 256) -> FloatArray:
    """Return the outline of a disk around the origin: an `ellipse` with equal axes.

    Parameters
    ----------
    radius : float
    points : int
        Number of evenly spaced points.

    Returns
    -------
    (points, 2) float64
        Counterclockwise from ``(radius, 0)``.

    Raises
    ------
    ValueError
        When the radius is not positive, or ``points`` is less than three.
    """
    check_positive(radius=radius)
    return ellipse(radius, radius, points)


def ellipse(a: float, b: float, points: int = 256) -> FloatArray:
    """Return the outline of an ellipse around the origin.

    Parameters
    ----------
    a, b : float
        Half axes along x and y.
    points : int
        Number of points, evenly spaced in the ellipse's parameter.

    Returns
    -------
    (points, 2) float64
        Counterclockwise from ``(a, 0)``.

    Raises
    ------
    ValueError
        When a half axis is not positive, or ``points`` is less than three.
    """
    check_positive(a=a, b=b)
    return _polar(points) * (a, b)


def rectangle(width: float, height: float) -> FloatArray:
    """Return the outline of the rectangle from the origin to ``(width, height)``.

    Parameters
    ----------
    width, height : float

    Returns
    -------
    (4, 2) float64
        Counterclockwise from the origin.

    Raises
    ------
    ValueError
        When a side is not positive.
    """
    check_positive(width=width, height=height)
    return np.array([(0, 0), (width, 0), (width, height), (0, height)], dtype=np.float64)


def regular_polygon(corners: int, radius: float = 1.0) -> FloatArray:
    """Return the outline of a regular polygon around the origin.

    Parameters
    ----------
    corners : int
    radius : float
        Distance of the corners from the origin.

    Returns
    -------
    (corners, 2) float64
        Counterclockwise from the corner at the top.

    Raises
    ------
    ValueError
        When there are fewer than three corners or the radius is not positive.
    """
    check_positive(radius=radius)
    return _polar(corners, start=np.pi / 2) * radius


def star(tips: int, inner: float = 0.5) -> FloatArray:
    """Return the outline of a star around the origin, with its tips on the unit circle.

    Parameters
    ----------
    tips : int
    inner : float
        Distance from the origin of the corners between the tips, below 1.

    Returns
    -------
    (2 tips, 2) float64
        Counterclockwise from the tip at the top.

    Raises
    ------
    ValueError
        When there are fewer than three tips or ``inner`` is not between 0 and 1.
    """
    _check_inner(inner)
    check_integer("tips", tips, minimum=3)
    outline = _polar(2 * tips, start=np.pi / 2)
    outline[1::2] *= inner
    return outline


def ring(inner: float = 0.5, points: int = 256) -> list[FloatArray]:
    """Return the outline of the unit disk around the origin with a concentric circular hole.

    Parameters
    ----------
    inner : float
        Radius of the hole, below 1.
    points : int
        Points on each circle.

    Returns
    -------
    list of two (points, 2) float64
        The outer circle counterclockwise, the inner one clockwise.

    Raises
    ------
    ValueError
        When ``inner`` is not between 0 and 1, or ``points`` is less than three.
    """
    _check_inner(inner)
    circle = _polar(points)
    return [circle, inner * circle[::-1]]


def _check_inner(inner: float) -> None:
    check_numbers(inner=inner)
    if not 0 < inner < 1:
        raise ValueError(f"inner must be between 0 and 1, not {inner}")


def _polar(points: int, start: float = 0.0) -> FloatArray:
    """Points evenly spaced on the unit circle, counterclockwise from the angle ``start`` in radians."""
    check_integer("points", points, minimum=3)
    angle = start + np.arange(points) * (2 * np.pi / points)
    return np.stack([np.cos(angle), np.sin(angle)], axis=1)


def read_polylines(path: str | os.PathLike[str]) -> list[FloatArray]:
    """Read contours from a text file of points.

    Parameters
    ----------
    path : str or path-like
        One point per line: x and y, separated by blanks, tabs, commas or semicolons, possibly in quotes. A blank line
        ends a contour, ``#`` begins a comment, and the first line may be a heading such as ``x,y``. Contours are closed
        automatically; the first point may be repeated at the end.

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
    # Number of the contour, line and position of each point.
    points: list[tuple[int, int, tuple[float, float]]] = []
    number_of_contour = 0
    for line, raw in enumerate(read_text(path).split(b"\n"), 1):
        text, comment, _ = raw.partition(b"#")
        words = text.translate(_SEPARATORS).split()
        if not words:
            # A comment line does not end a contour.
            number_of_contour += not comment
            continue
        if line == 1 and not any(map(is_number, words)):
            continue
        if len(words) != 2:
            raise MeshFileError(path, f"{len(words)} values instead of two, x and y,", line)
        try:
            x, y = map(number, words)
        except ValueError as error:
            raise MeshFileError(path, str(error), line) from None
        points.append((number_of_contour, line, (x, y)))
        if len(points) > MAX_POINTS:
            raise MeshFileError(path, f"more than {MAX_POINTS:,} points", line, "use fewer points")
    contours, begins = [], []
    for _, group in groupby(points, key=itemgetter(0)):
        loop = list(group)
        start, positions = loop[0][1], np.array([position for _, _, position in loop])
        contour = drop_close_points(positions, 0.0)
        if len(contour) < 3 or is_collinear(contour):
            what = f"a contour of {len(contour)} different points that encloses no area begins"
            raise MeshFileError(path, what, start, "use blank lines only between contours")
        contours.append(contour)
        begins.append(start)
    if not contours:
        raise MeshFileError(path, "has no points")
    plural = "contour begins at line" if len(begins) == 1 else "contours begin at lines"
    with report_damage(path, describe=lambda error: f"{error} (the {plural} {join_items(begins)})"):
        return [one.points for one in arrange(contours)]
