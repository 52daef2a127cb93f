"""Cuts shortened one stretch at a time, the surface a disk throughout.

A stretch leads from one node, where cuts part, end, or meet the boundary, to the next. Without it the disk is sewn to
itself along a line: a ring, and every way from the one side of the ring to the other opens it again. The cheapest takes
the stretch's place, wherever it begins and ends, and so the nodes move as well. A stretch with a loose end keeps that
end, and gets the cheapest way from there to the other cuts.
"""

from __future__ import annotations

import numpy as np
from scipy.sparse import csr_array
from scipy.sparse.csgraph import connected_components, dijkstra

from quasiharmonic.arrays import BoolArray, IntArray
from quasiharmonic.cuts.graph import EdgeGraph
from quasiharmonic.mesh.opening import opened_along

# A stretch is exchanged for one that saves this part of it at least.
_SAVES = 1e-6
# Rounds of all stretches at most. Most cuts are at rest after three.
_ROUNDS = 8


def shortened(graph: EdgeGraph, cut: BoolArray) -> BoolArray:
    """Exchange stretches of cuts for cheaper ones until there is none.

    Parameters
    ----------
    graph : EdgeGraph
    cut : (e,) bool
        Edges whose cutting leaves every component a disk.

    Returns
    -------
    (e,) bool
        Such edges again, with the same loose ends.
    """
    cut = cut.copy()
    for _ in range(_ROUNDS):
        before, tried = cut.copy(), set[bytes]()
        # The costliest first. What an exchange does to the others is seen before they are tried.
        while fresh := [way for way in stretches(graph, cut) if way.tobytes() not in tried]:
            way = max(fresh, key=lambda way: (graph.cost[way].sum(), -way[0]))
            tried.add(way.tobytes())
            cut[way] = False
            cut[_cheapest(graph, cut, way)] = True
        if np.array_equal(cut, before):
            break
    return cut


def stretches(graph: EdgeGraph, cut: BoolArray) -> list[IntArray]:
    """The paths of which cuts consist, as edges in order, each once."""
    on_rim = graph.rim_vertices
    beside: dict[int, list[tuple[int, int]]] = {}
    for number, (i, j) in zip(np.flatnonzero(cut).tolist(), graph.ends[cut].tolist(), strict=True):
        beside.setdefault(i, []).append((number, j))
        beside.setdefault(j, []).append((number, i))
    found, walked = [], set[int]()
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
            found.append(np.array(way, dtype=np.int64))
    return found


def _cheapest(graph: EdgeGraph, others: BoolArray, way: IntArray) -> IntArray:
    """What may take a stretch's place, or the stretch itself, the other cuts (e,) given."""
    cost = float(graph.cost[way].sum())
    degree = np.bincount(graph.ends[way].ravel(), minlength=graph.n)
    held = graph.touched(others) | graph.rim_vertices
    ends = np.flatnonzero((degree == 1) & ~held)
    if ends.size == 2:
        return way
    if ends.size == 1:
        distance, before = graph.distances(np.flatnonzero(held), graph.cost, limit=cost)
        better = distance[ends[0]] < (1 - _SAVES) * cost
        return graph.way_back(before, int(ends[0])) if better else way

    # The ring: its vertices, its sides, and the edges within.
    FT, origin = opened_along(graph.F, graph.ends[others], graph.n)
    tail, head = np.empty(len(graph.ends), dtype=np.int64), np.empty(len(graph.ends), dtype=np.int64)
    tail[graph.side], head[graph.side] = FT.T, FT.T[(1, 2, 0), :]
    inner = ~(others | graph.rim)
    border = ~inner[graph.side]
    ends = FT.T[border], FT.T[(1, 2, 0), :][border]
    m = origin.size
    ones = np.ones(ends[0].size, dtype=np.int8)
    loop = connected_components(csr_array((ones, ends), shape=(m, m)), directed=False)[1]
    on_loop = np.zeros(m, dtype=bool)
    on_loop[ends[0]] = True
    start = next(v for v in (int(tail[way[0]]), int(head[way[0]])) if held[origin[v]])
    near = on_loop & (loop == loop[start])
    inside = csr_array((graph.cost[inner], (tail[inner], head[inner])), shape=(m, m))
    distance, before, _ = dijkstra(
        inside, directed=False, indices=np.flatnonzero(near), return_predecessors=True, min_only=True, limit=cost
    )
    distance[near | ~on_loop] = np.inf
    end = int(np.argmin(distance))
    if not distance[end] < (1 - _SAVES) * cost:
        return way
    path = [end]
    while before[path[-1]] >= 0:
        path.append(int(before[path[-1]]))
    return graph.numbers(origin[path[:-1]], origin[path[1:]])
