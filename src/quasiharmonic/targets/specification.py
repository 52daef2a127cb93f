"""Outlines specified by a short string, as on the command line: ``letter:G``, ``rect:2x1``, ``drawing.svg``."""

from __future__ import annotations

import math
from os import PathLike, fspath
from pathlib import Path

from quasiharmonic.io.errors import check_path
from quasiharmonic.targets.outlines import shapes as outlines
from quasiharmonic.targets.outlines.contours import MAX_POINTS
from quasiharmonic.targets.outlines.letters import Font, letter
from quasiharmonic.targets.outlines.shapes import read_polylines
from quasiharmonic.targets.outlines.svg import read_svg
from quasiharmonic.targets.outlines.words import word
from quasiharmonic.util.arrays import FloatArray, check_numbers

FORMS = "disk, ellipse:2x1, rect:2x1, polygon:6, star:5, ring:0.5, letter:G, word:QH, or a file .svg, .txt or .csv"
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
    raise ValueError(f"unknown outline {text!r}: use {FORMS}")


def _number(text: str, argument: str) -> float:
    try:
        return float(argument)
    except ValueError:
        raise ValueError(f"{text!r}: {argument!r} is not a number") from None


def _pair(text: str, argument: str) -> tuple[float, float]:
    parts = argument.lower().split("x")
    if len(parts) != 2:
        raise ValueError(f"{text!r}: give two numbers with an x between them, as in 2x1")
    return _number(text, parts[0]), _number(text, parts[1])


def _count(text: str, argument: str) -> int:
    if not (argument.isascii() and argument.isdigit()):
        raise ValueError(f"{text!r}: {argument!r} is not a whole number")
    if len(argument) > 6 or int(argument) > MAX_POINTS // 2:
        raise ValueError(f"{text!r}: {argument} is too many")
    return int(argument)
