"""The edges of a surface as a graph in which cuts are paths, with the lengths and costs of edges.

An edge costs its length, or less where the surface is creased. A crease hides a seam, and a cut there releases much of
the curvature. Creases at most halve the cost, so no path is longer than twice the shortest.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from scipy.sparse import csr_array
from scipy.sparse.csgraph import dijkstra

from quasiharmonic.geometry.mesh.topology import edge_keys, edges
from quasiharmonic.util.arrays import BoolArray, FloatArray, IntArray

# A concave edge with this dihedral bend, or a convex edge with twice as much, has half its cost.
_SHARP = 0.5 * np.pi
_SAVED = 0.5


@dataclass(frozen=True, eq=False)
class EdgeGraph:
    """The edges of a surface.

    Attributes
    ----------
    V : (n, 3) float64
        Positions, in a unit in which the surface has area 1.
    F : (f, 3) int64
    ends : (e, 2) int64
        Vertices of the edges, smaller first, in ascending order.
    side : (3, f) int64
        Edge of each side of each triangle: from corner 0 to 1, 1 to 2 and 2 to 0.
    rim : (e,) bool
        Whether each edge is on the boundary.
    length, cost : (e,) float64
        Positive.
    """

    V: FloatArray
    F: IntArray
    ends: IntArray
    side: IntArray
    rim: BoolArray
    length: FloatArray
    cost: FloatArray

    @property
    def n(self) -> int:
        """Number of vertices."""
        return len(self.V)

    @cached_property
    def rim_vertices(self) -> BoolArray:
        """Mask (n,) of the boundary vertices."""
        return self.touched(self.rim)

    def touched(self, chosen: BoolArray) -> BoolArray:
        """Mask (n,) of the vertices that belong to any of the chosen edges (e,)."""
        found = np.zeros(self.n, dtype=bool)
        found[self.ends[chosen]] = True
        return found

    def numbers(self, tail: IntArray, head: IntArray) -> IntArray:
        """Indices of the edges between pairs of vertices; every pair must be an edge."""
        own = edge_keys(self.ends[:, 0], self.ends[:, 1], self.n)
        return np.searchsorted(own, edge_keys(tail, head, self.n))

    def distances(self, sources: IntArray, weight: FloatArray, limit: float = np.inf) -> tuple[FloatArray, IntArray]:
        """Distance of each vertex from the nearest source, and its predecessor on the shortest path.

        Parameters
        ----------
        sources : (s,) int64
        weight : (e,) float64
            `length` or `cost`; positive.
        limit : float
            Maximum length of a path.

        Returns
        -------
        distance : (n,) float64
            Infinite where no path exists.
        before : (n,) int64
            Negative at sources and where no path exists.
        """
        # Before version 1.17, SciPy's graph searches accept 32-bit indices only.
        tail, head = self.ends.astype(np.int32).T
        graph = csr_array((weight, (tail, head)), shape=(self.n, self.n))
        distance, before, _ = dijkstra(
            graph, directed=False, indices=sources, return_predecessors=True, min_only=True, limit=limit
        )
        return distance, before.astype(np.int64)

    def way_back(self, before: IntArray, start: int) -> IntArray:
        """Edges of the path from a vertex back to its source, in order; ``before`` as returned by `distances`."""
        way = [start]
        while before[way[-1]] >= 0:
            way.append(int(before[way[-1]]))
        return self.numbers(np.array(way[:-1], dtype=np.int64), np.array(way[1:], dtype=np.int64))


def edge_graph(V: FloatArray, F: IntArray) -> EdgeGraph:
    """Build the `EdgeGraph` of a surface, with lengths and costs.

    Parameters
    ----------
    V : (n, 2) or (n, 3) float64
        Rest positions, of any size.
    F : (f, 3) int64
        Triangles of surfaces, closed or not.

    Returns
    -------
    EdgeGraph
    """
    space = np.zeros((len(V), 3))
    space[:, : V.shape[1]] = np.ldexp(V, -int(np.frexp(np.abs(V).max(initial=0))[1]))
    corners = space[F]
    normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    double = np.linalg.norm(normal, axis=1)
    area = 0.5 * float(double.sum())
    if area > 0:
        space /= np.sqrt(area)
    normal /= np.maximum(double, np.finfo(np.float64).tiny)[:, None]

    found = edges(F, len(V))
    ends = np.concatenate([found.interior, np.sort(found.boundary, axis=1)])
    rim = np.arange(len(ends)) >= len(found.interior)
    key = edge_keys(ends[:, 0], ends[:, 1], len(V))
    order = np.argsort(key)
    ends, rim, key = ends[order], rim[order], key[order]
    tail, head = F.T, F.T[(1, 2, 0), :]
    side = np.searchsorted(key, edge_keys(tail, head, len(V)))

    along = space[ends[:, 1]] - space[ends[:, 0]]
    length = np.linalg.norm(along, axis=1)
    # Lengths must be positive, because zeros are not edges in a sparse graph.
    length = np.maximum(length, max(1e-12 * float(length.mean()), np.finfo(np.float64).tiny))
    # ``left`` is the triangle in which the edge runs from the smaller vertex to the larger, ``right`` the other.
    triangle = np.broadcast_to(np.arange(len(F)), side.shape)
    left, right = np.zeros(len(ends), dtype=np.int64), np.zeros(len(ends), dtype=np.int64)
    left[side[tail < head]], right[side[tail > head]] = triangle[tail < head], triangle[tail > head]
    across = np.cross(normal[left], normal[right])
    sine, cosine = (across * along).sum(axis=1) / length, (normal[left] * normal[right]).sum(axis=1)
    bend = np.where(rim, 0, np.arctan2(sine, cosine))
    sharpness = np.minimum(np.maximum(-bend, 0.5 * bend) / _SHARP, 1)
    return EdgeGraph(space, F, ends, side, rim, length, length * (1 - _SAVED * sharpness))
