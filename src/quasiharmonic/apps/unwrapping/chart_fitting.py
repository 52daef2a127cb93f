"""Fit charts to the texture: divide those that are too long for it, and mend those that rounding made not bijective.

Rounding damages triangles that are only a few units of the stored precision high, and parts of a boundary that are
that close to each other. A single triangle can always be stored.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from quasiharmonic.apps.unwrapping.chart import Chart, halve, measure_fullest
from quasiharmonic.apps.unwrapping.chart_cuts import divide, divide_overlap, group_undivided, is_undivided
from quasiharmonic.apps.unwrapping.chart_maps import WORST_STRETCH
from quasiharmonic.apps.unwrapping.hinges import UNDIVIDED_COST
from quasiharmonic.apps.unwrapping.layout import GRID_UNIT, ChartLayout, grid_unit
from quasiharmonic.geometry.exact.certificate import Certificate, certify
from quasiharmonic.util.arrays import BoolArray, FloatArray, IntArray, mark
from quasiharmonic.util.options import UnwrapOptions
from quasiharmonic.util.progress import heartbeat

# Enlarged triangles are at least this number of units high. Rounding can invert triangles that are lower than the
# second number.
_HEIGHT, _LEAST_HEIGHT = 8.0, 3.0
# Charts are not enlarged by less than this factor: another fault than low triangles would remain.
_LEAST_FACTOR = 1.1
# Rounding this many times as coarsely as in a texture shows which charts it will probably damage.
_COARSER = 16.0
# Charts are enlarged to at most this number of units, which is 2⁻⁷ of the side of a texture.
_LARGEST = 2.0**17


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
    texture: IntArray,
    *,
    wanted: UnwrapOptions,
    size: tuple[int, int],
    density: float | None,
    area: float | None = None,
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
    texture : (f,) int64
        See `find_textures`.
    wanted : UnwrapOptions
        With ``divide_for_packing``, charts without stretch and rectangles are divided like the others, and not only
        where they are too long.
    size : two int
        Width and height of the texture.
    density : float or None
        Texels per unit of length, if they are given.
    area : float, optional
        Area of the charts of the fullest texture, if there are others than these.

    Returns
    -------
    list of Chart
        Ordered by first triangle.
    """
    for_packing = wanted.divide_for_packing
    if area is None:
        area = measure_fullest(charts, texture)
    ratio = max(size) / min(size)
    side = float(np.sqrt(area * ratio / (_TUNING.expected_use * wanted.tiles)))
    longest_flat = _TUNING.longest_flat * side
    if density is not None:
        side = min(side, max(size) / density)
        longest_flat = min(longest_flat, max(size) / density)

    def divide_long(chart: Chart, count: int) -> list[Chart]:
        full = wanted.max_charts is not None and count >= wanted.max_charts
        if full or len(chart.F) < 2 or not _is_too_long(chart, side, area, for_packing):
            return []
        if _is_fixed(chart, for_packing):
            parts = _halve(chart, cost)
            return parts or (_halve(chart, cost / UNDIVIDED_COST) if max(chart.shape.sides) > longest_flat else [])
        working, bound = chart.open(V, cost), float(wanted.max_stretch)
        return [] if is_undivided(working) else [chart.part(part, bound) for part in divide(working, bound)]

    return _divide_each(charts, divide_long)


def _divide_each(charts: Sequence[Chart], parts_of: Callable[[Chart, int], list[Chart]]) -> list[Chart]:
    """Divide charts and their parts as long as ``parts_of``, given a chart and the number of charts, has parts."""
    done: list[Chart] = []
    waiting = list(charts)
    while waiting:
        heartbeat()
        chart = waiting.pop()
        parts = parts_of(chart, len(done) + len(waiting) + 1)
        waiting += parts
        if not parts:
            done.append(chart)
    return sorted(done, key=lambda chart: int(chart.triangles[0]))


def _halve(chart: Chart, cost: FloatArray) -> list[Chart]:
    """Divide a chart at the middle of its longer side; return no parts if they would be hardly shorter.

    Triangles with sides that are too dear to cut stay together.
    """
    at = (chart.uv @ [1, 1j] / chart.shape.lying).real
    group = group_undivided(chart.F, cost[chart.triangles])
    middle = np.bincount(group, at[chart.F].mean(axis=1)) / np.maximum(np.bincount(group), 1)
    first = middle[group] < (at.min() + at.max()) / 2
    if first.all() or not first.any():
        return []
    parts = chart.split(first)
    return parts if max(max(part.shape.sides) for part in parts) <= _TUNING.shorter * max(chart.shape.sides) else []


def _is_too_long(chart: Chart, side: float, area: float, for_packing: bool) -> bool:
    """Whether a chart prevents a scale at which the texture has this side."""
    if _is_fixed(chart, for_packing):
        longest = _TUNING.longest_alone if chart.shape.area > _TUNING.alone * area else _TUNING.longest_fixed
        return max(chart.shape.sides) > longest * side
    width, height = chart.shape.sides
    loose = chart.shape.area < _TUNING.loose * width * height
    return max(width, height) > side * (_TUNING.longest_loose if loose else _TUNING.longest)


