"""Cut a surface into few charts and flatten them, under a bound on stretch."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
from numpy.typing import ArrayLike

from quasiharmonic.apps.unwrapping.chart import Chart, finish_chart, mirror_charts
from quasiharmonic.apps.unwrapping.chart_maps import FREE_SHARE, WORST_STRETCH, WorkingChart
from quasiharmonic.apps.unwrapping.chart_search import Workers, search_charts
from quasiharmonic.apps.unwrapping.coarse_search import CoarseSearch, cut_into_charts
from quasiharmonic.apps.unwrapping.developed_charts import develop_charts
from quasiharmonic.apps.unwrapping.draft import Draft
from quasiharmonic.apps.unwrapping.hinges import DEMANDED_COST, UNDIVIDED_COST, Hinges, find_hinges
from quasiharmonic.apps.unwrapping.layout import LayoutChoice
from quasiharmonic.apps.unwrapping.symmetry import Mirror
from quasiharmonic.apps.unwrapping.unrolling import lay_flat_parts, unfold_small_components
from quasiharmonic.energies.deformation import signed_areas
from quasiharmonic.energies.newton.map_model import in_units
from quasiharmonic.geometry.exact.certificate import is_injective
from quasiharmonic.geometry.mesh.reference import surface_area
from quasiharmonic.geometry.mesh.splitting import fans, split_parts
from quasiharmonic.geometry.mesh.topology import are_sides, boundary_edges
from quasiharmonic.util.arrays import BoolArray, FloatArray, IntArray, invert_indices, mark, repeat_each, scale_to_unit

#: Default of ``max_stretch``.
MAX_STRETCH = 1.5
# Minimum gain of the first cuts; see `find_cuts`.
_MIN_GAIN = 0.1
# The first cuts may be longer by this factor if they are mirrored; seams are then longer by up to about a quarter.
_GROWTH = 1.6


def find_charts(
    V: FloatArray,
    F: IntArray,
    *,
    max_stretch: float = MAX_STRETCH,
    max_charts: int | None = None,
    edge_costs: FloatArray | None = None,
    uv_cuts: ArrayLike | None = None,
    uv: FloatArray | None = None,
    choose: LayoutChoice | None = None,
    mirror: Mirror | None = None,
    hinges: Hinges | None = None,
    draft: Draft | None = None,
    callback: Callable[[str, int, int], object] | None = None,
    jobs: int | None = None,
) -> list[Chart]:
    """Cut a surface into charts that flatten with little stretch.

    Stretch is the larger of σ₁ and 1/σ₂, after all charts are scaled by one factor to the area of the surface. At most
    1 % of the surface is stretched by more than ``max_stretch``, and no triangle by more than 3, except triangles with
    an angle below 1°.

    Parameters
    ----------
    V : (n, 3) float64
    F : (f, 3) int64
        Triangles of manifold, consistently oriented surfaces without degenerate triangles.
    max_stretch : float
        Bound of at least 1. While that takes only a few more charts, the search goes on to two thirds of the stretch
        that the bound permits, to about 1.3 by default.
    max_charts : int, optional
        Maximum number of charts. It is exceeded only by components, and by parts without an injective map.
    edge_costs : (f, 3) float64, optional
        Positive factor on the cost of cutting each side of each triangle, from corner 0 to 1, 1 to 2 and 2 to 0. Two
        triangles stay together at factors of at least `UNDIVIDED_COST`, where possible. Sides with factors of at most
        `DEMANDED_COST` become seams.
    uv_cuts : (l, 2) array of int, optional
        Edges that are cut in any case, such as the seams of existing texture coordinates. Further cuts are then made
        only in closed parts, in parts with handles, and where the bound requires it.
    uv : (f, 3, 2) float64, optional
        Existing texture coordinates of the corners, with ``uv_cuts`` as seams; NaN where there are none. A part of them
        that is bijective, with stretches up to 3, is the initial map of its chart.
    choose : LayoutChoice, optional
        How to choose from several lists of charts of the developable parts; by default, these parts are joined as much
        as possible.
    mirror : Mirror, optional
        Mirror images, if seams and charts are to be mirrored. Curved parts are mirrored unless a triangle of theirs
        crosses the plane, or the seams there would grow by more than a quarter.
    hinges : Hinges, optional
        The hinges of the triangles, if they are known.
    draft : Draft, optional
        Gets the charts so far, in case that a time limit ends the search.
    callback : callable, optional
        Called with the phase, the number of finished parts and the number of all parts; may raise an exception.
    jobs : int, optional
        Number of threads for many triangles (`MANY_TRIANGLES`); by default the number of cores.

    Returns
    -------
    list of Chart
        Ordered by first triangle. The result does not depend on ``jobs``.
    """
    if not len(F):
        return []
    workers, draft = Workers(jobs, callback), draft or Draft()
    cost = np.ones(F.shape) if edge_costs is None else np.asarray(edge_costs, dtype=np.float64)
    demanded = cost <= DEMANDED_COST
    given = _ends(F, demanded) if uv_cuts is None else np.asarray(uv_cuts, dtype=np.int64)
    if uv_cuts is None:
        exact, charts = _develop(V, F, cost, max_stretch, max_charts, choose, workers, mirror, hinges)
        working, rest = list[WorkingChart](), np.flatnonzero(~exact)
    else:
        exact, charts = _lay_flat(V, F, given)
        working, rest = _keep_parts(V, F, np.flatnonzero(~exact), given, cost, uv)
    min_gain = _MIN_GAIN if uv_cuts is None else np.inf
    coarse = uv_cuts is None and max_charts is None and not given.size
    draft.charts = [*charts]
    total = surface_area(V, F)
    divisible = None if max_charts is None else max_charts - len(charts)

    def divide(found: list[Chart], points: FloatArray, own: FloatArray, unit: float) -> list[Chart]:
        """Divide charts of a coarse mesh that are too long for the texture."""
        if choose is None:
            return found
        area = choose.measure_area(V, F) / unit**2
        return choose.divide(found, points, own, np.zeros(len(own), dtype=np.int64), area=area)

    def cut(some: IntArray) -> list[WorkingChart]:
        """Cut triangles into disks, or a large surface into charts."""
        at_sides = given[are_sides(given, F[some], len(V))]
        vertices = np.flatnonzero(mark(len(V), F[some]))
        own = invert_indices(len(V), vertices)[F[some]]
        points, gain = V[vertices], min_gain if len(at_sides) else _MIN_GAIN
        search = CoarseSearch(max_stretch, min_gain, workers, points, divide) if coarse else None
        found = cut_into_charts(points, own, np.searchsorted(vertices, at_sides), cost[some], gain, search)
        for chart in found:
            chart.triangles, chart.vertices = some[chart.triangles], vertices[chart.vertices]
        return found

    def search(parts: list[WorkingChart], most: int | None, share: float) -> list[Chart]:
        found = search_charts(
            parts,
            max_stretch,
            max_charts=most,
            total_area=share * total,
            joinable=uv_cuts is None,
            workers=workers,
            keep=draft.keep,
        )
        return _finish(found, max_stretch, share * total)

    working += [chart for some in workers.map("cut", cut, [rest] if rest.size else [], rest.size) for chart in some]
    half = rest[mirror.positive[rest]] if mirror is not None else rest[:0]
    one_side = cut(half) if half.size and 2 * half.size == rest.size else []
    if mirror is not None and one_side and _are_short(one_side, working, F[rest], V):
        draft.mirror = mirror
        found = search(one_side, None if divisible is None else max(divisible // 2, 1), 0.5)
        charts += mirror_charts(F, found, mirror)
    else:
        charts += search(working, divisible, 1.0)
    draft.charts, draft.working = sorted(charts, key=lambda chart: int(chart.triangles[0])), ()
    return [*draft.charts]


def _are_short(half: list[WorkingChart], whole: list[WorkingChart], F: IntArray, V: FloatArray) -> bool:
    """Whether the seams of both halves of a surface (f, 3) are not much longer than those of the whole."""
    rim = boundary_edges(F, len(V))
    outline = float(np.linalg.norm(V[rim[:, 0]] - V[rim[:, 1]], axis=1).sum())
    # Each seam is on the outline of charts twice.
    return 2 * _perimeter(half) - outline <= _GROWTH * (_perimeter(whole) - outline)


def _perimeter(charts: list[WorkingChart]) -> float:
    """Length of the outlines of charts."""
    ends = [chart.V[np.stack([loop, np.roll(loop, -1)])] for chart in charts for loop in chart.piece.loops]
    return float(sum(np.linalg.norm(start - end, axis=1).sum() for start, end in ends))


def _ends(F: IntArray, sides: BoolArray) -> IntArray:
    """Return the edges (l, 2) at some sides (f, 3)."""
    return np.stack([F[sides], F[:, (1, 2, 0)][sides]], axis=1)


def _develop(
    V: FloatArray,
    F: IntArray,
    cost: FloatArray,
    max_stretch: float,
    max_charts: int | None,
    choose: LayoutChoice | None,
    workers: Workers,
    mirror: Mirror | None,
    hinges: Hinges | None,
) -> tuple[BoolArray, list[Chart]]:
    """Make charts of the developable parts; return a mask (f,) of their triangles, and the charts."""
    hinges = find_hinges(V, F) if hinges is None else hinges
    undivided = cost >= UNDIVIDED_COST
    mask, charts = unfold_small_components(V, F, hinges, undivided, cost <= DEMANDED_COST)
    rows = np.flatnonzero(~mask)
    if not rows.size:
        return mask, charts
    own_mirror = None if mirror is None else mirror.select(rows)
    developed, more = develop_charts(
        V,
        F[rows],
        cost[rows],
        hinges if rows.size == len(F) else find_hinges(V, F[rows]),
        None if choose is None else choose.select(rows),
        workers.check_wanted,
        own_mirror,
        max_stretch=max_stretch,
    )
    left = None if max_charts is None else max_charts - len(charts) - len(more)
    if left is None or int(fans(F[rows[~developed]])[1].max(initial=-1)) + 1 <= left:
        charts += [replace(chart, triangles=rows[chart.triangles]) for chart in more]
        mask[rows[developed]] = True
    return mask, charts


def _lay_flat(V: FloatArray, F: IntArray, cut: IntArray) -> tuple[BoolArray, list[Chart]]:
    """Lay out the planar parts between cuts; return a mask (f,) of their triangles, and their charts."""
    parts = split_parts(F, np.arange(len(F)), cut, len(V))
    vertices = np.concatenate([origin for _, _, origin in parts])
    first = np.cumsum([0, *(len(origin) for _, _, origin in parts)])
    rows = np.concatenate([rows for rows, _, _ in parts])
    own = np.concatenate([own + start for (_, own, _), start in zip(parts, first, strict=False)])
    component = repeat_each(np.arange(len(parts)), [len(rows) for rows, _, _ in parts])
    flat, uv = lay_flat_parts(V[vertices], own, component)
    charts = []
    for k in np.flatnonzero(flat).tolist():
        rows_of, own_of, origin = parts[k]
        charts.append(Chart(rows_of, own_of, origin, uv[first[k] : first[k + 1]], np.ones(len(rows_of)), 0.0))
    mask = np.zeros(len(F), dtype=bool)
    mask[rows] = flat[component]
    return mask, charts


def _keep_parts(
    V: FloatArray, F: IntArray, rows: IntArray, cut: IntArray, cost: FloatArray, uv: FloatArray | None
) -> tuple[list[WorkingChart], IntArray]:
    """Return the parts of triangles (k,) between demanded cuts as charts, and the triangles of all other parts."""
    charts, others = list[WorkingChart](), [rows[:0]]
    for of, own, origin in split_parts(F[rows], rows, cut, len(V)) if rows.size else []:
        try:
            chart = WorkingChart(of, origin, V[origin], own, cost[of])
        except ValueError:
            # The part is closed or has handles.
            others.append(of)
            continue
        charts.append(chart)
        if uv is not None and np.isfinite(uv[of]).all():
            _try_map(chart, uv[of])
    return charts, np.sort(np.concatenate(others))


def _try_map(chart: WorkingChart, corner_uv: FloatArray) -> None:
    """Use texture coordinates (k, 3, 2) as the map of a chart if they are bijective without extreme stretch."""
    uv = np.empty((len(chart.V), 2))
    uv[chart.F] = corner_uv
    # In this unit, areas neither overflow nor underflow.
    uv = scale_to_unit(uv)
    uv[:, 0] *= np.sign(signed_areas(chart.F, in_units(uv, 0)).sum())
    if is_injective(chart.F, uv):
        chart.use(uv)
        if not chart.bijective or chart.too_long.any():
            chart.uv = None


def _finish(charts: list[WorkingChart], bound: float, total: float) -> list[Chart]:
    """Return the charts in the surface's unit; ``total`` is the area of the surface."""
    kept = sum(chart.share_over(bound) * chart.surface_area for chart in charts) <= FREE_SHARE * total
    return [finish_chart(chart, _excess(chart, bound, kept)) for chart in charts]


def _excess(chart: WorkingChart, bound: float, kept: bool) -> float:
    """Return by how much a chart exceeds the bound; ``kept`` says that all charts together keep the bound on 99 %."""
    missed = 0.0
    if not kept:
        order = np.argsort(chart.stretch, kind="stable")
        below = np.cumsum(chart.area[order])
        quantile = chart.stretch[order[min(int(np.searchsorted(below, 1 - FREE_SHARE)), len(order) - 1)]]
        missed = max(missed, float(quantile) - bound)
    if chart.too_long.any():
        missed = max(missed, float(chart.stretch[chart.too_long].max()) - WORST_STRETCH)
    return missed
