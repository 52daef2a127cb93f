"""Outlines as exact curves instead of polylines, for boundaries that slide along them."""

from __future__ import annotations

from os import PathLike, fspath
from pathlib import Path

import numpy as np

from quasiharmonic.geometry.curves.arcs import Arc
from quasiharmonic.geometry.curves.curve import Curve
from quasiharmonic.io.errors import reading
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
        with reading(text):
            return _contours(svg_paths(text, arcs=True))
    return [Curve.polygon(contour) for contour in contours]


def _contours(paths: list[Pieces]) -> list[Curve]:
    """Return closed curves for the paths that are longer than a point."""
    return [
        Curve.contour(pieces)
        for pieces in paths
        if any(isinstance(piece, Arc) or np.ptp(piece, axis=0).any() for piece in pieces)
    ]
