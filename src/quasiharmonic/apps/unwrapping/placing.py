"""Place the charts of `unwrap` in the texture: by their shapes, one material in each tile, or as boxes for a lightmap.

The boxes begin and end at whole texels, so that no filter mixes texels of two charts.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from math import ceil, sqrt
from typing import Any, NamedTuple

import numpy as np
from scipy.ndimage import maximum_filter1d

from quasiharmonic.apps.atlas.packing.layout import MAX_SIZE
from quasiharmonic.apps.atlas.packing.pack import Packing, Placement, check_texture, pack_charts
from quasiharmonic.apps.unwrapping.chart import Chart
from quasiharmonic.util.arrays import (
    BoolArray,
    FloatArray,
    IntArray,
    count_of,
    number_array,
    to_complex,
    to_points,
)
from quasiharmonic.util.options import UnwrapOptions


class PlacingTuning(NamedTuple):
    """Numbers that tune how charts are placed in tiles and lightmaps."""

    # Angle of the edges that are seams of a lightmap by default, in degrees.
    hard: float = 60.0
    # A filter at half the resolution mixes texels that are closer.
    least_padding: int = 4
    # Coordinates of later tiles are rounded more coarsely, by this share of the texture's side.
    rounding: float = 2.0**-18
    # If charts do not fit at the density of another tile, the density is lowered by this factor, at most so often.
    lower: float = 0.97
    trials: int = 20
    # Smallest side of a chart's box in texels. Boxes begin at multiples of it, so that texels of half the resolution
    # fit.
    cell: int = 2
    # The scale is lowered by this factor until all boxes fit, at most so often, and then bisected.
    lower_scale: float = 0.8
    scale_trials: int = 60
    bisections: int = 7
    # Charts are packed in units of at most this power of two, and at least its inverse.
    largest_exponent: int = 1000


_TUNING = PlacingTuning()


def check_placing(wanted: UnwrapOptions) -> tuple[UnwrapOptions, tuple[int, int]]:
    """Return the options, with those that a lightmap implies, and width and height of the texture.

    ValueError for options that exclude each other.
    """
    size = check_texture(
        wanted.resolution, wanted.padding, wanted.texels_per_unit, wanted.tiles, wanted.rotate, bool(wanted.stack)
    )
    if wanted.tile_by is not None and (wanted.tiles > 1 or wanted.faces is not None or wanted.stack):
        raise ValueError("tile_by gives each material a tile of its own: omit tiles, faces and stack")
    if not wanted.lightmap:
        return wanted, size
    if wanted.stack:
        raise ValueError("in a lightmap each chart has its own place: omit stack")
    if wanted.tiles > 1 or wanted.tile_by is not None or wanted.faces is not None:
        raise ValueError("a lightmap is one texture for all triangles: omit tiles, tile_by and faces")
    if float(wanted.padding) < _TUNING.least_padding:
        least = _TUNING.least_padding
        raise ValueError(f"a lightmap needs a padding of at least {least} texels, not {wanted.padding:g}")
    return wanted if wanted.hard_edges is not None else replace(wanted, hard_edges=_TUNING.hard), size


def number_tiles(tile_by: Any, count: int) -> IntArray:
    """Return the tile (f,) of each triangle of the model, from 0; ValueError if the numbers are malformed."""
    if isinstance(tile_by, str):
        raise ValueError(
            f"tile_by={tile_by!r} needs materials: pass a file, a MeshData or meshes of trimesh, or numbers"
        )
    numbers = number_array("tile_by", tile_by, count, "triangle")
    return np.unique(numbers, return_inverse=True)[1].reshape(-1)


def place_charts(
    charts: Sequence[Chart],
    tile: IntArray | None,
    wanted: UnwrapOptions,
    size: tuple[int, int],
    density: float | None,
    exponent: int,
    **options: Any,
) -> Packing:
    """Return the packing of charts, which are in units of ``2 ** exponent``, as is the ``density``.

    ``tile`` has the tile of each triangle of the cleaned mesh; None without ``tile_by``. ``options`` are those of
    `pack_charts` that `UnwrapOptions` does not have. ValueError if the charts do not fit.
    """
    padding = float(wanted.padding)
    if wanted.lightmap:
        return _pack_texel_boxes(charts, size, padding, wanted.rotate, density)
    exponent = min(max(exponent, -_TUNING.largest_exponent), _TUNING.largest_exponent)
    if tile is not None:
        options["rounding"] = _TUNING.rounding

    def pack(some: Sequence[Chart], density: float | None) -> Packing:
        # In the model's own unit, so that messages have its density, or in the next one that is far from overflow.
        packing = pack_charts(
            [(np.ldexp(chart.uv, exponent), chart.F) for chart in some],
            resolution=size,
            padding=padding,
            texels_per_unit=None if density is None else float(np.ldexp(density, -exponent)),
            tiles=wanted.tiles,
            rotate=wanted.rotate,
            stack=bool(wanted.stack),
            **options,
        )
        return replace(packing, texels_per_unit=float(np.ldexp(packing.texels_per_unit, exponent)))

    if tile is None:
        return pack(charts, density)
    return _pack_tiles(charts, np.array([tile[chart.triangles[0]] for chart in charts]), pack, density)


def _pack_tiles(
    charts: Sequence[Chart],
    tile: IntArray,
    pack: Callable[[Sequence[Chart], float | None], Packing],
    density: float | None,
) -> Packing:
    """Return charts packed into given tiles (c,), at the largest density that is found for all of them."""
    numbers = np.unique(tile).tolist()
    groups = {k: [chart for chart, at in zip(charts, tile, strict=True) if at == k] for k in numbers}
    found = {k: pack(groups[k], density) for k in numbers}
    least = min(packing.texels_per_unit for packing in found.values())
    for trial in range(_TUNING.trials):
        try:
            fitted = {k: one if one.texels_per_unit == least else pack(groups[k], least) for k, one in found.items()}
            break
        except ValueError:
            if density is not None or trial == _TUNING.trials - 1:
                raise
            least *= _TUNING.lower
    order = np.argsort(tile, kind="stable")
    placements, uvs = [], []
    for k, packing in fitted.items():
        placements += [replace(one, tile=k) for one in packing.placements]
        uvs += [uv + np.array([k % 10, k // 10]) for uv in packing.uv]
    back = np.argsort(order)
    used = float(np.mean([packing.utilisation for packing in fitted.values()]))
    return Packing(tuple(placements[i] for i in back), tuple(uvs[i] for i in back), least, used)


@dataclass(frozen=True, eq=False)
class _TexelBoxes:
    """Boxes of charts at unit scale: sides (c, 2), and which charts are rectangles (c,)."""

    sides: FloatArray
    rectangular: BoolArray

    def stretch(self, scale: float) -> FloatArray:
        """Return the factors (c, 2) on both sides of each chart; sides of rectangles become whole texels."""
        sides = np.maximum(self.sides, np.finfo(float).tiny)
        whole = np.maximum(np.rint(sides * scale), _TUNING.cell) / sides
        even = np.maximum(scale, _TUNING.cell / sides.max(axis=1, keepdims=True))
        return np.where(self.rectangular[:, None], whole, even)

    def texels(self, scale: float) -> IntArray:
        """Return width and height (c, 2) of the boxes in texels."""
        return np.maximum(np.ceil(self.sides * self.stretch(scale) - 1e-6), _TUNING.cell).astype(np.int64)


def _pack_texel_boxes(
    charts: Sequence[Chart], size: tuple[int, int], padding: float, rotate: bool, density: float | None
) -> Packing:
    """Pack charts as boxes that begin at even texels and keep the padding, as large as possible and at one scale.

    Sides of rectangular charts lie between texels: their lengths change by at most half a texel, or to two texels.
    Charts smaller than two texels are enlarged. If the charts do not fit, a ValueError names a sufficient resolution.
    """
    # A chart whose box is larger than the chart by at most this share is a rectangle.
    rectangle = 1e-6
    shapes = [chart.shape for chart in charts]
    directions = np.array([shape.direction if rotate else 1.0 for shape in shapes], dtype=np.complex128)
    sides = np.array([shape.extent(complex(along)) for shape, along in zip(shapes, directions, strict=True)])
    area = np.array([shape.area for shape in shapes])
    boxes = _TexelBoxes(sides, area >= (1 - rectangle) * sides.prod(axis=1))
    gap = ceil(padding)
    scale = density or sqrt(size[0] * size[1] / max(float(sides.prod(axis=1).sum()), np.finfo(float).tiny))
    placed = _place(boxes.texels(scale), size, gap, rotate)
    if density is None:
        for _ in range(_TUNING.scale_trials):
            if placed is not None:
                break
            scale *= _TUNING.lower_scale
            placed = _place(boxes.texels(scale), size, gap, rotate)
        low, high = scale, scale / _TUNING.lower_scale
        for _ in range(_TUNING.bisections if placed is not None else 0):
            middle = sqrt(low * high)
            found = _place(boxes.texels(middle), size, gap, rotate)
            low, high, placed = (low, middle, placed) if found is None else (middle, high, found)
        scale = low
    if placed is None:
        larger = [(size[0] << k, size[1] << k) for k in range(1, 64) if max(size) << k <= MAX_SIZE]
        enough = next((one for one in larger if _place(boxes.texels(scale), one, gap, rotate) is not None), None)
        advice = "reduce the padding or the texel density" if enough is None else f"use {enough[0]} × {enough[1]}"
        raise ValueError(
            f"{count_of('chart', 'charts', len(charts))} with a padding of {padding:g} texels do not fit into a "
            f"lightmap of {size[0]} × {size[1]} texels: {advice}"
        )
    corners, turned = placed
    stretch, uvs, placements = boxes.stretch(scale), [], []
    for k, chart in enumerate(charts):
        local = to_points(to_complex(chart.uv) * np.conj(directions[k]))
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
    margin = _TUNING.cell * ceil(gap / (2 * _TUNING.cell))
    columns, rows = ((side - 2 * margin + gap) // _TUNING.cell for side in size)
    cells = -(-(texels + gap) // _TUNING.cell)
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
        corners[k] = margin + _TUNING.cell * at, margin + _TUNING.cell * (upper - height)
    return corners, turned
