"""Constrained Delaunay triangulation: triangles between given points that have given segments among their edges.

    Qhull's Delaunay triangles ──exactly valid?──▶ yes ──▶ recover missing segments by edge flips [1]_
                                      └──▶ no ──▶ insert the points one by one [2]_ ──▶ recover segments

    A polygon without further points: triangulate by a sweep ──▶ edge flips.

Every returned triangle is strictly positive, which is verified exactly. Delaunay's criterion is tested in floating
point. If rounding makes it uncertain, either diagonal is accepted.

References
----------
.. [1] S. W. Sloan, A fast algorithm for generating constrained Delaunay triangulations. Computers & Structures 47
   (1993).
.. [2] C. L. Lawson, Software for C¹ surface interpolation. Mathematical Software III (1977).
"""

from __future__ import annotations

from collections import deque
from collections.abc import Iterable

import numpy as np

from quasiharmonic.geometry.exact.predicates import orientation
from quasiharmonic.geometry.exact.triangles import triangle_signs
from quasiharmonic.geometry.mesh.polygons import triangulate
from quasiharmonic.geometry.mesh.topology import edge_keys, edges, find_pairs, label_components, pair_keys
from quasiharmonic.util.arrays import BoolArray, FloatArray, IntArray, cyclic_pairs, mark, to_integers


class BlockedError(ValueError):
    """A segment passes through the point ``point``, which is not one of its ends."""

    def __init__(self, tail: int, head: int, point: int) -> None:
        super().__init__(f"the segment from point {tail} to point {head} passes through point {point}")
        self.point = point


def constrained_delaunay(points: FloatArray, segments: IntArray, hull: IntArray) -> IntArray:
    """Triangulate points within a convex polygon, with given segments among the edges.

    Parameters
    ----------
    points : (n, 2) float64
        Distinct points of magnitude about one.
    segments : (s, 2) int64
        Pairs of points. Two segments share at most an end.
    hull : (h,) int64
        Corners of the convex polygon around all other points, counterclockwise, every corner strictly convex.

    Returns
    -------
    (t, 3) int64
        Counterclockwise triangles. Every point is a corner of at least one.

    Raises
    ------
    BlockedError
        If a segment passes through a point.
    ValueError
        If points coincide, or a point is outside the polygon.
    """
    F = delaunay_by_qhull(points)
    triangulation = None
    if not _covers(F, points, hull):
        triangulation = Triangulation.of_points(points, hull)
        F = triangulation.triangles()
    n = len(points)
    required = pair_keys(segments, n)
    tails, heads = F.ravel(), np.roll(F, -1, axis=1).ravel()
    missing = segments[~np.isin(required, edge_keys(tails, heads, n))]
    if not len(missing):
        return F
    triangulation = triangulation or Triangulation(points, F)
    triangulation.require(segments)
    for tail, head in missing.tolist():
        triangulation.recover(tail, head)
    return triangulation.triangles()


def delaunay_of_polygon(points: FloatArray) -> IntArray | None:
    """Triangulate a simple polygon (k, 2) without further points; None if the polygon runs clockwise."""
    integers = to_integers(points)
    corners = list(zip(integers[::2], integers[1::2], strict=True))
    if sum(corners[k - 1][0] * y - x * corners[k - 1][1] for k, (x, y) in enumerate(corners)) < 0:
        return None
    triangulation = Triangulation(points, np.array(triangulate(corners), dtype=np.int64))
    sides = np.arange(len(points))
    triangulation.require(cyclic_pairs(sides))
    triangulation.legalise()
    return triangulation.triangles()


def triangulate_inside(points: FloatArray, rim: IntArray, low: FloatArray, high: FloatArray) -> IntArray:
    """Return the constrained Delaunay triangles (t, 3) to the left of directed edges ``rim`` (m, 2) that form loops.

    ``low`` and ``high`` (2,) are corners of a box around all points. Raises as `constrained_delaunay`.
    """
    k = len(points)
    box = np.array([low, (high[0], low[1]), high, (low[0], high[1])])
    F = constrained_delaunay(np.concatenate([points, box]), rim, k + np.arange(4))
    return F[select_inside(F, rim, k + 4)]


