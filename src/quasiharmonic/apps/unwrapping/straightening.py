"""Strips: parts of a surface that are regular grids of quadrilaterals, laid out as rectangles.

Triangles are paired to quadrilaterals. If every quadrilateral of a part were a unit square, the part could be unrolled
exactly where it is a grid, and its corners would have whole coordinates. A tube repeats itself after some columns and
is cut along one. The sides of columns and rows then get mean lengths.
"""

from __future__ import annotations

from dataclasses import replace
from typing import NamedTuple

import numpy as np

from quasiharmonic.apps.unwrapping.chart import Chart, finish_chart
from quasiharmonic.apps.unwrapping.chart_maps import WorkingChart
from quasiharmonic.apps.unwrapping.hinges import DEMANDED_COST, UNDIVIDED_COST, Hinges
from quasiharmonic.apps.unwrapping.pieces import CREASE
from quasiharmonic.apps.unwrapping.unrolling import find_forest, lay_along
from quasiharmonic.geometry.mesh.reference import corner_angles, rest_shapes
from quasiharmonic.geometry.mesh.splitting import fans
from quasiharmonic.geometry.mesh.topology import edge_keys, group_by_label, pair_keys
from quasiharmonic.util.arrays import BoolArray, ComplexArray, FloatArray, IntArray, mark

# Strips end at edges with larger angles between the normals. The first one allows all edges.
_ANGLES = (np.pi, np.pi / 3, CREASE)
# No angle of a quadrilateral differs by more from a right angle, in radians.
_SKEWED = np.pi / 4
# Fewer triangles between creases are no strip: pairs of them are everywhere on a rough surface.
_FEWEST = 12
# Strips with at most this stretch are straight when they are unrolled.
_STRAIGHT = 1.001


class Strip(NamedTuple):
    """A grid of quadrilaterals that `unwrap` found with ``straighten=True``.

    Attributes
    ----------
    triangle : int
        Its first triangle.
    columns, rows : int
        Number of quadrilaterals along its two sides.
    stretch : float
        Largest stretch as a rectangle.
    straightened : bool
        Whether it became a rectangle; not if that stretches a triangle beyond the bound, or needs too many charts.

    See Also
    --------
    UnwrapResult : Lists them as ``strips``.

    Examples
    --------
    >>> import numpy as np
    >>> from quasiharmonic import unwrap
    >>> from quasiharmonic.surfaces import grid
    >>> flat, F = grid(8, 4)
    >>> V = np.column_stack([np.cos(2 * flat[:, 0]), np.sin(2 * flat[:, 0]), flat[:, 1] + 0.1 * flat[:, 0] ** 2])
    >>> [(strip.columns, strip.rows) for strip in unwrap(V, F, straighten=True).strips]
    [(8, 4)]
    """

    triangle: int
    columns: int
    rows: int
    stretch: float
    straightened: bool


class _GridPlaces(NamedTuple):
    """Column and row of each corner (k, 3) of a grid."""

    column: IntArray
    row: IntArray


def straighten_strips(
    V: FloatArray,
    F: IntArray,
    hinges: Hinges,
    cost: FloatArray,
    cut: IntArray | None,
    bound: float,
    max_charts: int | None = None,
) -> tuple[list[Chart], list[Strip]]:
    """Lay out the strips of a surface as rectangles.

    Flat strips, and others that are straight without stretch, are left out.

    Parameters
    ----------
    V : (n, 3) float64
    F : (f, 3) int64
    hinges : Hinges
    cost : (f, 3) float64
        Factors on the cost of seams; see `find_charts`.
    cut : (l, 2) int64, optional
        Edges that are seams in any case.
    bound : float
        Bound on the stretch of each triangle. Strips that exceed it do not become charts.
    max_charts : int, optional
        No strip becomes a chart if these and what is left have more parts.

    Returns
    -------
    charts : list of Chart
        Rectangles along the axes, ordered by first triangle.
    strips : list of Strip
        These and the strips that exceed the bound, ordered by first triangle.
    """
    apart = hinges.touch(cost <= DEMANDED_COST)
    if cut is not None:
        apart |= np.isin(pair_keys(hinges.ends(F), len(V)), pair_keys(cut, len(V)))
    diagonal = _find_diagonals(V, F, hinges, cost, apart)
    together = diagonal | hinges.flat | hinges.touch(cost >= UNDIVIDED_COST)
    paired = mark(len(F), hinges.first[diagonal], hinges.second[diagonal])
    left = np.ones(len(F), dtype=bool)
    weight = hinges.price(cost)
    charts, strips = list[Chart](), dict[int, Strip]()
    for angle in _ANGLES:
        joined = ~apart & (together | (np.abs(hinges.angle) <= angle)) & left[hinges.first] & left[hinges.second]
        place = _lay_squares(F, hinges, joined, diagonal)
        for rows, here in _list_parts(F, hinges, joined):
            if rows.size < _FEWEST or not paired[rows].all() or (hinges.flat | diagonal)[here].all():
                continue
            grid = _find_grid(place, hinges, rows, here, diagonal, weight)
            if grid is None:
                continue
            chart = _make_rectangle(V, F, cost, rows, grid)
            worst, first = float(chart.stretch.max()), int(rows[0])
            if worst <= _STRAIGHT:
                continue
            # A part that a smaller angle leaves with the same first triangle replaces the larger part.
            strips[first] = Strip(first, int(grid.column.max()), int(grid.row.max()), worst, worst <= bound)
            if worst <= bound:
                charts.append(chart)
                left[rows] = False
    charts.sort(key=lambda chart: int(chart.triangles[0]))
    if max_charts is not None and len(charts) + int(fans(F[left])[1].max(initial=-1)) + 1 > max_charts:
        return [], [strip._replace(straightened=False) for _, strip in sorted(strips.items())]
    return charts, [strip for first, strip in sorted(strips.items()) if strip.straightened or left[first]]