def _is_fixed(chart: Chart, for_packing: bool) -> bool:
    """Whether a chart is divided only where it is too long for the texture."""
    return (chart.isometric or chart.straight) and not for_packing


def divide_fragile(charts: Sequence[Chart], V: FloatArray, cost: FloatArray, *, bound: float) -> list[Chart]:
    """Divide charts that will probably not be bijective in a texture, before they are packed.

    Their positions are rounded `_COARSER` times as coarsely as there. The arguments and the result are those of
    `mend_charts`.
    """
    area = sum(chart.shape.area for chart in charts)
    unit = _COARSER * float(np.sqrt(area / _TUNING.expected_use)) * GRID_UNIT

    def divide_damaged(chart: Chart, _: int) -> list[Chart]:
        verdict = certify(chart.F, np.rint(chart.uv / unit))
        if verdict.bijective or len(chart.F) == 1:
            return []
        return _divide_faulty(chart, verdict, mark(len(chart.F)), V, cost, bound)

    return _divide_each(charts, divide_damaged)


def mend_charts(
    charts: Sequence[Chart],
    layout: ChartLayout,
    faulty: IntArray,
    *,
    scale: float,
    V: FloatArray,
    cost: FloatArray,
    bound: float,
) -> list[Chart]:
    """Enlarge or divide the charts that are not bijective in the texture.

    Parameters
    ----------
    charts : sequence of Chart
    layout : ChartLayout
        Their places in the texture.
    faulty : (k,) int64
        The charts that are not bijective there.
    scale : float
        Texture coordinates per unit of length of the charts.
    V : (n, 3) float64
        Vertices of the mesh.
    cost : (f, 3) float64
        Factors on the cost of seams; see `find_charts`.
    bound : float
        Bound on the stretch.

    Returns
    -------
    list of Chart
        Ordered by first triangle. Each faulty chart is larger now, or replaced by charts of fewer triangles.
    """
    wrong = set(faulty.tolist())
    done = [chart for k, chart in enumerate(charts) if k not in wrong]
    units = scale / grid_unit(layout.uv)
    for k in sorted(wrong):
        chart = charts[k]
        rows, stored = np.unique(layout.F[chart.triangles], return_inverse=True)
        height = units * _heights(chart.uv[chart.F])
        factor = _HEIGHT / float(height.min()) if height.min() > 0 else np.inf
        if _LEAST_FACTOR < factor <= _LARGEST / (units * np.ptp(chart.uv, axis=0).max()):
            done.append(_enlarge(chart, factor, V, cost))
        elif len(chart.F) == 1:
            done.append(_thicken(chart, _HEIGHT / units))
        else:
            verdict = certify(stored.reshape(-1, 3), layout.uv[rows])
            done += _divide_faulty(chart, verdict, height < _LEAST_HEIGHT, V, cost, bound)
    return sorted(done, key=lambda chart: int(chart.triangles[0]))


def _divide_faulty(
    chart: Chart, verdict: Certificate, low: BoolArray, V: FloatArray, cost: FloatArray, bound: float
) -> list[Chart]:
    """Divide a chart so that triangles with faults are in charts of their own; ``low`` (k,) are triangles at risk."""
    bad = mark(len(chart.F), verdict.inverted, verdict.degenerate)
    bad |= np.isin(chart.F, verdict.multiply_wound).any(axis=1)
    if len(verdict.crossings) and not bad.any():
        parts = divide_overlap(chart.open(V, cost), verdict.crossings)
        if len(parts) > 1:
            return [chart.part(one, bound) for one in parts]
    bad |= low & bad.any()
    if bad.all() or not bad.any():
        bad = halve(chart.uv[chart.F])
    return chart.split(bad)


def _enlarge(chart: Chart, factor: float, V: FloatArray, cost: FloatArray) -> Chart:
    """Enlarge a chart; the stretch of triangles that are not thin is a miss of the bound."""
    working = chart.open(V, cost)
    working.stretch = factor * chart.stretch
    too_long = working.stretch[working.too_long]
    misses = max([chart.misses, *(too_long - WORST_STRETCH).tolist()])
    return replace(chart, uv=factor * chart.uv, stretch=working.stretch, misses=misses)


def _thicken(chart: Chart, height: float) -> Chart:
    """Give a thin triangle a height that can be stored."""
    z = chart.uv[chart.F[0]] @ [1, 1j]
    longest = int(np.argmax(np.abs(np.roll(z, -1) - z)))
    start, end, tip = np.roll(z, -longest)
    along = (end - start) / abs(end - start)
    foot = start + along * ((tip - start) * along.conjugate()).real
    uv = chart.uv.copy()
    tip = foot + 1j * along * height
    uv[chart.F[0, longest - 1]] = tip.real, tip.imag
    return replace(chart, uv=uv)


def _heights(corners: FloatArray) -> FloatArray:
    """Return the smallest height (k,) of each triangle (k, 3, 2)."""
    sides = np.roll(corners, -1, axis=1) - corners
    twice = sides[:, 0, 0] * sides[:, 1, 1] - sides[:, 0, 1] * sides[:, 1, 0]
    return np.asarray(twice / np.linalg.norm(sides, axis=2).max(axis=1))
