"""Outlines of letters in TrueType and OpenType fonts, and of words, which are made of overlapping letters.

A word has an outline of contours, and the exact curves of the contours.
"""

from __future__ import annotations

import itertools
from functools import lru_cache
from importlib.util import find_spec
from os import PathLike
from pathlib import Path as FilePath
from typing import Any, NamedTuple

import numpy as np

from quasiharmonic.geometry.curves.curve import Curve
from quasiharmonic.io.errors import check_path
from quasiharmonic.targets.outlines.contours import Pieces, drop_close_points, filled, flatten, nested, signed_area
from quasiharmonic.util.arrays import FloatArray, check_instance, check_positive, count_of, describe
from quasiharmonic.util.hints import explain_missing

Font = str | PathLike[str]
_FONT_FILES = ".ttf", ".otf", ".ttc"

#: Overlap of each letter with the one before, in units of the font size, by default.
OVERLAP = 0.03


class MeetingTuning(NamedTuple):
    """Numbers that tune the search for the meeting points of letters."""

    # Points of a united outline closer than this, in units of the font size, are merged.
    same_point: float = 1e-12
    # Maximum number of Newton steps to the intersection of two curves.
    max_steps: int = 30
    # Tolerance of the intersection, as a share of the curve's size.
    tolerance: float = 1e-14
    # Maximum relative difference between the lengths of a curve and its chords.
    length_difference: float = 0.01
    # Where chords cross at a small angle, the curves may intersect at this distance from there, in tolerances.
    max_distance: float = 100.0


_TUNING = MeetingTuning()

_TANGENT_LETTERS = (
    "letters of the word are almost tangent where they touch, so their curves cannot be joined: choose other letters, "
    "or slide the boundary along a polygon"
)


def letter(character: str, font: Font | None = None, *, tolerance: float = 5e-4) -> list[FloatArray]:
    """Return the outline of one character of a font.

    Parameters
    ----------
    character : str
        A single visible character.
    font : str or path, optional
        A font file (TrueType or OpenType), or the name of an installed font, optionally with weight and slant:
        ``"DejaVu Serif:bold:italic"``. By default DejaVu Sans Bold, which comes with matplotlib.
    tolerance : float
        Maximum deviation of the contours from the font's curves, in units of the font size.

    Returns
    -------
    list of (k, 2) float64
        The contours by decreasing area, so the first is an outer one. Outer contours are counterclockwise, holes
        clockwise. The font size is 1 and the base line is y = 0.

    Raises
    ------
    ValueError
        When ``character`` is not a single character, the font has no outline for it, no installed font has this name,
        or the file is not a font.
    FileNotFoundError
        When the font file does not exist.
    """
    if not isinstance(character, str) or len(character) != 1:
        raise ValueError(f"character must be a single character, not {describe(character)}")
    check_positive(tolerance=tolerance)
    found = [flatten(path, tolerance) for path in glyph_paths(character, font)]
    try:
        contours = nested([contour for contour in found if len(contour) > 2 and signed_area(contour) != 0])
    except ValueError as error:
        raise ValueError(f"the glyph of {character!r}: {error}") from error
    if not contours:
        raise ValueError(f"the glyph of {character!r} has no outline: choose another character")
    return contours


def glyph_paths(character: str, font: Font | None = None) -> list[Pieces]:
    """Closed paths of lines and Bézier curves of a character, in units of the font size; raises as `letter`."""
    if font is None:
        return [[piece.copy() for piece in path] for path in _default_glyph(character)]
    return _read_glyph(character, _font_file(font))


@lru_cache(maxsize=256)
def _default_glyph(character: str) -> list[Pieces]:
    """The paths of a character in the default font, which does not change."""
    return _read_glyph(character, _find_default())


def _read_glyph(character: str, file: FilePath) -> list[Pieces]:
    """The paths of a character in a font file."""
    import logging

    from fontTools.pens.basePen import BasePen
    from fontTools.ttLib import TTFont

    class OutlinePen(BasePen):  # type: ignore[misc]
        """Collect the pieces of each contour, without lines of length zero."""

        def __init__(self, glyphs: Any) -> None:
            super().__init__(glyphs)
            self.paths: list[Pieces] = []

        def _moveTo(self, point: tuple[float, float]) -> None:
            self.paths.append([])

        def _lineTo(self, point: tuple[float, float]) -> None:
            if point != self._getCurrentPoint():
                self._curve(point)

        def _curve(self, *points: tuple[float, float]) -> None:
            self.paths[-1].append(np.array([self._getCurrentPoint(), *points], dtype=np.float64))

        _curveToOne = _qCurveToOne = _curve  # noqa: N815

        def _closePath(self) -> None:
            if self.paths[-1]:
                self._lineTo(tuple(self.paths[-1][0][0]))

    # Without a handler, messages of fontTools about odd fonts would appear on the screen.
    if not (log := logging.getLogger("fontTools")).handlers:
        log.addHandler(logging.NullHandler())
    try:
        with file.open("rb") as data, TTFont(data, fontNumber=0, lazy=True) as face:
            name = (face.getBestCmap() or {}).get(ord(character))
            pen = OutlinePen(glyphs := face.getGlyphSet())
            if name is not None:
                glyphs[name].draw(pen)
            em = face["head"].unitsPerEm
    except Exception as error:  # a damaged font may raise any error
        raise ValueError(f"{file} is not a readable font: {error}") from error
    if name is None:
        raise ValueError(f"{file.name} has no glyph for {character!r}: choose another font")
    return [[piece / em for piece in path] for path in pen.paths if path]


