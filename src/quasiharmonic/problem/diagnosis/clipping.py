"""Exact convex polygons in the plane, and the part of one that sees given points.

All lines pass through two points of the target, and all points are intersections of two of these lines. Both have
homogeneous integer coordinates, so every sign is exact. The size of the numbers is bounded: after any number of cuts, a
corner is the intersection of two of the original lines.

All such work has a common budget of time, `Effort`.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from fractions import Fraction

import numpy as np

from quasiharmonic.util.arrays import FloatArray, IntArray
from quasiharmonic.util.progress import heartbeat

Point = tuple[int, int]
Line = tuple[int, int, int]
"""``a, b, c``: the point (x, y) lies to the left where ``a x + b y + c > 0``."""

# Coordinates below are at most 1 and rounded once, so the error of a product of two differences is below this margin.
# Values within the margin are computed again in integers.
MARGIN = 2.0**-48


def line(p: Point, q: Point) -> Line:
    """Return the line from ``p`` to ``q``, positive to its left."""
    a, b = p[1] - q[1], q[0] - p[0]
    return a, b, -(a * p[0] + b * p[1])


def reverse(along: Line) -> Line:
    """Return the same line, positive on the other side."""
    a, b, c = along
    return -a, -b, -c


def join(first: Line, second: Line) -> Line:
    """Return the intersection of two lines, or the line through two points; all in homogeneous coordinates.

    The line is positive to the left of the direction from the first point to the second.
    """
    a, b, c = first
    d, e, f = second
    return b * f - c * e, c * d - a * f, a * e - b * d


class Rounding:
    """Conversion of integer points to doubles of magnitude one; ``low`` and ``high`` bound the points."""

    def __init__(self, points: Sequence[Point]) -> None:
        xs, ys = zip(*points, strict=True)
        self.low, self.high = (min(xs), min(ys)), (max(xs), max(ys))
        self.centre = (self.low[0] + self.high[0]) // 2, (self.low[1] + self.high[1]) // 2
        self.unit = max(self.high[0] - self.low[0], self.high[1] - self.low[1], 1)

    def round(self, points: Iterable[tuple[int, int, int]]) -> FloatArray:
        """Return points in homogeneous coordinates, centred, scaled and rounded; (k, 2) float64."""
        (cx, cy), unit = self.centre, self.unit
        # Python rounds quotients of integers once, for any size.
        return np.array([((x - cx * w) / (unit * w), (y - cy * w) / (unit * w)) for x, y, w in points])


@dataclass(frozen=True)
class Convex:
    """An open convex polygon of positive area.

    Attributes
    ----------
    lines : list of Line
        Its sides in counterclockwise order, the polygon to their left.
    corners : list of (int, int, int)
        Homogeneous coordinates of the start of each side, the last coordinate positive.
    """

    lines: list[Line]
    corners: list[tuple[int, int, int]]

    @staticmethod
    def box(low: Point, high: Point) -> Convex:
        """Return the axis-parallel rectangle between two points."""
        (x0, y0), (x1, y1) = low, high
        corners = [(x0, y0), (x1, y0), (x1, y1), (x0, y1)]
        sides = [line(corners[i], corners[(i + 1) % 4]) for i in range(4)]
        return Convex(sides, [join(sides[i - 1], sides[i]) for i in range(4)])

    def cut(self, along: Line) -> Convex | None:
        """Return the part to the left of a line, or None if it has no area."""
        a, b, c = along
        sides = [a * x + b * y + c * w for x, y, w in self.corners]
        if min(sides) >= 0:
            return self
        if max(sides) <= 0:
            return None
        lines: list[Line] = []
        corners: list[tuple[int, int, int]] = []
        for i, here in enumerate(sides):
            side, after = self.lines[i], sides[i + 1 - len(sides)]
            if here > 0 or (here == 0 and after > 0):
                lines.append(side)
                corners.append(self.corners[i])
            elif after > 0:
                lines.append(side)
                corners.append(join(along, side))
            if here > 0 and after <= 0:
                lines.append(along)
                corners.append(self.corners[i + 1 - len(sides)] if after == 0 else join(side, along))
        return Convex(lines, corners)


class Lattice:
    """Positions (k, 2) as integers: the doubles of a target divided by their smallest unit.

    Attributes
    ----------
    points : list of (int, int)
        The same points, exactly.
    approximate : (k, 2) float64
        The same points, centred and scaled to magnitude one, rounded.
    """

    def __init__(self, positions: FloatArray) -> None:
        fraction, exponent = np.frexp(positions)
        mantissa = np.ldexp(fraction, 53).astype(np.int64)
        lowest = int(exponent[mantissa != 0].min(initial=np.iinfo(np.int32).max))
        shift = np.where(mantissa != 0, exponent - lowest, 0)
        integers = [m << s for m, s in zip(mantissa.ravel().tolist(), shift.ravel().tolist(), strict=True)]
        self.points: list[Point] = list(zip(integers[::2], integers[1::2], strict=True))
        self._lowest = lowest - 53
        self._rounding = Rounding(self.points)
        self.low, self.high = self._rounding.low, self._rounding.high
        self.approximate = self._rounding.round((x, y, 1) for x, y in self.points)

    def corners(self, area: Convex) -> FloatArray:
        """Return corners of a polygon in the coordinates of ``approximate``; (r, 2) float64."""
        return self._rounding.round(area.corners)

    def find_middle(self, area: Convex) -> tuple[float, float]:
        """Return a position in the middle of a polygon: the mean of three distant corners, rounded once."""
        r, unit = len(area.corners), Fraction(2) ** self._lowest
        three = [area.corners[k] for k in (0, r // 3, 2 * r // 3)]
        x, y = (sum(Fraction(corner[axis], corner[2]) for corner in three) * unit / 3 for axis in (0, 1))
        return float(x), float(y)


class Walls:
    """Segments that block the view between points of a lattice, given as pairs of points (m, 2)."""

    def __init__(self, ends: IntArray, lattice: Lattice, effort: Effort) -> None:
        self._ends, self._lattice, self._effort = ends, lattice, effort
        corners = lattice.approximate[ends.T].transpose(2, 0, 1)  # coordinate, end, wall
        self._low, self._high = corners.min(axis=1), corners.max(axis=1)

    def find_seeing(self, area: Convex, eyes: Sequence[int]) -> Convex | None:
        """Return a part of ``area`` of positive area that sees all points ``eyes``, or None if no point does.

        A point sees an eye if the open segment between them meets no wall. Walls on the same line, or with an end at
        the eye, remove nothing from an open set. The search cuts the area along the shadow of one wall after another,
        removes the shadow, and examines the remaining parts.
        """
        approximate = self._lattice.corners(area)
        walls = self._walls_near(np.concatenate([approximate, self._lattice.approximate[list(eyes)]]))
        # Each entry has the walls that may hide the area from the first eyes; empty lists for eyes that see all of it.
        waiting: list[tuple[Convex, FloatArray, list[IntArray]]] = [(area, approximate, [])]
        while waiting:
            area, approximate, blocking = waiting.pop()
            parts = None
            blocking = list(blocking)
            for k, eye in enumerate(eyes):
                if k == len(blocking):
                    blocking.append(self._walls_facing(eye, walls))
                if len(blocking[k]):
                    parts, blocking[k] = self._split(area, approximate, eye, blocking[k])
                if parts is not None:
                    break
            if parts is None:
                return area
            waiting += [(part, self._lattice.corners(part), blocking) for part in parts]
        return None

    def _walls_near(self, points: FloatArray) -> IntArray:
        """Return walls that reach into the bounding box of some points, (m, 2) int64."""
        (x0, y0), (x1, y1) = points.min(axis=0) - MARGIN, points.max(axis=0) + MARGIN
        inside = (self._low[0] <= x1) & (self._high[0] >= x0) & (self._low[1] <= y1) & (self._high[1] >= y0)
        return self._ends[inside]

    def _walls_facing(self, eye: int, walls: IntArray) -> IntArray:
        """Return walls ordered from right to left as seen from an eye, without those that end at it; (m, 2) int64."""
        ends = walls[(walls[:, 0] != eye) & (walls[:, 1] != eye)]
        p, q = self._lattice.approximate[ends.T] - self._lattice.approximate[eye]
        turned = p[:, 0] * q[:, 1] < p[:, 1] * q[:, 0]
        return np.where(turned[:, None], ends[:, ::-1], ends)

    def _split(
        self, area: Convex, approximate: FloatArray, eye: int, walls: IntArray
    ) -> tuple[list[Convex] | None, IntArray]:
        """Cut an area at the shadow of one of the walls.

        Return the visible parts, the most promising last, and the walls that may still hide some of these parts. The
        parts are None if no wall hides any of the area.
        """
        # About 100 µs for the calls of NumPy, and 1 µs for twenty pairs of a wall and a corner.
        self._effort.spend(100 + len(walls) * len(approximate) // 20)
        here = self._lattice.approximate[eye]
        p, q = self._lattice.approximate[walls.T]
        right, left = cross((p - here)[:, None], approximate - here), cross((q - here)[:, None], approximate - here)
        front = cross((q - p)[:, None], approximate - p[:, None])
        blocks = (right.max(axis=1) > -MARGIN) & (left.min(axis=1) < MARGIN) & (front.min(axis=1) < MARGIN)
        # Start with the walls that hide most corners: a wall that hides all of them ends the search.
        hidden = ((right > 0) & (left < 0) & (front < 0)).sum(axis=1)[blocks]
        walls = walls[blocks][np.argsort(-hidden, kind="stable")]
        points = self._lattice.points
        for k, (i, j) in enumerate(walls.tolist()):
            parts = _view_past(area, points[eye], points[i], points[j])
            if parts is not None:
                return parts, walls[k + 1 :]
        return None, walls[:0]


def _view_past(area: Convex, eye: Point, p: Point, q: Point) -> list[Convex] | None:
    """Return the parts of an area outside the shadow of a wall, or None if the wall hides no part of it."""
    across = line(p, q)
    side = across[0] * eye[0] + across[1] * eye[1] + across[2]
    if side == 0:
        return None
    if side < 0:
        p, q, across = q, p, reverse(across)
    first, second = line(eye, p), line(eye, q)
    beside = area.cut(first)
    ahead = beside and beside.cut(reverse(second))
    if beside is None or ahead is None or ahead.cut(reverse(across)) is None:
        return None
    parts = [area.cut(reverse(first)), beside.cut(second), ahead.cut(across)]
    return [part for part in parts if part is not None]


def cross(u: FloatArray, v: FloatArray) -> FloatArray:
    """Return cross products along the last axis; the other axes are broadcast."""
    return u[..., 0] * v[..., 1] - u[..., 1] * v[..., 0]


class EffortSpentError(Exception):
    """The budget is exhausted."""


@dataclass
class Effort:
    """A budget of time, and the amount spent so far, in units of about a microsecond."""

    limit: int
    spent: int = 0

    def spend(self, amount: int) -> None:
        """Spend an amount before the work; raise `EffortSpentError`, now and later, if the budget is exhausted."""
        heartbeat()
        self.spent += amount
        if self.spent > self.limit:
            raise EffortSpentError