def _find_diagonals(V: FloatArray, F: IntArray, hinges: Hinges, cost: FloatArray, apart: BoolArray) -> BoolArray:
    """Return the hinges (e,) at which two triangles form a quadrilateral, those with the best angles first.

    Inside polygons, the cost of seams is high.
    """
    angle = corner_angles(rest_shapes(V, F).sides)
    one, other = (np.roll(angle, shift, axis=1).ravel() for shift in (0, -1))
    apex = np.roll(angle, -2, axis=1).ravel()
    corners = [apex[hinges.one], apex[hinges.other], one[hinges.one] + other[hinges.other]]
    corners.append(other[hinges.one] + one[hinges.other])
    skewed = np.abs(np.stack(corners) - np.pi / 2).max(axis=0)
    least = np.minimum(cost.ravel()[hinges.one], cost.ravel()[hinges.other])
    # Flat faces have high costs, and polygons inside them the square of these.
    inside = (least >= UNDIVIDED_COST).astype(np.int64) + (least >= UNDIVIDED_COST**2)
    chosen, free = np.zeros(apart.size, dtype=bool), np.ones(len(F), dtype=bool)
    order = np.lexsort((skewed, -inside))
    order = order[(skewed <= _SKEWED)[order] & ~apart[order]]
    for k, a, b in zip(order.tolist(), hinges.first[order].tolist(), hinges.second[order].tolist(), strict=True):
        if free[a] and free[b]:
            chosen[k], free[a], free[b] = True, False, False
    return chosen


def _list_parts(F: IntArray, hinges: Hinges, joined: BoolArray) -> list[tuple[IntArray, IntArray]]:
    """Return the triangles and hinges of each part that is connected by the joined hinges (e,), and has some."""
    part = fans(F, ~hinges.mark_sides(joined, len(F)))[1]
    number = np.flatnonzero(joined)
    of_hinge = part[hinges.first[number]]
    # Both lists have the parts with hinges, by ascending labels.
    triangles = group_by_label(np.where(mark(len(F), of_hinge)[part], part, -1))
    return list(zip(triangles, (number[some] for some in group_by_label(of_hinge)), strict=True))


def _lay_squares(F: IntArray, hinges: Hinges, joined: BoolArray, diagonal: BoolArray) -> ComplexArray:
    """Lay out triangles (f, 3) along joined hinges (e,) as if their quadrilaterals were unit squares."""
    side = np.zeros(len(F), dtype=np.int64)
    side[hinges.first[diagonal]], side[hinges.second[diagonal]] = hinges.one[diagonal] % 3, hinges.other[diagonal] % 3
    linked, _, component = find_forest(F, hinges, np.flatnonzero(joined))
    # Half a unit square in each triangle: its diagonal is this side, from (0, 0) to (1, 1), and its apex is (0, 1).
    # Rows of the table are the start of the diagonal, its end, and the apex; the third coordinate is zero.
    half = np.array([[0.0, 0.0, 0.0], [1, 1, 0], [0, 1, 0]])[(np.arange(3) - side[:, None]) % 3].reshape(-1, 3)
    place = lay_along(half, np.arange(F.size).reshape(-1, 3), hinges.one[linked], hinges.other[linked], component)
    # Rotate each component so that its first triangle's leg from the diagonal's end to the apex is along x.
    first = np.unique(component, return_index=True)[1]
    leg = place[first, (side[first] + 2) % 3] - place[first, (side[first] + 1) % 3]
    return (place - place[first, side[first]][component][:, None]) / (leg / np.abs(leg))[component][:, None]


