"""The edges of a surface as a graph in which cuts are paths, with the lengths and costs of edges.

An edge costs its length, or less where the surface is creased. A crease hides a seam, and a cut there releases much of
the curvature. Creases at most halve the cost, so no path is longer than twice the shortest.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np
from scipy.sparse import csr_array
from scipy.sparse.csgraph import dijkstra

from quasiharmonic.geometry.coarsening import has_marked_corner, mark_rings
from quasiharmonic.geometry.mesh.reference import area_vectors, cross, dot, surface_area
from quasiharmonic.geometry.mesh.topology import edge_keys, find_sides, first_of_pairs, opposite_sides, pair_keys
from quasiharmonic.util.arrays import (
    BoolArray,
    FloatArray,
    IntArray,
    enumerate_each,
    mark,
    pad_to_space,
    repeat_each,
    scale_to_unit,
)
from quasiharmonic.util.kernels import compiled

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
        return self.mark_vertices(self.rim)

    @property
    def bends(self) -> FloatArray:
        """Angles (e,) in radians by which the surface bends at edges: positive if convex, negative if concave."""
        normal = area_vectors(self.V, self.F).T
        normal /= np.maximum(np.sqrt(dot(normal, normal)), np.finfo(np.float64).tiny)
        # ``left`` is the triangle in which the edge runs from the smaller vertex to the larger, ``right`` the other.
        falls = self.F.T[(1, 2, 0), :] < self.F.T
        around = np.zeros((2, len(self.ends)), dtype=np.int64)
        around.ravel()[self.side + len(self.ends) * falls] = np.arange(len(self.F))
        left, right = (normal.take(triangle, axis=1) for triangle in around)
        along = self.V.take(self.ends[:, 1], axis=0) - self.V.take(self.ends[:, 0], axis=0)
        sine = dot(cross(left, right), along.T) / self.length
        cosine = dot(left, right)
        return np.where(self.rim, 0, np.arctan2(sine, cosine))

    def mark_vertices(self, chosen: BoolArray) -> BoolArray:
        """Mask (n,) of the vertices that belong to any of the chosen edges (e,)."""
        return mark(self.n, self.ends.compress(chosen, axis=0))

    @cached_property
    def half_edges(self) -> tuple[IntArray, IntArray]:
        """Opposite half-edge and edge of each half-edge, (3 f,) each; number 3 t + k runs from corner k of triangle t.

        Half-edges on the outside have -1 for their opposite.
        """
        side = np.ascontiguousarray(self.side.T).ravel()
        return opposite_sides(side), side

    def list_pairs(self) -> tuple[IntArray, IntArray, IntArray]:
        """Return the two triangles at each interior edge, and the edge; (i,) int64 each, by the first triangle."""
        opposite, side = self.half_edges
        one = first_of_pairs(opposite)
        return one // 3, opposite[one] // 3, side[one]

    @cached_property
    def _stars(self) -> tuple[IntArray, IntArray]:
        """Triangles around the vertices: where those of each vertex start (n + 1,), and the triangles (3 f,)."""
        order = np.argsort(self.F.ravel(), kind="stable")
        return np.searchsorted(self.F.ravel()[order], np.arange(self.n + 1)), order // 3

    @cached_property
    def _room(self) -> list[Any]:
        """Outputs of `gather_part`, which it uses again: for small parts, new memory would take half of the time."""
        return make_room(len(self.F), self.n, len(self.ends))

    def part_near(self, vertices: IntArray, rings: int) -> tuple[EdgeGraph, IntArray]:
        """Return the graph of the triangles around vertices (k,), and the indices of its edges here.

        The part's rim contains only edges of the surface's rim. No path leads to its outer vertices, where triangles of
        the surface are missing: edges there cost infinitely. Only one thread may call this at a time.
        """
        _, chosen, own, corners, sides, *_, sizes = self._room
        gather_part(*self._stars, self.F, self.side, vertices, rings, *self._room)
        many, chosen, own = sizes[0], chosen[: sizes[1]], own[: sizes[2]].copy()
        F, number = corners[:many].copy(), sides[:many].T.copy()
        graph = EdgeGraph(
            self.V[chosen],
            F,
            np.searchsorted(chosen, self.ends[own]),
            number,
            self.rim[own],
            self.length[own],
            self.cost[own],
        )
        return graph.without_paths_at(np.bincount(number.ravel()) == 1), own

    def without_paths_at(self, outer: BoolArray) -> EdgeGraph:
        """Return the graph with infinite costs around those of the outer edges (e,) that are not the rim."""
        outside = self.mark_vertices(outer & ~self.rim)
        return replace(self, cost=np.where(outside[self.ends].any(axis=1), np.inf, self.cost))

    def numbers(self, tail: IntArray, head: IntArray) -> IntArray:
        """Indices of the edges between pairs of vertices; every pair must be an edge."""
        return np.searchsorted(pair_keys(self.ends, self.n), edge_keys(tail, head, self.n))

    @cached_property
    def _rows(self) -> tuple[IntArray, IntArray, IntArray]:
        """Where the neighbours of each vertex start (n + 1,), the neighbours (2 e,), and the edges to them (2 e,)."""
        count, (smaller, larger) = len(self.ends), self.ends.T
        above = np.searchsorted(smaller, np.arange(self.n + 1))
        columns = csr_array((np.arange(count), larger, above), shape=(self.n, self.n)).tocsc()
        below, of_larger = columns.indptr, columns.data
        # At each vertex, its larger neighbours come first.
        first, second = np.arange(count) + below[smaller], np.arange(count) + above[1:][larger[of_larger]]
        neighbour, edge = np.empty((2, 2 * count), dtype=np.int64)
        neighbour[first], neighbour[second] = larger, smaller[of_larger]
        edge[first], edge[second] = np.arange(count), of_larger
        return above + below.astype(np.int64), neighbour, edge

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
            Negative at sources and where no path exists. Of several shortest paths to a vertex, the one is used whose
            last but one vertex is the smallest, unless rounding makes that vertex equally far.
        """
        distance, before = np.empty(self.n), np.empty(self.n, dtype=np.int64)
        find_shortest_paths(*self._rows, weight, sources, limit, distance, before)
        return distance, before

    def way_back(self, before: IntArray, start: int) -> IntArray:
        """Edges of the path from a vertex back to its source, in order; ``before`` as returned by `distances`."""
        way = [start]
        while before[way[-1]] >= 0:
            way.append(int(before[way[-1]]))
        return self.numbers(np.array(way[:-1], dtype=np.int64), np.array(way[1:], dtype=np.int64))


