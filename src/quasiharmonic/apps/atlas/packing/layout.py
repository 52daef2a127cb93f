"""Search for the largest common scale at which the bitmaps of all charts fit into the tiles."""

from __future__ import annotations

from collections.abc import Sequence
from math import ceil, hypot, pi, sqrt
from typing import NamedTuple

import numpy as np

from quasiharmonic.apps.atlas.packing.bitmap_search import (
    BITMAPS,
    MANY,
    MORE_CELLS,
    MOST_CELLS,
    TRIALS,
    BitmapSearch,
    Layout,
    Textures,
)
from quasiharmonic.apps.atlas.packing.board import Occupied
from quasiharmonic.apps.atlas.packing.shapes import Shape
from quasiharmonic.util.arrays import ComplexArray, FloatArray, IntArray


class LayoutTuning(NamedTuple):
    """Numbers that tune the search for the scale of a layout."""

    # Share of the tiles that charts with half the padding around them are expected to cover.
    expected: float = 0.8
    # Directions compared for the expected scale.
    turns: int = 16
    # Around charts that stay, shapes are placed on boards with this many times as many cells along a tile, in turn:
    # first quickly, then into narrow places.
    finer: tuple[int, ...] = (1, 4)
    # Around charts that stay, the scale is halved at most so often until the shapes fit, and bisected so often then.
    halvings: int = 24
    bisections: int = 5
    # Number of angles compared for the direction of a single shape, and the precision of the best one.
    angles: int = 256
    angle_precision: float = 1e-6
    # Number of cells along each texel if shapes are placed as boxes.
    box_cells: int = 4
    # Relative precision of the sufficient size.
    size_precision: float = 0.01


_TUNING = LayoutTuning()

#: Largest side of a texture in texels: single precision stores no more positions.
MAX_SIZE = 1 << 24


def find_layout(
    shapes: Sequence[Shape], into: Textures, scale: float | None, *, bitmaps: int = BITMAPS
) -> Layout | None:
    """Place shapes at the largest common scale that is found, or at a given scale.

    Parameters
    ----------
    shapes : sequence of Shape
        At least one.
    into : Textures
    scale : float or None
        Texels per unit of length.
    bitmaps : int
        Maximum number of shapes that are not placed as boxes.

    Returns
    -------
    Layout
        None if the shapes do not fit, not even with a largest box of one texel.
    """
    if len(shapes) == 1 and into.rotate and scale is None:
        return _place_one(shapes[0], into)
    if scale is not None:
        if not _may_fit(shapes, into, scale):
            return None
        if (quick := _place_at(shapes, into, scale, bitmaps)) is not None:
            return quick
        largest = find_layout(shapes, into, None, bitmaps=bitmaps)
        return None if largest is None else largest.shrink(scale, into.size)
    layout, order = _enlarge(shapes, into, least_scale(shapes), TRIALS, bitmaps=bitmaps)
    if layout is None:
        return _place_boxes(shapes, into)
    if order is None:
        return layout
    fine = BitmapSearch(shapes, into, layout.scale, given=layout.directions, bitmaps=bitmaps)
    return fine.enlarge_finely(order) or layout


def _place_at(shapes: Sequence[Shape], into: Textures, scale: float, bitmaps: int = BITMAPS) -> Layout | None:
    """Place shapes quickly at a given scale; None if that finds no layout."""
    search = BitmapSearch(shapes, into, scale, bitmaps=bitmaps)
    return search.place_in(search.cells)


def _enlarge(
    shapes: Sequence[Shape], into: Textures, least: float, trials: int, **drawing: int
) -> tuple[Layout, IntArray | None] | tuple[None, None]:
    """Place shapes at a large scale, larger than the least; return the layout, and the order of few shapes."""
    expected = _expected_scale(shapes, into)
    while expected > least:
        search = BitmapSearch(shapes, into, expected, **drawing)  # type: ignore[arg-type]
        if len(shapes) > MANY:
            if (layout := search.enlarge_coarsely(least)) is not None:
                return layout, None
        elif (found := search.enlarge(least, trials)) is not None:
            return found
        expected /= MORE_CELLS
    return None, None


def find_layout_around(
    occupied: Occupied, shapes: Sequence[Shape], into: Textures, scale: float | None
) -> Layout | None:
    """Place shapes into the free part of tiles, at a given scale or at the largest one that is found.

    Parameters
    ----------
    occupied : Occupied
        What is in the tiles.
    shapes, into, scale
        See `find_layout`.

    Returns
    -------
    Layout
        None if the shapes do not fit.
    """
    size, padding, tiles, _ = into
    free = occupied.free_area(tiles, padding)
    sides = np.sqrt([shape.area for shape in shapes])

    def place(scale: float) -> Layout | None:
        # With half the padding around it, a shape covers at least this area, by the Brunn–Minkowski inequality.
        least = float(((scale * sides + sqrt(pi) * padding / 2) ** 2).sum())
        if least > free or not _may_fit(shapes, into, scale):
            return None
        for finer in _TUNING.finer:
            search = BitmapSearch(shapes, into, scale, occupied=occupied, finer=finer)
            if (found := search.place_in(search.cells)) is not None:
                return found
        return None

    if scale is not None:
        return place(scale)
    high = max(size) * max(1.0, sqrt(tiles)) / min(sum(shape.area for shape in shapes) ** 0.5, 1 / least_scale(shapes))
    best, low = None, high
    longest = max(max(shape.sides) for shape in shapes)
    for _ in range(_TUNING.halvings):
        high, low = low, low / 2
        best = place(low)
        # Smaller charts need hardly less room if the padding is larger than they are.
        if best is not None or low * longest < min(1.0, padding):
            break
    for _ in range(_TUNING.bisections if best is not None else 0):
        middle = sqrt(low * high)
        found = place(middle)
        low, high, best = (low, middle, best) if found is None else (middle, high, found)
    return best


