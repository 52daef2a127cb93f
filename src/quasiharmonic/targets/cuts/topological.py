"""Cuts required by the topology of a surface, across handles and between boundary loops, as short as possible.

A spanning tree of triangles, joined across edges, unfolds to a disk. Cutting all edges that it does not cross opens the
surface. Most of these cuts are unnecessary: after removing loose ends, only a few paths remain, which depend on the
tree. The tree used here is that of Erickson and Whittlesey [1]_. Shortest paths lead from every vertex to the boundary
(to one vertex on closed surfaces). The tree crosses the edges that close the longest loops. The remaining edges, two
per handle and one per further boundary loop, together with the paths from both their ends, form the shortest set of
cuts of this kind. `shortening` then moves them away from the root.

References
----------
.. [1] J. Erickson, K. Whittlesey, Greedy optimal homotopy and homology generators. SODA (2005).
"""

from __future__ import annotations

import numpy as np
from scipy.sparse import csr_array
from scipy.sparse.csgraph import minimum_spanning_tree

from quasiharmonic.targets.cuts.graph import EdgeGraph
from quasiharmonic.util.arrays import BoolArray, FloatArray, IntArray


def opening_cuts(graph: EdgeGraph) -> BoolArray:
    """Cut a connected surface into a disk.

    Parameters
    ----------
    graph : EdgeGraph

    Returns
    -------
    (e,) bool
        Mask of the cut edges; all False for a disk. A closed surface without handles is cut along a path between two
        distant vertices.
    """
    cut = np.zeros(len(graph.ends), dtype=bool)
    closed = not graph.rim.any()
    roots = np.array([0]) if closed else np.flatnonzero(graph.rim_vertices)
    distance, before = graph.distances(roots, graph.cost)
    for number in _extra_edges(graph, distance, before).tolist():
        cut[number] = True
        for end in graph.ends[number].tolist():
            cut[graph.way_back(before, end)] = True
    cut = without_loose_ends(graph, cut)
    if closed and not cut.any():
        cut[_long_path(graph)] = True
    return cut


def without_loose_ends(graph: EdgeGraph, cut: BoolArray) -> BoolArray:
    """Remove from cuts (e,) all paths that end in the interior.

    A disk remains a disk. A tree of cuts is removed completely.
    """
    cut = cut.copy()
    on_rim = graph.rim_vertices
    while True:
        degree = np.bincount(graph.ends[cut].ravel(), minlength=graph.n)
        loose = cut & ((degree == 1) & ~on_rim)[graph.ends].any(axis=1)
        if not loose.any():
            return cut
        cut &= ~loose


def _extra_edges(graph: EdgeGraph, distance: FloatArray, before: IntArray) -> IntArray:
    """Edges that are neither in the forest of shortest paths nor crossed by the tree of triangles."""
    free = ~graph.rim
    reached = np.flatnonzero(before >= 0)
    free[graph.numbers(reached, before[reached])] = False
    # The two triangles of each edge.
    order = np.argsort(graph.side.ravel(), kind="stable")
    pair = np.flatnonzero(np.diff(graph.side.ravel()[order]) == 0)
    number = graph.side.ravel()[order][pair]
    one, other = order[pair] % len(graph.F), order[pair + 1] % len(graph.F)
    keep = free[number]
    number, one, other = number[keep], one[keep], other[keep]
    around = graph.cost[number] + distance[graph.ends[number]].sum(axis=1)
    # Ranks as weights: the longest loops get the lowest rank. No rank is zero, and only their order matters.
    rank = np.empty(number.size)
    rank[np.lexsort((number, -around))] = np.arange(1, number.size + 1)
    # Before version 1.17, SciPy's spanning trees accept 32-bit indices only.
    ends = one.astype(np.int32), other.astype(np.int32)
    tree = minimum_spanning_tree(csr_array((rank, ends), shape=(len(graph.F), len(graph.F))))
    crossed = np.isin(rank, tree.data)
    return np.sort(number[~crossed])


def _long_path(graph: EdgeGraph) -> IntArray:
    """Path between two distant vertices of a closed surface; at least two edges, since one edge opens nothing."""
    start = int(np.argmax(np.linalg.norm(graph.V - graph.V.mean(axis=0), axis=1)))
    for _ in range(2):
        away, _ = graph.distances(np.array([start]), graph.length)
        start, end = int(np.argmax(away)), start
    _, before = graph.distances(np.array([end]), graph.cost)
    path = graph.way_back(before, start)
    if path.size == 1:
        # Go through a common neighbour of both ends.
        corners = graph.F[np.isin(graph.F, (start, end)).sum(axis=1) == 2][0]
        around = int(corners[(corners != start) & (corners != end)][0])
        path = graph.numbers(np.array([start, around]), np.array([around, end]))
    return path