@compiled
def find_shortest_paths(
    start: IntArray,
    neighbour: IntArray,
    edge: IntArray,
    weight: FloatArray,
    sources: IntArray,
    limit: float,
    distance: FloatArray,
    before: IntArray,
) -> None:
    """Fill in the results (n,) of `EdgeGraph.distances`, given `EdgeGraph._rows`."""
    n, along = distance.size, weight.take(edge)
    # Before version 1.17, SciPy's graph searches accept 32-bit indices only. With ``directed=False``, SciPy would copy
    # and transpose the graph first, which takes half of the time.
    graph = csr_array((along, neighbour.astype(np.int32), start.astype(np.int32)), shape=(n, n))
    distance[:], before[:], _ = dijkstra(graph, indices=sources, return_predecessors=True, min_only=True, limit=limit)
    tail = repeat_each(np.arange(n), np.diff(start))
    last = (distance[tail] + along == distance[neighbour]) & (distance[tail] < distance[neighbour])
    # The smallest is written last.
    before[neighbour[last][::-1]] = tail[last][::-1]
    before[(before < 0) | np.isinf(distance)] = -1


def triangles_near(F: IntArray, marked: BoolArray, rings: int) -> BoolArray:
    """Mask (f,) of the triangles around marked vertices (n,): for one ring, all that have a marked corner."""
    return has_marked_corner(F, mark_rings(F, marked, rings - 1))


