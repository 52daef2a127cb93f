"""The charts at a time limit: those that a search has so far, and charts grown by normals of all other triangles.

Grown charts are nearly flat and found quickly, but more than a search finds. Every triangle starts as a chart. In each
round, pairs of neighbouring charts are joined whose triangles all face nearly the same way; long common outlines and
flat pairs come first. Normals are averaged before, because those of noisy surfaces differ everywhere. A chart is
projected along its mean normal. It is divided if it overlaps itself, and steep triangles are cut off.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from quasiharmonic.apps.unwrapping.chart import Chart, cut_out_chart, finish_chart, halve, mirror_charts
from quasiharmonic.apps.unwrapping.chart_maps import FREE_SHARE, WORST_STRETCH, WorkingChart, keeps_bound
from quasiharmonic.apps.unwrapping.hinges import DEMANDED_COST
from quasiharmonic.apps.unwrapping.straightening import Strip
from quasiharmonic.apps.unwrapping.symmetry import Mirror
from quasiharmonic.apps.unwrapping.unrolling import covers_once
from quasiharmonic.geometry.mesh.splitting import fans
from quasiharmonic.geometry.mesh.topology import edge_keys, find_pairs, mark_sides, number_components, rank_labels
from quasiharmonic.util.arrays import BoolArray, FloatArray, IntArray, find_exponent, mark

# Largest and smallest bound in radians on the angle between a triangle and the plane of its chart.
_MOST_INCLINED, _LEAST_INCLINED = np.pi / 3, 1e-3
# Cells of directions along half an edge of the cube around all directions, times the largest angle.
_CELLS = 1.5
# Number of averages of the normals over neighbouring triangles.
_SMOOTHINGS = 4
# Charts that are not joined after so many rounds stay apart.
_MAX_ROUNDS = 100


@dataclass(eq=False)
class Draft:
    """Charts of a search that may end early.

    Attributes
    ----------
    charts : sequence of Chart
        Charts that are finished.
    working : sequence of WorkingChart
        Further charts, with and without maps.
    mirror : Mirror or None
        Mirror images, if ``working`` has charts of one side only.
    rows : (k,) int64 or None
        The triangles that are searched, if not all are. The charts above refer to these.
    others : sequence of Chart
        Charts of other triangles.
    strips : sequence of Strip
        Strips among these, and strips that stay as they are.
    """

    charts: Sequence[Chart] = ()
    working: Sequence[WorkingChart] = ()
    mirror: Mirror | None = None
    rows: IntArray | None = None
    others: Sequence[Chart] = ()
    strips: Sequence[Strip] = ()

    def keep(self, working: Sequence[WorkingChart]) -> None:
        """Replace the charts that are not finished."""
        self.working = working

    def complete(
        self, V: FloatArray, F: IntArray, cost: FloatArray, cuts: IntArray | None, bound: float
    ) -> tuple[list[Chart], BoolArray]:
        """Return all bijective charts that keep the bound, and charts grown by normals of all other triangles.

        Parameters
        ----------
        V : (n, 3) float64
        F : (f, 3) int64
        cost : (f, 3) float64
            Factor on the cost of a seam at each side; see `find_charts`.
        cuts : (l, 2) int64, optional
            Edges that must be seams.
        bound : float
            Bound on the stretch.

        Returns
        -------
        charts : list of Chart
            Ordered by first triangle.
        grown : (f,) bool
            The triangles of charts that were grown by normals.
        """
        good = [finish_chart(chart, 0.0) for chart in self.working if chart.bijective and keeps_bound(chart, bound)]
        rows = np.arange(len(F)) if self.rows is None else self.rows
        found = [*self.charts, *(good if self.mirror is None else mirror_charts(F[rows], good, self.mirror))]
        found = [*self.others, *(replace(chart, triangles=rows[chart.triangles]) for chart in found)]
        grown = np.ones(len(F), dtype=bool)
        for chart in found:
            grown[chart.triangles] = False
        found += grow_charts(V, F, np.flatnonzero(grown), cost, _find_seams(V, F, cost, cuts), bound)
        return sorted(found, key=lambda chart: int(chart.triangles[0])), grown


def grow_charts(
    V: FloatArray, F: IntArray, rows: IntArray, cost: FloatArray, cut: BoolArray, bound: float
) -> list[Chart]:
    """Divide a part of a surface into nearly flat charts.

    Parameters
    ----------
    V : (n, 3) float64
    F : (f, 3) int64
        Triangles of manifold, consistently oriented surfaces without degenerate triangles.
    rows : (k,) int64
        The triangles of the part, ascending.
    cost : (f, 3) float64
        Factor on the cost of a seam at each side of each triangle.
    cut : (f, 3) bool
        Sides that must be seams.
    bound : float
        Bound on the stretch.

    Returns
    -------
    list of Chart
        Bijective, except for single triangles that are too thin for double precision. No triangle is stretched by more
        than 3. Charts of smooth surfaces keep the bound; charts of noisy ones may exceed it.
    """
    if not rows.size:
        return []
    exponent = find_exponent(V)
    corners, cross = _find_corners(V, F[rows], exponent)
    label = _join(corners, F[rows], cross, cost[rows], cut[rows], bound)
    charts, left = list[Chart](), np.arange(len(rows))
    while left.size:
        triangles = F[rows[left]]
        apart = cut[rows[left]] | _differ(triangles, label[left])
        split, component = fans(triangles, apart)
        uv, stretch = _project(corners[left], cross[left], component)
        place = np.zeros((int(split.max()) + 1, 2))
        place[split] = uv
        size = np.bincount(component)
        steep = stretch > WORST_STRETCH
        mild = np.bincount(component, steep) == 0
        good = covers_once(split, place, component, mild & (size > 1)) | (size == 1)
        order = np.argsort(component, kind="stable")
        for k, some in enumerate(np.split(order, np.cumsum(size)[:-1])):
            if good[k]:
                missed = _find_excess(stretch[some], cross[left[some]], max(bound, 1 / np.cos(_LEAST_INCLINED)))
                found = rows[left[some]], split[some], triangles[some], np.ldexp(uv[some], exponent)
                charts.append(cut_out_chart(*found, stretch[some], missed))
            else:
                label[left[some]] = 2 * k + (steep[some] if 0 < steep[some].sum() < some.size else halve(uv[some]))
        left = left[~good[component]]
    return charts


def expect_charts(V: FloatArray, F: IntArray, cost: FloatArray, cuts: IntArray | None, bound: float) -> int:
    """Return about how many charts `Draft.complete` makes if the search has none; for the arguments see there."""
    corners, cross = _find_corners(V, F, find_exponent(V))
    return int(np.unique(_join(corners, F, cross, cost, _find_seams(V, F, cost, cuts), bound)).size)


def _find_seams(V: FloatArray, F: IntArray, cost: FloatArray, cuts: IntArray | None) -> BoolArray:
    """Return the sides (f, 3) that must be seams."""
    cut: BoolArray = cost <= DEMANDED_COST
    return cut if cuts is None else cut | mark_sides(F, cuts, len(V))


def _find_corners(V: FloatArray, F: IntArray, exponent: int) -> tuple[FloatArray, FloatArray]:
    """Return the corners (k, 3, 3) of triangles (k, 3), over a power of two, and normals of twice their area (k, 3)."""
    corners = np.ldexp(V[F], -exponent)
    return corners, np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])


def _join(
    corners: FloatArray, F: IntArray, cross: FloatArray, cost: FloatArray, cut: BoolArray, bound: float
) -> IntArray:
    """Return a chart (k,) of each triangle, given its corners (k, 3, 3) and a normal of twice its area (k, 3)."""
    most = max(min(np.arccos(1 / bound), _MOST_INCLINED), _LEAST_INCLINED)
    one, other = find_pairs(F)
    joined = ~(cut.ravel()[one] | cut.ravel()[other])
    one, other = one[joined], other[joined]
    normal = _smooth(cross, one // 3, other // 3, most)
    # Neighbours that face the same cell of directions are joined at once.
    facing = _find_cells(normal, most)
    alike = facing[one // 3] == facing[other // 3]
    part = number_components(one[alike] // 3, other[alike] // 3, len(F))
    cross = _sum_rows(cross, part)
    middle = _scale_to_one(cross)
    radius = np.zeros(len(middle))
    np.maximum.at(radius, part, _angles(normal, middle[part]))
    weight = (np.linalg.norm(corners - np.roll(corners, -1, axis=1), axis=2) * cost).ravel()
    common = (weight[one] + weight[other]) / 2
    inner = np.bincount(part[one[alike] // 3], 2 * common[alike], len(middle))
    outline: FloatArray = (np.bincount(part, weight.reshape(-1, 3).sum(axis=1)) - inner).astype(np.float64)
    a, b, common = _list_pairs(part[one // 3], part[other // 3], common)
    label, mean, inclined = np.arange(len(middle)), middle, radius
    for _ in range(_MAX_ROUNDS):
        union = _scale_to_one(cross[a] + cross[b])
        angle = np.maximum(_angles(union, mean[a]) + inclined[a], _angles(union, mean[b]) + inclined[b])
        possible = angle <= most
        a, b, common, angle = a[possible], b[possible], common[possible], angle[possible]
        if not a.size:
            break
        score = common / np.minimum(outline[a], outline[b]) * (1 - angle / (2 * most))
        chosen = _find_mutual(a, b, score, len(cross))
        outline[a[chosen]] -= 2 * common[chosen]
        new = np.arange(len(cross))
        new[b[chosen]] = a[chosen]
        new = rank_labels(new)
        cross, outline, label = _sum_rows(cross, new), np.bincount(new, outline).astype(np.float64), new[label]
        mean, inclined = _scale_to_one(cross), np.zeros(len(cross))
        np.maximum.at(inclined, label, _angles(middle, mean[label]) + radius)
        a, b, common = _list_pairs(new[a], new[b], common)
    return label[part]


def _find_excess(stretch: FloatArray, cross: FloatArray, bound: float) -> float:
    """Return by how much 99 % of the area of a chart exceed the bound on stretch."""
    area, order = np.linalg.norm(cross, axis=1), np.argsort(-stretch)
    over = int(np.searchsorted(np.cumsum(area[order]), FREE_SHARE * area.sum()))
    return max(float(stretch[order[over]]) - bound, 0.0)


def _smooth(cross: FloatArray, first: IntArray, second: IntArray, most: float) -> FloatArray:
    """Return normals (k, 3) without noise, given pairs of neighbouring triangles."""
    area, itself = np.linalg.norm(cross, axis=1)[:, None], np.arange(len(cross))
    smooth = _scale_to_one(cross)
    for _ in range(_SMOOTHINGS):
        # Creases stay sharp.
        near = _angles(smooth[first], smooth[second]) <= most
        a, b = first[near], second[near]
        rows, to = np.concatenate([itself, a, b]), np.concatenate([itself, b, a])
        smooth = _scale_to_one(_sum_rows((smooth * area)[rows], to))
    return smooth


def _find_cells(normal: FloatArray, most: float) -> IntArray:
    """Return a cell (k,) of each direction (k, 3): a square on a cube, small compared to the angle ``most``."""
    # Their number along an edge is odd, so that the axes are in the middle of cells.
    count = 2 * int(np.ceil(_CELLS / most)) + 1
    axis = np.argmax(np.abs(normal), axis=1)
    ahead = np.take_along_axis(normal, axis[:, None], axis=1)
    square = normal / np.where(ahead == 0, 1.0, np.abs(ahead))
    place = np.minimum(((square + 1) / 2 * count).astype(np.int64), count - 1)
    place[np.arange(len(axis)), axis] = np.where(ahead[:, 0] > 0, count, count + 1)
    return place @ np.array([1, count + 2, (count + 2) ** 2])


def _find_mutual(a: IntArray, b: IntArray, score: FloatArray, n: int) -> IntArray:
    """Return the pairs (a, b) of which each is the best one of its two parts."""
    order = np.argsort(score, kind="stable")
    best = np.empty(n, dtype=np.int64)
    # Of several values for one element, the last is stored.
    best[np.stack([a[order], b[order]], axis=1)] = order[:, None]
    number = np.arange(a.size)
    return np.flatnonzero((best[a] == number) & (best[b] == number))


def _list_pairs(a: IntArray, b: IntArray, common: FloatArray) -> tuple[IntArray, IntArray, FloatArray]:
    """Return each pair of different parts once, with the sum of the lengths."""
    apart = a != b
    key = edge_keys(a[apart], b[apart], int(max(a.max(initial=0), b.max(initial=0))) + 1)
    _, first, at = np.unique(key, return_index=True, return_inverse=True)
    total: FloatArray = np.bincount(at, common[apart]).astype(np.float64)
    return a[apart][first], b[apart][first], total


def _sum_rows(values: FloatArray, label: IntArray) -> FloatArray:
    """Return the sums (c, 3) of the rows of values (k, 3) with each label."""
    return np.stack([np.bincount(label, column) for column in values.T], axis=1)


def _project(corners: FloatArray, cross: FloatArray, component: IntArray) -> tuple[FloatArray, FloatArray]:
    """Project charts along their mean normals; return positions (k, 3, 2), scaled to the area, and stretch (k,)."""
    mean = _scale_to_one(_sum_rows(cross, component))
    area = np.linalg.norm(cross, axis=1)
    cosine = np.minimum((_scale_to_one(cross) * mean[component]).sum(axis=1), 1.0)
    scale = np.sqrt(np.bincount(component, area) / np.bincount(component, area * cosine))[component]
    # The axis with the smallest part of the normal is far from it.
    axis = np.eye(3)[np.argmin(np.abs(mean), axis=1)]
    across = _scale_to_one(np.cross(mean, axis))
    frame = np.stack([across, np.cross(mean, across)], axis=1)
    first = np.unique(component, return_index=True)[1]
    local = corners - corners[first, 0][component][:, None]
    uv = np.einsum("kcx,kdx->kcd", local, frame[component]) * scale[:, None, None]
    return uv, np.maximum(scale, 1 / (scale * cosine))


def _scale_to_one(vectors: FloatArray) -> FloatArray:
    """Scale vectors (k, 3) to length 1."""
    length = np.linalg.norm(vectors, axis=1)
    return vectors / np.where(length > 0, length, 1.0)[:, None]


def _angles(a: FloatArray, b: FloatArray) -> FloatArray:
    """Return the angles (k,) between unit vectors (k, 3)."""
    return np.asarray(2 * np.arcsin(np.minimum(np.linalg.norm(a - b, axis=1) / 2, 1.0)))


def _differ(F: IntArray, label: IntArray) -> BoolArray:
    """Return the sides (k, 3) between triangles with different labels."""
    one, other = find_pairs(F)
    return mark(F.size, one[label[one // 3] != label[other // 3]]).reshape(-1, 3)
