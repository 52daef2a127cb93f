"""Divide charts that are too long for the texture, so that the texture is used well."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from quasiharmonic.apps.unwrapping.chart import Chart
from quasiharmonic.apps.unwrapping.chart_cuts import divide, is_undivided
from quasiharmonic.apps.unwrapping.hinges import UNDIVIDED_COST
from quasiharmonic.geometry.mesh.topology import find_pairs, label_components
from quasiharmonic.util.arrays import FloatArray
from quasiharmonic.util.progress import heartbeat


class LengthTuning(NamedTuple):
    """Numbers that tune which charts are too long; lengths are in sides of the texture at the expected scale."""

    # Share of the texture that charts are expected to cover, which determines this scale.
    expected_use: float = 0.6
    # Longest chart.
    longest: float = 0.85
    # A chart is loose if it covers less than this share of its box.
    loose: float = 0.6
    # Longest loose chart.
    longest_loose: float = 0.7
    # Longest chart without stretch, and longest rectangle, unless they are divided like the others.
    longest_fixed: float = 0.95
    # Such a chart is alone if it has more than this share of the area.
    alone: float = 0.9
    # Longest chart that is alone.
    longest_alone: float = 1.3
    # Longest chart without stretch that is not cut through its flat faces.
    longest_flat: float = 2.0
    # If such a chart is halved, each part must have at most this multiple of its length.
    shorter: float = 0.85


_TUNING = LengthTuning()


def divide_long_charts(
    charts: Sequence[Chart],
    V: FloatArray,
    cost: FloatArray,
    *,
    bound: float,
    size: tuple[int, int],
    tiles: int,
    max_charts: int | None,
    for_packing: bool = False,
    density: float | None = None,
) -> list[Chart]:
    """Divide charts across their middle until each fits into a texture that the charts cover well.

    The parts keep the maps of their charts.

    Parameters
    ----------
    charts : sequence of Chart
    V : (n, 3) float64
        Vertices of the mesh.
    cost : (f, 3) float64
        Factors on the cost of seams; see `find_charts`.
    bound : float
        Bound on the stretch.
    size : two int
        Width and height of the texture.
    tiles : int
        Number of textures.
    max_charts : int or None
        Maximum number of charts.
    for_packing : bool
        Whether charts without stretch and rectangles are divided like the others, and not only where they are too long.
    density : float, optional
        Texels per unit of length, if they are given.

    Returns
    -------
    list of Chart
        Ordered by first triangle.
    """
    area = sum(chart.shape.area for chart in charts)
    ratio = max(size) / min(size)
    side = float(np.sqrt(area * ratio / (_TUNING.expected_use * tiles)))
    longest_flat = _TUNING.longest_flat * side
    if density is not None:
        side = min(side, max(size) / density)
        longest_flat = min(longest_flat, max(size) / density)
    done: list[Chart] = []
    waiting = list(charts)
    while waiting:
        heartbeat()
        chart = waiting.pop()
        full = max_charts is not None and len(done) + len(waiting) + 1 >= max_charts
        if full or len(chart.F) < 2 or not _is_too_long(chart, side, area, for_packing):
            done.append(chart)
            continue
        if _is_fixed(chart, for_packing):
            parts = _halve(chart, cost)
            if not parts and _length(chart) > longest_flat:
                parts = _halve(chart, cost / UNDIVIDED_COST)
        else:
            parts = _divide(chart, V, cost, bound)
        if parts:
            waiting += parts
        else:
            done.append(chart)
    return sorted(done, key=lambda chart: int(chart.triangles[0]))


def _divide(chart: Chart, V: FloatArray, cost: FloatArray, bound: float) -> list[Chart]:
    """Divide a chart across its middle; return no parts if it should stay whole."""
    working = chart.open(V, cost)
    if is_undivided(working):
        return []
    return [chart.part(part, bound) for part in divide(working, bound)]


def _halve(chart: Chart, cost: FloatArray) -> list[Chart]:
    """Divide a chart at the middle of its longer side; return no parts if they would be hardly shorter.

    Triangles with sides that are too dear to cut stay together.
    """
    shape = chart.shape
    width, height = shape.extent(shape.direction)
    along = shape.direction if width >= height else 1j * shape.direction
    at = (chart.uv @ [1, 1j] / along).real
    one, other = find_pairs(chart.F)
    dear = (cost[chart.triangles] >= UNDIVIDED_COST).ravel()
    joined = dear[one] | dear[other]
    group = label_components(one[joined] // 3, other[joined] // 3, len(chart.F))
    middle = np.bincount(group, at[chart.F].mean(axis=1)) / np.maximum(np.bincount(group), 1)
    first = middle[group] < (at.min() + at.max()) / 2
    if first.all() or not first.any():
        return []
    parts = [part for rows in (np.flatnonzero(first), np.flatnonzero(~first)) for part in chart.take(rows)]
    return parts if max(map(_length, parts)) <= _TUNING.shorter * _length(chart) else []


def _is_too_long(chart: Chart, side: float, area: float, for_packing: bool) -> bool:
    """Whether a chart prevents a scale at which the texture has this side."""
    if _is_fixed(chart, for_packing):
        longest = _TUNING.longest_alone if chart.shape.area > _TUNING.alone * area else _TUNING.longest_fixed
        return _length(chart) > longest * side
    shape = chart.shape
    width, height = shape.extent(shape.direction)
    loose = shape.area < _TUNING.loose * width * height
    return max(width, height) > side * (_TUNING.longest_loose if loose else _TUNING.longest)


def _is_fixed(chart: Chart, for_packing: bool) -> bool:
    """Whether a chart is divided only where it is too long for the texture."""
    return (chart.isometric or chart.straight) and not for_packing


def _length(chart: Chart) -> float:
    """Longer side of a chart's box."""
    return max(chart.shape.extent(chart.shape.direction))
