"""Cuts of large surfaces: found on a coarse mesh, carried to the fine one, and shortened there.

A coarse mesh results from removing vertices one after another (`geometry.coarsening`). Inserting a vertex again splits
the edges of its fan, which all start at the fan's apex. A cut along such an edge becomes a cut from the apex to the
vertex and on to the edge's other end. So cuts keep their topology, and only their paths need shortening. That is done
at every level, where paths need to move by few edges only.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np

from quasiharmonic.geometry.coarsening import Removal, coarsen
from quasiharmonic.geometry.mesh.topology import boundary_edges, edge_keys, pair_keys
from quasiharmonic.targets.cuts.graph import EdgeGraph, edge_graph, triangles_near
from quasiharmonic.targets.cuts.shortening import shorten_cuts
from quasiharmonic.util.arrays import BoolArray, FloatArray, IntArray
from quasiharmonic.util.progress import heartbeat

# Number of vertices of the coarse mesh.
_COARSE = 4000
# A stretch is exchanged for paths within this many rings of triangles around it.
_RINGS = 5


def cut_by_levels(
    V: FloatArray,
    F: IntArray,
    costs: FloatArray | None,
    find: Callable[[EdgeGraph, IntArray, list[list[Removal]]], BoolArray],
    rings: int,
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

    Returns
    -------
    (k, 2) int64
        Edges, smaller vertex first.
    """
    n = len(V)
    rim = boundary_edges(F, n)
    fixed = np.zeros(n, dtype=bool)
    fixed[rim] = True
    coarsening = coarsen(F, n, fixed, _COARSE)
    rim_keys = pair_keys(rim, n)
    factors = [None] * (len(coarsening.rounds) + 1) if costs is None else _vertex_costs(F, costs, coarsening.rounds, n)
    means = _mean_positions(V, fixed, coarsening.rounds)
    vertices, graph = _make_subset(means, coarsening.F, _side_costs(factors[-1], coarsening.F), rim_keys)
    cut = vertices[graph.ends[find(graph, vertices, coarsening.rounds)]]
    if not cut.size:
        return cut
    for k in reversed(range(len(coarsening.rounds))):
        cut = insert_vertices(cut, coarsening.rounds[k], n)
        if k in coarsening.levels:
            heartbeat()
            marked = np.zeros(n, dtype=bool)
            marked[cut] = True
            T = coarsening.levels[k]
            near = triangles_near(T, marked, rings)
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
    on_cut = np.zeros(len(graph.ends), dtype=bool)
    on_cut[graph.numbers(*np.searchsorted(vertices, cut).T)] = True
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