def select_inside(F: IntArray, rim: IntArray, n: int) -> BoolArray:
    """Select the triangles (t, 3) to the left of directed edges that form loops, and those joined to them inside.

    ``rim`` (m, 2) has the edges as pairs of ``n`` points. Triangles are joined across all other edges.
    """
    tails, heads = F.ravel(), np.roll(F, -1, axis=1).ravel()
    one, other = find_pairs(F)
    is_open = ~np.isin(edge_keys(tails[one], heads[one], n), pair_keys(rim, n))
    part = label_components(one[is_open] // 3, other[is_open] // 3, len(F))
    forward = np.flatnonzero(np.isin(tails * n + heads, rim[:, 0] * n + rim[:, 1]))
    return mark(len(F), part[forward // 3])[part]


def delaunay_by_qhull(points: FloatArray) -> IntArray:
    """Delaunay triangles computed by Qhull, all of them counterclockwise."""
    from scipy.spatial import Delaunay, QhullError

    try:
        # Qhull is more accurate near the origin. The caller verifies the result on the original points.
        F: IntArray = Delaunay(points - points.mean(axis=0)).simplices.astype(np.int64)
    except QhullError:
        return np.empty((0, 3), dtype=np.int64)
    sign, _ = triangle_signs(F, np.ascontiguousarray(points, dtype=np.float64))
    # Triangles without area lie on the hull, between points on a line.
    F, sign = F[sign != 0], sign[sign != 0]
    F[sign < 0] = F[sign < 0, ::-1]
    return F


def _covers(F: IntArray, points: FloatArray, hull: IntArray) -> bool:
    """Whether positive triangles cover a polygon once and use all points; true if their boundary is the polygon."""
    if not len(F) or not np.bincount(F.ravel(), minlength=len(points)).all():
        return False
    found = edges(F, len(points))
    if found.nonmanifold.size or found.inconsistent.size or len(found.boundary) != len(hull):
        return False
    around = edge_keys(hull, np.roll(hull, -1), len(points))
    there = pair_keys(found.boundary, len(points))
    return bool(np.array_equal(np.sort(around), np.sort(there)))


class Triangulation:
    """Triangulation of a convex polygon, which strictly positive triangles cover once, changed by edge flips."""

    def __init__(self, points: FloatArray, F: IntArray) -> None:
        self._array = points
        self._x, self._y = points[:, 0].tolist(), points[:, 1].tolist()
        tails, heads, apexes = F.ravel(), np.roll(F, -1, axis=1).ravel(), np.roll(F, -2, axis=1).ravel()
        # The third corner of the triangle to the left of each half-edge, and one half-edge from every point.
        self._apex = dict(zip(zip(tails.tolist(), heads.tolist(), strict=True), apexes.tolist(), strict=True))
        self._neighbour = dict(zip(tails.tolist(), heads.tolist(), strict=True))
        self._required: set[tuple[int, int]] = set()

    @classmethod
    def of_points(cls, points: FloatArray, hull: IntArray) -> Triangulation:
        """Insert the points one by one into the convex polygon with corners ``hull``."""
        fan = np.stack([np.full(len(hull) - 2, hull[0]), hull[1:-1], hull[2:]], axis=1)
        triangulation = cls(points, fan)
        triangulation.legalise()
        inner = np.setdiff1d(np.arange(len(points)), hull)
        at = int(hull[0])
        for point in inner[_snake_order(points[inner])].tolist():
            triangulation._insert(point, at)
            at = point
        return triangulation

    def triangles(self) -> IntArray:
        """All triangles, (t, 3) int64, each starting at its smallest corner."""
        found = [(a, b, c) for (a, b), c in self._apex.items() if a < b and a < c]
        return np.array(found, dtype=np.int64).reshape(-1, 3)

    def require(self, segments: IntArray) -> None:
        """Mark segments that `legalise` must not remove."""
        pairs = [(a, b) for a, b in segments.tolist()]
        self._required.update(pairs)
        self._required.update((b, a) for a, b in pairs)

    def legalise(self) -> None:
        """Flip edges until all unmarked edges satisfy Delaunay's criterion."""
        self._legalise(list(self._apex))

    def recover(self, tail: int, head: int) -> None:
        """Make a segment an edge by flipping the edges that cross it."""
        crossing = deque(self._find_crossed(tail, head))
        new_edges = []
        while crossing:
            p, q = crossing.popleft()
            if not self._can_flip(p, q):
                crossing.append((p, q))
                continue
            left, right = self._flip(p, q)
            if {left, right}.isdisjoint((tail, head)) and (
                self._turn(tail, head, left) > 0 > self._turn(tail, head, right)
                or self._turn(tail, head, left) < 0 < self._turn(tail, head, right)
            ):
                crossing.append((left, right))
            else:
                new_edges.append((left, right))
        self._legalise(new_edges)

    def _find_crossed(self, tail: int, head: int) -> list[tuple[int, int]]:
        """Edges that cross a segment, starting at its tail, with the end on its right first."""
        if (tail, head) in self._apex or (head, tail) in self._apex:
            return []
        right = self._neighbour[tail]
        while True:
            left = self._apex[tail, right]
            if self._turn(tail, head, right) < 0 < self._turn(tail, head, left):
                break
            if self._turn(tail, head, left) == 0 and self._is_ahead(tail, head, left):
                raise BlockedError(tail, head, left)
            right = left
        found = [(right, left)]
        while (ahead := self._apex[left, right]) != head:
            side = self._turn(tail, head, ahead)
            if side == 0:
                raise BlockedError(tail, head, ahead)
            right, left = (right, ahead) if side > 0 else (ahead, left)
            found.append((right, left))
        return found

    def _insert(self, point: int, at: int) -> None:
        """Split the triangle or edge that contains a point; the search starts ``at`` another point."""
        a = at
        b = self._neighbour[a]
        c = self._apex[a, b]
        # Cross any side that has the point on its right. This terminates in Delaunay triangulations.
        while True:
            for tail, head in ((a, b), (b, c), (c, a)):
                if self._turn(tail, head, point) < 0:
                    if (head, tail) not in self._apex:
                        raise ValueError(f"point {point} is outside the polygon")
                    a, b, c = head, tail, self._apex[head, tail]
                    break
            else:
                break
        on = [(tail, head) for tail, head in ((a, b), (b, c), (c, a)) if self._turn(tail, head, point) == 0]
        if len(on) > 1:
            raise ValueError(f"point {point} coincides with another")
        around = [(a, b), (b, c), (c, a)]
        for tail, head in on:
            if (head, tail) not in self._apex:
                raise ValueError(f"point {point} is on the polygon's outline")
            across = self._apex.pop((head, tail))
            del self._apex[tail, head]
            around = [edge for edge in around if edge != (tail, head)] + [(tail, across), (across, head)]
        for tail, head in around:
            self._apex[tail, head] = point
            self._apex[head, point] = tail
            self._apex[point, tail] = head
            self._neighbour[tail] = head
        self._neighbour[point] = around[0][0]
        self._legalise(around)

    def _legalise(self, suspects: Iterable[tuple[int, int]]) -> None:
        """Flip edges and then their neighbours until Delaunay's criterion holds up to rounding."""
        waiting = list(suspects)
        while waiting:
            p, q = waiting.pop()
            if (p, q) not in self._apex or (q, p) not in self._apex or (p, q) in self._required:
                continue
            if self._in_circle(p, q) and self._can_flip(p, q):
                left, right = self._flip(p, q)
                waiting += [(p, right), (right, q), (q, left), (left, p)]

    def _can_flip(self, p: int, q: int) -> bool:
        """Whether the two triangles at an edge form a strictly convex quadrilateral."""
        left, right = self._apex[p, q], self._apex[q, p]
        return self._turn(left, right, q) > 0 and self._turn(right, left, p) > 0

    def _flip(self, p: int, q: int) -> tuple[int, int]:
        """Replace an edge by the other diagonal and return its ends."""
        left, right = self._apex.pop((p, q)), self._apex.pop((q, p))
        for a, b, c in ((right, q, left), (left, p, right)):
            self._apex[a, b], self._apex[b, c], self._apex[c, a] = c, a, b
        self._neighbour[p], self._neighbour[q] = right, left
        return left, right

    def _is_ahead(self, tail: int, head: int, point: int) -> bool:
        x, y = self._x, self._y
        along = (x[head] - x[tail]) * (x[point] - x[tail]) + (y[head] - y[tail]) * (y[point] - y[tail])
        return along > 0

    def _turn(self, a: int, b: int, c: int) -> float:
        """A number with the exact sign of the orientation of three points."""
        # Bound with a margin on the rounding of an orientation, relative to the sum of the magnitudes of its terms.
        bound = 4e-16
        x, y = self._x, self._y
        left = (x[a] - x[c]) * (y[b] - y[c])
        right = (y[a] - y[c]) * (x[b] - x[c])
        if abs(left - right) > bound * (abs(left) + abs(right)) + 1e-300:
            return left - right
        return float(orientation(self._array[a], self._array[b], self._array[c]))

    def _in_circle(self, p: int, q: int) -> bool:
        """Whether the point across an edge is certainly inside the circumcircle of the triangle to the edge's left."""
        # Bound with a margin on the rounding of the determinant, relative to the sum of the magnitudes of its terms.
        bound = 2e-15
        x, y = self._x, self._y
        a, d = self._apex[p, q], self._apex[q, p]
        px, py, qx, qy, ax, ay = x[p] - x[d], y[p] - y[d], x[q] - x[d], y[q] - y[d], x[a] - x[d], y[a] - y[d]
        pp, qq, aa = px * px + py * py, qx * qx + qy * qy, ax * ax + ay * ay
        det = pp * (qx * ay - qy * ax) + qq * (ax * py - ay * px) + aa * (px * qy - py * qx)
        size = (
            pp * (abs(qx * ay) + abs(qy * ax)) + qq * (abs(ax * py) + abs(ay * px)) + aa * (abs(px * qy) + abs(py * qx))
        )
        return det > bound * size


def _snake_order(points: FloatArray) -> IntArray:
    """Order points row by row in alternating directions, so that neighbours in the order are close."""
    rows = max(int(np.sqrt(len(points) / 2)), 1)
    low, extent = points.min(axis=0), np.ptp(points, axis=0)
    row = np.minimum(((points[:, 1] - low[1]) / max(extent[1], 1e-300) * rows).astype(np.int64), rows - 1)
    return np.lexsort((np.where(row % 2, -points[:, 0], points[:, 0]), row))