def find_distinct(values: IntArray) -> IntArray:
    """Return the distinct values in ascending order; for few values faster than `numpy.unique`."""
    values = np.sort(values, axis=None)
    return values[np.flatnonzero(np.diff(values, prepend=-1))]


def make_room(*sizes: int) -> list[Any]:
    """Return the outputs of `gather_part`, given the numbers of triangles, vertices and edges."""
    found, among = ([np.zeros(size, dtype=kind) for size in sizes] for kind in (np.int64, np.bool_))
    return [*found, *np.zeros((2, sizes[0], 3), dtype=np.int64), *among, np.zeros(3, dtype=np.int64)]


@compiled
def gather_part(
    start: IntArray,
    star: IntArray,
    F: IntArray,
    side: IntArray,
    seeds: IntArray,
    rings: int,
    triangles: IntArray,
    vertices: IntArray,
    edges: IntArray,
    corners: IntArray,
    sides: IntArray,
    near_triangles: BoolArray,
    near_vertices: BoolArray,
    near_edges: BoolArray,
    sizes: IntArray,
) -> None:
    """Fill in the triangles in some rings around vertices, their vertices and edges, ascending, and their numbers (3,).

    Each of the given vertices has triangles. ``corners`` and ``sides`` (f, 3) get the places of their corners and sides
    among these. The triangles around each vertex are in ``star``, from where ``start`` says; the edges of the sides are
    ``side`` (3, f). The masks are all False, before and after.
    """
    near, some = seeds, np.empty(0, dtype=np.int64)
    for _ in range(rings):
        which, nth = enumerate_each(start[near + 1] - start[near])
        some = find_distinct(star[start[near][which] + nth])
        near = find_distinct(F[some])
    own = find_distinct(side[:, some])
    sizes[:] = some.size, near.size, own.size
    triangles[: some.size], vertices[: near.size], edges[: own.size] = some, near, own
    corners[: some.size] = np.searchsorted(near, F[some])
    sides[: some.size] = np.searchsorted(own, side[:, some].T)


def edge_graph(V: FloatArray, F: IntArray, costs: FloatArray | None = None) -> EdgeGraph:
    """Build the `EdgeGraph` of a surface, with lengths and costs.

    Parameters
    ----------
    V : (n, 2) or (n, 3) float64
        Rest positions, of any size.
    F : (f, 3) int64
        Triangles of surfaces, closed or not.
    costs : (f, 3) float64, optional
        Factor of the cost at each side of each triangle, from corner 0 to 1, 1 to 2 and 2 to 0. An edge between two
        triangles has the mean of its two factors.

    Returns
    -------
    EdgeGraph
    """
    space = pad_to_space(scale_to_unit(V))
    area = surface_area(space, F)
    if area > 0:
        space /= np.sqrt(area)

    ends, side_of = find_sides(F, len(V))
    side = np.ascontiguousarray(side_of.T)
    count = np.bincount(side.ravel())
    rim = count == 1

    along = space.take(ends[:, 1], axis=0) - space.take(ends[:, 0], axis=0)
    length = np.linalg.norm(along, axis=1)
    # Lengths must be positive, because zeros are not edges in a sparse graph.
    length = np.maximum(length, max(1e-12 * float(length.mean()), np.finfo(np.float64).tiny))
    graph = EdgeGraph(space, np.ascontiguousarray(F), ends, side, rim, length, length)
    bend = graph.bends
    sharpness = np.minimum(np.maximum(-bend, 0.5 * bend) / _SHARP, 1)
    cost = length * (1 - _SAVED * sharpness)
    if costs is not None:
        cost *= np.bincount(side.ravel(), costs.T.ravel()) / count
    return replace(graph, cost=cost)
