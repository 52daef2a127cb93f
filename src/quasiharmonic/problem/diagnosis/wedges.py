"""The view from a point as wedges, each bounded by two rays and the wall where the view ends."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from quasiharmonic.problem.diagnosis.clipping import MARGIN, Convex, Lattice, cross, line
from quasiharmonic.problem.diagnosis.effort import Effort
from quasiharmonic.util.arrays import BoolArray, FloatArray, IntArray, as_offsets

# Number of consecutive wedges that form a row for a first comparison.
_ROW = 16
# Limit on the pairs of rows that are compared wedge by wedge.
_MAX_ROWS = 1024


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

    def overlapping(self, other: Wedges) -> IntArray | None:
        """Return pairs of wedges that may overlap, (m, 2) int64, or None if there are too many candidates."""
        self.effort.spend(300)
        rows = np.argwhere(self._rows_may_reach(other) & other._rows_may_reach(self).T)
        if len(rows) > _MAX_ROWS:
            return None
        self.effort.spend(len(rows) * _ROW**2 // 10)
        in_row = np.stack(np.divmod(np.arange(_ROW**2), _ROW), axis=1)
        i, j = (_ROW * rows[:, None] + in_row).reshape(-1, 2).T
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
        corners: FloatArray = self.lattice.approximate[np.column_stack([np.full(len(self), self.eye), self.wall])]
        return corners

    @cached_property
    def _rays(self) -> FloatArray:
        """Points on the right and the left ray, relative to the eye; (2, c, 2), rounded."""
        points = self.lattice.approximate
        rays: FloatArray = points[np.stack([self.right, self.left])] - points[self.eye]
        return rays

    @cached_property
    def _boxes(self) -> FloatArray:
        """Corners of bounding boxes of rows of wedges; (rows, 4, 2)."""
        first = np.arange(0, len(self), _ROW)
        low, high = (extreme.reduceat(self._triangles, as_offsets(first)) for extreme in (np.minimum, np.maximum))
        (x0, y0), (x1, y1) = low.min(axis=1).T, high.max(axis=1).T
        return np.stack([np.stack(corner, axis=1) for corner in ((x0, y0), (x1, y0), (x1, y1), (x0, y1))], axis=1)

    def _rows_may_reach(self, other: Wedges) -> BoolArray:
        """Return whether rows of these wedges may overlap with rows of others; (rows, rows) bool."""
        if not len(self) or not len(other):
            return np.zeros((-(-len(self) // _ROW), -(-len(other) // _ROW)), dtype=bool)
        mine, boxes = self._boxes[:, None], other._boxes[None]
        reach: BoolArray = np.all(mine[..., 0, :] <= boxes[..., 2, :] + MARGIN, axis=2)
        first = np.arange(0, len(self), _ROW)
        last = np.minimum(first + _ROW, len(self)) - 1
        right, left = self._rays[0, first, None, None], self._rays[1, last, None, None]
        from_eye = boxes - self.lattice.approximate[self.eye]
        # Rows that span half a circle or more are not bounded by two rays.
        wide = cross(right, left)[..., 0] < MARGIN
        reach &= (cross(right, from_eye) > -MARGIN).any(axis=2) | wide
        reach &= (cross(left, from_eye) < MARGIN).any(axis=2) | wide
        return reach
