"""Outlines specified by a short string, as on the command line: ``letter:G``, ``rect:2x1``, ``drawing.svg``.

An outline is a list of contours, or, for a boundary that slides, a list of exact curves. A file may assign vertices to
the sides of the curves.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from os import PathLike, fspath
from pathlib import Path

import numpy as np

from quasiharmonic.geometry.curves import BoundaryCurves
from quasiharmonic.geometry.curves.arcs import Arc
from quasiharmonic.geometry.curves.curve import Curve
from quasiharmonic.io.errors import MeshFileError, check_path, report_damage
from quasiharmonic.io.untrusted import read_pairs
from quasiharmonic.targets.outlines import shapes as outlines
from quasiharmonic.targets.outlines.contours import MAX_POINTS, Pieces
from quasiharmonic.targets.outlines.letters import Font, glyph_paths, letter, word, word_curves
from quasiharmonic.targets.outlines.shapes import read_polylines
from quasiharmonic.targets.outlines.svg import read_svg, svg_paths
from quasiharmonic.util.arrays import FloatArray, check_numbers
from quasiharmonic.util.hints import suggest

_SHAPES = "disk", "ellipse:2x1", "rect:2x1", "polygon:6", "star:5", "ring:0.5", "letter:G", "word:QH"
FORMS = f"{', '.join(_SHAPES)}, or a file .svg, .txt or .csv"
_POINT_FILES = ".txt", ".csv"
#: Default deviation of contours from curves.
TOLERANCE = 1e-6


def outline(
    specification: str | PathLike[str], *, font: Font | None = None, tolerance: float = TOLERANCE
) -> list[FloatArray]:
    """Make the outline that a string or a file specifies.

    Parameters
    ----------
    specification : str or path
        One of

        - ``disk``, ``ellipse:2x1`` (half axes), ``ring:0.5`` (the unit disk around a hole of this radius);
        - ``rect:2x1`` (width and height), ``polygon:6`` (corners), ``star:5`` (tips);
        - ``letter:G``, ``word:QH`` (overlapping letters, which needs Shapely);
        - the name of a drawing, ``.svg``, or of a file of points, ``.txt`` or ``.csv`` (see `read_svg` and
          `read_polylines`).
    font : str or path, optional
        Font of letters and words, as in `letter`.
    tolerance : float
        Maximum deviation of contours from curves. For letters and words in units of the font size, otherwise as a share
        of the larger side.

    Returns
    -------
    list of (k, 2) float64
        Contours by decreasing area. Contours from files keep their orientation. Otherwise outer contours are
        counterclockwise and holes clockwise.

    Raises
    ------
    ValueError, OSError, ModuleNotFoundError
        When the form is unknown, the file does not exist, or a number or letter is invalid; and as `letter`, `word`,
        `read_svg` and `read_polylines`.

    Examples
    --------
    >>> [contour.tolist() for contour in outline("rect:2x1")]
    [[[0.0, 0.0], [2.0, 0.0], [2.0, 1.0], [0.0, 1.0]]]
    """
    check_path("specification", specification)
    check_numbers(tolerance=tolerance)
    text = fspath(specification)
    name, colon, argument = text.partition(":")
    if not 0 < tolerance < 1:
        raise ValueError(f"tolerance must be between 0 and 1, not {tolerance}")
    if name in ("letter", "word") and colon:
        return (letter if name == "letter" else word)(argument, font, tolerance=tolerance)
    if font is not None:
        raise ValueError(f"{text!r} takes no font: only letter: and word: do")
    suffix = Path(text).suffix.lower()
    if suffix == ".svg":
        return read_svg(text, tolerance=tolerance)
    if suffix in _POINT_FILES:
        return read_polylines(text)
    # On a circle of diameter 1 divided into n chords, the chords deviate by (π / n)² / 4.
    points = min(MAX_POINTS, max(64, math.ceil(math.pi / math.sqrt(4 * tolerance))))
    match name, colon:
        case "disk", "":
            return [outlines.disk(points=points)]
        case "ellipse", ":":
            return [outlines.ellipse(*_pair(text, argument), points=points)]
        case "ring", ":":
            return outlines.ring(_number(text, argument), points=points)
        case "rect", ":":
            return [outlines.rectangle(*_pair(text, argument))]
        case "polygon", ":":
            return [outlines.regular_polygon(_count(text, argument))]
        case "star", ":":
            return [outlines.star(_count(text, argument))]
    raise ValueError(f"unknown outline {text!r}: use {FORMS}{suggest(text, _SHAPES)}")


def _number(text: str, argument: str) -> float:
    try:
        return float(argument)
    except ValueError:
        raise ValueError(f"{text!r}: {argument!r} is not a number, such as 0.5 in ring:0.5") from None


def _pair(text: str, argument: str) -> tuple[float, float]:
    parts = argument.lower().split("x")
    if len(parts) != 2:
        raise ValueError(f"{text!r}: give two numbers with an x between them, as in 2x1")
    return _number(text, parts[0]), _number(text, parts[1])


def _count(text: str, argument: str) -> int:
    if not (argument.isascii() and argument.isdigit()):
        raise ValueError(f"{text!r}: {argument!r} is not a whole number, such as 5 in star:5")
    if len(argument) > 6 or int(argument) > MAX_POINTS // 2:
        raise ValueError(f"{text!r}: {argument} is too many: at most {MAX_POINTS // 2} are possible")
    return int(argument)


def outline_curves(specification: str | PathLike[str], *, font: Font | None = None) -> list[Curve]:
    """Return the curves of an outline that a string or a file specifies, one for each contour.

    Parameters
    ----------
    specification : str or path
        As in `outline`. Circles and ellipses are exact. Letters, words and drawings consist of their lines, arcs and
        Bézier curves. Files of points are polygons.
    font : str or path, optional
        For letters and words.

    Returns
    -------
    list of Curve
        Closed, in no particular order, oriented as drawn.

    Raises
    ------
    ValueError, OSError, ModuleNotFoundError
        As `outline`; when letters of a word touch at so small an angle that their curves cannot be joined.

    Examples
    --------
    >>> [curve.corners(20.0).size for curve in outline_curves("letter:G")]
    [8]
    """
    # Raises for invalid specifications.
    contours = outline(specification, font=font)
    text = fspath(specification)
    name, _, argument = text.partition(":")
    if name == "letter":
        return _contours(glyph_paths(argument, font))
    if name == "word":
        return word_curves(argument, font, TOLERANCE)
    if name == "disk":
        return [Curve.circle()]
    if name == "ring":
        return [Curve.circle(), Curve.circle(float(argument))]
    if name == "ellipse":
        a, b = map(float, argument.lower().split("x"))
        return [Curve([Arc((0.0, 0.0), (a, 0.0), (0.0, b), 0.0, 2 * np.pi)])]
    if Path(text).suffix.lower() == ".svg":
        with report_damage(text):
            return _contours(svg_paths(text, arcs=True))
    return [Curve.polygon(contour) for contour in contours]


def _contours(paths: list[Pieces]) -> list[Curve]:
    """Return closed curves for the paths that are longer than a point."""
    return [
        Curve.contour(pieces)
        for pieces in paths
        if any(isinstance(piece, Arc) or np.ptp(piece, axis=0).any() for piece in pieces)
    ]


def find_sliding_curves(
    to: str,
    *,
    font: str | None = None,
    corner_angle: float = 20.0,
    fixed: Sequence[int] = (),
    pieces: Path | None = None,
) -> BoundaryCurves:
    """Return the curves of an outline for a sliding boundary; arguments and errors as `outline_curves`,
    `BoundaryCurves`.

    The file ``pieces`` assigns vertices to sides of the outline; ValueError if a line is wrong or names a missing side.
    """
    curves = outline_curves(to, font=font)
    if pieces is None:
        return BoundaryCurves(curves, fixed=fixed, corner_angle=corner_angle)
    sides = [side for curve in curves for side in curve.sides(corner_angle)]
    return BoundaryCurves(sides, on=read_pieces(pieces, len(sides)), fixed=fixed, corner_angle=corner_angle)


def read_pieces(path: Path, sides: int) -> dict[int, int]:
    """Read lines of a vertex and its side; side indices must be below ``sides``.

    Blanks, commas or colons separate the indices; ``#`` starts a comment.
    """
    sides_of: dict[int, int] = {}
    for number, (vertex, side) in read_pairs(path, "'vertex side'"):
        if side >= sides:
            there = f"only sides 0 … {sides - 1}" if sides > 1 else "only one side, 0"
            raise MeshFileError(path, f"says side {side}, but the outline has {there}", number)
        if vertex in sides_of:
            raise MeshFileError(path, f"lists vertex {vertex} a second time", number)
        sides_of[vertex] = side
    return sides_of