def estimate_use(shapes: Sequence[Shape], into: Textures, *, above: float = 0.0) -> float:
    """Part of the tiles that shapes cover if they are placed quickly; 0 if that is not above a given part."""
    area, room = sum(shape.area for shape in shapes), into.texels
    least = max(least_scale(shapes), sqrt(above * room / area)) if area > 0 else np.inf
    layout, _ = _enlarge(shapes, into, least, 0, skewed=False)
    return 0.0 if layout is None else area * layout.scale**2 / room


def _may_fit(shapes: Sequence[Shape], into: Textures, scale: float) -> bool:
    """Whether neither the areas nor a length of shapes exclude that they fit into tiles at a scale."""
    area = sum(shape.area for shape in shapes) * scale * scale
    longest = max(max(shape.sides) for shape in shapes) * scale
    return area <= into.texels and longest <= hypot(*into.size)


def _place_one(shape: Shape, into: Textures) -> Layout | None:
    """Place one shape in the middle of a tile, in the direction in which it can be largest."""
    room = np.array(into.size) - into.padding

    def scales(angles: FloatArray) -> FloatArray:
        seen = np.exp(-1j * angles)[:, None] * shape.hull
        sides = np.stack([np.ptp(seen.real, axis=1), np.ptp(seen.imag, axis=1)], axis=1)
        with np.errstate(over="ignore"):
            return np.asarray((room / np.maximum(sides, np.finfo(float).tiny)).min(axis=1))

    if room.min() <= 0:
        return None
    width = pi / _TUNING.angles
    angles = np.angle(shape.direction) + pi / 2 * np.arange(2)
    if not shape.straight:
        angles = np.concatenate([angles, width * np.arange(_TUNING.angles)])
    best = float(angles[np.argmax(scales(angles))])
    while not shape.straight and width > _TUNING.angle_precision:
        # The best angle so far comes first, so that it stays if no other one is better.
        near = best + width * np.array([0, -1, -0.75, -0.5, -0.25, 0.25, 0.5, 0.75, 1])
        best, width = float(near[np.argmax(scales(near))]), width / 4
    scale, least = float(scales(np.array([best]))[0]), least_scale([shape])
    if scale < least:
        return None
    if not max(shape.extent(1)):
        scale = least
    centre, tile = np.array([complex(*into.size) / 2]), np.zeros(1, dtype=np.int64)
    return Layout(scale, np.exp(1j * np.array([best])), centre, tile, 0.0)


def find_sufficient_size(shapes: Sequence[Shape], into: Textures, scale: float | None) -> tuple[int, int]:
    """Width and height of tiles, of the same ratio, into which shapes fit that do not fit into the given ones.

    A side above `MAX_SIZE` means that none was found.
    """

    def enlarge(factor: float) -> tuple[int, int]:
        return ceil(into.size[0] * factor), ceil(into.size[1] * factor)

    def fits(size: tuple[int, int]) -> bool:
        larger = into._replace(size=size)
        if scale is None:
            return _place_boxes(shapes, larger) is not None
        return _may_fit(shapes, larger, scale) and _place_at(shapes, larger, scale) is not None

    low, high = 1.0, 2.0
    while not fits(enlarge(high)):
        low, high = high, 2 * high
        if high * max(into.size) > MAX_SIZE:
            return enlarge(high)
    while enlarge(low) != enlarge(high) and high - low > _TUNING.size_precision * high:
        middle = (low + high) / 2
        low, high = (low, middle) if fits(enlarge(middle)) else (middle, high)
    return enlarge(high)


def _place_boxes(shapes: Sequence[Shape], into: Textures) -> Layout | None:
    """Place shapes as boxes at the least scale."""
    search = BitmapSearch(shapes, into, least_scale(shapes), bitmaps=0)
    return search.place_in(min(_TUNING.box_cells * max(into.size), MOST_CELLS))


def least_scale(shapes: Sequence[Shape]) -> float:
    """Scale at which the longest side of all boxes is one texel."""
    return 1 / (max(max(shape.sides) for shape in shapes) or 1.0)


def _expected_scale(shapes: Sequence[Shape], into: Textures) -> float:
    """Scale at which the shapes with half the padding around them cover the expected share of the tiles."""
    size, padding, tiles, _ = into
    area = sum(shape.area for shape in shapes)
    length = sum(float(np.abs(shape.heads - shape.tails).sum()) for shape in shapes)
    free = _TUNING.expected * tiles * size[0] * size[1] - len(shapes) * pi * padding**2 / 4
    b = length * padding / 2
    # The largest shape must fit in the tile, in its best direction of a few.
    turns = np.exp(0.5j * pi * np.arange(_TUNING.turns) / _TUNING.turns)
    sides = [_least_length(shape, turns) for shape in shapes]
    fits = (max(size) - padding) / (max(sides) or 1.0)
    if free <= 0:
        return 0.0
    return min(2 * free / (b + sqrt(b**2 + 4 * area * free)), fits) if area > 0 else fits


def _least_length(shape: Shape, turns: ComplexArray) -> float:
    """Longest side of a shape's box in the best of several directions."""
    seen = shape.hull * turns.conj()[:, None]
    return float(np.maximum(np.ptp(seen.real, axis=1), np.ptp(seen.imag, axis=1)).min())
