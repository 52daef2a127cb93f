"""What a page may ask the boundary to follow: an outline by its word, a drawing dropped on it, a polygon drawn by hand.

Nothing here reads a file that a page names: the words are those of shapes, and drawings come with their bytes.
"""

from __future__ import annotations

import re
import tempfile
from dataclasses import dataclass
from pathlib import Path, PurePosixPath

import numpy as np

from quasiharmonic.geometry.curves.curve import Curve
from quasiharmonic.targets import outline, outline_curves, read_svg
from quasiharmonic.util.arrays import FloatArray

# Digits and a point, of a length that no number on a page needs.
_NUMBER = r"\d{1,6}(?:\.\d{1,6})?"
_WORDS = re.compile(
    rf"disk|ellipse:{_NUMBER}x{_NUMBER}|ring:{_NUMBER}|rect:{_NUMBER}x{_NUMBER}|polygon:\d{{1,4}}|star:\d{{1,4}}"
    r"|letter:\S|word:\S{1,20}"
)
#: Of a drawing dropped on the page, and of the points drawn by hand.
MOST_BYTES, MOST_POINTS = 8 << 20, 10_000


@dataclass(frozen=True, eq=False)
class Outline:
    """Contours, and how they are asked for elsewhere.

    Attributes
    ----------
    to : str
        What ``--to`` of the command takes: a word, or the name of the file that ``content`` is to be kept in.
    contours : list of (k, 2) float64
    content : bytes or None
        That file, where ``to`` is no word.
    """

    to: str
    contours: list[FloatArray]
    content: bytes | None = None

    def curves(self) -> list[Curve]:
        """What a boundary slides along."""
        if self.content is None:
            return outline_curves(self.to)
        with tempfile.TemporaryDirectory() as folder:
            path = Path(folder) / self.to
            path.write_bytes(self.content)
            return outline_curves(path)


def outline_named(word: object) -> Outline:
    """The outline of a word, ``letter:R``.

    Raises
    ------
    ValueError
        When it is no such word; a file's name is none either.
    """
    if not isinstance(word, str) or not _WORDS.fullmatch(word):
        raise ValueError(
            f"unknown outline {str(word)[:40]!r}: use disk, ellipse:2x1, ring:0.5, rect:2x1, polygon:6, star:5, "
            "letter:R and word:QH"
        )
    return Outline(word, outline(word))


def outline_drawn(name: str, content: bytes) -> Outline:
    """The outline of an SVG drawing dropped on the page.

    Raises
    ------
    ValueError
        When it is none, or too large.
    """
    shown = re.sub(r"[^\w.-]", "_", PurePosixPath(name.replace("\\", "/")).stem)[:60].strip(".") or "drawing"
    if len(content) > MOST_BYTES:
        raise ValueError(f"{shown}.svg has {len(content):,} bytes; at most {MOST_BYTES:,} are allowed")
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "dropped.svg"
        path.write_bytes(content)
        try:
            contours = read_svg(path)
        except (ValueError, OSError) as error:
            raise ValueError(str(error).replace(str(path), f"{shown}.svg")) from None
    return Outline(f"{shown}.svg", contours, content)


def outline_by_hand(points: FloatArray) -> Outline:
    """The polygon (k, 2) drawn on the page.

    Raises
    ------
    ValueError
        When it has fewer than three corners or far too many, or one is not finite.
    """
    if points.ndim != 2 or points.shape[1:] != (2,) or not 3 <= len(points) <= MOST_POINTS:
        raise ValueError(f"a polygon has 3 to {MOST_POINTS:,} corners")
    if not np.isfinite(points).all():
        raise ValueError("a corner of the polygon is not finite")
    content = "".join(f"{x!r}, {y!r}\n" for x, y in points.tolist()).encode()
    return Outline("polygon.txt", [np.array(points, dtype=np.float64)], content)
