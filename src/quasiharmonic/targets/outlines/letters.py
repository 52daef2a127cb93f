"""Outlines of letters in any font that matplotlib can read."""

from __future__ import annotations

from importlib.util import find_spec
from os import PathLike
from pathlib import Path as FilePath
from typing import Any

import numpy as np

from quasiharmonic.targets.outlines import truetype
from quasiharmonic.targets.outlines.contours import Pieces, flatten, signed_area
from quasiharmonic.targets.outlines.nesting import nested
from quasiharmonic.util.arrays import FloatArray

Font = str | PathLike[str]
_FONT_FILES = ".ttf", ".otf", ".ttc"
# Folder within matplotlib's data.
_BUNDLED = "fonts", "ttf"


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
    if len(character) != 1:
        raise ValueError(f"character must be a single character, not {character!r}")
    found = _contours(character, font, tolerance)
    try:
        contours = nested(found)
    except ValueError as error:
        raise ValueError(f"the glyph of {character!r}: {error}") from error
    if not contours:
        raise ValueError(f"the glyph of {character!r} has no outline")
    return contours


def _contours(character: str, font: Font | None, tolerance: float) -> list[FloatArray]:
    """Contours of a character, in the font's orientation."""
    contours = [flatten(pieces, tolerance) for pieces in glyph_paths(character, font)]
    return [contour for contour in contours if len(contour) > 2 and signed_area(contour) != 0]


def glyph_paths(character: str, font: Font | None = None) -> list[Pieces]:
    """Closed paths of lines and Bézier curves of a character; raises as `letter`."""
    file = _font_file(font)
    plain = truetype.glyph(file, character)
    return _by_matplotlib(file, character) if plain is None else plain


def _by_matplotlib(file: FilePath, character: str) -> list[Pieces]:
    """Read the paths of a character in any font with matplotlib, or raise a ValueError that states the problem."""
    from matplotlib.font_manager import FontProperties, get_font
    from matplotlib.path import Path
    from matplotlib.textpath import text_to_path

    try:
        face = get_font(file)
    except RuntimeError as error:
        raise ValueError(f"{file} is not a readable font: {error}") from error
    if not face.get_char_index(ord(character)):
        raise ValueError(f"{file.name} has no glyph for {character!r}")
    points, codes = text_to_path.get_text_path(FontProperties(fname=file), character)
    if len(codes) == 0:
        return []
    return _pieces(Path(np.asarray(points) / text_to_path.FONT_SCALE, codes))


def _pieces(path: Any) -> list[Pieces]:
    """Split a matplotlib path of lines and Bézier curves into closed parts."""
    parts: list[Pieces] = []
    here = np.zeros((0, 2))
    for flat, code in path.iter_segments(simplify=False):
        control = flat.reshape(-1, 2)
        if code == path.MOVETO:
            parts.append([])
        elif code == path.CLOSEPOLY:  # its point has no meaning
            continue
        else:
            parts[-1].append(np.concatenate([here, control]))
        here = control[-1:]
    return [part for part in parts if part]


def _font_file(font: Font | None) -> FilePath:
    if font is None:
        return _bundled("DejaVuSans-Bold.ttf")
    file = FilePath(font)
    if file.is_file():
        return file
    if file.suffix.lower() in _FONT_FILES or len(file.parts) > 1:
        raise FileNotFoundError(f"there is no font file {file}")
    return _installed(str(font))


def _bundled(name: str) -> FilePath:
    """Path of a font that comes with matplotlib; imports matplotlib only if its data are not in its own folder."""
    found = find_spec("matplotlib")
    for folder in (found and found.submodule_search_locations) or []:
        file = FilePath(folder, "mpl-data", *_BUNDLED, name)
        if file.is_file():
            return file
    import matplotlib

    return FilePath(matplotlib.get_data_path(), *_BUNDLED, name)


def _installed(name: str) -> FilePath:
    """Path of the file of an installed font."""
    from difflib import get_close_matches

    from matplotlib.font_manager import FontProperties, findfont, get_font_names

    try:
        return FilePath(findfont(FontProperties(name), fallback_to_default=False))
    except ValueError as error:
        near = get_close_matches(name.split(":")[0], get_font_names(), n=3)
        hint = f"; similar names: {', '.join(near)}" if near else ""
        raise ValueError(f"no font named {name!r} is installed{hint}") from error
