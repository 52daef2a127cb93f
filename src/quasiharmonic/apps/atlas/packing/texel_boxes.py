"""Pack charts for lightmaps: as boxes on whole texels, so that no filter mixes texels of two charts."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from math import ceil, sqrt

import numpy as np
from scipy.ndimage import maximum_filter1d

from quasiharmonic.apps.atlas.packing.layout import MAX_SIZE
from quasiharmonic.apps.atlas.packing.pack import Packing, Placement
from quasiharmonic.apps.atlas.packing.shapes import Shape
from quasiharmonic.util.arrays import BoolArray, ComplexArray, FloatArray, IntArray, count_of, to_complex, to_points

# Smallest side of a chart's box in texels. Boxes begin at multiples of it, so that texels of half the resolution fit.
_CELL = 2
# The scale is lowered by this factor until all boxes fit, at most so often, and then bisected.
_LOWER, _TRIALS, _BISECTIONS = 0.8, 60, 7


@dataclass(frozen=True, eq=False)
class _TexelBoxes:
    """Boxes of charts at unit scale: sides (c, 2), their directions (c,), and which charts are rectangles (c,)."""

    sides: FloatArray
    directions: ComplexArray
    rectangular: BoolArray

    def stretch(self, scale: float) -> FloatArray:
        """Return the factors (c, 2) on both sides of each chart; sides of rectangles become whole texels."""
        sides = np.maximum(self.sides, np.finfo(float).tiny)
        whole = np.maximum(np.rint(sides * scale), _CELL) / sides
        even = np.maximum(scale, _CELL / sides.max(axis=1, keepdims=True))
        return np.where(self.rectangular[:, None], whole, even)

    def texels(self, scale: float) -> IntArray:
        """Return width and height (c, 2) of the boxes in texels."""
        return np.maximum(np.ceil(self.sides * self.stretch(scale) - 1e-6), _CELL).astype(np.int64)


def pack_texel_boxes(
    charts: Sequence[tuple[FloatArray, Shape]],
    size: tuple[int, int],
    padding: float,
    *,
    rotate: bool,
    texels_per_unit: float | None,
) -> Packing:
    """Pack charts as boxes that begin at even texels and keep the padding, as large as possible and at one scale.

    Sides of rectangular charts lie between texels: their lengths change by at most half a texel, or to two texels.
    Charts smaller than two texels are enlarged.

    Parameters
    ----------
    charts : sequence of (uv, shape)
        Positions (m, 2) of each chart's vertices, and its shape.
    size, padding, rotate, texels_per_unit
        As those of `pack_charts`.

    Raises
    ------
    ValueError
        If the charts do not fit. The message names a sufficient resolution.
    """
    # A chart whose box is larger than the chart by at most this share is a rectangle.
    rectangle = 1e-6
    shapes = [shape for _, shape in charts]
    directions = np.array([shape.direction if rotate else 1.0 for shape in shapes], dtype=np.complex128)
    sides = np.array([shape.extent(complex(along)) for shape, along in zip(shapes, directions, strict=True)])
    area = np.array([shape.area for shape in shapes])
    boxes = _TexelBoxes(sides, directions, area >= (1 - rectangle) * sides.prod(axis=1))
    gap = ceil(padding)
    scale = texels_per_unit or sqrt(size[0] * size[1] / max(float(sides.prod(axis=1).sum()), np.finfo(float).tiny))
    placed = _place(boxes.texels(scale), size, gap, rotate)
    if texels_per_unit is None:
        for _ in range(_TRIALS):
            if placed is not None:
                break
            scale *= _LOWER
            placed = _place(boxes.texels(scale), size, gap, rotate)
        low, high = scale, scale / _LOWER
        for _ in range(_BISECTIONS if placed is not None else 0):
            middle = sqrt(low * high)
            found = _place(boxes.texels(middle), size, gap, rotate)
            low, high, placed = (low, middle, placed) if found is None else (middle, high, found)
        scale = low
    if placed is None:
        factor = 2
        while _place(boxes.texels(scale), (factor * size[0], factor * size[1]), gap, rotate) is None:
            factor *= 2
            if factor * max(size) > MAX_SIZE:
                break
        raise ValueError(
            f"{count_of('chart', 'charts', len(charts))} with a padding of {padding:g} texels do not fit into a "
            f"lightmap of {size[0]} × {size[1]} texels: use {factor * size[0]} × {factor * size[1]}"
        )
    corners, turned = placed
    stretch, uvs, placements = boxes.stretch(scale), [], []
    for k, (uv, _) in enumerate(charts):
        local = to_points(to_complex(uv) * np.conj(directions[k]))
        local = (local - local.min(axis=0)) * stretch[k]
        if turned[k]:
            local = np.stack([local[:, 1].max() - local[:, 1], local[:, 0]], axis=1)
        uvs.append((local + corners[k]) / size)
        angle = float(-np.angle(directions[k]) + np.pi / 2 * turned[k])
        placements.append(Placement(angle, False, (float(corners[k, 0]), float(corners[k, 1])), 0))
    covered = float((area * stretch.prod(axis=1)).sum())
    return Packing(tuple(placements), tuple(uvs), scale, covered / (size[0] * size[1]))


def _place(texels: IntArray, size: tuple[int, int], gap: int, rotate: bool) -> tuple[IntArray, IntArray] | None:
    """Return the lower left corners (c, 2) of boxes, and whether they are turned by 90° (c,); None if they do not fit.

    Each box, the highest first, is placed where its upper side is lowest above all boxes before it.
    """
    margin = _CELL * ceil(gap / (2 * _CELL))
    columns, rows = ((side - 2 * margin + gap) // _CELL for side in size)
    cells = -(-(texels + gap) // _CELL)
    corners, turned = np.zeros_like(texels), np.zeros(len(texels), dtype=np.int64)
    if columns < 1 or int(cells.prod(axis=1).sum()) > columns * rows:
        return None
    top = np.zeros(columns, dtype=np.int64)
    for k in np.lexsort((-cells.min(axis=1), -cells.max(axis=1))).tolist():
        best = None
        for turn in (0, 1) if rotate else (0,):
            width, height = cells[k, turn], cells[k, 1 - turn]
            if width > columns:
                continue
            # The filter's windows are centred.
            below = maximum_filter1d(top, width, mode="constant")[width // 2 : columns - (width - 1) // 2]
            at = int(np.argmin(below))
            if best is None or below[at] + height < best[0]:
                best = int(below[at] + height), at, int(width), int(height), turn
        if best is None or best[0] > rows:
            return None
        upper, at, width, height, turned[k] = best
        top[at : at + width] = upper
        corners[k] = margin + _CELL * at, margin + _CELL * (upper - height)
    return corners, turned
