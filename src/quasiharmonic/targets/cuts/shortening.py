"""Shortening of cuts, one stretch at a time and from coarse to fine meshes; the cut surface remains a disk.

A stretch is a path between two nodes, where cuts branch, end or meet the boundary. Closing the cut along a stretch
turns the disk into a ring. Every path across the ring opens it again, and the cheapest replaces the stretch. That path
may begin and end anywhere, so the nodes move too. A stretch with a loose end keeps that end and gets the cheapest path
from there to the other cuts.

On large surfaces only paths close to the stretch are considered. Each end of such a path must lie on cuts that are
connected to the stretch's own end nearby, so both ends are on different borders of the ring.

`cut_by_levels` finds cuts of a large surface on a coarse mesh, carries them to the fine one, and shortens them on the
way. A coarse mesh results from removing vertices one after another (`geometry.coarsening`). Inserting a vertex again
splits the edges of its fan, which all start at the fan's apex. A cut along such an edge becomes a cut from the apex to
the vertex and on to the edge's other end. So cuts keep their topology, and paths need to move by few edges only.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
from scipy.sparse import csr_array
from scipy.sparse.csgraph import dijkstra

from quasiharmonic.geometry.coarsening import Removal, coarsen
from quasiharmonic.geometry.mesh.reference import rest_frames
from quasiharmonic.geometry.mesh.topology import boundary_edges, edge_keys, label_components, pair_keys
from quasiharmonic.targets.cuts.graph import EdgeGraph, edge_graph, find_distinct, triangles_near
from quasiharmonic.util.arrays import BoolArray, FloatArray, IntArray, mark
from quasiharmonic.util.kernels import compiled
from quasiharmonic.util.progress import heartbeat

# Minimum relative saving for which a stretch is exchanged.
_SAVES = 1e-6
# Maximum number of rounds over all stretches. Most cuts converge after three.
_ROUNDS = 8
# Coarse triangles lower than this share of a side are smoothed, at most this number of times.
_THIN, _THIN_SWEEPS = 1e-9, 5
# A stretch is exchanged for paths within this many rings of triangles around it.
_RINGS = 5


def shorten_cuts(
    graph: EdgeGraph, cut: BoolArray, price: Callable[[BoolArray], float] | None = None, rings: int | None = None
) -> BoolArray:
    """Exchange stretches of cuts for cheaper ones until none can be improved.

    Parameters
    ----------
    graph : EdgeGraph
    cut : (e,) bool
        Cut edges that make a connected surface a disk.
    price : callable, optional
        Price of all cuts (e,) together; every exchange must lower it.
    rings : int, optional
        Consider only paths within this many rings of triangles around a stretch. The graph may then be that of a part
        of the surface, without paths at its outer vertices.

    Returns
    -------
    (e,) bool
        Cut edges that make the surface a disk, with the same loose ends.
    """
    lowest = np.inf if price is None else price(cut)
    cut = cut.copy()
    degree = np.bincount(graph.ends[cut].ravel(), minlength=graph.n)
    # The number of exchanges before the last try of each stretch that has not been exchanged.
    tried = dict[bytes, int]()
    exchanges = 0
    for _ in range(_ROUNDS):
        before = exchanges
        # Costliest first.
        for way in sorted(stretches(graph, cut), key=lambda way: (-graph.cost[way].sum(), way[0])):
            heartbeat()
            name = way.tobytes()
            # Other cuts far away do not matter.
            done = name in tried and (rings is not None or tried[name] == exchanges)
            if done or not _is_stretch(graph, cut, degree, way):
                continue
            instead = _find_cheapest_path(graph, cut, way) if rings is None else _cheapest_near(graph, cut, way, rings)
            if instead is None:
                tried[name] = exchanges
                continue
            exchanged, degrees = _exchange(graph, cut, degree, way, instead)
            if price is not None:
                if not (now := price(exchanged)) < lowest:
                    tried[name] = exchanges
                    continue
                lowest = now
            cut, degree, exchanges = exchanged, degrees, exchanges + 1
        if exchanges == before:
            break
    return cut


def _exchange(
    graph: EdgeGraph, cut: BoolArray, degree: IntArray, way: IntArray, instead: IntArray
) -> tuple[BoolArray, IntArray]:
    """Replace a stretch; what it alone connected to other cuts is removed, too. Returns the cuts and their degrees."""
    cut, degree = cut.copy(), degree.copy()
    np.subtract.at(degree, graph.ends[way], 1)
    others = degree.copy()
    cut[way] = False
    np.add.at(degree, graph.ends[instead[~cut[instead]]], 1)
    cut[instead] = True
    for node in find_distinct(graph.ends[way[[0, -1]]]).tolist():
        while others[node] and not graph.rim_vertices[node] and degree[node] == 1:
            chosen = np.flatnonzero(cut)
            at_node = chosen[(graph.ends[chosen] == node).any(axis=1)]
            cut[at_node] = False
            degree[graph.ends[at_node[0]]] -= 1
            node = int(graph.ends[at_node[0]].sum()) - node
    return cut, degree


def stretches(graph: EdgeGraph, cut: BoolArray) -> list[IntArray]:
    """Split cuts into their paths between nodes, each as edges in order."""
    chosen = np.flatnonzero(cut)
    order, last = np.empty((2, chosen.size), dtype=np.int64)
    count = walk_stretches(graph.ends[chosen], graph.rim_vertices, order, last)
    last = last[:count]
    return np.split(chosen[order[: last[-1]]], last[:-1]) if count else []


@compiled
def walk_stretches(ends: IntArray, on_rim: BoolArray, order: IntArray, last: IntArray) -> int:
    """Fill in the edges (k, 2) of all stretches in order, and where each stretch ends; return their number.

    Nodes are the vertices of the rim, and those that do not have two edges.
    """
    beside: dict[int, list[tuple[int, int]]] = {}
    for number, (i, j) in enumerate(ends.tolist()):
        beside.setdefault(i, []).append((number, j))
        beside.setdefault(j, []).append((number, i))
    walked, size, count = set[int](), 0, 0
    for node, ways in beside.items():
        if len(ways) == 2 and not on_rim[node]:
            continue
        for number, here in ways:
            if number in walked:
                continue
            way = [number]
            while len(beside[here]) == 2 and not on_rim[here]:
                number, here = next(step for step in beside[here] if step[0] != way[-1])
                way.append(number)
            walked.update(way)
            order[size : size + len(way)] = way
            size += len(way)
            last[count] = size
            count += 1
    return count


def _is_stretch(graph: EdgeGraph, cut: BoolArray, degree: IntArray, way: IntArray) -> bool:
    """Whether edges still are a stretch of cuts after exchanges of other stretches; ``degree`` (n,) is that of cuts."""
    if not cut[way].all():
        return False
    ends = graph.ends[way]
    node = (degree[ends] != 2) | graph.rim_vertices[ends]
    if way.size == 1:
        return bool(node.all())
    inside = (ends[:-1, :, None] == ends[1:, None, :]).any(axis=2)
    return bool(node[0].any() and node[-1].any() and not node[:-1][inside].any())


def _cheapest_near(graph: EdgeGraph, cut: BoolArray, way: IntArray, rings: int) -> IntArray | None:
    """Return edges close to a stretch that replace it at lower cost, or None."""
    part, own = graph.part_near(find_distinct(graph.ends[way]), rings)
    instead = _find_cheapest_path(part, cut[own], np.searchsorted(own, way))
    return None if instead is None else own[instead]


def _find_cheapest_path(graph: EdgeGraph, cut: BoolArray, way: IntArray) -> IntArray | None:
    """Return edges that replace a stretch at lower cost, or None."""
    others = cut.copy()
    others[way] = False
    held = graph.mark_vertices(others) | graph.rim_vertices
    degree = np.bincount(graph.ends[way].ravel(), minlength=graph.n)
    loose = np.flatnonzero((degree == 1) & ~held)
    limit = (1 - _SAVES) * float(graph.cost[way].sum())
    if loose.size == 0:
        return _find_path_across(graph, way, others, held, limit)
    distance, before = graph.distances(loose[:1], graph.cost, limit=limit)
    goals = np.flatnonzero(held) if loose.size == 1 else loose[1:]
    goal = int(goals[np.argmin(distance[goals])])
    if np.isinf(distance[goal]):
        return None
    # After rounding, several goals may be equally near: the path ends at the first one.
    is_goal, at = mark(graph.n, goals), goal
    while (at := int(before[at])) >= 0:
        goal = at if is_goal[at] else goal
    instead = graph.way_back(before, goal)
    # A single edge between interior vertices opens nothing.
    return None if loose.size == 2 and instead.size == 1 else instead


def _find_path_across(
    graph: EdgeGraph, way: IntArray, others: BoolArray, held: BoolArray, limit: float
) -> IntArray | None:
    """Cheapest path across the ring that remains without a stretch; None if all cost more than ``limit``."""
    # The two ends of the stretch lie on different borders of the ring.
    first, last = graph.ends[way[0]], graph.ends[way[-1]]
    start, goal = first[np.argmax(held[first])], last[1 - np.argmax(held[last[::-1]])]
    opposite, side = graph.half_edges
    path = find_path_across(
        opposite,
        side,
        others | graph.rim,
        graph.cost,
        _corner_at(graph, int(way[0]), int(start)),
        _corner_at(graph, int(way[-1]), int(goal)),
        limit,
    )
    return path if path.size else None


def _corner_at(graph: EdgeGraph, edge: int, end: int) -> int:
    """A corner at one end of an edge, in a triangle that has this edge; numbered as in `find_path_across`."""
    half = int(np.argmax(graph.half_edges[1] == edge))
    return half if graph.F.flat[half] == end else half + 1 - 3 * (half % 3 == 2)


def find_path_across(
    opposite: IntArray, side: IntArray, border: BoolArray, cost: FloatArray, start: int, goal: int, limit: float
) -> IntArray:
    """Edges of the cheapest path between two borders of a surface, from the second border to the first.

    Half-edges and corners are numbered alike: number ``3 t + k`` is the half-edge of triangle ``t`` from its corner
    ``k`` to the next one, and this corner.

    Parameters
    ----------
    opposite : (3 f,) int64
        The other half-edge of the same edge; -1 where no triangle follows.
    side : (3 f,) int64
        Edge of each half-edge.
    border : (e,) bool
        Edges at which the surface is open.
    cost : (e,) float64
    start, goal : int
        Corners at two borders, which the path connects. It does not touch other borders.
    limit : float
        Maximum cost of the path.

    Returns
    -------
    (k,) int64
        Empty if there is no such path.
    """
    path = np.empty(opposite.size, dtype=np.int64)
    return path[: cross_ring(opposite, side, border, cost, start, goal, limit, path)].copy()


@compiled
def cross_ring(
    opposite: IntArray,
    side: IntArray,
    border: BoolArray,
    cost: FloatArray,
    start: int,
    goal: int,
    limit: float,
    path: IntArray,
) -> int:
    """Fill in the edges of the path of `find_path_across`, and return their number.

    Of paths of equal cost, the one is used whose last vertex has the smallest corner, and each of whose edges is the
    smallest possible one, seen from there.
    """
    halves = np.arange(opposite.size)
    following = halves + 1 - 3 * (halves % 3 == 2)
    inner = ~border[side]
    joined = halves[inner & (opposite >= 0)]
    node = label_components(joined, following[opposite[joined]], halves.size)
    tail, head = node, node[following]
    on_border = mark(halves.size, tail[~inner], head[~inner])
    loop = np.where(on_border, label_components(tail[~inner], head[~inner], halves.size), -1)
    near, far = loop[node[start]], loop[node[goal]]
    if near < 0 or far < 0 or near == far:
        return 0
    blocked = on_border & (loop != near) & (loop != far)
    used = inner & (halves > opposite) & ~blocked[tail] & ~blocked[head]
    tail, head, number = tail[used], head[used], side[used]
    size = halves.size
    graph = csr_array((cost[number], (tail.astype(np.int32), head.astype(np.int32))), shape=(size, size))
    sources = np.flatnonzero(loop == near)
    distance: FloatArray = dijkstra(graph, directed=False, indices=sources, min_only=True, limit=limit)
    goals = np.flatnonzero(loop == far)
    end, length = int(goals[np.argmin(distance[goals])]), 0
    if not np.isfinite(distance[end]):
        return 0
    while distance[end] > 0:
        at = np.flatnonzero((tail == end) | (head == end))
        other = tail[at] + head[at] - end
        shortest = (distance[other] + cost[number[at]] == distance[end]) & (distance[other] < distance[end])
        step = int(np.argmin(np.where(shortest, number[at], cost.size)))
        path[length] = number[at[step]]
        end, length = int(other[step]), length + 1
    return length


def cut_by_levels(
    V: FloatArray,
    F: IntArray,
    costs: FloatArray | None,
    find: Callable[[EdgeGraph, IntArray, list[list[Removal]]], BoolArray],
    rings: int,
    *,
    goal: int,
    sweeps: int = 0,
    every: int = 1,
) -> IntArray:
    """Cut a large connected surface.

    Parameters
    ----------
    V : (n, 2) or (n, 3) float64
    F : (f, 3) int64
    costs : (f, 3) float64, optional
        As for `edge_graph`. On coarse meshes, an edge has the mean of the lowest factors around the vertices that its
        ends represent.
    find : callable
        Returns the cuts (e,) bool of an `EdgeGraph`, given the graph and the indices (m,) of its vertices. Each vertex
        is at the mean position of the vertices that it represents.
    rings : int
        Distance to which cuts may move at each level, in rings of triangles.
    goal : int
        Number of vertices of the coarse mesh.
    sweeps : int
        Number of times that the coarse mesh is smoothed. Means of few positions make it rough.
    every : int
        Cuts are shortened on the surface and on each ``every``-th coarser mesh; each of these halves the vertices.

    Returns
    -------
    (k, 2) int64
        Edges, smaller vertex first.
    """
    n = len(V)
    rim = boundary_edges(F, n)
    fixed = mark(n, rim)
    coarsening = coarsen(F, n, fixed, goal)
    rim_keys = pair_keys(rim, n)
    factors = [None] * (len(coarsening.rounds) + 1) if costs is None else _vertex_costs(F, costs, coarsening.rounds, n)
    means = _smooth(_mean_positions(V, fixed, coarsening.rounds), coarsening.F, fixed, sweeps)
    _raise_thin(means, coarsening.F, fixed)
    vertices, graph = _make_subset(means, coarsening.F, _side_costs(factors[-1], coarsening.F), rim_keys)
    cut = vertices[graph.ends[find(graph, vertices, coarsening.rounds)]]
    if not cut.size:
        return cut
    levels = sorted(coarsening.levels)[::every]
    for k in reversed(range(len(coarsening.rounds))):
        cut = insert_vertices(cut, coarsening.rounds[k], n)
        if k in levels:
            heartbeat()
            T = coarsening.levels[k]
            near = triangles_near(T, mark(n, cut), rings)
            some = costs[near] if k == 0 and costs is not None else _side_costs(factors[k], T[near])
            cut = _shorten(*_make_subset(V, T[near], some, rim_keys), cut)
    return cut


def _mean_positions(V: FloatArray, fixed: BoolArray, rounds: list[list[Removal]]) -> FloatArray:
    """Return the mean position (n, d) of the vertices that each vertex represents; fixed vertices (n,) do not move."""
    total = np.column_stack([V, np.ones(len(V))])
    for removals in rounds:
        for vertices, rings in removals:
            np.add.at(total, rings[:, 0], total[vertices])
    return np.where(fixed[:, None], V, total[:, :-1] / total[:, -1:])


def _smooth(V: FloatArray, F: IntArray, fixed: BoolArray, sweeps: int) -> FloatArray:
    """Move the vertices (n, d) of triangles that are not fixed halfway to the mean of their neighbours, repeatedly."""
    tail, head, n = F.ravel(), F[:, (1, 2, 0)].ravel(), len(V)
    degree = np.bincount(tail, minlength=n)
    free = ~fixed & (degree > 0)
    for _ in range(sweeps):
        mean = np.stack([np.bincount(tail, x[head], n) for x in V.T], axis=1)[free] / degree[free, None]
        V[free] = 0.5 * (V[free] + mean)
    return V


def _raise_thin(V: FloatArray, F: IntArray, fixed: BoolArray) -> None:
    """Smooth where triangles are too thin for a map: on voxel models, means of positions can lie on a line."""
    for _ in range(_THIN_SWEEPS):
        first, second = rest_frames(V, F)
        thin = np.abs(second.imag) <= _THIN * np.maximum(first, np.abs(second))
        if not thin.any():
            break
        _smooth(V, F, fixed | ~mark(len(V), F[thin]), 1)


def _vertex_costs(F: IntArray, costs: FloatArray, rounds: list[list[Removal]], n: int) -> list[FloatArray]:
    """Return a factor for each vertex (n,) before each round and after the last: the mean of those it represents."""
    total, number = np.full(n, np.inf), np.ones(n)
    np.minimum.at(total, F, np.minimum(costs, np.roll(costs, 1, axis=1)))
    found = [total / number]
    for removals in rounds:
        for vertices, rings in removals:
            total += np.bincount(rings[:, 0], total[vertices], n)
            number += np.bincount(rings[:, 0], number[vertices], n)
        found.append(total / number)
    return found


def _side_costs(factor: FloatArray | None, F: IntArray) -> FloatArray | None:
    """Return the costs (f, 3) of the sides of triangles by factors of vertices (n,)."""
    return None if factor is None else 0.5 * (factor[F] + factor[F[:, (1, 2, 0)]])


def insert_vertices(cut: IntArray, removals: list[Removal], n: int) -> IntArray:
    """Carry cuts (k, 2) to the mesh before a round of removals; edges are (smaller, larger) vertex."""
    degree = np.bincount(cut.ravel(), minlength=n)
    keys = pair_keys(cut, n)
    replaced, new = [np.empty(0, dtype=np.int64)], [np.empty((0, 2), dtype=np.int64)]
    for vertices, rings in removals:
        if rings.shape[1] < 4:
            continue
        # The new edges of a fan lead from its apex, ring[0], to ring[2], ring[3], …
        some, at = np.nonzero((degree[rings[:, :1]] > 0) & (degree[rings[:, 2:-1]] > 0))
        apex, end, vertex = rings[some, 0], rings[some, at + 2], vertices[some]
        key = edge_keys(apex, end, n)
        on_cut = np.isin(key, keys)
        apex, end, vertex = apex[on_cut], end[on_cut], vertex[on_cut]
        # If cuts at the apex follow new edges of one fan only, they meet at the vertex instead.
        _, first, number = np.unique(vertex, return_index=True, return_counts=True)
        first = first[(number == 1) | (degree[apex[first]] > number)]
        replaced.append(key[on_cut])
        new += [np.stack([vertex, end], axis=1), np.stack([vertex, apex], axis=1)[first]]
    kept = cut[~np.isin(keys, np.concatenate(replaced))]
    return np.sort(np.concatenate([kept, *new]), axis=1)


def _shorten(vertices: IntArray, graph: EdgeGraph, cut: IntArray) -> IntArray:
    """Shorten cuts (k, 2) close to where they are; returned are edges, smaller vertex first."""
    on_cut = mark(len(graph.ends), graph.numbers(*np.searchsorted(vertices, cut).T))
    return vertices[graph.ends[shorten_cuts(graph, on_cut, rings=_RINGS)]]


def _make_subset(
    V: FloatArray, F: IntArray, costs: FloatArray | None, rim_keys: IntArray
) -> tuple[IntArray, EdgeGraph]:
    """Return the vertices of some triangles, and their graph, as `EdgeGraph.part_near` does."""
    vertices = np.flatnonzero(np.bincount(F.ravel(), minlength=len(V)))
    graph = edge_graph(V[vertices], np.searchsorted(vertices, F), costs)
    ends = vertices[graph.ends]
    rim = np.isin(pair_keys(ends, len(V)), rim_keys)
    return vertices, replace(graph, rim=rim).without_paths_at(graph.rim)
