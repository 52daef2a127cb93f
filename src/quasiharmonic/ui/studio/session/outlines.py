"""Outlines for the boundary: a named shape, an uploaded drawing, or a polygon drawn by hand.

This module never reads a file named by a page: names are those of shapes, and drawings arrive as bytes.
"""

from __future__ import annotations

import re
from dataclasses import dataclass
from pathlib import PurePosixPath

import numpy as np

from quasiharmonic.geometry.curves.curve import Curve
from quasiharmonic.targets import outline, outline_curves, read_svg
from quasiharmonic.ui.studio.session.validation import stored_file
from quasiharmonic.util.arrays import FloatArray

# A decimal number of limited length.
_NUMBER = r"\d{1,6}(?:\.\d{1,6})?"
_WORDS = re.compile(
    rf"disk|ellipse:{_NUMBER}x{_NUMBER}|ring:{_NUMBER}|rect:{_NUMBER}x{_NUMBER}|polygon:\d{{1,4}}|star:\d{{1,4}}"
    r"|letter:\S|word:\S{1,20}"
)
#: Maximum size of an uploaded drawing in bytes.
MAX_BYTES = 8 << 20
#: Maximum number of points drawn by hand.
MAX_POINTS = 10_000


@dataclass(frozen=True, eq=False)
class Outline:
    """Contours, and the argument that reproduces them."""

    to: str  # Argument of ``--to``: the name of a shape, or the file name for ``content``
    contours: list[FloatArray]  # each (k, 2)
    content: bytes | None = None  # Contents of that file; None if ``to`` is the name of a shape

    @property
    def texts(self) -> dict[str, bytes]:
        """Contents of the files that ``to`` names, by name."""
        return {} if self.content is None else {self.to: self.content}

    def curves(self) -> list[Curve]:
        """Return the curves for a sliding boundary."""
        if self.content is None:
            return outline_curves(self.to)
        with stored_file(self.to, self.content) as path:
            return outline_curves(path)


def make_outline(word: object) -> Outline:
    """Return the outline of a named shape, such as ``letter:R``; ValueError for other names, also those of files."""
    if not isinstance(word, str) or not _WORDS.fullmatch(word):
        raise ValueError(
            f"unknown outline {str(word)[:40]!r}: use disk, ellipse:2x1, ring:0.5, rect:2x1, polygon:6, star:5, "
            "letter:R and word:QH"
        )
    return Outline(word, outline(word))


def read_drawing(name: str, content: bytes) -> Outline:
    """Return the outline of an uploaded SVG drawing; ValueError if it is not a valid drawing, or too large."""
    shown = re.sub(r"[^\w.-]", "_", PurePosixPath(name.replace("\\", "/")).stem)[:60].strip(".") or "drawing"
    if len(content) > MAX_BYTES:
        raise ValueError(f"{shown}.svg has {len(content):,} bytes; at most {MAX_BYTES:,} are allowed")
    with stored_file("dropped.svg", content) as path:
        try:
            contours = read_svg(path)
        except (ValueError, OSError) as error:
            raise ValueError(str(error).replace(str(path), f"{shown}.svg")) from None
    return Outline(f"{shown}.svg", contours, content)


def make_polygon(points: FloatArray) -> Outline:
    """Return the outline of a polygon (k, 2) drawn on the page.

    ValueError if it has fewer than three or too many corners, or a corner is not finite.
    """
    if points.ndim != 2 or points.shape[1:] != (2,) or not 3 <= len(points) <= MAX_POINTS:
        raise ValueError(f"a polygon has 3 to {MAX_POINTS:,} corners")
    if not np.isfinite(points).all():
        raise ValueError("a corner of the polygon is not finite")
    content = "".join(f"{x!r}, {y!r}\n" for x, y in points.tolist()).encode()
    return Outline("polygon.txt", [np.array(points, dtype=np.float64)], content)
