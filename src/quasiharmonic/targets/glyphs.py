"""Outlines of letters and words in any font that matplotlib can read."""

from __future__ import annotations

import itertools
from os import PathLike
from pathlib import Path as FilePath
from typing import Any

import numpy as np

from quasiharmonic.arrays import FloatArray
from quasiharmonic.targets.contours import Pieces, distinct, flatten, signed_area
from quasiharmonic.targets.nesting import filled, nested

Font = str | PathLike[str]
_FONT_FILES = ".ttf", ".otf", ".ttc"


def letter(character: str, font: Font | None = None, *, tolerance: float = 5e-4) -> list[FloatArray]:
    """Outlines of one character of a font.

    Parameters
    ----------
    character : str
        Exactly one, with something to see.
    font : str or path, optional
        A font file (TrueType or OpenType), or the name of an installed font, with a weight and a slant
        after colons if need be: ``"DejaVu Serif:bold:italic"``. DejaVu Sans Bold, which comes with
        matplotlib, by default.
    tolerance : float
        How far the contours may stray from the font's curves, in units of the font size.

    Returns
    -------
    list of (k, 2) float64
        The contours by decreasing area, so the first is the outer one; counterclockwise where the
        letter lies inside and clockwise around its holes. The font size is 1 and the base line
        y = 0.

    Raises
    ------
    ValueError
        When ``character`` is not a single one, or the font has no outline for it, or no font has this
        name, or the file is no font.
    FileNotFoundError
        When there is no such font file.
    """
    if len(character) != 1:
        raise ValueError(f"an outline is made of one character, not of {character!r}")
    found = _contours(character, font, tolerance)
    try:
        contours = nested(found)
    except ValueError as error:
        raise ValueError(f"the glyph of {character!r}: {error}") from error
    if not contours:
        raise ValueError(f"the glyph of {character!r} has no outline")
    return contours


def word(text: str, font: Font | None = None, *, overlap: float = 0.03, tolerance: float = 5e-4) -> list[FloatArray]:
    """Outline of several letters, set so tightly that they make one piece.

    A connected surface can fill no outline of several pieces, so the letters of a word have to overlap.

    Parameters
    ----------
    text : str
        Characters with something to see.
    font : str or path, optional
        As for `letter`.
    overlap : float
        How far each letter is pushed into the one before, in units of the font size.
    tolerance : float
        As for `letter`.

    Returns
    -------
    list of (k, 2) float64
        One outer contour, counterclockwise, and holes, clockwise. The first letter stands as `letter`
        has it.

    Raises
    ------
    ValueError
        As for `letter`; when the overlap is not positive; when a part of a letter touches no other, as
        the dot of an i.
    FileNotFoundError
        When there is no such font file.
    ModuleNotFoundError
        When Shapely, which unites the letters, is not installed.
    """
    if not 0 < overlap < np.inf:
        raise ValueError(f"overlap must be positive and finite, not {overlap}")
    if not text:
        raise ValueError("a word needs a letter")
    letters = [letter(character, font, tolerance=tolerance) for character in text]
    for before, after in itertools.pairwise(letters):
        shift = _gap(before, after) + overlap
        for contour in after:
            contour[:, 0] -= shift
    contours = [distinct(contour, tolerance) for contour in _united(letters)]
    loose = len(filled(contours)) - 1
    if loose:
        raise ValueError(
            f"{loose} {'part' if loose == 1 else 'parts'} of {text!r} (a dot, an accent) "
            f"{'touches' if loose == 1 else 'touch'} no other; choose other letters, capitals for instance"
        )
    return contours


def _gap(before: list[FloatArray], after: list[FloatArray]) -> float:
    """How far one letter can move to the left until it touches another, on some level of both."""
    low, high = (
        [extreme([extreme(c[:, 1]) for c in shape]) for shape in (before, after)] for extreme in (np.min, np.max)
    )
    levels = np.linspace(max(low), min(high), 513)[1:-1:2]
    room = -_leftmost([c * (-1, 1) for c in before], levels)
    return float((_leftmost(after, levels) - room).min())


