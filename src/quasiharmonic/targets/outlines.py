"""Closed outlines in the plane: letters, disks, polygons.

A contour is a (k, 2) float64 array of points, the last joined to the first, none repeated.
Outer contours run counterclockwise and holes clockwise: the filled side lies to the left, as the
triangles do along the boundary loops of a mesh.
"""

from __future__ import annotations

from os import PathLike
from pathlib import Path as FilePath
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike, NDArray

if TYPE_CHECKING:
    from matplotlib.path import Path

FloatArray = NDArray[np.float64]

# How far a flattened curve may stray from the true one, in units of the font size: 1/20 of a pixel
# where a letter is 100 pixels high.
_TOLERANCE = 5e-4


def disk(radius: float = 1.0, points: int = 256) -> FloatArray:
    """Outline of a disk around the origin, (points, 2) float64: an `ellipse` with equal axes."""
    _positive(radius=radius)
    return ellipse(radius, radius, points)


def ellipse(a: float, b: float, points: int = 256) -> FloatArray:
    """Outline of an ellipse around the origin.

    Parameters
    ----------
    a, b : float
        Half axes along x and y.
    points : int
        Points on it, evenly spaced in angle for ``a = b``.

    Returns
    -------
    (points, 2) float64
        Counterclockwise from ``(a, 0)``.

    Raises
    ------
    ValueError
        When a half axis is not positive or there are fewer than three points.
    """
    _positive(a=a, b=b)
    return _polar(points) * (a, b)


def rectangle(width: float, height: float) -> FloatArray:
    """Outline of the rectangle from the origin to ``(width, height)``.

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
    _positive(width=width, height=height)
    return np.array([(0, 0), (width, 0), (width, height), (0, height)], dtype=np.float64)


def regular_polygon(corners: int, radius: float = 1.0) -> FloatArray:
    """Outline of a regular polygon around the origin.

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
    _positive(radius=radius)
    return _polar(corners, start=np.pi / 2) * radius


def star(tips: int, inner: float = 0.5) -> FloatArray:
    """Outline of a star around the origin, its tips on the unit circle.

    Parameters
    ----------
    tips : int
    inner : float
        Distance of the corners between the tips from the origin, below 1.

    Returns
    -------
    (2 tips, 2) float64
        Counterclockwise from the tip at the top.

    Raises
    ------
    ValueError
        When there are fewer than three tips or ``inner`` is not between 0 and 1.
    """
    if not 0 < inner < 1:
        raise ValueError(f"the inner radius of a star is between 0 and 1, not {inner}")
    if tips < 3:
        raise ValueError(f"a star needs at least 3 tips, not {tips}")
    outline = _polar(2 * tips, start=np.pi / 2)
    outline[1::2] *= inner
    return outline


def letter(character: str, font: str | PathLike[str] | None = None) -> list[FloatArray]:
    """Outlines of one character of a font.

    Parameters
    ----------
    character : str
        Exactly one, with something to see.
    font : path, optional
        A font file (TrueType or OpenType); DejaVu Sans Bold, which comes with matplotlib, by default.

    Returns
    -------
    list of (k, 2) float64
        The contours by decreasing area, so the first is the outer one; counterclockwise where the
        letter lies inside and clockwise around its holes. The font size is 1 and the base line
        y = 0. Curves are polylines within 0.0005 of it.

    Raises
    ------
    ValueError
        When ``character`` is not a single one, or the font has no outline for it.
    FileNotFoundError
        When there is no such font file.
    """
    from matplotlib.font_manager import FontProperties, get_font
    from matplotlib.path import Path
    from matplotlib.textpath import text_to_path

    if len(character) != 1:
        raise ValueError(f"an outline is made of one character, not of {character!r}")
    file = _font_file(font)
    if not get_font(file).get_char_index(ord(character)):
        raise ValueError(f"{file.name} has no glyph for {character!r}")
    points, codes = text_to_path.get_text_path(FontProperties(fname=file), character)
    if len(codes) == 0:
        raise ValueError(f"the glyph of {character!r} has no outline")
    path = Path(np.asarray(points) / text_to_path.FONT_SCALE, codes)
    contours = [contour for contour in _flatten(path) if len(contour) > 2]
    contours.sort(key=lambda c: -abs(signed_area(c)))
    for i, contour in enumerate(contours):
        # Only a larger contour can contain this one, and those come before it.
        depth = sum(_contains(other, contour[0]) for other in contours[:i])
        if (signed_area(contour) > 0) != (depth % 2 == 0):
            contours[i] = contour[::-1].copy()
    return contours