def _font_file(font: Font) -> FilePath:
    check_path("font", font)
    file = FilePath(font)
    if file.is_file():
        return file
    if file.suffix.lower() in _FONT_FILES or len(file.parts) > 1:
        raise FileNotFoundError(f"there is no font file {file}")
    return _find_installed(str(font))


def _find_default() -> FilePath:
    """Path of the default font; imports matplotlib, which is slow, only if its data are not in its own folder."""
    font = FilePath("fonts", "ttf", "DejaVuSans-Bold.ttf")
    found = find_spec("matplotlib")
    for folder in (found and found.submodule_search_locations) or []:
        if (file := FilePath(folder, "mpl-data", font)).is_file():
            return file
    import matplotlib

    return FilePath(matplotlib.get_data_path(), font)


def _find_installed(name: str) -> FilePath:
    """Path of the file of an installed font."""
    from difflib import get_close_matches

    from matplotlib.font_manager import FontProperties, findfont, get_font_names

    try:
        return FilePath(findfont(FontProperties(name), fallback_to_default=False))
    except ValueError as error:
        near = get_close_matches(name.split(":")[0], get_font_names(), n=3)
        hint = f"; similar names: {', '.join(near)}" if near else ""
        raise ValueError(f"no font named {name!r} is installed{hint}") from error


def word(text: str, font: Font | None = None, *, overlap: float = OVERLAP, tolerance: float = 5e-4) -> list[FloatArray]:
    """Return the outline of several letters that overlap and form one piece.

    A connected surface cannot fill an outline of several pieces, so the letters must overlap.

    Parameters
    ----------
    text : str
        Visible characters.
    font : str or path, optional
        As for `letter`.
    overlap : float
        Overlap of each letter with the one before, in units of the font size.
    tolerance : float
        As for `letter`.

    Returns
    -------
    list of (k, 2) float64
        One outer contour, counterclockwise, and holes, clockwise. The first letter has the position of `letter`.

    Raises
    ------
    ValueError
        As for `letter`; when the overlap is not positive; when a part of a letter, such as the dot of an i, touches no
        other.
    FileNotFoundError
        When the font file does not exist.
    ModuleNotFoundError
        When Shapely, which unites the letters, is not installed.
    """
    contours = [
        drop_close_points(contour, tolerance) for contour in _unite(_place_letters(text, font, overlap, tolerance)[0])
    ]
    loose = len(filled(contours)) - 1
    if loose:
        raise ValueError(
            f"{count_of('part', 'parts', loose)} of {text!r} (a dot, an accent) "
            f"{'touches' if loose == 1 else 'touch'} no other part: choose other letters, such as capitals"
        )
    return contours


def word_curves(text: str, font: Font | None, tolerance: float) -> list[Curve]:
    """Return the exact curves of the contours of `word`: pieces of the letters' curves, joined at their intersections.

    There is one closed curve for each contour. Errors as `word`; ValueError also when letters touch at so small an
    angle that the intersection of their curves cannot be found.
    """
    letters, shifts = _place_letters(text, font, OVERLAP, tolerance)
    drawn = [
        Curve.contour([piece - (shift, 0.0) for piece in path])
        for character, shift in zip(text, shifts, strict=True)
        for path in glyph_paths(character, font)
        if any(np.ptp(piece, axis=0).any() for piece in path)
    ]
    return [_trace(drop_close_points(contour, _TUNING.same_point), drawn, tolerance) for contour in _unite(letters)]


def _place_letters(
    text: str, font: Font | None, overlap: float, tolerance: float
) -> tuple[list[list[FloatArray]], list[float]]:
    """Return the contours of each letter in its position, and each letter's shift to the left."""
    check_instance("text", text, str)
    check_positive(overlap=overlap)
    if not text:
        raise ValueError("a word needs at least one letter")
    letters = [letter(character, font, tolerance=tolerance) for character in text]
    shifts = [0.0]
    for before, after in itertools.pairwise(letters):
        shifts.append(_letter_spacing(before, after) + overlap)
        for contour in after:
            contour[:, 0] -= shifts[-1]
    return letters, shifts


