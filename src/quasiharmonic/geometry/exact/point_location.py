"""In which triangle points of the plane lie, decided exactly.

Candidates come from a `NestedGrid`. Corners and points are put into its cells by the same rounded arithmetic, which
is monotonic; whether a candidate contains the point is decided in floating point where the determinants are clear
of their error, and by `quasiharmonic.geometry.exact.predicates` where not.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

from quasiharmonic.geometry.exact.nested_grid import NestedGrid
from quasiharmonic.geometry.exact.predicates import orientation, twice_area
from quasiharmonic.util.arrays import BoolArray, FloatArray, IntArray
from quasiharmonic.util.kernels import compiled

# The determinant l − r of differences of up to 1 is off by no more: (3u + O(u²)) · 2 with u = 2⁻⁵³.
_UNSURE = 2.0**-50
# What stands for a triangle where that is so.
_UNDECIDED = -2
# The same as a part of |l| + |r|; and below it what underflow may do.
_RELATIVE_BOUND, _UNDERFLOW_BOUND = 2.0**-51, 2.0**-1000
# Barycentric coordinates are taken from determinants whose error is this part of the triangle's own at most.
_ACCURATE = 2.0**-40
# Points, and pairs of a point and a candidate, handled at a time: what is in work stays in the cache.
_POINTS, _PAIRS = 1 << 13, 1 << 17


class PointLocator:
    """Finds the triangles that points lie in.

    Parameters
    ----------
    corners : (f, 3, 2) float64
        Triangles, at least one, finite and all counterclockwise.
    """

    def __init__(self, corners: FloatArray) -> None:
        self._corners = corners
        self._low, self._high = corners.min(axis=(0, 1)), corners.max(axis=(0, 1))
        # Each axis in its own unit, a power of two, so that the box has sides of 1/4 to 1. Halved first: the extent
        # of numbers near the largest double must not overflow.
        self._exponent = -1 - np.frexp(self._high / 2 - self._low / 2)[1]
        scaled = np.ldexp(corners, self._exponent)
        self._origin = np.ldexp(self._low, self._exponent)
        self._rows = np.ascontiguousarray(scaled.reshape(len(corners), 6))
        self._grid = NestedGrid(scaled - self._origin)

    def find(self, points: FloatArray) -> IntArray:
        """The closed triangle that contains each point, decided exactly for the coordinates as stored.

        Parameters
        ----------
        points : (k, 2) float64

        Returns
        -------
        (k,) int64
            The smallest index, where several triangles contain a point; -1 where none does, or it is not finite.
        """
        found = np.full(len(points), -1, dtype=np.int64)
        for start in range(0, len(points), _POINTS):
            here = points[start : start + _POINTS]
            boxed = np.flatnonzero(((here >= self._low) & (here <= self._high)).all(axis=1))
            scaled, hits = np.ldexp(here[boxed], self._exponent), np.empty(boxed.size, dtype=np.int64)
            begin, end = self._grid.lists(scaled - self._origin)
            sure_hits(scaled, begin, end, self._grid.listed, self._rows, hits)
            unsure = np.flatnonzero(hits == _UNDECIDED)
            hits[unsure] = self._decided(here[boxed[unsure]], begin[unsure], end[unsure])
            found[start + boxed] = hits
        return found

    def barycentric(self, points: FloatArray, triangle: IntArray) -> FloatArray:
        """Barycentric coordinates of points in triangles that contain them.

        Parameters
        ----------
        points : (k, 2) float64
        triangle : (k,) int64
            As `find` has it, nowhere -1.

        Returns
        -------
        (k, 3) float64
            Never negative; zero exactly where the point lies on the edge opposite (or is within 1e-300 of it).
        """
        weights = np.empty((len(points), 3))
        for start in range(0, len(points), _POINTS):
            chunk = slice(start, start + _POINTS)
            weights[chunk] = self._weights(points[chunk], triangle[chunk])
        return weights

    def _decided(self, points: FloatArray, begin: IntArray, end: IntArray) -> IntArray:
        """What `find` returns, for points where floating point does not tell."""
        found = np.full(len(points), -1, dtype=np.int64)
        for point, entry in _pairs(begin, end):
            triangle = self._grid.listed[entry].astype(np.int64)
            # A point's candidates ascend: written backwards, the smallest is the last to be written.
            hits = np.flatnonzero(self._contain(points, point, triangle))[::-1]
            found[point[hits]] = triangle[hits]
        return found

    def _contain(self, points: FloatArray, point: IntArray, triangle: IntArray) -> BoolArray:
        """Whether the closed triangles contain the points paired with them."""
        least = _least_determinants(np.ldexp(points, self._exponent)[point], self._rows.take(triangle, axis=0))
        contain: BoolArray = least > _UNSURE
        unsure = np.flatnonzero(np.abs(least) <= _UNSURE)
        if unsure.size:
            p, (a, b, c) = points[point[unsure]], self._corners[triangle[unsure]].swapaxes(0, 1)
            contain[unsure] = (orientation(p, a, b) >= 0) & (orientation(p, b, c) >= 0) & (orientation(p, c, a) >= 0)
        return contain

    def _weights(self, points: FloatArray, triangle: IntArray) -> FloatArray:
        """Barycentric coordinates of a few points."""
        x, y = np.ldexp(points, self._exponent).T
        corner = self._rows.take(triangle, axis=0).T
        dx, dy = corner[0::2] - x, corner[1::2] - y
        # Row i belongs to corner i: twice the area of the triangle that the point forms with the edge opposite.
        left, right = dx[[1, 2, 0]] * dy[[2, 0, 1]], dy[[1, 2, 0]] * dx[[2, 0, 1]]
        area = left - right
        error = _RELATIVE_BOUND * (np.abs(left) + np.abs(right)).max(axis=0) + _UNDERFLOW_BOUND
        poor = np.flatnonzero((error > _ACCURATE * area.sum(axis=0)) | (area.min(axis=0) <= error))
        if poor.size:
            area[:, poor] = _careful_areas(points[poor], self._corners[triangle[poor]])
        return (area / area.sum(axis=0)).T


def _pairs(begin: IntArray, end: IntArray) -> Iterator[tuple[IntArray, IntArray]]:
    """Pairs of a point and an entry of its list, by point and then by entry, in portions."""
    count = end - begin
    upto = np.cumsum(count)
    start = done = 0
    while start < begin.size:
        stop = max(int(np.searchsorted(upto, done + _PAIRS, side="right")), start + 1)
        point = np.repeat(np.arange(start, stop), count[start:stop])
        yield point, np.arange(done, int(upto[stop - 1])) + (end - upto)[point]
        start, done = stop, int(upto[stop - 1])


@compiled
def sure_hits(
    points: FloatArray,
    begin: IntArray,
    end: IntArray,
    listed: NDArray[np.int32],
    rows: FloatArray,
    hits: IntArray,
) -> None:
    """Fill in the first of each point's listed triangles that is not surely outside, if it surely contains the point.

    -2 if that is not sure, -1 where all are surely outside. rows: the triangles' corners (f, 6).
    """
    hits[:] = -1
    for point, entry in _pairs(begin, end):
        triangle = listed[entry]
        least = _least_determinants(points[point], rows.take(triangle, axis=0))
        possible = np.flatnonzero(least >= -_UNSURE)[::-1]
        # Written backwards, the first is the last to be written.
        hits[point[possible]] = np.where(least > _UNSURE, triangle, _UNDECIDED)[possible]


def _least_determinants(points: FloatArray, rows: FloatArray) -> FloatArray:
    """The least of the determinants of a point with the edges of a triangle, positive inside, for pairs of them."""
    x, y = points.T
    ax, bx, cx = (rows[:, i] - x for i in (0, 2, 4))
    ay, by, cy = (rows[:, i] - y for i in (1, 3, 5))
    least: FloatArray = np.minimum(ax * by - ay * bx, bx * cy - by * cx)
    return np.minimum(least, cx * ay - cy * ax, out=least)


def _careful_areas(points: FloatArray, corners: FloatArray) -> FloatArray:
    """Areas between points and the edges opposite to the corners (k, 3, 2), in any unit of each triangle; (3, k)."""
    extent = corners.max(axis=1) / 2 - corners.min(axis=1) / 2
    exponent = -1 - np.frexp(extent)[1]
    p, (a, b, c) = np.ldexp(points, exponent), np.ldexp(corners, exponent[:, None]).swapaxes(0, 1)
    return np.stack([twice_area(p, b, c), twice_area(p, c, a), twice_area(p, a, b)])
