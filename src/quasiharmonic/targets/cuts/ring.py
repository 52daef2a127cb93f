"""The cheapest path across a ring, which is what remains of a cut surface when one stretch of its cuts is closed."""

from __future__ import annotations

import numpy as np
from scipy.sparse import csr_array
from scipy.sparse.csgraph import dijkstra

from quasiharmonic.geometry.mesh.topology import label_components
from quasiharmonic.util.arrays import BoolArray, FloatArray, IntArray
from quasiharmonic.util.kernels import compiled


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
    on_border = np.zeros(halves.size, dtype=bool)
    on_border[tail[~inner]] = on_border[head[~inner]] = True
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