def signed_area(contour: ArrayLike) -> float:
    """Area within a contour, positive when it runs counterclockwise.

    Parameters
    ----------
    contour : (k, 2) float
    """
    contour = np.asarray(contour, dtype=np.float64)
    x, y = (contour - contour[0]).T
    return float(x @ np.roll(y, -1) - y @ np.roll(x, -1)) / 2


def _polar(points: int, start: float = 0.0) -> FloatArray:
    """Points evenly spaced on the unit circle, counterclockwise from the angle ``start``."""
    if points < 3:
        raise ValueError(f"an outline needs at least 3 points, not {points}")
    angle = start + np.arange(points) * (2 * np.pi / points)
    return np.stack([np.cos(angle), np.sin(angle)], axis=1)


def _positive(**lengths: float) -> None:
    for name, length in lengths.items():
        if not (0 < length < np.inf):
            raise ValueError(f"{name} must be positive and finite, not {length}")


def _font_file(font: str | PathLike[str] | None) -> FilePath:
    if font is None:
        import matplotlib

        return FilePath(matplotlib.get_data_path(), "fonts", "ttf", "DejaVuSans-Bold.ttf")
    file = FilePath(font)
    if not file.is_file():
        raise FileNotFoundError(f"no font file {file}")
    return file


def _flatten(path: Path) -> list[FloatArray]:
    """Turn a matplotlib path of lines and Bézier curves into closed polylines."""
    contours: list[list[FloatArray]] = []
    here = np.zeros((0, 2))
    for flat, code in path.iter_segments(simplify=False):
        control = flat.reshape(-1, 2)
        if code == path.MOVETO:
            contours.append([control])
        elif code == path.CLOSEPOLY:  # its point says nothing
            continue
        else:
            contours[-1].append(_bezier(np.concatenate([here, control])))
        here = control[-1:]
    return [_distinct(np.concatenate(parts)) for parts in contours]


def _bezier(control: FloatArray) -> FloatArray:
    """Points on a Bézier curve, its first one left out.

    A polyline of n equal steps in the parameter strays at most max |b''| / (8 n²), and the second
    derivative of a curve of degree d is bounded by d (d - 1) times the second differences of its
    control points.
    """
    degree = len(control) - 1
    if degree == 1:
        return control[1:]
    bend = np.linalg.norm(np.diff(control, n=2, axis=0), axis=1).max()
    steps = max(1, int(np.ceil(np.sqrt(degree * (degree - 1) * bend / (8 * _TOLERANCE)))))
    t = (np.arange(1, steps + 1) / steps)[:, None]
    # de Casteljau's construction, for all parameters at once.
    points = np.repeat(control[:, None, :], steps, axis=1)
    while len(points) > 1:
        points = (1 - t) * points[:-1] + t * points[1:]
    return np.asarray(points[0])


def _distinct(contour: FloatArray) -> FloatArray:
    """Drop points that repeat the one before them, all but exactly."""
    apart = np.linalg.norm(contour - np.roll(contour, 1, axis=0), axis=1)
    return np.asarray(contour[apart > 1e-3 * _TOLERANCE])


def _contains(contour: FloatArray, point: FloatArray) -> bool:
    """Whether a ray from the point to the right crosses the contour an odd number of times."""
    (x0, y0), (x1, y1) = contour.T, np.roll(contour, -1, axis=0).T
    spans = (y0 > point[1]) != (y1 > point[1])
    x = x0[spans] + (point[1] - y0[spans]) / (y1 - y0)[spans] * (x1 - x0)[spans]
    return bool(np.count_nonzero(x > point[0]) % 2)
