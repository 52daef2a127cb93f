"""Shortening of cuts, one stretch at a time; the cut surface remains a disk.

A stretch is a path between two nodes, where cuts branch, end or meet the boundary. Closing the cut along a stretch
turns the disk into a ring. Every path across the ring opens it again, and the cheapest replaces the stretch. That path
may begin and end anywhere, so the nodes move too. A stretch with a loose end keeps that end and gets the cheapest path
from there to the other cuts.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from scipy.sparse import csr_array
from scipy.sparse.csgraph import connected_components, dijkstra

from quasiharmonic.geometry.mesh.opening import opened_along
from quasiharmonic.targets.cuts.graph import EdgeGraph
from quasiharmonic.util.arrays import BoolArray, IntArray

# Minimum relative saving for which a stretch is exchanged.
_SAVES = 1e-6
# Maximum number of rounds over all stretches. Most cuts converge after three.
_ROUNDS = 8


def shortened(graph: EdgeGraph, cut: BoolArray, price: Callable[[BoolArray], float] | None = None) -> BoolArray:
    """Exchange stretches of cuts for cheaper ones until none can be improved.

    Parameters
    ----------
    graph : EdgeGraph
    cut : (e,) bool
        Cut edges that make a connected surface a disk.
    price : callable, optional
        Price of all cuts (e,) together; every exchange must lower it.

    Returns
    -------
    (e,) bool
        Cut edges that make the surface a disk, with the same loose ends.
    """
    lowest = np.inf if price is None else price(cut)
    disk = _Disk(graph, cut)
    for _ in range(_ROUNDS):
        before, tried = disk, set[bytes]()
        # Costliest first. Stretches are computed again after each exchange, because it may change the others.
        while fresh := [way for way in stretches(graph, disk.cut) if way.tobytes() not in tried]:
            way = max(fresh, key=lambda way: (graph.cost[way].sum(), -way[0]))
            tried.add(way.tobytes())
            instead = disk.cheapest(way)
            if instead is None:
                continue
            exchanged = disk.cut.copy()
            exchanged[way] = False
            exchanged[instead] = True
            if price is not None:
                if not (now := price(exchanged)) < lowest:
                    continue
                lowest = now
            disk = _Disk(graph, exchanged)
        if disk is before:
            break
    return disk.cut


def stretches(graph: EdgeGraph, cut: BoolArray) -> list[IntArray]:
    """Split cuts into their paths between nodes, each as edges in order."""
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


class _Disk:
    """A surface cut into a disk, which can be closed along one stretch and opened elsewhere.

    For every edge, the vertex copies at its ends are stored for its left side, seen from the smaller to the larger
    vertex, and for its right side. They are -1 outside the surface.
    """

    def __init__(self, graph: EdgeGraph, cut: BoolArray) -> None:
        self.graph = graph
        self.cut = cut
        FT, self._origin = opened_along(graph.F, graph.ends[cut], graph.n)
        copies = np.stack([FT.T, FT.T[(1, 2, 0), :]], axis=2)
        tail, head = graph.F.T, graph.F.T[(1, 2, 0), :]
        leads_up = tail < head
        self._left = np.full(graph.ends.shape, -1)
        self._right = np.full(graph.ends.shape, -1)
        self._left[graph.side[leads_up]] = copies[leads_up]
        self._right[graph.side[~leads_up]] = copies[~leads_up][:, ::-1]

    def cheapest(self, way: IntArray) -> IntArray | None:
        """Return edges that replace a stretch at lower cost, or None."""
        graph = self.graph
        others = self.cut.copy()
        others[way] = False
        held = graph.touched(others) | graph.rim_vertices
        degree = np.bincount(graph.ends[way].ravel(), minlength=graph.n)
        loose = np.flatnonzero((degree == 1) & ~held)
        limit = (1 - _SAVES) * float(graph.cost[way].sum())
        if loose.size == 0:
            return self._across(way, others, held, limit)
        if loose.size == 2:
            return None
        distance, before = graph.distances(np.flatnonzero(held), graph.cost, limit=limit)
        return graph.way_back(before, int(loose[0])) if np.isfinite(distance[loose[0]]) else None

    def _across(self, way: IntArray, others: BoolArray, held: BoolArray, limit: float) -> IntArray | None:
        """Cheapest path across the ring that remains without a stretch; None if all cost more than ``limit``."""
        graph, m = self.graph, self._origin.size
        sewn = _joined(np.concatenate([self._left[way], self._right[way]], axis=1)[:, [0, 2, 1, 3]].reshape(-1, 2), m)
        border = others | graph.rim
        sides = np.concatenate([self._left[border], self._right[border]])
        sides = sewn[sides[sides[:, 0] >= 0]]
        loop = _joined(sides, m)
        on_border = np.zeros(m, dtype=bool)
        on_border[sides] = True
        # The two ends of the stretch lie on different loops of the ring.
        first = graph.ends[way[0]]
        start = sewn[self._left[way[0], int(np.argmax(held[first]))]]
        near = on_border & (loop == loop[start])
        inner = sewn[self._left[~border]]
        ring = csr_array((graph.cost[~border], tuple(inner.astype(np.int32).T)), shape=(m, m))
        distance, before, _ = dijkstra(
            ring, directed=False, indices=np.flatnonzero(near), return_predecessors=True, min_only=True, limit=limit
        )
        distance[near | ~on_border] = np.inf
        end = int(np.argmin(distance))
        if np.isinf(distance[end]):
            return None
        path = [end]
        while before[path[-1]] >= 0:
            path.append(int(before[path[-1]]))
        origin = np.empty(m, dtype=np.int64)
        origin[sewn] = self._origin
        return graph.numbers(origin[path[:-1]], origin[path[1:]])


def _joined(pairs: IntArray, m: int) -> IntArray:
    """Component labels of ``m`` elements connected by pairs."""
    ones = np.ones(len(pairs), dtype=np.int8)
    return connected_components(csr_array((ones, pairs.T), shape=(m, m)), directed=False)[1].astype(np.int64)
