"""The curves of an outline along which a boundary slides, and the file that assigns vertices to its sides.

Such outlines are exact curves instead of polylines.
"""

from __future__ import annotations

from collections.abc import Sequence
from os import PathLike, fspath
from pathlib import Path

import numpy as np

from quasiharmonic.geometry.curves import BoundaryCurves
from quasiharmonic.geometry.curves.arcs import Arc
from quasiharmonic.geometry.curves.curve import Curve
from quasiharmonic.io.errors import MeshFileError, report_damage
from quasiharmonic.io.lowlevel.textual import read_pairs
from quasiharmonic.targets.outlines.contours import Pieces
from quasiharmonic.targets.outlines.letters import Font, glyph_paths
from quasiharmonic.targets.outlines.svg import svg_paths
from quasiharmonic.targets.outlines.words import word_curves
from quasiharmonic.targets.specification import TOLERANCE, outline


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
