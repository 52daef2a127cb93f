"""Mend charts that are not bijective in the precision of texture coordinates: enlarge or divide them.

Rounding damages triangles that are only a few units of the stored precision high, and parts of a boundary that are
that close to each other. A single triangle can always be stored.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from quasiharmonic.apps.unwrapping.chart import Chart
from quasiharmonic.apps.unwrapping.chart_cuts import divide_overlap
from quasiharmonic.apps.unwrapping.chart_maps import WORST_STRETCH
from quasiharmonic.apps.unwrapping.layout import ChartLayout
from quasiharmonic.apps.unwrapping.rounding import grid_unit
from quasiharmonic.geometry.exact.certificate import Certificate, certify
from quasiharmonic.util.arrays import BoolArray, FloatArray, IntArray

# Enlarged triangles are at least this number of units high. Rounding can invert triangles that are lower than the
# second number.
_HEIGHT, _LEAST_HEIGHT = 8.0, 3.0
# Charts are not enlarged by less than this factor: another fault than low triangles would remain.
_LEAST_FACTOR = 1.1
# Charts are enlarged to at most this number of units, which is 2⁻⁷ of the side of a texture.
_LARGEST = 2.0**17


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
            done += _divide(chart, verdict, height < _LEAST_HEIGHT, V, cost, bound)
    return sorted(done, key=lambda chart: int(chart.triangles[0]))


def _divide(
    chart: Chart, verdict: Certificate, low: BoolArray, V: FloatArray, cost: FloatArray, bound: float
) -> list[Chart]:
    """Divide a chart so that triangles with faults are in charts of their own; ``low`` (k,) are triangles at risk."""
    bad = np.zeros(len(chart.F), dtype=bool)
    bad[verdict.inverted], bad[verdict.degenerate] = True, True
    bad |= np.isin(chart.F, verdict.multiply_wound).any(axis=1)
    if len(verdict.crossings) and not bad.any():
        working = chart.open(V, cost)
        working.crossings = verdict.crossings
        parts = divide_overlap(working)
        if len(parts) > 1:
            return [chart.part(one, bound) for one in parts]
    bad |= low & bad.any()
    if bad.all() or not bad.any():
        along = chart.uv[chart.F].mean(axis=1)
        along = along[:, np.argmax(np.ptp(along, axis=0))]
        bad = np.argsort(np.argsort(along, kind="stable")) < len(along) // 2
    return [part for rows in (np.flatnonzero(bad), np.flatnonzero(~bad)) for part in chart.take(rows)]


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
    heights: FloatArray = twice / np.linalg.norm(sides, axis=2).max(axis=1)
    return heights