def _leftmost(shape: list[FloatArray], levels: FloatArray) -> FloatArray:
    """Where a shape begins on horizontal lines, infinite where it does not meet them."""
    a = np.concatenate(shape)
    b = np.concatenate([np.roll(contour, -1, axis=0) for contour in shape])
    y = levels[:, None]
    meets = (a[:, 1] > y) != (b[:, 1] > y)
    rise = np.where(a[:, 1] == b[:, 1], 1.0, b[:, 1] - a[:, 1])
    return np.asarray(np.where(meets, a[:, 0] + (y - a[:, 1]) / rise * (b[:, 0] - a[:, 0]), np.inf).min(axis=1))


def _contours(text: str, font: Font | None, tolerance: float) -> list[FloatArray]:
    """Contours of a line of text as the font winds them, counterclockwise or not."""
    contours = [flatten(pieces, tolerance) for pieces in glyph_paths(text, font)]
    return [contour for contour in contours if len(contour) > 2 and signed_area(contour) != 0]


def glyph_paths(text: str, font: Font | None = None) -> list[Pieces]:
    """The closed paths of lines and Bézier curves that a line of text is drawn by; raises as `letter`."""
    from matplotlib.font_manager import FontProperties, get_font
    from matplotlib.path import Path
    from matplotlib.textpath import text_to_path

    file = _font_file(font)
    try:
        face = get_font(file)
    except RuntimeError as error:
        raise ValueError(f"{file} is not a font that can be read: {error}") from error
    for character in text:
        if not face.get_char_index(ord(character)):
            raise ValueError(f"{file.name} has no glyph for {character!r}")
    points, codes = text_to_path.get_text_path(FontProperties(fname=file), text)
    if len(codes) == 0:
        return []
    return _pieces(Path(np.asarray(points) / text_to_path.FONT_SCALE, codes))


def _pieces(path: Any) -> list[Pieces]:
    """Take a matplotlib path of lines and Bézier curves apart into its closed parts."""
    parts: list[Pieces] = []
    here = np.zeros((0, 2))
    for flat, code in path.iter_segments(simplify=False):
        control = flat.reshape(-1, 2)
        if code == path.MOVETO:
            parts.append([])
        elif code == path.CLOSEPOLY:  # its point says nothing
            continue
        else:
            parts[-1].append(np.concatenate([here, control]))
        here = control[-1:]
    return [part for part in parts if part]


def _united(shapes: list[list[FloatArray]]) -> list[FloatArray]:
    """The outline of all that some shapes cover; each is an outline of its own, wound as `nested` does."""
    try:
        import shapely
    except ModuleNotFoundError as error:
        raise ModuleNotFoundError(
            "joining the letters of a word needs Shapely: pip install 'quasiharmonic[shapes]'"
        ) from error

    covered = [
        shapely.difference(
            shapely.union_all([shapely.Polygon(c) for c in contours if signed_area(c) > 0]),
            shapely.union_all([shapely.Polygon(c) for c in contours if signed_area(c) < 0]),
        )
        for contours in shapes
    ]
    rings = shapely.get_rings(shapely.get_parts(shapely.union_all(covered)))
    # The last point of a ring is its first again.
    return nested([shapely.get_coordinates(ring)[:-1] for ring in rings])


def _font_file(font: Font | None) -> FilePath:
    if font is None:
        import matplotlib

        return FilePath(matplotlib.get_data_path(), "fonts", "ttf", "DejaVuSans-Bold.ttf")
    file = FilePath(font)
    if file.is_file():
        return file
    if file.suffix.lower() in _FONT_FILES or len(file.parts) > 1:
        raise FileNotFoundError(f"no font file {file}")
    return _installed(str(font))


def _installed(name: str) -> FilePath:
    """The file of an installed font."""
    from difflib import get_close_matches

    from matplotlib.font_manager import FontProperties, findfont, get_font_names

    try:
        return FilePath(findfont(FontProperties(name), fallback_to_default=False))
    except ValueError as error:
        near = get_close_matches(name.split(":")[0], get_font_names(), n=3)
        hint = f"; there is {', '.join(near)}" if near else ""
        raise ValueError(f"no font of the name {name!r} is installed{hint}") from error
