"""Exact search for the triangle that contains a point of the plane.

Candidates come from a `NestedGrid`. Corners and points are assigned to cells by the same rounded arithmetic, which is
monotonic. Floating point decides whether a candidate contains the point if the determinants exceed their error bound.
`quasiharmonic.geometry.exact.predicates` decides the remaining cases.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

from quasiharmonic.geometry.exact.nested_grid import NestedGrid
from quasiharmonic.geometry.exact.predicates import orientation, twice_area
from quasiharmonic.util.arrays import BoolArray, FloatArray, IntArray, repeat_each
from quasiharmonic.util.kernels import compiled

# Error bound of the determinant l − r of differences of up to 1: (3u + O(u²)) · 2 with u = 2⁻⁵³.
_UNSURE = 2.0**-50
# Result for a point whose triangle floating point cannot determine.
_UNDECIDED = -2
# The same bound relative to |l| + |r|.
_RELATIVE_BOUND = 2.0**-51
# Bound on the loss by underflow.
_UNDERFLOW_BOUND = 2.0**-1000
# Barycentric coordinates use determinants whose error is at most this fraction of the triangle's determinant.
_MAX_ERROR = 2.0**-40
# Points per block, so that the data stay in the cache.
_POINTS_PER_BLOCK = 1 << 13
# Pairs of a point and a candidate per block.
_PAIRS_PER_BLOCK = 1 << 17


class PointLocator:
    """Point location in finite counterclockwise triangles (f, 3, 2), at least one."""

    def __init__(self, corners: FloatArray) -> None:
        self._corners = corners
        self._low, self._high = corners.min(axis=(0, 1)), corners.max(axis=(0, 1))
        # Scale each axis by a power of two so that the box has sides of 1/4 to 1. Halve first, so that the extent of
        # numbers near the largest double does not overflow.
        self._exponent = -1 - np.frexp(self._high / 2 - self._low / 2)[1]
        scaled = np.ldexp(corners, self._exponent)
        self._origin = np.ldexp(self._low, self._exponent)
        self._rows = np.ascontiguousarray(scaled.reshape(len(corners), 6))
        self._grid = NestedGrid(scaled - self._origin)

    def find(self, points: FloatArray) -> IntArray:
        """Find the closed triangle that contains each point (k, 2), exactly for the coordinates as stored.

        The result is the smallest index if several triangles contain a point; -1 if none does or the point is not
        finite.
        """
        found = np.full(len(points), -1, dtype=np.int64)
        for start in range(0, len(points), _POINTS_PER_BLOCK):
            here = points[start : start + _POINTS_PER_BLOCK]
            boxed = np.flatnonzero(((here >= self._low) & (here <= self._high)).all(axis=1))
            scaled, hits = np.ldexp(here[boxed], self._exponent), np.empty(boxed.size, dtype=np.int64)
            begin, end = self._grid.lists(scaled - self._origin)
            sure_hits(scaled, begin, end, self._grid.listed, self._rows, hits)
            unsure = np.flatnonzero(hits == _UNDECIDED)
            hits[unsure] = self._decide(here[boxed[unsure]], begin[unsure], end[unsure])
            found[start + boxed] = hits
        return found

    def barycentric(self, points: FloatArray, triangle: IntArray) -> FloatArray:
        """Barycentric coordinates (k, 3) of points in triangles that contain them, as returned by `find`.

        They are never negative, and zero exactly if the point lies on the opposite edge or within 1e-300 of it.
        """
        weights = np.empty((len(points), 3))
        for start in range(0, len(points), _POINTS_PER_BLOCK):
            chunk = slice(start, start + _POINTS_PER_BLOCK)
            weights[chunk] = self._weights(points[chunk], triangle[chunk])
        return weights

    def _decide(self, points: FloatArray, begin: IntArray, end: IntArray) -> IntArray:
        """Compute the result of `find` for points that floating point cannot decide."""
        found = np.full(len(points), -1, dtype=np.int64)
        for point, entry in _pairs(begin, end):
            triangle = self._grid.listed[entry].astype(np.int64)
            # Candidates of a point ascend. Writing them backwards leaves the smallest.
            hits = np.flatnonzero(self._contain(points, point, triangle))[::-1]
            found[point[hits]] = triangle[hits]
        return found

    def _contain(self, points: FloatArray, point: IntArray, triangle: IntArray) -> BoolArray:
        """Whether each closed triangle contains the point paired with it."""
        lowest = _lowest_determinants(np.ldexp(points, self._exponent)[point], self._rows.take(triangle, axis=0))
        contain: BoolArray = lowest > _UNSURE
        unsure = np.flatnonzero(np.abs(lowest) <= _UNSURE)
        if unsure.size:
            p, (a, b, c) = points[point[unsure]], self._corners[triangle[unsure]].swapaxes(0, 1)
            contain[unsure] = (orientation(p, a, b) >= 0) & (orientation(p, b, c) >= 0) & (orientation(p, c, a) >= 0)
        return contain

    def _weights(self, points: FloatArray, triangle: IntArray) -> FloatArray:
        """Barycentric coordinates of one block of points."""
        x, y = np.ldexp(points, self._exponent).T
        corner = self._rows.take(triangle, axis=0).T
        dx, dy = corner[0::2] - x, corner[1::2] - y
        # Row i belongs to corner i: twice the area of the triangle formed by the point and the opposite edge.
        left, right = dx[[1, 2, 0]] * dy[[2, 0, 1]], dy[[1, 2, 0]] * dx[[2, 0, 1]]
        area = left - right
        error = _RELATIVE_BOUND * (np.abs(left) + np.abs(right)).max(axis=0) + _UNDERFLOW_BOUND
        inaccurate = np.flatnonzero((error > _MAX_ERROR * area.sum(axis=0)) | (area.min(axis=0) <= error))
        if inaccurate.size:
            area[:, inaccurate] = _accurate_areas(points[inaccurate], self._corners[triangle[inaccurate]])
        return (area / area.sum(axis=0)).T


def _pairs(begin: IntArray, end: IntArray) -> Iterator[tuple[IntArray, IntArray]]:
    """Yield portions of the pairs of a point and an entry of its list, sorted by point, then entry."""
    count = end - begin
    total = np.cumsum(count)
    start = done = 0
    while start < begin.size:
        stop = max(int(np.searchsorted(total, done + _PAIRS_PER_BLOCK, side="right")), start + 1)
        point = repeat_each(np.arange(start, stop), count[start:stop])
        yield point, np.arange(done, int(total[stop - 1])) + (end - total)[point]
        start, done = stop, int(total[stop - 1])


@compiled
def sure_hits(
    points: FloatArray,
    begin: IntArray,
    end: IntArray,
    listed: NDArray[np.int32],
    rows: FloatArray,
    hits: IntArray,
) -> None:
    """Fill in the first candidate of each point that is not surely outside, if it surely contains the point.

    Fill in -2 if this is not sure, and -1 if the point is surely outside all candidates. rows: corners (f, 6).
    """
    hits[:] = -1
    for point, entry in _pairs(begin, end):
        triangle = listed[entry]
        lowest = _lowest_determinants(points[point], rows.take(triangle, axis=0))
        possible = np.flatnonzero(lowest >= -_UNSURE)[::-1]
        # Writing backwards leaves the first candidate.
        hits[point[possible]] = np.where(lowest > _UNSURE, triangle, _UNDECIDED)[possible]


def _lowest_determinants(points: FloatArray, rows: FloatArray) -> FloatArray:
    """Minimum determinant of each point with the edges of its paired triangle; positive inside."""
    x, y = points.T
    ax, bx, cx = (rows[:, i] - x for i in (0, 2, 4))
    ay, by, cy = (rows[:, i] - y for i in (1, 3, 5))
    lowest: FloatArray = np.minimum(ax * by - ay * bx, bx * cy - by * cx)
    return np.minimum(lowest, cx * ay - cy * ax, out=lowest)


def _accurate_areas(points: FloatArray, corners: FloatArray) -> FloatArray:
    """Areas of points with the edges opposite to the corners (k, 3, 2), in a unit of each triangle; (3, k)."""
    extent = corners.max(axis=1) / 2 - corners.min(axis=1) / 2
    exponent = -1 - np.frexp(extent)[1]
    p, (a, b, c) = np.ldexp(points, exponent), np.ldexp(corners, exponent[:, None]).swapaxes(0, 1)
    return np.stack([twice_area(p, b, c), twice_area(p, c, a), twice_area(p, a, b)])
