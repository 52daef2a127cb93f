"""Cuts that a surface needs whatever its shape: across handles and between boundary loops, as short as they get.

A tree of triangles, joined across edges, unfolds to a disk; cut are the edges that it does not cross. Most of these are
of use to nobody: what remains without their loose ends is a few paths. Which, the tree decides. Here it is the one of
Erickson and Whittlesey [1]_: a shortest path leads from every vertex back to the boundary (to one vertex, where there
is none), and the tree crosses the edges that close the longest ways. The others, two for each handle and one for each
further loop, with the paths at both ends of each, are the shortest set of cuts of that kind. `shortening` then lets
them go from where they were tied.

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
        Which edges are cut; none of a disk. A closed surface without handles is cut along a path between two vertices
        far from each other.
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
    """Cuts (e,) less all paths that end inside: a disk stays one, and a tree leaves nothing."""
    cut = cut.copy()
    on_rim = graph.rim_vertices
    while True:
        degree = np.bincount(graph.ends[cut].ravel(), minlength=graph.n)
        loose = cut & ((degree == 1) & ~on_rim)[graph.ends].any(axis=1)
        if not loose.any():
            return cut
        cut &= ~loose


def _extra_edges(graph: EdgeGraph, distance: FloatArray, before: IntArray) -> IntArray:
    """The edges that neither the forest of shortest paths uses nor the tree of triangles crosses."""
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
    # The least of such weights, none of them zero, are the longest ways around; their order is all that counts.
    rank = np.empty(number.size)
    rank[np.lexsort((number, -around))] = np.arange(1, number.size + 1)
    # SciPy before 1.17 has spanning trees of graphs with 32-bit indices only.
    ends = one.astype(np.int32), other.astype(np.int32)
    tree = minimum_spanning_tree(csr_array((rank, ends), shape=(len(graph.F), len(graph.F))))
    crossed = np.isin(rank, tree.data)
    return np.sort(number[~crossed])


def _long_path(graph: EdgeGraph) -> IntArray:
    """A path between two vertices of a closed surface far from each other; two edges at least, or nothing opens."""
    start = int(np.argmax(np.linalg.norm(graph.V - graph.V.mean(axis=0), axis=1)))
    for _ in range(2):
        away, _ = graph.distances(np.array([start]), graph.length)
        start, end = int(np.argmax(away)), start
    _, before = graph.distances(np.array([end]), graph.cost)
    path = graph.way_back(before, start)
    if path.size == 1:
        # Around a vertex that is a neighbour of both ends.
        corners = graph.F[np.isin(graph.F, (start, end)).sum(axis=1) == 2][0]
        around = int(corners[(corners != start) & (corners != end)][0])
        path = graph.numbers(np.array([start, around]), np.array([around, end]))
    return path
