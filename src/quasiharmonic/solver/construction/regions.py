"""Partition of a target into convex regions without additional points, and the order of the cuts.

Constrained Delaunay triangles are joined with neighbours as long as the result is convex [1]_. The remaining interior
edges, the *cuts*, connect all loops and pins, because a convex region surrounds none of them.

References
----------
.. [1] S. Hertel, K. Mehlhorn, Fast triangulation of simple polygons. Foundations of Computation Theory, Lecture Notes
   in Computer Science 158 (1983).
"""

from __future__ import annotations

from collections.abc import Sequence
from heapq import heappop, heappush

import numpy as np

from quasiharmonic.geometry.exact.constrained_delaunay import triangulate_inside
from quasiharmonic.geometry.exact.predicates import orientation
from quasiharmonic.solver.construction.sheet import Edge, HalfEdges
from quasiharmonic.util.arrays import FloatArray, IntArray, cyclic_pairs


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