def _find_grid(
    place: ComplexArray, hinges: Hinges, rows: IntArray, here: IntArray, diagonal: BoolArray, weight: FloatArray
) -> _GridPlaces | None:
    """Return columns and rows of the corners of a part, if it is a grid or a tube; None otherwise.

    Parameters
    ----------
    place : (f, 3) complex128
        See `_lay_squares`.
    hinges : Hinges
    rows, here : (k,), (h,) int64
        Triangles and hinges of the part.
    diagonal : (e,) bool
    weight : (e,) float64
        What it costs to cut a tube at each hinge.
    """
    inner = here[~diagonal[here]]
    # The translation of the layout across each edge between squares: zero in a grid, a multiple of the period in a tube
    # along the edge where it is cut open. If the ends of an edge differ by two translations, one side is rotated.
    z, ahead = place.ravel(), np.roll(place, -1, axis=1).ravel()
    step = np.rint(z[hinges.one[inner]] - ahead[hinges.other[inner]])
    turned = np.abs(step - ahead[hinges.one[inner]] + z[hinges.other[inner]]) > 0.5
    across, along = (int(np.gcd.reduce(part.astype(np.int64))) for part in (step.real, step.imag))
    if turned.any() or (across and along):
        return None
    # A tube goes around along its columns.
    period, turn = max(across, along), -1j if along else 1
    corners = np.rint(place[rows] * turn)
    # The square of each triangle, by its lower left corner, and the corners of the triangle relative to this corner.
    cell = np.floor((place[rows] * turn).mean(axis=1).view(np.float64).reshape(-1, 2)).astype(np.int64)
    offset = np.stack([corners.real, corners.imag], axis=-1).astype(np.int64) - cell[:, None]
    cell[:, 1] -= cell[:, 1].min()
    if period:
        side = hinges.one[inner]
        cell[:, 0] -= _choose_cut(z[side] * turn, ahead[side] * turn, weight[inner], period)
        cell[:, 0] %= period
    else:
        cell[:, 0] -= cell[:, 0].min()
    if not _is_full_grid(cell, inner.size, tube=period > 0):
        return None
    corner = cell[:, None] + offset
    return _GridPlaces(corner[..., 0], corner[..., 1])


def _choose_cut(start: ComplexArray, end: ComplexArray, weight: FloatArray, period: int) -> int:
    """Return the column before which it costs least to cut a tube, given its edges' ends (k,) and weights (k,)."""
    column, other = (np.rint(z.real).astype(np.int64) for z in (start, end))
    upright = column == other
    return int(np.argmin(np.bincount(column[upright] % period, weight[upright], period)))


def _is_full_grid(cell: IntArray, links: int, *, tube: bool) -> bool:
    """Return whether triangles in cells (k, 2), with a number of links between squares, are a grid without gaps.

    Two triangles, one square, must be in each cell of the bounding rectangle. An edge links only squares in adjacent
    cells, and each pair of these at most once. So if there are as many links as adjacent pairs, all of them are linked.
    """
    m, n = (cell.max(axis=0) + 1).tolist()
    pairs = (m if tube else m - 1) * n + m * (n - 1)
    return links == pairs and bool((np.bincount(cell[:, 0] * n + cell[:, 1], minlength=m * n) == 2).all())


def _make_rectangle(V: FloatArray, F: IntArray, cost: FloatArray, rows: IntArray, grid: _GridPlaces) -> Chart:
    """Return a grid as a chart whose columns and rows have constant widths, means of the lengths of their sides."""
    T, (column, row) = F[rows], grid
    node = column * (int(row.max()) + 1) + row
    _, first, own = np.unique(node, return_index=True, return_inverse=True)
    own = own.reshape(-1, 3)
    ahead = np.roll(own, -1, axis=1)
    _, side = np.unique(edge_keys(own.ravel(), ahead.ravel(), first.size), return_index=True)
    length = np.linalg.norm(V[T] - V[np.roll(T, -1, axis=1)], axis=2).ravel()[side]
    ticks = []
    for along, across in ((column, row), (row, column)):
        least = np.minimum(along, np.roll(along, -1, axis=1)).ravel()[side]
        straight = (across == np.roll(across, -1, axis=1)).ravel()[side]
        # These lengths have the least symmetric Dirichlet energy, summed over the sides.
        high, low = (np.bincount(least[straight], length[straight] ** power) for power in (2, -2))
        ticks.append(np.concatenate([[0.0], np.cumsum((high / low) ** 0.25)]))
    uv = np.stack([ticks[0][column.ravel()[first]], ticks[1][row.ravel()[first]]], axis=1)
    vertices = T.ravel()[first]
    working = WorkingChart(rows, vertices, V[vertices], own, cost[rows])
    working.use(uv)
    return replace(finish_chart(working, 0.0), straight=True)
