"""All charts as one mesh in the texture, rounded, its seams on the model, and the choice between lists of charts."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Protocol

import numpy as np

from quasiharmonic.apps.atlas.packing.bitmap_search import Textures
from quasiharmonic.apps.atlas.packing.layout import estimate_use
from quasiharmonic.apps.atlas.packing.pack import Packing
from quasiharmonic.apps.unwrapping.chart import Chart, group_charts, measure_charts
from quasiharmonic.apps.unwrapping.cleaning import CleanedMesh
from quasiharmonic.geometry.mesh.reference import surface_area
from quasiharmonic.geometry.mesh.topology import edge_keys
from quasiharmonic.util.arrays import BoolArray, FloatArray, IntArray
from quasiharmonic.util.progress import heartbeat

# Above this loss, lists with unions that have much larger boxes than their parts are compared, too.
_GENEROUS = 0.05
# If at least this share of the outlines of a list lies along the axes, so must those of the list that is returned.
_MOSTLY_STRAIGHT = 0.87
# Their share may be smaller by this difference.
_BENT = 0.03
# Lists with more charts than this are not packed for comparison.
_MAX_COMPARED = 150
# A layout that uses this share of the texture is good enough: no further list is compared.
_GOOD_USE = 0.83
#: Positions in the unit square are multiples of this unit. Single precision stores these numbers and their differences
#: from 1 exactly.
GRID_UNIT = 2.0**-24
# A vertex moves by at most this number of units along each axis at a time.
_REACH = 2
# Maximum number of passes over the triangles that are not positive.
_PASSES = 8
# More triangles than this are not repaired: the surface is too large for the grid.
_MOST = 100_000


@dataclass(frozen=True, eq=False)
class ChartLayout:
    """Charts in the texture.

    Attributes
    ----------
    rows : (k, 3) int64
        Rows of ``uv`` for the corners of each triangle. Charts have no common rows.
    uv : (m, 2) float64
        Texture coordinates, rounded by `round_positions`.
    chart : (k,) int64
        Chart of each triangle, from 0.
    mirrored : (k,) bool
        Whether the triangle's chart is mirrored.
    """

    rows: IntArray
    uv: FloatArray
    chart: IntArray
    mirrored: BoolArray

    @property
    def F(self) -> IntArray:
        """The triangles (k, 3), reversed in mirrored charts."""
        return np.where(self.mirrored[:, None], self.rows[:, ::-1], self.rows)


class Divide(Protocol):
    """Divide long charts, given positions (n, 3), costs (f, 3) and textures (f,); see `divide_long_charts`."""

    def __call__(
        self, charts: list[Chart], V: FloatArray, cost: FloatArray, texture: IntArray, *, area: float | None = None
    ) -> list[Chart]: ...


@dataclass(frozen=True, eq=False)
class LayoutChoice:
    """How to choose from several lists of charts of the same triangles.

    Attributes
    ----------
    divide : callable
        See `Divide`.
    into : Textures
    loss : float
        By which the use of the texture may be below the best one for the sake of fewer charts.
    texture : (f,) int64
        See `find_textures`.
    """

    divide: Divide
    into: Textures
    loss: float
    texture: IntArray

    def select(self, rows: IntArray) -> LayoutChoice:
        """Return the choice for some triangles (k,)."""
        return replace(self, texture=self.texture[rows])

    def measure_area(self, V: FloatArray, F: IntArray) -> float:
        """Return the largest area of the triangles of a texture, given positions (n, 3) and all triangles (f, 3)."""
        numbers = np.unique(self.texture[self.texture >= 0]).tolist()
        if not numbers:
            return surface_area(V, F)
        return max(surface_area(V, F[self.texture == k]) for k in numbers)

    def is_generous(self, charts: list[Chart]) -> bool:
        """Whether unions of charts with much larger boxes than their parts can be worth their use of the texture."""
        return self.loss > _GENEROUS and self._are_comparable(group_charts(charts, self.texture))

    def choose(self, found: list[list[Chart]], V: FloatArray, cost: FloatArray) -> list[Chart]:
        """Return the last list that uses the texture at most by `loss` worse than the best one, long charts divided.

        If almost all outlines of a list lie along the axes, so must those of the list that is returned.
        """
        # Of lists with equal numbers of charts, the last one.
        lists = list({len(charts): charts for charts in found}.values())
        if len(lists) > 1:
            straight = np.array([_straight_share(charts) for charts in lists])
            allowed = straight >= (straight.max() - _BENT if straight.max() >= _MOSTLY_STRAIGHT else 0.0)
            lists = [lists[k] for k in np.flatnonzero(allowed)[::-1]]
        if len(lists) == 1:
            return self.divide(lists[0], V, cost, self.texture)
        chosen, use = lists[0], -1.0
        for some in lists:
            charts = self.divide(some, V, cost, self.texture)
            covered = self._estimate_use(charts, max(use + self.loss, 0.0))
            if use < 0 or covered > use + self.loss:
                chosen, use = charts, covered
            if use >= _GOOD_USE - self.loss:
                break
        return chosen

    def _estimate_use(self, charts: list[Chart], above: float) -> float:
        """Part of the fullest texture that charts cover at one scale; 0 if that is not above a given part."""
        groups = group_charts(charts, self.texture)
        if not self._are_comparable(groups):
            return 0.0
        areas = [*map(measure_charts, groups)]
        largest, uses = max(areas, default=0.0), []
        for group, area in zip(groups, areas, strict=True):
            if area > 0:
                share = area / largest
                uses.append(estimate_use([chart.shape for chart in group], self.into, above=above * share) / share)
        return min(uses, default=0.0)

    def _are_comparable(self, groups: list[list[Chart]]) -> bool:
        """Whether the charts of all textures are few enough to pack them for comparison."""
        return max(map(len, groups), default=0) <= _MAX_COMPARED


def _straight_share(charts: list[Chart]) -> float:
    """Share of the outlines of charts, by length, that lies along the sides of their boxes."""
    straight, length = np.sum([chart.shape.outline_lengths for chart in charts], axis=0)
    return float(straight / max(length, np.finfo(float).tiny))


def join_charts(charts: Sequence[Chart], packing: Packing, count: int) -> ChartLayout:
    """Return the layout of packed charts that have ``count`` triangles in all."""
    rows, chart = np.full((count, 3), -1), np.full(count, -1)
    start = 0
    for k, one in enumerate(charts):
        rows[one.triangles] = one.F + start
        chart[one.triangles] = k
        start += len(one.uv)
    assert chart.min() >= 0, "every triangle has a chart"
    mirrored = np.array([placement.mirrored for placement in packing.placements])[chart]
    layout = ChartLayout(rows, np.concatenate(packing.uv), chart, mirrored)
    return ChartLayout(rows, round_positions(layout.F, layout.uv), chart, mirrored)


def find_seams(cleaned: CleanedMesh, layout: ChartLayout) -> IntArray:
    """Return the model's edges (s, 2) at which triangles meet that are not joined in the texture, ascending.

    Of several edges whose vertices were merged, the first one is listed.
    """
    side = find_differing_sides(cleaned.F, layout.rows, len(cleaned.V))
    cut = np.stack([cleaned.corners.ravel()[side], cleaned.corners[:, (1, 2, 0)].ravel()[side]], axis=1)
    found = np.unique(np.sort(np.concatenate([cut, cleaned.seams]), axis=1), axis=0)
    joint = np.sort(cleaned.representatives[found], axis=1)
    return found[np.sort(np.unique(joint, axis=0, return_index=True)[1])]


def find_differing_sides(F: IntArray, rows: IntArray, n: int) -> IntArray:
    """Return one side (k,) of each edge of triangles (f, 3) whose two sides have different ``rows`` (f, 3) at an end.

    Side ``3 t + k`` runs from corner ``k`` of triangle ``t`` to the next corner.
    """
    tail, head = F.ravel(), F[:, (1, 2, 0)].ravel()
    here, there = rows.ravel(), rows[:, (1, 2, 0)].ravel()
    upwards = tail < head
    low, high = np.where(upwards, here, there), np.where(upwards, there, here)
    key = edge_keys(tail, head, n)
    order = np.argsort(key, kind="stable")
    key, low, high = key[order], low[order], high[order]
    return order[1:][(key[1:] == key[:-1]) & ((low[1:] != low[:-1]) | (high[1:] != high[:-1]))]


def round_positions(F: IntArray, uv: FloatArray) -> FloatArray:
    """Round positions to multiples of a power of two that single precision stores, also if v is replaced by 1 − v.

    Rounding can invert extremely thin triangles. Their vertices then move by a few units, if all triangles around them
    become positive.

    Parameters
    ----------
    F : (k, 3) int64
        Triangles, positive before rounding.
    uv : (n, 2) float64
        Positions in the unit square, or in the squares of several tiles.

    Returns
    -------
    (n, 2) float64
    """
    unit = grid_unit(uv)
    grid = np.rint(uv / unit).astype(np.int64)
    for _ in range(_PASSES):
        wrong = np.flatnonzero(_twice_areas(grid[F]) <= 0)
        if not 0 < wrong.size <= _MOST or not _repair(F, grid, wrong):
            break
    return np.asarray(grid.astype(np.float64) * unit)


def grid_unit(uv: FloatArray) -> float:
    """Return the unit of which `round_positions` makes positions (n, 2) multiples."""
    # Numbers beyond 1 need a larger unit.
    return GRID_UNIT * 2.0 ** int(np.ceil(np.log2(np.abs(uv).max(initial=1.0))))


def _repair(F: IntArray, grid: IntArray, wrong: IntArray) -> bool:
    """Move vertices of triangles that are not positive; return whether a vertex moved."""
    moved = False
    steps = np.stack(np.meshgrid(*[np.arange(-_REACH, _REACH + 1)] * 2), axis=2).reshape(-1, 2)
    steps = steps[np.argsort((steps**2).sum(axis=1), kind="stable")]
    incident = _Incidence(F, np.unique(F[wrong]))
    for triangle in wrong.tolist():
        heartbeat()
        best, move = 0, None
        for vertex in F[triangle].tolist():
            if _twice_areas(grid[F[triangle]]) > 0:
                break
            around = incident.around(vertex)
            corners = np.repeat(grid[F[around]][None], len(steps), axis=0)
            here = np.broadcast_to(F[around] == vertex, corners.shape[:3])
            corners[here] += np.repeat(steps, here[0].sum(), axis=0)
            left = np.count_nonzero(_twice_areas(corners) <= 0, axis=1)
            choice = int(np.argmin(left))
            if left[0] - left[choice] > best:
                best, move = int(left[0] - left[choice]), (vertex, steps[choice])
        if move is not None:
            grid[move[0]] += move[1]
            moved = True
    return moved


class _Incidence:
    """The triangles around some vertices (m,), ascending."""

    def __init__(self, F: IntArray, vertices: IntArray) -> None:
        corner = np.flatnonzero(np.isin(F, vertices))
        corner = corner[np.argsort(F.ravel()[corner], kind="stable")]
        self._triangle, self._vertex = corner // 3, F.ravel()[corner]

    def around(self, vertex: int) -> IntArray:
        """Return the triangles around a vertex."""
        begin, end = np.searchsorted(self._vertex, [vertex, vertex + 1])
        return self._triangle[begin:end]


def _twice_areas(corners: IntArray) -> IntArray:
    """Return twice the signed areas (...) of triangles (..., 3, 2) with integer positions, exactly."""
    a, b = corners[..., 1, :] - corners[..., 0, :], corners[..., 2, :] - corners[..., 0, :]
    return np.asarray(a[..., 0] * b[..., 1] - a[..., 1] * b[..., 0])