def _trace(contour: FloatArray, drawn: list[Curve], tolerance: float) -> Curve:
    """Return the curve of which a united contour is a polyline, made of pieces of the letters' curves."""
    middles = (contour + np.roll(contour, -1, axis=0)) / 2
    by_point, by_middle = (np.stack([one.nearest(points)[1] for one in drawn]) for points in (contour, middles))
    # A chord belongs to the curve closest to its middle and both its ends. Other curves may cross it there.
    own = np.argmin(by_point + by_middle + np.roll(by_point, -1, axis=1), axis=0)
    begins = np.flatnonzero(own != np.roll(own, 1))
    if not begins.size:
        return drawn[own[0]]
    contour, own = np.roll(contour, -begins[0], axis=0), np.roll(own, -begins[0])
    runs = np.split(np.arange(len(contour)), begins[1:] - begins[0])
    curves = [drawn[own[run[0]]] for run in runs]
    # Start of each run, on the previous curve and on its own.
    meetings = [_find_meeting(curves[k - 1], curves[k], contour[run[0]]) for k, run in enumerate(runs)]
    pieces = []
    for k, (one, run) in enumerate(zip(curves, runs, strict=True)):
        points = contour[np.append(run, run[-1] + 1) % len(contour)]
        start, end = meetings[k][1], meetings[(k + 1) % len(runs)][0]
        steps = np.diff(one.nearest(points)[0])
        if float(np.sum(steps - one.length * np.round(steps / one.length))) > 0:
            pieces += one.section(start, end)
        else:
            pieces += [np.asarray(piece)[::-1] for piece in reversed(one.section(end, start))]
    found = Curve(pieces)
    around = float(np.hypot(*(np.roll(contour, -1, axis=0) - contour).T).sum())
    away = float(found.nearest(contour)[1].max())
    if (
        not found.closed
        or abs(found.length - around) > _TUNING.length_difference * around
        or away > _TUNING.max_distance * tolerance
    ):
        raise ValueError(_TANGENT_LETTERS)
    return found


def _find_meeting(one: Curve, other: Curve, near: FloatArray) -> tuple[float, float]:
    """Intersection of two curves near a point, as arc lengths along each, by Newton's method."""
    s, t = (curve.nearest(near[None])[0] for curve in (one, other))
    ahead = np.ones(1, dtype=bool)
    for _ in range(_TUNING.max_steps):
        apart = ((other.position(t) - one.position(s)) @ (1, 1j))[0]
        if abs(apart) <= _TUNING.tolerance * one.size:
            return float(s[0]), float(t[0])
        along, across = one.frame(s, ahead)[0][0], other.frame(t, ahead)[0][0]
        sine = (along.conjugate() * across).imag
        if abs(sine) < 1e-6:
            break
        s = one.advance(s, np.array([(apart * across.conjugate()).imag / -sine]))
        t = other.advance(t, np.array([(apart * along.conjugate()).imag / -sine]))
    raise ValueError(_TANGENT_LETTERS)


def _letter_spacing(before: list[FloatArray], after: list[FloatArray]) -> float:
    """Distance by which one letter can move to the left until it touches another."""
    low, high = (
        [extreme([extreme(c[:, 1]) for c in shape]) for shape in (before, after)] for extreme in (np.min, np.max)
    )
    levels = np.linspace(max(low), min(high), 513)[1:-1:2]
    right_side = -_find_leftmost([c * (-1, 1) for c in before], levels)
    return float((_find_leftmost(after, levels) - right_side).min())


def _find_leftmost(shape: list[FloatArray], levels: FloatArray) -> FloatArray:
    """Smallest x of a shape on each horizontal line, ``inf`` where the line misses the shape."""
    a = np.concatenate(shape)
    b = np.concatenate([np.roll(contour, -1, axis=0) for contour in shape])
    y = levels[:, None]
    meets = (a[:, 1] > y) != (b[:, 1] > y)
    rise = np.where(a[:, 1] == b[:, 1], 1.0, b[:, 1] - a[:, 1])
    return np.asarray(np.where(meets, a[:, 0] + (y - a[:, 1]) / rise * (b[:, 0] - a[:, 0]), np.inf).min(axis=1))


def _unite(shapes: list[list[FloatArray]]) -> list[FloatArray]:
    """Outline of the union of shapes, each of them an outline oriented as in `nested`."""
    with explain_missing("joining the letters of a word needs Shapely", extra="shapes"):
        import shapely

    covered = [
        shapely.difference(
            shapely.union_all([shapely.Polygon(c) for c in contours if signed_area(c) > 0]),
            shapely.union_all([shapely.Polygon(c) for c in contours if signed_area(c) < 0]),
        )
        for contours in shapes
    ]
    rings = shapely.get_rings(shapely.get_parts(shapely.union_all(covered)))
    # A ring repeats its first point at the end.
    return nested([shapely.get_coordinates(ring)[:-1] for ring in rings])
