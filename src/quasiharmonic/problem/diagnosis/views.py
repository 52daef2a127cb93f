"""The view from a point past walls, in all directions.

From an eye, the view in every direction ends at the nearest wall. Consecutive directions that end at the same wall form
a wedge, between two rays through ends of walls. The directions that each wall covers are computed exactly, and the
nearest wall from rounded distances. A rounding error makes a wedge extend behind a nearer wall. So wedges contain all
visible points, and may contain more.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import cached_property, cmp_to_key, lru_cache
from typing import Any, NamedTuple

import numpy as np

from quasiharmonic.geometry.exact.predicates import orientation
from quasiharmonic.problem.diagnosis.clipping import MARGIN, Convex, Effort, Lattice, cross, line
from quasiharmonic.util.arrays import BoolArray, FloatArray, IntArray, SignArray, as_offsets, scale_to_unit


class ViewTuning(NamedTuple):
    """Numbers that tune the comparison of views and their cache."""

    # Number of consecutive wedges that form a row for a first comparison.
    row: int = 16
    # Limit on the pairs of rows that are compared wedge by wedge.
    max_rows: int = 1024
    # Number of cached views.
    max_cached: int = 200


_TUNING = ViewTuning()


@dataclass(frozen=True, eq=False)
class Wedges:
    """Triangles with their tips at an eye, in counterclockwise order; indices are points of a lattice.

    Attributes
    ----------
    right, left : (c,) int64
        Points on the two rays that bound each wedge.
    wall : (c, 2) int64
        Ends of the wall that bounds each wedge, from right to left.
    effort : Effort
        Budget for all work with the wedges.
    """

    lattice: Lattice
    eye: int
    right: IntArray
    left: IntArray
    wall: IntArray
    effort: Effort

    def __len__(self) -> int:
        return len(self.right)

    def parts(self, area: Convex, only: BoolArray | None = None) -> Iterator[tuple[int, Convex]]:
        """Yield the parts of an area in the wedges, or in those of ``only``, with the index of each wedge."""
        self.effort.spend(100 + len(self) // 10)
        reached = self._may_reach(np.arange(len(self)), self.lattice.corners(area)[None])
        points = self.lattice.points
        eye = points[self.eye]
        for k in np.flatnonzero(reached if only is None else reached & only).tolist():
            self.effort.spend(30)
            p, q = self.wall[k].tolist()
            part = area.cut(line(eye, points[self.right[k]]))
            part = part and part.cut(line(points[self.left[k]], eye))
            part = part and part.cut(line(points[p], points[q]))
            if part is not None:
                yield k, part

    def find_overlapping(self, other: Wedges) -> IntArray | None:
        """Return pairs of wedges that may overlap, (m, 2) int64, or None if there are too many candidates."""
        self.effort.spend(300)
        rows = np.argwhere(self._rows_may_reach(other) & other._rows_may_reach(self).T)
        if len(rows) > _TUNING.max_rows:
            return None
        self.effort.spend(len(rows) * _TUNING.row**2 // 10)
        in_row = np.stack(np.divmod(np.arange(_TUNING.row**2), _TUNING.row), axis=1)
        i, j = (_TUNING.row * rows[:, None] + in_row).reshape(-1, 2).T
        there = (i < len(self)) & (j < len(other))
        i, j = i[there], j[there]
        for one, two in ((self, other), (other, self)):
            near = one._may_reach(i if one is self else j, two._triangles[j if one is self else i])
            i, j = i[near], j[near]
        return np.stack([i, j], axis=1)

    def _may_reach(self, which: IntArray, corners: FloatArray) -> BoolArray:
        """Return whether wedges (m,) and polygons (m, r, 2) may overlap: no side of the wedge separates them."""
        triangle = self._triangles[which, :, None]
        tip, p, q = triangle[:, 0], triangle[:, 1], triangle[:, 2]
        right, left = self._rays[:, which, None]
        reach: BoolArray = np.any(cross(right, corners - tip) > -MARGIN, axis=1)
        reach &= np.any(cross(left, corners - tip) < MARGIN, axis=1)
        reach &= np.any(cross(q - p, corners - p) > -MARGIN, axis=1)
        return reach

    @cached_property
    def _triangles(self) -> FloatArray:
        """Triangles of the eye and a wall, which contain the wedges; (c, 3, 2), rounded."""
        return self.lattice.approximate[np.column_stack([np.full(len(self), self.eye), self.wall])]

    @cached_property
    def _rays(self) -> FloatArray:
        """Points on the right and the left ray, relative to the eye; (2, c, 2), rounded."""
        points = self.lattice.approximate
        return points[np.stack([self.right, self.left])] - points[self.eye]

    @cached_property
    def _boxes(self) -> FloatArray:
        """Corners of bounding boxes of rows of wedges; (rows, 4, 2)."""
        first = np.arange(0, len(self), _TUNING.row)
        low, high = (extreme.reduceat(self._triangles, as_offsets(first)) for extreme in (np.minimum, np.maximum))
        (x0, y0), (x1, y1) = low.min(axis=1).T, high.max(axis=1).T
        return np.stack([np.stack(corner, axis=1) for corner in ((x0, y0), (x1, y0), (x1, y1), (x0, y1))], axis=1)

    def _rows_may_reach(self, other: Wedges) -> BoolArray:
        """Return whether rows of these wedges may overlap with rows of others; (rows, rows) bool."""
        if not len(self) or not len(other):
            return np.zeros((-(-len(self) // _TUNING.row), -(-len(other) // _TUNING.row)), dtype=bool)
        mine, boxes = self._boxes[:, None], other._boxes[None]
        reach: BoolArray = np.all(mine[..., 0, :] <= boxes[..., 2, :] + MARGIN, axis=2)
        first = np.arange(0, len(self), _TUNING.row)
        last = np.minimum(first + _TUNING.row, len(self)) - 1
        right, left = self._rays[0, first, None, None], self._rays[1, last, None, None]
        from_eye = boxes - self.lattice.approximate[self.eye]
        # Rows that span half a circle or more are not bounded by two rays.
        wide = cross(right, left)[..., 0] < MARGIN
        reach &= (cross(right, from_eye) > -MARGIN).any(axis=2) | wide
        reach &= (cross(left, from_eye) < MARGIN).any(axis=2) | wide
        return reach


class Views:
    """The views from points among walls.

    Parameters
    ----------
    ends : (m, 2) int64
        The walls, as pairs of points.
    positions : (k, 2) float64
        The points.
    lattice : Lattice
        The same points as integers.
    corner : (k, 2) int64
        For each point that is a corner of the target the next corner and the one before, else -1.
    effort : Effort
        Budget for the views and for all work with them.
    """

    def __init__(
        self, ends: IntArray, positions: FloatArray, lattice: Lattice, corner: IntArray, effort: Effort
    ) -> None:
        self._ends, self._positions, self._lattice, self._corner = ends, positions, lattice, corner
        # For inexact computations.
        self._scaled = scale_to_unit(positions)
        self._effort = effort
        #: Returns the wedges visible from a point; from a corner, only those inside the target.
        self.wedges: Callable[[int], Wedges] = lru_cache(_TUNING.max_cached)(self._compute_wedges)

    def _compute_wedges(self, eye: int) -> Wedges:
        """Compute the wedges of an eye; walls that end at the eye, or lie on a line with it, hide nothing."""
        self._effort.spend(500 + len(self._ends))
        here, where = self._positions[eye], self._positions
        turn = orientation(here, where[self._ends[:, 0]], where[self._ends[:, 1]])
        turn[(self._ends == eye).any(axis=1)] = 0
        walls = np.where(turn[:, None] > 0, self._ends, self._ends[:, ::-1])[turn != 0]
        sides = self._corner[eye]
        around, rank = self._sort(eye, np.unique(np.append(walls, sides[sides >= 0])))
        first, last = rank[walls.T]
        count, owner = len(around), np.arange(len(walls))
        # Split a wall that covers the first direction into two.
        over = np.flatnonzero(last < first)
        first, last = np.append(first, np.zeros_like(over)), np.append(np.where(last < first, count, last), last[over])
        owner = np.append(owner, over)[first < last]
        first, last = first[first < last], last[first < last]
        tail, head = self._scaled[walls[owner].T] - self._scaled[eye]
        ray = self._scaled[around] - self._scaled[eye]
        with np.errstate(invalid="ignore"):  # Rounding may make a ray zero.
            ray /= np.hypot(*ray.T)[:, None]
        between = ray + np.roll(ray, -1, axis=0)
        nearest = _find_nearest(first, last, tail, head - tail, between)
        if sides[0] >= 0:
            # The inside is counterclockwise from the next side to the side before.
            nearest[(np.arange(count) - rank[sides[0]]) % count >= (rank[sides[1]] - rank[sides[0]]) % count] = -1
        begin = np.flatnonzero(np.append(-2, nearest[:-1]) != nearest) if count else around
        end = np.append(begin[1:], 0)
        seen = nearest[begin] >= 0
        return Wedges(
            self._lattice, eye, around[begin[seen]], around[end[seen]], walls[owner[nearest[begin[seen]]]], self._effort
        )

    def _sort(self, eye: int, points: IntArray) -> tuple[IntArray, IntArray]:
        """Sort points by direction from the eye, counterclockwise from the x axis.

        Return one of the points in each direction, in order, and the rank of each point's direction (k,). The rank is
        undefined for other points.
        """
        here, where = self._positions[eye], self._positions
        low = (where[:, 1] < here[1]) | ((where[:, 1] == here[1]) & (where[:, 0] < here[0]))
        dx, dy = (self._scaled[points] - self._scaled[eye]).T
        angle = np.arctan2(dy, dx)
        angle[low[points] & (angle > 0)] = -np.pi
        points = points[np.lexsort([angle, low[points]])]

        def turns() -> SignArray:
            """Return for all but the last point: 1 if the next one comes later, 0 if it has the same direction."""
            turn = orientation(here, where[points[:-1]], where[points[1:]])
            turn[low[points[:-1]] != low[points[1:]]] = 1
            return turn

        turn = turns()
        if np.any(turn < 0):
            # Rounding put nearby directions in the wrong order: sort exactly.
            points = np.array(sorted(points.tolist(), key=self._direction(eye, low)), dtype=np.int64)
            turn = turns()
        new = np.append(True, turn > 0)[: len(points)]
        rank = np.zeros(len(where), dtype=np.int64)
        rank[points] = np.cumsum(new) - 1
        return points[new], rank

    def _direction(self, eye: int, low: BoolArray) -> Callable[[int], Any]:
        """Return the exact sort key of points by direction."""
        points = self._lattice.points
        (x, y), lower = points[eye], low.tolist()

        def compare(i: int, j: int) -> int:
            if lower[i] != lower[j]:
                return 1 if lower[i] else -1
            (px, py), (qx, qy) = points[i], points[j]
            return (py - y) * (qx - x) - (px - x) * (qy - y)

        return cmp_to_key(compare)


def _find_nearest(first: IntArray, last: IntArray, tail: FloatArray, along: FloatArray, ray: FloatArray) -> IntArray:
    """Return the nearest wall in each of a circle of directions ``ray`` (r, 2), -1 if there is none.

    A wall covers the directions from ``first`` up to, not including, ``last`` (m,). ``tail`` (m, 2) is its start
    relative to the eye, ``along`` (m, 2) the vector from its start to its end. Each wall is stored at two overlapping
    runs of 2ᵏ directions that cover it. Walls do not cross, so the nearest wall of a run is the same in all its
    directions. It is passed down from each run to its two halves.
    """
    best = np.full(len(ray), -1)
    if not len(first):
        return best
    above = cross(tail, along)

    def distance(wall: IntArray, direction: IntArray) -> FloatArray:
        with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
            result: FloatArray = above[wall] / cross(ray[direction], along[wall])
        return result

    def put(wall: IntArray, direction: IntArray) -> None:
        current = best[direction]
        nearer = (current < 0) | (distance(wall, direction) < distance(current, direction))
        best[direction[nearer]] = wall[nearer]

    level = np.frexp((last - first).astype(np.float64))[1] - 1
    for k in range(int(level.max()), -1, -1):
        if k < level.max():
            # Each run of the previous level consists of two runs of this one.
            covered = np.flatnonzero(best >= 0)
            put(best[covered], covered + (1 << k))
        here = np.flatnonzero(level == k)
        wall, start = np.concatenate([here, here]), np.concatenate([first[here], last[here] - (1 << k)])
        order = np.lexsort([distance(wall, start), start])
        wall, start = wall[order], start[order]
        foremost = np.append(True, start[1:] != start[:-1])[: len(start)]
        put(wall[foremost], start[foremost])
    return best
