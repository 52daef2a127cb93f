"""Triangulations as half-edges, for local changes: a mesh as a sheet that is cut, and a target in convex regions.

The interior edges of a `Sheet` are split, and it is cut along walks. A vertex on a cut becomes two *copies*, one on
either side. All indices are of copies, and ``vertex`` maps each copy to its vertex. Vertices beyond the original mesh
are midpoints of split edges.

`Regions` partition a target into convex regions without additional points, and order the cuts. Constrained Delaunay
triangles are joined with neighbours as long as the result is convex [1]_. The remaining interior edges, the *cuts*,
connect all loops and pins, because a convex region surrounds none of them.

References
----------
.. [1] S. Hertel, K. Mehlhorn, Fast triangulation of simple polygons. Foundations of Computation Theory, Lecture Notes
   in Computer Science 158 (1983).
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from heapq import heappop, heappush
from itertools import pairwise

import numpy as np

from quasiharmonic.geometry.exact.constrained_delaunay import triangulate_inside
from quasiharmonic.geometry.exact.predicates import orientation
from quasiharmonic.geometry.mesh.topology import trace_loops
from quasiharmonic.util.arrays import FloatArray, IntArray, cyclic_pairs

Edge = tuple[int, int]
Triangle = tuple[int, int, int]


class HalfEdges:
    """An oriented surface with boundary, made from triangles ``F`` (f, 3).

    Attributes
    ----------
    apex : dict
        The third corner of the triangle to the left of a half-edge.
    following : dict
        The next vertex along the boundary, with the surface to the left.
    """

    def __init__(self, F: IntArray) -> None:
        self.apex: dict[Edge, int] = {}
        # The head of one half-edge from each vertex.
        self._neighbour: dict[int, int] = {}
        self.add(F.tolist())
        self.following = {a: b for a, b in self.apex if (b, a) not in self.apex}

    def add(self, triangles: Iterable[Iterable[int]]) -> None:
        """Add counterclockwise triangles."""
        apex, neighbour = self.apex, self._neighbour
        for a, b, c in triangles:
            apex[a, b], apex[b, c], apex[c, a] = c, a, b
            neighbour[a], neighbour[b], neighbour[c] = b, c, a

    def remove(self, triangles: Iterable[Triangle]) -> None:
        """Remove triangles; others must replace them."""
        for a, b, c in triangles:
            del self.apex[a, b], self.apex[b, c], self.apex[c, a]

    def is_inner(self, a: int, b: int) -> bool:
        """Whether an edge exists between two vertices and has a triangle on either side."""
        return (a, b) in self.apex and (b, a) in self.apex

    def link(self, vertex: int) -> Iterator[Edge]:
        """Yield the sides opposite to a vertex in its triangles, counterclockwise."""
        first = tail = self.following.get(vertex, self._neighbour[vertex])
        while (head := self.apex.get((vertex, tail))) is not None:
            yield tail, head
            tail = head
            if tail == first:
                return

    def triangles(self) -> list[Triangle]:
        """Return all triangles, each from its smallest corner, sorted."""
        return sorted((a, b, c) for (a, b), c in self.apex.items() if a < b and a < c)

    def inner_edges(self) -> list[Edge]:
        """Return all edges with a triangle on either side, the smaller end first, sorted."""
        return sorted((a, b) for a, b in self.apex if a < b and (b, a) in self.apex)


class Sheet(HalfEdges):
    """An oriented surface with boundary that can be cut.

    Parameters
    ----------
    F : (f, 3) int64
        Its triangles before any cut.
    n : int
        Number of vertices.
    pins : iterable of int
        Interior vertices that act as loops of one vertex until a cut ends there.

    Attributes
    ----------
    vertex : list of int
        The vertex of each copy.
    parents : list of (int, int)
        The two vertices whose midpoint each added vertex is, in order of addition.
    preceding : dict
        The previous copy along the boundary.
    """

    def __init__(self, F: IntArray, n: int, pins: Iterable[int] = ()) -> None:
        super().__init__(F)
        self._n = n
        self._pins = set(pins)
        self.vertex = list(range(n))
        self.parents: list[Edge] = []
        self.preceding = {b: a for a, b in self.following.items()}

    def is_fixed(self, copy: int) -> bool:
        """Whether a copy is on the boundary or is a pin."""
        return copy in self.following or copy in self._pins

    def loops(self) -> list[list[int]]:
        """Return the boundary copies in order, loop by loop, with the surface to the left."""
        boundary = np.array(list(self.following.items()), dtype=np.int64).reshape(-1, 2)
        return [loop.tolist() for loop in trace_loops(boundary)]

    def split(self, a: int, b: int) -> int:
        """Add a vertex at the midpoint of an interior edge; return its copy."""
        middle = len(self.vertex)
        self.vertex.append(self._n + len(self.parents))
        self.parents.append((self.vertex[a], self.vertex[b]))
        for tail, head in ((a, b), (b, a)):
            opposite = self.apex.pop((tail, head))
            self.add([(tail, middle, opposite), (middle, head, opposite)])
        return middle

    def cut(self, walk: Sequence[int]) -> list[int]:
        """Cut along interior edges, from a copy on the boundary to another, or to a pin that is still uncut.

        All copies of the walk but its ends are interior; none occurs twice. Return the copies to the right of the walk;
        the old copies stay to its left. A pin at the end is not duplicated.
        """
        doubled = walk if walk[-1] in self.following else walk[:-1]
        right = dict(zip(doubled, range(len(self.vertex), len(self.vertex) + len(doubled)), strict=True))
        self.vertex += [self.vertex[copy] for copy in doubled]
        renamed: dict[Triangle, list[int]] = {}
        for before, copy, after in zip([None, *walk[:-1]], walk, [*walk[1:], None], strict=True):
            if copy not in right:
                continue
            tail = self.following[copy] if before is None else before
            end = self.preceding[copy] if after is None else after
            while tail != end:
                head = self.apex[copy, tail]
                corners = (copy, tail, head)
                smallest = corners.index(min(corners))
                triangle = (corners[smallest], corners[smallest - 2], corners[smallest - 1])
                renamed.setdefault(triangle, list(triangle))[triangle.index(copy)] = right[copy]
                tail = head
        self.remove(renamed)
        self.add(renamed.values())
        back = [right.get(copy, copy) for copy in walk]
        self._update_boundary(walk, back)
        return back

    def _update_boundary(self, walk: Sequence[int], right: Sequence[int]) -> None:
        """Update the boundary: from the start of a cut along its left side, and back along its right side."""
        after, before = self.following[walk[0]], self.preceding.get(walk[-1])
        pairs = [*pairwise(walk), *zip(right[:0:-1], right[-2::-1], strict=True)]
        pairs.append((right[0], after))
        if before is not None:
            pairs.append((before, right[-1]))
        for tail, head in pairs:
            self.following[tail] = head
            self.preceding[head] = tail

    def rows(self) -> IntArray:
        """Return all triangles as copies, (t, 3) int64."""
        return np.array(self.triangles(), dtype=np.int64).reshape(-1, 3)


class Regions:
    """A planar region bounded by loops, with interior points, and its partition into convex regions.

    Parameters
    ----------
    points : (k, 2) float64
        Positions, pairwise distinct, of magnitude about one. Every point is on a loop or a pin.
    loops : sequence of (l,) int64
        Loops of points, the region to their left; simple, disjoint and nested.
    pins : (p,) int64
        Points strictly inside.

    Attributes
    ----------
    apex : dict
        The third corner of the triangle to the left of a half-edge of the triangulation.
    cuts : set of (int, int)
        The cuts as half-edges, in both directions.
    """

    def __init__(self, points: FloatArray, loops: Sequence[IntArray], pins: IntArray) -> None:
        # A turn counts as straight if the point is off the line by at most this many roundings of the largest
        # coordinate.
        roundings = 4.0
        self.points = points
        self._x, self._y = points[:, 0].tolist(), points[:, 1].tolist()
        self._tolerance = roundings * float(np.spacing(np.abs(points).max()))
        rim = np.concatenate([cyclic_pairs(loop) for loop in loops])
        low, high = points.min(axis=0) - 1.0, points.max(axis=0) + 1.0
        self.apex = HalfEdges(triangulate_inside(points, rim, low, high)).apex
        self.cuts = {(a, b) for a, b in self.apex if (b, a) in self.apex}
        self._join()
        self._loop = np.full(len(points), -1)
        for number, loop in enumerate([*loops, *pins[:, None]]):
            self._loop[loop] = number
        self._number_of_loops = len(loops) + len(pins)

    def turn(self, a: int, b: int, c: int) -> int:
        """Sign of the turn at b from a to c; 0 if it is straight up to rounding."""
        x, y = self._x, self._y
        ux, uy, vx, vy = x[c] - x[a], y[c] - y[a], x[b] - x[a], y[b] - y[a]
        cross = vx * uy - vy * ux
        # Straight ahead, not back.
        if abs(cross) <= self._tolerance * np.hypot(ux, uy) and vx * (ux - vx) + vy * (uy - vy) > 0:
            return 0
        return self.exact_turn(a, b, c)

    def exact_turn(self, a: int, b: int, c: int) -> int:
        """Exact sign of the turn at b from a to c."""
        return int(orientation(self.points[a], self.points[b], self.points[c]))

    def length(self, a: int, b: int) -> float:
        """Distance between two points."""
        return float(np.hypot(self._x[b] - self._x[a], self._y[b] - self._y[a]))

    def bridges(self) -> list[Edge]:
        """Return cuts that connect all loops, each from the part connected to the first loop to another loop."""
        at: dict[int, list[tuple[float, int, int]]] = {}
        for a, b in sorted(self.cuts):
            if self._loop[a] != self._loop[b]:
                at.setdefault(int(self._loop[a]), []).append((self.length(a, b), a, b))
        connected, found = {0}, list[Edge]()
        waiting: list[tuple[float, int, int]] = []
        for cut in at.get(0, []):
            heappush(waiting, cut)
        while waiting and len(connected) < self._number_of_loops:
            _, a, b = heappop(waiting)
            loop = int(self._loop[b])
            if loop not in connected:
                connected.add(loop)
                found.append((a, b))
                for cut in at.get(loop, []):
                    heappush(waiting, cut)
        return found

    def diagonals(self, bridges: Sequence[Edge]) -> list[Edge]:
        """Return the other cuts, ordered so that each divides its remaining part into halves of similar size."""
        closed = set(bridges) | {(b, a) for a, b in bridges}
        region = self._number_regions()
        beside: dict[int, list[tuple[int, Edge]]] = {}
        weight = dict.fromkeys(region.values(), 0)
        for (a, b), number in region.items():
            weight[number] += 1
            if (a, b) in self.cuts and (a, b) not in closed:
                beside.setdefault(number, []).append((region[b, a], (a, b)))
        return _order_by_halves(weight, beside)

    def _join(self) -> None:
        """Join neighbouring triangles and regions if the result is convex, across the longest edges first."""
        after: dict[int, dict[int, int]] = {}
        before: dict[int, dict[int, int]] = {}
        # Around each point, the edges in counterclockwise order; initially all edges.
        for (a, b), c in self.apex.items():
            after.setdefault(a, {})[b] = c
            before.setdefault(a, {})[c] = b
        inner = sorted((edge for edge in self.cuts if edge[0] < edge[1]), key=lambda e: (-self.length(*e), e))
        for a, b in inner:
            if self._is_removable(a, before[a][b], after[a][b]) and self._is_removable(b, before[b][a], after[b][a]):
                self.cuts -= {(a, b), (b, a)}
                for at, other in ((a, b), (b, a)):
                    low, high = before[at].pop(other), after[at].pop(other)
                    after[at][low], before[at][high] = high, low

    def _is_removable(self, at: int, low: int, high: int) -> bool:
        """Whether the counterclockwise angle between two edges is at most straight."""
        return low != high and self.turn(low, at, high) <= 0 and not self._turns_back(at, low, high)

    def _turns_back(self, at: int, low: int, high: int) -> bool:
        x, y = self._x, self._y
        flat = orientation(self.points[low], self.points[at], self.points[high]) == 0
        along = (x[low] - x[at]) * (x[high] - x[at]) + (y[low] - y[at]) * (y[high] - y[at])
        return bool(flat) and along > 0

    def _number_regions(self) -> dict[Edge, int]:
        """Number of the region to the left of each half-edge."""
        region: dict[Edge, int] = {}
        for count, first in enumerate(sorted(self.apex)):
            waiting = [first] if first not in region else []
            while waiting:
                a, b = waiting.pop()
                if (a, b) in region:
                    continue
                region[a, b] = count
                c = self.apex[a, b]
                waiting += [(b, c), (c, a)]
                if (b, a) in self.apex and (a, b) not in self.cuts:
                    waiting.append((b, a))
        return region


def _order_by_halves(weight: dict[int, int], beside: dict[int, list[tuple[int, Edge]]]) -> list[Edge]:
    """Return the edges of a tree, ordered so that each divides its remaining part into two of similar weight.

    ``weight`` is that of every node; ``beside`` has the neighbours of a node and the name of the edge as seen from it.
    """
    found: list[Edge] = []
    cut: set[Edge] = set()
    trees = [next(iter(weight))] if weight else []
    while trees:
        root = trees.pop()
        order, up = [root], {root: (root, (-1, -1))}
        for node in order:
            for other, edge in beside.get(node, []):
                if edge not in cut and other not in up:
                    up[other] = node, edge
                    order.append(other)
        if len(order) == 1:
            continue
        below = {node: weight[node] for node in order}
        for node in reversed(order[1:]):
            below[up[node][0]] += below[node]
        best = min(order[1:], key=lambda node: abs(2 * below[node] - below[root]))
        a, b = up[best][1]
        cut |= {(a, b), (b, a)}
        found.append((a, b))
        trees += [root, best]
    return found
