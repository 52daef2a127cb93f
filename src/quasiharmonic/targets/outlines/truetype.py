"""The outline of one plain glyph of a TrueType font.

What matplotlib loads before it can be asked takes a tenth of a second, a third of what mapping a small mesh takes in
all, and the font that letters are made of by default is of this kind. What is handed back is what FreeType, which
matplotlib asks, makes of such a glyph at 100 pixels, unhinted, to the last bit: points rounded to 1/64 of a pixel, ties
away from zero.
"""

from __future__ import annotations

from itertools import pairwise
from pathlib import Path
from unicodedata import category

import numpy as np

from quasiharmonic.targets.outlines.contours import Pieces
from quasiharmonic.util.arrays import IntArray

# Pixels of an em, and parts of a pixel that points are rounded to.
_PIXELS, _PARTS = 100, 64
# Beyond Latin, Greek and Cyrillic there is what is written from right to left, joined or stacked, by rules of its own;
# and so are marks, and what is not to be seen. Of the rest characters are letters, numbers, punctuation and symbols.
_SIMPLE, _KINDS = 0x530, "LNPS"


def glyph(file: Path, character: str) -> list[Pieces] | None:
    """Closed paths of lines and quadratic Bézier curves that a character is drawn by.

    Parameters
    ----------
    file : Path
    character : str
        A single one.

    Returns
    -------
    list of list of (2 or 3, 2) float64, or None
        Control points in units of the font size, each piece from where the one before ends. None where matplotlib is
        to be asked: of fonts that are damaged, vary or are not TrueType, and of glyphs that are empty, made of others,
        or not there.
    """
    import logging

    from fontTools.ttLib import TTFont

    # What it has to say of odd fonts is for those who have set up logging, and not for the screen.
    if not (log := logging.getLogger("fontTools")).handlers:
        log.addHandler(logging.NullHandler())
    if ord(character) >= _SIMPLE or category(character)[0] not in _KINDS:
        return None
    try:
        with file.open("rb") as data, TTFont(data, lazy=True) as font:
            if "glyf" not in font or "fvar" in font:
                return None
            name = font.getBestCmap()[ord(character)]
            drawn, bearing = font["glyf"][name], font["hmtx"][name][1]
            if drawn.numberOfContours < 1:
                return None
            points = _scaled(np.array(drawn.coordinates, dtype=np.int64), font["head"].unitsPerEm)
            points[:, 0] -= _scaled(np.array(drawn.xMin - bearing), font["head"].unitsPerEm)
            on, ends = [flag & 1 for flag in drawn.flags], [0, *(end + 1 for end in drawn.endPtsOfContours)]
    except Exception:  # a damaged font may raise anything, and FreeType has words for it
        return None
    return [_pieces(points[a:b], on[a:b]) for a, b in pairwise(ends) if a < b]


def _scaled(units: IntArray, em: int) -> IntArray:
    """Font units in 1/64 of a pixel, rounded as FreeType does, by a scale that is itself a fraction of 2^16."""
    scale = ((_PIXELS * _PARTS << 16) + em // 2) // em
    return np.sign(units) * (np.abs(units) * scale + 0x8000 >> 16)


def _pieces(points: IntArray, on: list[int]) -> Pieces:
    """A contour as lines and quadratic curves, between two points off the curve one on it in their middle."""
    corners = points.tolist()
    if not on[0]:
        # It begins where it ends, or else in the middle between its first and its last point.
        start = corners.pop() if on[-1] else _middle(corners[0], corners[-1])
        on = [1, *(on[:-1] if on[-1] else on)]
        corners = [start, *corners]
    pieces: list[list[list[int]]] = []
    here, control = corners[0], None
    for point, is_on in zip([*corners[1:], corners[0]], [*on[1:], 1], strict=True):
        if control is None:
            if is_on:
                pieces.append([here, point])
                here = point
            else:
                control = point
            continue
        end = point if is_on else _middle(control, point)
        pieces.append([here, control, end])
        here, control = end, None if is_on else point
    return [np.array(piece) / _PARTS / _PIXELS for piece in pieces]


def _middle(a: list[int], b: list[int]) -> list[int]:
    """Between two points, rounded towards zero as C divides."""
    return [int((p + q) / 2) for p, q in zip(a, b, strict=True)]
