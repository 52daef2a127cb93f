"""Outlines of letters in TrueType and OpenType fonts."""

from __future__ import annotations

from functools import lru_cache
from importlib.util import find_spec
from os import PathLike
from pathlib import Path as FilePath
from typing import Any

import numpy as np

from quasiharmonic.io.errors import check_path
from quasiharmonic.targets.outlines.contours import Pieces, flatten, nested, signed_area
from quasiharmonic.util.arrays import FloatArray, check_positive, describe

Font = str | PathLike[str]
_FONT_FILES = ".ttf", ".otf", ".ttc"


def letter(character: str, font: Font | None = None, *, tolerance: float = 5e-4) -> list[FloatArray]:
    """Outline of one character of a font.

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
        raise ValueError(f"the glyph of {character!r} has no outline")
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
        raise ValueError(f"{file.name} has no glyph for {character!r}")
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
