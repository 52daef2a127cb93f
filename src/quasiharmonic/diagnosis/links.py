"""Link distance in a simple polygon: how few straight segments lead from one corner to another.

The polygon is triangulated once. From a corner one sees as far as a window: the first edge of the
shortest path, drawn on past the corner around which that path bends. From the window one sees as far
as the next, and so on, greedily [1]_. All this in exact arithmetic: a window passes through a corner
and one point found before, so that the integers grow by a fixed number of digits a step.

Segments may touch the boundary. A path of segments strictly inside may need more of them, never fewer.

References
----------
.. [1] S. Suri, A linear time algorithm for minimum link paths inside a simple polygon. Computer
   Vision, Graphics, and Image Processing 35 (1986).
.. [2] D. T. Lee, F. P. Preparata, Euclidean shortest paths in the presence of rectilinear barriers.
   Networks 14 (1984).
"""

from __future__ import annotations

from collections import deque
from fractions import Fraction
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

FloatArray = NDArray[np.float64]
Point = tuple[int, int, int]
"""Homogeneous coordinates, the last positive."""


class Polygon:
    """A simple polygon, triangulated.

    Parameters
    ----------
    corners : list of (int, int)
        Counterclockwise, no two equal.
    near : (k, 2) float64
        The same, rounded so that order is kept in each coordinate.

    Attributes
    ----------
    triangles : list of (int, int, int)
        As corners, counterclockwise.
    work : int
        Triangles and sides gone through so far, a measure of the time spent.
    """

    def __init__(self, corners: list[tuple[int, int]], near: FloatArray) -> None:
        self._points: list[Point] = [(x, y, 1) for x, y in corners]
        self.triangles = clip_ears(corners, near)
        self._corner = {point: k for k, point in enumerate(self._points)}
        self._of_side = {side: t for t, (a, b, c) in enumerate(self.triangles) for side in ((a, b), (b, c), (c, a))}
        # The triangles form a tree, in which an ear hangs on what it was cut from.
        self._parent = [self._of_side.get((a, c), -1) for a, _, c in self.triangles]
        self._depth = [0] * len(self.triangles)
        for t in range(len(self.triangles) - 2, -1, -1):
            self._depth[t] = self._depth[self._parent[t]] + 1
        self._at = {corner: t for t, triangle in enumerate(self.triangles) for corner in triangle}
        self.work = len(corners)

    def link_distance(self, start: int, goal: int, limit: int) -> int:
        """Number of segments that it takes from one corner to another.

        Parameters
        ----------
        start, goal : int
            Two corners.
        limit : int
            Where to stop counting.

        Returns
        -------
        int
            The number, or ``limit + 1`` when it is larger than the limit.
        """
        window = [(self._points[start], self._at[start])]
        for count in range(1, limit + 1):
            ways = [self._shortest(point, t, goal) for point, t in window]
            common = _common_end(ways)
            if common == 1 or any(len(way) == common for way in ways):
                return count  # the ways part at the goal: it is seen from between them
            bend, after = ways[0][-common], ways[0][1 - common]
            # Of all lines from the window past the bend, the one that has turned furthest already.
            before, other = ways[0][-common - 1], ways[-1][-common - 1]
            if _turn(bend, before, other) == _turn(before, bend, after):
                before = other
            window = [(bend, self._at[self._corner[bend]]), self._hit(before, bend)]
        return limit + 1

    def _shortest(self, start: Point, t: int, goal: int) -> list[Point]:
        """The shortest path from a point in a triangle to a corner: start, bends, goal [2]_."""
        left, right = self._portals(start, t, goal)
        path, k = [start], 0
        # What is seen from the last bend through all doors so far lies between these two corners.
        at_left = at_right = 0
        near_left = near_right = start
        while (k := k + 1) < len(left):
            self.work += 1
            if _turn(path[-1], near_right, right[k]) >= 0:
                if _turn(path[-1], near_left, right[k]) > 0:
                    path.append(near_left)
                    near_right, k = near_left, at_left
                    at_right = k
                    continue
                near_right, at_right = right[k], k
            if _turn(path[-1], near_left, left[k]) <= 0:
                if _turn(path[-1], near_right, left[k]) < 0:
                    path.append(near_right)
                    near_left, k = near_right, at_right
                    at_left = k
                    continue
                near_left, at_left = left[k], k
        path.append(self._points[goal])
        # A bend that the path touches without turning is none.
        return [p for k, p in enumerate(path) if k in (0, len(path) - 1) or _turn(path[k - 1], p, path[k + 1])]

    def _portals(self, start: Point, t: int, goal: int) -> tuple[list[Point], list[Point]]:
        """Left and right ends of the sides crossed between a point and a corner, both points included."""
        up, down = [t], [self._at[goal]]
        while up[-1] != down[-1]:
            if self._depth[up[-1]] >= self._depth[down[-1]]:
                up.append(self._parent[up[-1]])
            else:
                down.append(self._parent[down[-1]])
        sleeve = up + down[-2::-1]
        # Triangles around the two ends need not be crossed.
        around = [self._corner.get(start, -1) in self.triangles[t] for t in sleeve]
        first = max((k for k, inside in enumerate(around) if inside), default=0)
        last = next(k for k in range(first, len(sleeve)) if goal in self.triangles[sleeve[k]])
        left, right = [start], [start]
        for here, following in pairwise(sleeve[first : last + 1]):
            if self._parent[here] == following:
                a, _, c = self.triangles[here]
            else:
                c, _, a = self.triangles[following]
            left.append(self._points[a])
            right.append(self._points[c])
        return [*left, self._points[goal]], [*right, self._points[goal]]

    def _hit(self, before: Point, bend: Point) -> tuple[Point, int]:
        """Where the way from a point through a corner leaves the polygon, and a triangle there."""
        along = _cross(before, bend)
        sides = [_side(along, p) for p in self._points]
        self.work += len(sides)
        n = len(sides)
        # The distance from the bend, up to a positive factor.
        x, y, w = before
        dx, dy = bend[0] * w - x, bend[1] * w - y
        origin = dx * bend[0] + dy * bend[1]

        def distance(p: Point) -> Fraction:
            return Fraction(dx * p[0] + dy * p[1], p[2]) - origin

        exits: list[tuple[Fraction, Point, int]] = []
        start = next(k for k in range(n) if sides[k])
        k = start
        while k < start + n:
            # From one corner beside the line to the next: across a side, or along corners on the line.
            after = k + 1
            while not sides[after % n]:
                after += 1
            if sides[k % n] != sides[after % n]:
                if after == k + 1:
                    i, j = k % n, after % n
                    p = _cross(along, _cross(self._points[i], self._points[j]))
                    p = p if p[2] > 0 else (-p[0], -p[1], -p[2])
                    exits.append((distance(p), p, self._of_side[i, j]))
                else:
                    on = (self._points[m % n] for m in range(k + 1, after))
                    far = max(on, key=distance)
                    exits.append((distance(far), far, self._at[self._corner[far]]))
            k = after
        _, point, t = min((e for e in exits if e[0] > 0), key=lambda e: e[0])
        return point, t


