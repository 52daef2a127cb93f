"""Find paths in the mesh with fewer edges than the target permits.

A map takes a path between two boundary vertices to a path of as many segments inside the target. So the number of edges
between two vertices cannot be smaller than their link distance.

The *link distance* in a simple polygon is the smallest number of segments of a path between two corners. The polygon is
triangulated once. The part of the polygon visible from a corner ends at a window. The window is the
first edge of the shortest path, extended past the corner at which that path bends. From this window the next one is
found, and so on, greedily [1]_. All arithmetic is exact: a window passes through a corner and one point found before,
so the integers grow by a fixed number of digits per step.

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
from collections.abc import Iterator
from fractions import Fraction
from itertools import pairwise

import numpy as np
from scipy.sparse import csr_array

from quasiharmonic.geometry.mesh.polygons import triangulate
from quasiharmonic.problem import Problem
from quasiharmonic.problem.diagnosis.clipping import MARGIN, Rounding, join
from quasiharmonic.problem.diagnosis.fixture import Corners, Fixture
from quasiharmonic.problem.diagnosis.obstruction import Forbids, Kind, Obstruction
from quasiharmonic.problem.diagnosis.witness import clear
from quasiharmonic.util.arrays import BoolArray, FloatArray, IntArray, invert_indices, vertex_names
from quasiharmonic.util.progress import heartbeat

Point = tuple[int, int, int]
"""Homogeneous coordinates, the last positive."""

# The degenerate line through a point and itself; every point is on it.
_NOWHERE: Point = (0, 0, 0)
# Largest number of edges between the vertices of a pair to check.
LONGEST = 8


class Polygon:
    """A simple polygon, triangulated; its corners are distinct and in counterclockwise order.

    Attributes
    ----------
    triangles : list of (int, int, int)
        Triangles by their corners, counterclockwise. They form a tree. In each triangle except the root, the side from
        the last to the first corner leads to its parent.
    work : int
        Number of triangles and crossings processed so far, a measure of the time spent.
    """

    def __init__(self, corners: list[tuple[int, int]]) -> None:
        self._points: list[Point] = [(x, y, 1) for x, y in corners]
        self._corner = {point: k for k, point in enumerate(self._points)}
        self.triangles = triangulate(corners)
        self._of_side = {side: t for t, (a, b, c) in enumerate(self.triangles) for side in ((a, b), (b, c), (c, a))}
        self._parent, self._depth = [-1] * len(self.triangles), [0] * len(self.triangles)
        self._build_tree()
        self._triangle_at = {corner: t for t, triangle in enumerate(self.triangles) for corner in triangle}
        self._rounding = Rounding(corners)
        self._approximate = self._rounding.round(self._points)
        self.work = len(corners)

    def _build_tree(self) -> None:
        """Arrange the triangles as a tree."""
        reached = deque([0])
        while reached:
            t = reached.popleft()
            a, b, c = self.triangles[t]
            for p, q in ((a, b), (b, c), (c, a)):
                child = self._of_side.get((q, p), -1)
                if child >= 0 and child != self._parent[t]:
                    self._parent[child], self._depth[child] = t, self._depth[t] + 1
                    self.triangles[child] = _with_last(self.triangles[child], q)
                    reached.append(child)

    def link_distance(self, start: int, goal: int, limit: int) -> int:
        """Return the smallest number of segments of a path between two corners, at most ``limit + 1``.

        After each segment, a path may be anywhere on the *window*, a segment across the polygon or at first a point.
        The shortest paths to the goal from both ends of the window join at the *bend*::

            before ●─__       ▓▓▓▓▓▓▓▓▓   ● after
                   │   ‾‾──__  ▓▓▓▓▓▓▓   ╱
            window │         ‾‾──__▓▓▓  ╱ __──    next window: from the bend to the right,
                   │         __──‾‾ ● ──‾‾        on the line from other
            other  ●─ __──‾‾     bend

        ``before`` and ``other`` precede the bend on the two paths; here they are the ends. All lines from the window
        through the bend lie between the two lines from them. The one that has turned further towards ``after`` is a
        limit: no segment from the window reaches a point behind it. So its part from the bend to the boundary is the
        next window.
        """
        window = [(self._points[start], self._triangle_at[start])]
        for count in range(1, limit + 1):
            heartbeat()
            paths = [self._shortest_path(point, t, goal) for point, t in window]
            common = _common_end(paths)
            if common == 1:
                return count  # The paths meet only at the goal, so a point of the window sees it.
            # Both paths have a point before the bend: no end of a window is a bend of the other end's path, because a
            # path bends at reflex corners only, and the part of the polygon behind the window is convex at both ends.
            # At the bend, the wall is on the side of `after`; at the other end, the line leaves the polygon.
            bend, after = paths[0][-common], paths[0][1 - common]
            before, other = paths[0][-common - 1], paths[-1][-common - 1]
            # If the line through the bend turns from `before` to `other` as the path turns at the bend, the line from
            # `other` has turned further.
            if _turn(bend, before, other) == _turn(before, bend, after):
                before = other
            window = [(bend, self._triangle_at[self._corner[bend]]), self._extend_ray(before, bend)]
        return limit + 1

    def _shortest_path(self, start: Point, t: int, goal: int) -> list[Point]:
        """Return the shortest path from a point in a triangle to a corner: start, bends, goal [2]_."""
        left, right = self._portals(start, t, goal)
        path, k = [start], 0
        # The view from the last bend through all sides crossed so far is between these two corners.
        at_left = at_right = 0
        to_left = to_right = _NOWHERE
        while (k := k + 1) < len(left):
            self.work += 1
            if _side(to_right, right[k]) >= 0:
                if _side(to_left, right[k]) > 0:
                    path.append(left[at_left])
                    k = at_right = at_left
                    to_left = to_right = _NOWHERE
                    continue
                at_right, to_right = k, join(path[-1], right[k])
            if _side(to_left, left[k]) <= 0:
                if _side(to_right, left[k]) < 0:
                    path.append(right[at_right])
                    k = at_left = at_right
                    to_left = to_right = _NOWHERE
                    continue
                at_left, to_left = k, join(path[-1], left[k])
        path.append(self._points[goal])
        # Drop corners at which the path does not turn.
        return [p for k, p in enumerate(path) if k in (0, len(path) - 1) or _turn(path[k - 1], p, path[k + 1])]

    def _portals(self, start: Point, t: int, goal: int) -> tuple[list[Point], list[Point]]:
        """Return the left and right ends of the sides that a path from a point to a corner crosses.

        Both lists include the point and the corner.
        """
        up, down = [t], [self._triangle_at[goal]]
        while up[-1] != down[-1]:
            if self._depth[up[-1]] >= self._depth[down[-1]]:
                up.append(self._parent[up[-1]])
            else:
                down.append(self._parent[down[-1]])
        sleeve = up + down[-2::-1]
        # Skip the triangles around the two ends.
        corner = self._corner.get(start, -1)
        first = max((k for k, t in enumerate(sleeve) if corner in self.triangles[t]), default=0)
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

    def _extend_ray(self, before: Point, bend: Point) -> tuple[Point, int]:
        """Return where the ray from a point through a corner leaves the polygon, and a triangle there."""
        # Number of corners whose comparison with a line costs as much as one step through a triangle.
        corners_per_step = 100
        along = join(before, bend)
        sides = self._sides(along)
        # `distance` is the distance from the bend, up to a positive factor.
        x, y, w = before
        dx, dy = bend[0] * w - x, bend[1] * w - y
        origin = dx * bend[0] + dy * bend[1]

        def distance(p: Point) -> Fraction:
            return Fraction(dx * p[0] + dy * p[1], p[2]) - origin

        exits: list[tuple[Fraction, Point, int]] = []
        beside = np.flatnonzero(sides)
        crossed = np.flatnonzero(sides[beside] != np.roll(sides[beside], -1))
        self.work += crossed.size + len(sides) // corners_per_step
        n = len(sides)
        # The line crosses the boundary between corners on different sides of it: through a side, or through corners on
        # it.
        for start, end in zip(beside[crossed].tolist(), np.roll(beside, -1)[crossed].tolist(), strict=True):
            if end == (start + 1) % n:
                p = join(along, join(self._points[start], self._points[end]))
                p = p if p[2] > 0 else (-p[0], -p[1], -p[2])
                exits.append((distance(p), p, self._of_side[start, end]))
            else:
                on = (self._points[m % n] for m in range(start + 1, end if end > start else end + n))
                far = max(on, key=distance)
                exits.append((distance(far), far, self._triangle_at[self._corner[far]]))
        _, point, t = min((e for e in exits if e[0] > 0), key=lambda e: e[0])
        return point, t

    def _sides(self, line: Point) -> IntArray:
        """Return the side of a line of each corner: 1 for left, -1 for right, 0 on the line."""
        a, b, c = line
        (x, y), unit, size = self._rounding.centre, self._rounding.unit, max(abs(a), abs(b))
        # Python rounds quotients of integers once, for any size.
        value = self._approximate @ (a / size, b / size) + (a * x + b * y + c) / (size * unit)
        sides = np.where(value > 0, 1, -1)
        for k in np.flatnonzero(np.abs(value) < MARGIN).tolist():
            sides[k] = _side(line, self._points[k])
        return sides


def _with_last(triangle: tuple[int, int, int], corner: int) -> tuple[int, int, int]:
    """Return the same triangle, rotated so that a corner is the last."""
    a, b, c = triangle
    return (b, c, a) if corner == a else (c, a, b) if corner == b else triangle


def _side(line: Point, p: Point) -> int:
    """Return 1 for a point to the left of a line, -1 for one to its right, 0 on it."""
    value = line[0] * p[0] + line[1] * p[1] + line[2] * p[2]
    return (value > 0) - (value < 0)


def _turn(p: Point, q: Point, r: Point) -> int:
    """Return 1 if the path from p over q to r turns left, -1 if it turns right, 0 if it is straight."""
    if p[2] == q[2] == r[2] == 1:
        value = (q[0] - p[0]) * (r[1] - p[1]) - (q[1] - p[1]) * (r[0] - p[0])
        return (value > 0) - (value < 0)
    return _side(join(p, q), r)


def _common_end(paths: list[list[Point]]) -> int:
    """Return the number of points that paths share at their ends; a single path is counted without its start."""
    if len(paths) == 1:
        return len(paths[0]) - 1
    count = 0
    for p, q in zip(reversed(paths[0]), reversed(paths[1]), strict=False):
        if p != q:
            break
        count += 1
    return count


class Shortcuts:
    """Finds boundary vertices that are closer in the mesh than inside the target.

    The problem has a single boundary loop, simple and counterclockwise in the target. After `find`, not all pairs that
    are ``unchecked`` or more edges apart were checked.
    """

    # Limit on the steps in the triangulated target, of some microseconds each: a constant,
    _WORK = 50_000
    # and a number per boundary vertex.
    _WORK_PER_VERTEX = 10
    # Limit on the pairs to collect.
    _MAX_PAIRS = 10_000_000
    # Offsets of trial points from the midpoint of two corners, as multiples of half their distance.
    _BESIDE = 0.05, 0.3, 1.0, -0.05, -0.3
    # Limit on the pairs of a segment and a nearby edge to check, for each call of `clear`.
    _MAX_NEAR_PAIRS = 1_000_000

    def __init__(self, problem: Problem, fixture: Fixture, corners: Corners) -> None:
        self._loop = problem.domain.loops[0]
        free, place = fixture.joined[:, 0], invert_indices(problem.n, self._loop)[fixture.joined[:, 1]]
        free, place = free[place >= 0], place[place >= 0]
        both = np.concatenate([fixture.inner, fixture.inner[:, ::-1]])
        # Free vertex × free vertex: 1 for each edge.
        self._inner = csr_array((np.ones(len(both)), both.T), shape=(problem.n, problem.n))
        # Place of a boundary vertex in the loop × free vertex: 1 for each edge.
        self._ends = csr_array((np.ones(len(free)), (place, free)), shape=(len(self._loop), problem.n))
        self._fixture = fixture
        # The angles of the target at its corners: a segment starts inside if it starts between two sides.
        self._corners = corners
        # The sides of the target, by their vertices (m, 2); segments must not meet them.
        self._sides = np.stack([self._loop, np.roll(self._loop, -1)], axis=1)
        self._polygon = Polygon(fixture.points(self._loop))
        self.unchecked = LONGEST + 1

    def find(self) -> Iterator[Obstruction]:
        """Yield obstructions of vertex pairs with fewer edges than segments between them, nearest pairs first."""
        n = len(self._loop)
        budget = self._WORK + self._WORK_PER_VERTEX * n
        # Place × free vertex: 1 if at most k - 1 edges join them, all but the first between free vertices. With a last
        # edge to the boundary, these are paths of at most k edges between two places.
        reached, known = self._ends, np.empty(0, dtype=np.int64)
        at_ends = np.bincount(self._ends.indices, minlength=self._ends.shape[1])
        for k in range(2, LONGEST + 1):
            if at_ends @ np.bincount(reached.indices, minlength=reached.shape[1]) > self._MAX_PAIRS:
                self.unchecked = k
                return
            pairs = (reached @ self._ends.T).tocoo()
            i, j = pairs.row.astype(np.int64), pairs.col.astype(np.int64)
            keys = np.setdiff1d((i * n + j)[i < j], known, assume_unique=True)
            known = np.concatenate([known, keys])
            reached = reached @ self._inner + reached
            reached.data[:] = 1
            i, j = np.divmod(keys, n)
            # A path along the boundary needs no more segments than edges, or two for a single edge. Pairs at two edges
            # have a common free neighbour; `conditions.Sight` checks whether it has a position that sees both.
            far = (np.minimum((i - j) % n, (j - i) % n) > k) & (k > 2)
            i, j = i[far], j[far]
            if not i.size:
                continue
            hidden = ~self.are_close(i, j, k)
            for a, b in zip(i[hidden].tolist(), j[hidden].tolist(), strict=True):
                if self._polygon.work > budget:
                    self.unchecked = k
                    return
                if self._polygon.link_distance(a, b, k) > k:
                    yield self._obstruction(a, b, k)

    def are_close(self, i: IntArray, j: IntArray, k: int) -> BoolArray:
        """Return whether corners are provably at most k > 2 segments apart.

        True if one corner sees the other, if one sees a third corner less than k sides from the other, or if both see
        one of a few points between them.
        """
        n, tails, heads = len(self._loop), self._loop[i], self._loop[j]
        where = self._fixture.positions
        p, q = where[tails], where[heads]
        result = self._clear(tails, heads, p, q)
        # Pairs that see each other, in both orders, as sorted keys. So the corners that one corner sees are successive,
        # and the nearest on either side of a third corner are the two keys beside that of the pair. Neighbours across
        # the start of the loop are missed, which only leaves more pairs to check.
        seen = np.sort(np.concatenate([(i * n + j)[result], (j * n + i)[result]]))
        for here, there in ((i, j), (j, i)) if seen.size else ():
            at = np.searchsorted(seen, here * n + there)
            for nearest in (seen[np.minimum(at, seen.size - 1)], seen[np.maximum(at - 1, 0)]):
                result |= (nearest // n == here) & (np.abs(nearest % n - there) < k)
        # At a bend, try points beside the midpoint, first towards the inside of the bend.
        inward = np.where((j - i) % n < (i - j) % n, 1.0, -1.0)
        dx, dy = (q / 2 - p / 2).T
        left = np.stack([-dy * inward, dx * inward], axis=1)
        for height in self._BESIDE:
            left_over = np.flatnonzero(~result)
            if not left_over.size:
                break
            with np.errstate(over="ignore"):
                trial = p[left_over] / 2 + q[left_over] / 2 + height * left[left_over]
            once = self._clear(tails[left_over], None, p[left_over], trial)
            left_over, trial = left_over[once], trial[once]
            result[left_over] = self._clear(heads[left_over], None, q[left_over], trial)
        return result

    def _clear(self, tails: IntArray, heads: IntArray | None, p: FloatArray, q: FloatArray) -> BoolArray:
        """Return whether segments from corners to other corners, or to points inside, provably lie inside."""
        where = self._fixture.positions
        inside: BoolArray = np.all(np.isfinite(q), axis=1)
        inside[inside] = self._corners.opens_to(tails[inside], q[inside], where)
        if heads is not None:
            inside[inside] = self._corners.opens_to(heads[inside], p[inside], where)
        ends = np.stack([tails, np.full(len(tails), -1) if heads is None else heads], axis=1)
        inside[inside] = clear(p[inside], q[inside], ends[inside], self._sides, where, self._MAX_NEAR_PAIRS)
        return inside

    def _obstruction(self, a: int, b: int, k: int) -> Obstruction:
        ends = self._loop[[a, b]]
        message = (
            f"A path of {k} edges inside the mesh joins the boundary {vertex_names(ends)}, and inside the target "
            f"every path from one to the other needs more than {k} segments."
        )
        path = self._shortest_path_edges(a, b, k)
        return Obstruction(Kind.LINK_DISTANCE, Forbids.INJECTIVE, message, vertices=ends, edges=path, split=path)

    def _shortest_path_edges(self, a: int, b: int, k: int) -> IntArray:
        """Return all edges on shortest paths between two boundary vertices, (e, 2) int64."""
        forth, back = self._find_rings(a, k), self._find_rings(b, k)
        start, end = self._loop[[a, b]]
        edges = [np.array([(start, v) for v in np.intersect1d(forth[0], back[k - 2])])]
        for step in range(1, k - 1):
            for v in np.intersect1d(forth[step - 1], back[k - 1 - step]).tolist():
                onward = np.intersect1d(_row_columns(self._inner, v), back[k - 2 - step])
                edges.append(np.array([(v, w) for w in onward.tolist()]))
        edges.append(np.array([(v, end) for v in np.intersect1d(forth[k - 2], back[0])]))
        return np.concatenate(edges)

    def _find_rings(self, corner: int, k: int) -> list[IntArray]:
        """Return free vertices that are exactly 1, 2, … k - 1 edges away from a boundary vertex."""
        rings = [_row_columns(self._ends, corner)]
        inside = rings[0]
        for _ in range(k - 2):
            following = np.unique(np.concatenate([_row_columns(self._inner, v) for v in rings[-1].tolist()]))
            rings.append(np.setdiff1d(following, inside))
            inside = np.union1d(inside, rings[-1])
        return rings


def _row_columns(matrix: csr_array, k: int) -> IntArray:
    """Return column indices of the entries in a row."""
    return matrix.indices[matrix.indptr[k] : matrix.indptr[k + 1]].astype(np.int64)
