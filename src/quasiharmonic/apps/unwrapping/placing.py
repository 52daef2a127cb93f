"""Place the charts of `unwrap` in the texture: by their shapes, one material in each tile, or for a lightmap."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from quasiharmonic.apps.atlas.packing.pack import Packing, pack_charts
from quasiharmonic.apps.atlas.packing.texel_boxes import pack_texel_boxes
from quasiharmonic.apps.unwrapping.chart import Chart
from quasiharmonic.util.arrays import IntArray, number_array
from quasiharmonic.util.options import UnwrapOptions

# Angle of the edges that are seams of a lightmap by default, in degrees.
_HARD = 60.0
# A filter at half the resolution mixes texels that are closer.
_LEAST_PADDING = 4
# Coordinates of later tiles are rounded more coarsely, by this share of the texture's side.
_ROUNDING = 2.0**-18
# If charts do not fit at the density of another tile, the density is lowered by this factor, at most so often.
_LOWER, _TRIALS = 0.97, 20


def check_placing(wanted: UnwrapOptions) -> UnwrapOptions:
    """Return the options, with those that a lightmap implies; ValueError for options that exclude each other."""
    if wanted.tile_by is not None and (wanted.tiles > 1 or wanted.faces is not None or wanted.stack):
        raise ValueError("tile_by gives each material a tile of its own: omit tiles, faces and stack")
    if not wanted.lightmap:
        return wanted
    if wanted.stack:
        raise ValueError("in a lightmap each chart has its own place: omit stack")
    if wanted.tiles > 1 or wanted.tile_by is not None or wanted.faces is not None:
        raise ValueError("a lightmap is one texture for all triangles: omit tiles, tile_by and faces")
    if float(wanted.padding) < _LEAST_PADDING:
        raise ValueError(f"a lightmap needs a padding of at least {_LEAST_PADDING} texels, not {wanted.padding:g}")
    return wanted if wanted.hard_edges is not None else replace(wanted, hard_edges=_HARD)


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
    **options: Any,
) -> Packing:
    """Return the packing of charts.

    ``tile`` has the tile of each triangle of the cleaned mesh; None without ``tile_by``. ``options`` are those of
    `pack_charts` that `UnwrapOptions` does not have. ValueError if the charts do not fit.
    """
    padding = float(wanted.padding)
    if wanted.lightmap:
        pairs = [(chart.uv, chart.shape) for chart in charts]
        return pack_texel_boxes(pairs, size, padding, rotate=wanted.rotate, texels_per_unit=density)

    def pack(some: Sequence[Chart], density: float | None) -> Packing:
        return pack_charts(
            [(chart.uv, chart.F) for chart in some],
            resolution=size,
            padding=padding if tile is None else padding + _ROUNDING * max(size),
            texels_per_unit=density,
            tiles=wanted.tiles,
            rotate=wanted.rotate,
            stack=bool(wanted.stack),
            **options,
        )

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
    for trial in range(_TRIALS):
        try:
            fitted = {k: one if one.texels_per_unit == least else pack(groups[k], least) for k, one in found.items()}
            break
        except ValueError:
            if density is not None or trial == _TRIALS - 1:
                raise
            least *= _LOWER
    order = np.argsort(tile, kind="stable")
    placements, uvs = [], []
    for k, packing in fitted.items():
        placements += [replace(one, tile=k) for one in packing.placements]
        uvs += [uv + np.array([k % 10, k // 10]) for uv in packing.uv]
    back = np.argsort(order)
    used = float(np.mean([packing.utilisation for packing in fitted.values()]))
    return Packing(tuple(placements[i] for i in back), tuple(uvs[i] for i in back), least, used)
