"""Cut a chart further: to the places of greatest stretch, or into two charts."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from scipy.sparse import csr_array
from scipy.sparse.csgraph import breadth_first_order, maximum_flow

from quasiharmonic.apps.unwrapping.chart_maps import WorkingChart
from quasiharmonic.apps.unwrapping.hinges import KEPT_COST, UNDIVIDED_COST
from quasiharmonic.geometry.mesh.splitting import fans, renumber
from quasiharmonic.geometry.mesh.topology import find_pairs, group_by_label, label_components
from quasiharmonic.targets.cuts.graph import EdgeGraph, edge_graph
from quasiharmonic.util.arrays import BoolArray, FloatArray, IntArray, invert_indices, mark


class CutTuning(NamedTuple):
    """Numbers that tune how a chart is cut further."""

    # Extensions of cuts: maximum number of peaks that one extension reaches.
    max_peaks: int = 24
    # It reaches fewer peaks if less than this share of the area is over the bound.
    many_over: float = 0.2
    # Other peaks closer than this multiple of the depth of a peak are not reached by the same extension.
    near: float = 0.3
    # Number of averages of the stretch over neighbouring triangles.
    smoothings: int = 3
    # Largest stretch in these averages.
    max_stretch: float = 4.0
    # Dividing lines: the cost of an edge decreases with the excess of the stretch by this factor.
    attraction: float = 10.0
    # A line stays between these values of the relative distance from its two ends.
    band: tuple[float, float] = (0.25, 0.75)
    # The band of a large chart is narrowed until it has at most this number of triangles.
    max_band: int = 1_500
    # Around each end, up to this distance, triangles belong to the nearer end; the chart has area 1.
    reach: float = 0.15
    # Lines between overlapping parts: maximum number of boundary positions that are compared.
    samples: int = 256
    # Value of a line that halves the boundary, relative to the share of the crossings that it parts.
    balance: float = 0.2
    # A line that leaves one part with more than all but this share of the triangles cuts off a corner only.
    min_part: float = 0.004
    # Lines that replace such a line: cost factor of boundary edges.
    detour: float = 10.0
    # Minimum cost of a line, relative to the boundary's length.
    line_cost: float = 0.05
    # Minimum cuts: costs of edges are integers of about this size.
    cost_unit: float = 1000.0
    # Upper bound of the sum of these integers.
    max_cost: int = 2**30


_TUNING = CutTuning()


def extend_cuts(chart: WorkingChart, bound: float) -> WorkingChart | None:
    """Cut a chart from its boundary to the peaks of its stretch; None if all of these are at the boundary."""
    graph = _graph(chart)
    opened = graph.rim_vertices.copy()
    cut = np.zeros(len(graph.ends), dtype=bool)
    excess = _excess(chart, bound)
    left = chart.share_over(bound)
    most = max(1, int(_TUNING.max_peaks * min(left / _TUNING.many_over, 1)))
    for _ in range(most):
        depth, before = graph.distances(np.flatnonzero(opened), graph.cost)
        score = excess * depth
        tip = int(np.argmax(score))
        if not score[tip] > 0:
            break
        path = graph.way_back(before, tip)
        cut[path] = True
        opened |= graph.mark_vertices(cut)
        near, _ = graph.distances(np.array([tip]), graph.cost, limit=_TUNING.near * depth[tip])
        excess[np.isfinite(near)] = 0
    if not cut.any():
        return None
    (longer,) = _open(chart, cut[graph.side].T)
    return longer


def divide_overlap(chart: WorkingChart, crossings: IntArray) -> list[WorkingChart]:
    """Divide a chart into two or more along a short line between parts that overlap, given crossings (c, 4)."""
    graph = _graph(chart)
    one, other = _overlapping_parts(chart, crossings)
    parts = _open(chart, _line_between(chart, graph, one, other)[graph.side].T)
    if max(len(part.F) for part in parts) < (1 - _TUNING.min_part) * len(chart.F):
        return parts
    # The overlapping parts are so close to each other that the line cuts off a corner only.
    return _open(chart, _line_from(chart, graph, int(one[0]), int(other[0]))[graph.side].T)


def divide(chart: WorkingChart, bound: float) -> list[WorkingChart]:
    """Divide a chart into two or more along a short line across its middle, where possible through much stretch."""
    graph = _graph(chart)
    if chart.uv is not None:
        there = _excess(chart, bound)
        graph.cost[:] /= 1 + _TUNING.attraction * there[graph.ends].mean(axis=1)
    return _open(chart, _line_between(chart, graph, *_far_ends(graph))[graph.side].T)


def _excess(chart: WorkingChart, bound: float) -> FloatArray:
    """How much the logarithm of the stretch around each vertex (m,) exceeds the bound, at least 0."""
    excess = np.log(np.minimum(chart.stretch, _TUNING.max_stretch)) - np.log(bound)
    weight = chart.area
    corners = chart.F.ravel()
    total = np.bincount(corners, np.repeat(weight, 3), minlength=len(chart.V))
    at = np.empty(0)
    for _ in range(_TUNING.smoothings):
        at = np.bincount(corners, np.repeat(weight * excess, 3), minlength=len(chart.V)) / total
        excess = at[chart.F].mean(axis=1)
    # A single triangle must not be lost by the averages.
    np.maximum.at(at, chart.F[chart.too_long].ravel(), np.log(_TUNING.max_stretch))
    return np.maximum(at, 0)


def is_undivided(chart: WorkingChart) -> bool:
    """Return whether all triangles of a chart should stay together, such as those of one polygon."""
    return bool((chart.cost >= UNDIVIDED_COST).any()) and not group_undivided(chart.F, chart.cost).any()


def _graph(chart: WorkingChart) -> EdgeGraph:
    """The edges of a chart with their costs."""
    return edge_graph(chart.V, chart.F, chart.cost)


def _overlapping_parts(chart: WorkingChart, crossings: IntArray) -> tuple[IntArray, IntArray]:
    """Boundary vertices of two parts of a chart that overlap each other.

    One part lies on one arc of the boundary, the other outside of this arc. Of all arcs between sampled boundary
    vertices, the one that parts most crossings is used, and of several the longest.
    """
    loop = np.concatenate(chart.piece.loops)
    pairs = invert_indices(len(chart.V), loop)[crossings[:, (0, 2)]]
    count = min(loop.size, _TUNING.samples)
    bins = pairs * count // loop.size
    crossed = np.zeros((count, count))
    np.add.at(crossed, (bins[:, 0], bins[:, 1]), 1)
    np.add.at(crossed, (bins[:, 1], bins[:, 0]), 1)
    # Sums over all arcs from sample i up to before sample j.
    both = np.pad(crossed.cumsum(axis=0).cumsum(axis=1), [(1, 0), (1, 0)])
    ends = np.arange(count + 1)
    i, j = (ends[:, None], ends[None, :])
    inside = both[j, j] - both[i, j] - both[j, i] + both[i, i]
    touching = both[j, count] - both[i, count]
    length = np.minimum(j - i, count - (j - i)) / count
    score = np.where(j > i, (touching - inside) / len(pairs) + _TUNING.balance * length, -np.inf)
    first, last = np.unravel_index(int(np.argmax(score)), score.shape)
    within = (bins >= first) & (bins < last)
    parted = within[:, 0] != within[:, 1]
    if not parted.any():
        parted[:], within[:, 0], within[:, 1] = True, True, False
    return loop[pairs[parted][within[parted]]], loop[pairs[parted][~within[parted]]]


def _line_from(chart: WorkingChart, graph: EdgeGraph, one: int, other: int) -> BoolArray:
    """Edges (e,) of a line that begins at the boundary between two of its vertices and divides the chart evenly."""
    loop = next(loop for loop in chart.piece.loops if one in loop)
    place = np.concatenate([[0.0], np.cumsum(graph.length[graph.numbers(loop, np.roll(loop, -1))])])
    total = float(place[-1])
    i = int(np.flatnonzero(loop == one)[0])
    at = np.flatnonzero(loop == other)
    j = int(at[0]) if at.size else (i + 1) % loop.size
    i, j = min(i, j), max(i, j)
    middle = (i + j) // 2 if place[j] - place[i] <= total / 2 else ((i + j + loop.size) // 2) % loop.size
    arc = np.abs(place[:-1] - place[middle])
    arc = np.minimum(arc, total - arc)
    weight = np.where(graph.rim, _TUNING.detour, 1.0) * graph.cost
    far, before = graph.distances(loop[[middle]], weight)
    with np.errstate(all="ignore"):
        score = np.where(arc > 0, (far[loop] + _TUNING.line_cost * total) / arc, np.inf)
    line = mark(len(graph.ends), graph.way_back(before, int(loop[np.argmin(score)])))
    return line & ~graph.rim


def _far_ends(graph: EdgeGraph) -> tuple[IntArray, IntArray]:
    """Two vertices of a chart that are far from each other."""
    ends = [0]
    for _ in range(3):
        distance, _ = graph.distances(np.array(ends[-1:]), graph.length)
        ends.append(int(np.argmax(np.where(np.isfinite(distance), distance, -1))))
    return np.array(ends[-1:]), np.array(ends[-2:-1])


def _line_between(chart: WorkingChart, graph: EdgeGraph, one: IntArray, other: IntArray) -> BoolArray:
    """Edges (e,) of the cheapest line that separates two sets of vertices."""
    near, far = (graph.distances(ends, graph.length)[0] for ends in (one, other))
    with np.errstate(all="ignore"):
        t = np.nan_to_num(near / (near + far), nan=0.5)[chart.F].mean(axis=1)
    k, lowest, highest = len(chart.F), *_TUNING.band
    group = group_undivided(chart.F, chart.cost)
    if not group.any():
        # The chart is a single polygon or flat face, which can only be divided between its triangles.
        group = group_undivided(chart.F, chart.cost, KEPT_COST)
    if not group.any():
        group = np.arange(k)
    t = _mean_of_groups(t, group)
    inside = np.abs(t - 0.5)
    half = 0.5 * (highest - lowest)
    if np.count_nonzero(inside < half) > _TUNING.max_band:
        half = float(np.partition(inside, _TUNING.max_band)[_TUNING.max_band])
    # Around the ends, triangles belong to the nearer one, so that no part is tiny.
    near, far = (_mean_of_groups(distance[chart.F].mean(axis=1), group) for distance in (near, far))
    source = (t <= 0.5 - half) | ((near < _TUNING.reach) & (near < far))
    sink = (t >= 0.5 + half) | ((far < _TUNING.reach) & (far <= near))
    if not source.any() or not sink.any():
        # The chart is so small that no triangle is close to an end.
        order = group[np.argsort(t, kind="stable")]
        first, last = group == order[0], group == order[order != order[0]][-1]
        source, sink = (source & ~last) | first, (sink & ~first) | last
    # Groups in the band are nodes; all others are the source, k, or the sink, k + 1.
    node = np.where(source, k, np.where(sink, k + 1, group))
    numbers, node = np.unique(np.concatenate([node, [k, k + 1]]), return_inverse=True)
    first, second, edge = graph.list_pairs()
    most = _TUNING.max_cost / (len(edge) + 1)
    capacity = np.clip(graph.cost[edge] / np.mean(graph.cost) * _TUNING.cost_unit, 1, most).astype(np.int32)
    a, b = node[first], node[second]
    apart = a != b
    a, b, capacity = a[apart], b[apart], capacity[apart]
    size = numbers.size
    one_way = csr_array((capacity, (a, b)), shape=(size, size))
    network = one_way + one_way.T
    flow = maximum_flow(network, size - 2, size - 1).flow
    rest = (network - flow).maximum(0)
    reached = mark(size, breadth_first_order(rest, size - 2, return_predecessors=False))
    side = reached[node[:k]]
    return mark(len(graph.ends), edge[side[first] != side[second]])


def group_undivided(F: IntArray, cost: FloatArray, least: float = UNDIVIDED_COST) -> IntArray:
    """Label (k,) of the group of triangles (k, 3) that should stay together: its first triangle.

    Triangles stay together at sides with a cost factor, ``cost`` (k, 3), of at least ``least``.
    """
    dear = (cost >= least).ravel()
    if not dear.any():
        return np.arange(len(F))
    one, other = find_pairs(F)
    joined = dear[one] | dear[other]
    return label_components(one[joined] // 3, other[joined] // 3, len(F))


def _mean_of_groups(values: FloatArray, group: IntArray) -> FloatArray:
    """Return for each triangle the mean of its group."""
    size = np.bincount(group, minlength=len(values))
    total = np.bincount(group, values, minlength=len(values))
    return total[group] / size[group]


def _open(chart: WorkingChart, cut: BoolArray) -> list[WorkingChart]:
    """Open a chart at sides (k, 3) of its triangles; return its parts, which keep the map."""
    split, component = fans(chart.F, cut)
    parts = []
    for rows in group_by_label(component):
        own, corner = renumber(split[rows], chart.F[rows])
        origin = chart.F[rows].ravel()[corner]
        part = WorkingChart(chart.triangles[rows], chart.vertices[origin], chart.V[origin], own, chart.cost[rows])
        if chart.uv is not None:
            part.uv = np.ldexp(chart.uv[origin], chart.piece.exponent - part.piece.exponent)
        parts.append(part)
    return parts
