"""The outline of a simple glyph of a TrueType font, read without matplotlib.

Loading matplotlib takes a tenth of a second, a third of the total time for a small mesh. The default font for letters
can be read directly instead. The result equals, bit for bit, the glyph that FreeType (used by matplotlib) returns at
100 pixels, unhinted. Points are rounded to 1/64 of a pixel, ties away from zero.
"""

from __future__ import annotations

from itertools import pairwise
from pathlib import Path
from unicodedata import category

import numpy as np

from quasiharmonic.targets.outlines.contours import Pieces
from quasiharmonic.util.arrays import IntArray

# Pixels per em, and subdivisions of a pixel to which points are rounded.
_PIXELS, _PARTS = 100, 64
# Scripts after Latin, Greek and Cyrillic may need shaping (right to left, joined or stacked), as do combining marks.
# Invisible characters are also excluded. This leaves letters, numbers, punctuation and symbols.
_SIMPLE, _KINDS = 0x530, "LNPS"


def glyph(file: Path, character: str) -> list[Pieces] | None:
    """Closed paths of lines and quadratic Bézier curves of a character.

    Parameters
    ----------
    file : Path
    character : str
        A single character.

    Returns
    -------
    list of list of (2 or 3, 2) float64, or None
        Control points in units of the font size; each piece starts where the one before ends. None if matplotlib must
        read the glyph: for fonts that are damaged, variable or not TrueType, and for glyphs that are empty, composite
        or missing.
    """
    import logging

    from fontTools.ttLib import TTFont

    # Without a handler, messages of fontTools about odd fonts would appear on the screen. Users who configure logging
    # get them.
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
    except Exception:  # a damaged font may raise any error; FreeType then reports it
        return None
    return [_pieces(points[a:b], on[a:b]) for a, b in pairwise(ends) if a < b]


def _scaled(units: IntArray, em: int) -> IntArray:
    """Convert font units to 1/64 of a pixel, rounded like FreeType with its fixed-point scale (16 fractional bits)."""
    scale = ((_PIXELS * _PARTS << 16) + em // 2) // em
    return np.sign(units) * (np.abs(units) * scale + 0x8000 >> 16)


def _pieces(points: IntArray, on: list[int]) -> Pieces:
    """Split a contour into lines and quadratic curves.

    Two successive off-curve points imply an on-curve point midway.
    """
    corners = points.tolist()
    if not on[0]:
        # Start at the last point if it is on the curve, otherwise midway between the first and last points.
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
    """Midpoint, rounded towards zero like integer division in C."""
    return [int((p + q) / 2) for p, q in zip(a, b, strict=True)]