def clip_ears(corners: list[tuple[int, int]], near: FloatArray) -> list[tuple[int, int, int]]:
    """Triangulate a simple polygon by cutting off one convex corner after another.

    Parameters
    ----------
    corners : list of (int, int)
        Counterclockwise, no two equal. Straight angles are allowed.
    near : (k, 2) float64
        The same, rounded so that order is kept in each coordinate.

    Returns
    -------
    list of (int, int, int)
        Counterclockwise triangles of positive area. The side from the first to the last corner of
        each but the last is one of a later triangle, or rather its reverse.
    """
    points = [(x, y, 1) for x, y in corners]
    n = len(points)
    before, after = [(k - 1) % n for k in range(n)], [(k + 1) % n for k in range(n)]
    blunt = [_turn(points[before[k]], points[k], points[after[k]]) <= 0 for k in range(n)]
    # Only corners that are not convex can lie in an ear, and one that does keeps it waiting.
    rest = np.flatnonzero(blunt)
    count = rest.size
    held_up: dict[int, list[int]] = {}
    # A corner whose neighbours changed queues anew: ears are cut in rounds, which keeps the tree low.
    turn_of = [0] * n
    queue = deque((k, 0) for k in range(n) if not blunt[k])
    triangles: list[tuple[int, int, int]] = []

    def again(corner: int) -> None:
        turn_of[corner] += 1
        queue.append((corner, turn_of[corner]))

    while len(triangles) < n - 2:
        b, turn = queue.popleft()
        if turn != turn_of[b] or blunt[b]:
            continue
        a, c = before[b], after[b]
        low, high = near[[a, b, c]].min(axis=0), near[[a, b, c]].max(axis=0)
        x, y = near[rest].T
        inside = (low[0] <= x) & (x <= high[0]) & (low[1] <= y) & (y <= high[1])
        sides = _cross(points[a], points[b]), _cross(points[b], points[c]), _cross(points[c], points[a])
        blocking = (
            k
            for k in rest[inside].tolist()
            if blunt[k] and k not in (a, c) and all(_side(side, points[k]) >= 0 for side in sides)
        )
        if (blocker := next(blocking, None)) is not None:
            held_up.setdefault(blocker, []).append(b)
            continue
        triangles.append((a, b, c))
        turn_of[b] = -1
        after[a], before[c] = c, a
        for k in (a, c):
            if blunt[k] and _turn(points[before[k]], points[k], points[after[k]]) > 0:
                blunt[k] = False
                count -= 1
                for freed in held_up.pop(k, []):
                    if turn_of[freed] >= 0:
                        again(freed)
            again(k)
        if 2 * count < rest.size:
            rest = rest[[blunt[k] for k in rest.tolist()]]
    return triangles


def _cross(p: Point, q: Point) -> Point:
    """The line through two points, positive to the left of the way from one to the other."""
    return p[1] * q[2] - p[2] * q[1], p[2] * q[0] - p[0] * q[2], p[0] * q[1] - p[1] * q[0]


def _side(line: Point, p: Point) -> int:
    """1 for a point to the left of a line, -1 for one to its right, 0 on it."""
    value = line[0] * p[0] + line[1] * p[1] + line[2] * p[2]
    return (value > 0) - (value < 0)


def _turn(p: Point, q: Point, r: Point) -> int:
    """1 where the way from p over q to r turns left, -1 where it turns right, 0 where it goes straight."""
    if p[2] == q[2] == r[2] == 1:
        value = (q[0] - p[0]) * (r[1] - p[1]) - (q[1] - p[1]) * (r[0] - p[0])
        return (value > 0) - (value < 0)
    return _side(_cross(p, q), r)


def _common_end(ways: list[list[Point]]) -> int:
    """Number of points that paths share at their ends, not counting the start of a single one."""
    if len(ways) == 1:
        return len(ways[0]) - 1
    count = 0
    for p, q in zip(reversed(ways[0]), reversed(ways[1]), strict=False):
        if p != q:
            break
        count += 1
    return count
