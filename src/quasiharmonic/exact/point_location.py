"""In which triangle points of the plane lie, decided exactly.

Candidates come from a `NestedGrid`. Corners and points are put into its cells by the same rounded arithmetic, which
is monotonic; whether a candidate contains the point is decided in floating point where the determinants are clear
of their error, and by `quasiharmonic.exact.predicates` where not.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from quasiharmonic.arrays import BoolArray, FloatArray, IntArray
from quasiharmonic.exact.nested_grid import NestedGrid
from quasiharmonic.exact.predicates import orientation, twice_area

# The determinant l − r of differences of up to 1 is off by no more: (3u + O(u²)) · 2 with u = 2⁻⁵³.
_UNSURE = 2.0**-50
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
            for point, triangle in self._candidates(here):
                # A point's candidates ascend: written backwards, the smallest is the last to be written.
                hits = np.flatnonzero(self._contain(here, point, triangle))[::-1]
                found[start + point[hits]] = triangle[hits]
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

    def _candidates(self, points: FloatArray) -> Iterator[tuple[IntArray, IntArray]]:
        """Pairs of a point and a triangle that may contain it, by point and then by triangle, in portions."""
        boxed = np.flatnonzero(((points >= self._low) & (points <= self._high)).all(axis=1))
        begin, end = self._grid.lists(np.ldexp(points[boxed], self._exponent) - self._origin)
        count = end - begin
        upto = np.cumsum(count)
        start = done = 0
        while start < boxed.size:
            stop = max(int(np.searchsorted(upto, done + _PAIRS, side="right")), start + 1)
            which = np.repeat(np.arange(start, stop), count[start:stop])
            entry = np.arange(done, int(upto[stop - 1])) + (end - upto)[which]
            yield boxed[which], self._grid.listed[entry].astype(np.int64)
            start, done = stop, int(upto[stop - 1])

    def _contain(self, points: FloatArray, point: IntArray, triangle: IntArray) -> BoolArray:
        """Whether the closed triangles contain the points paired with them."""
        x, y = (axis[point] for axis in np.ldexp(points, self._exponent).T)
        corner = self._rows.take(triangle, axis=0)
        ax, bx, cx = (corner[:, i] - x for i in (0, 2, 4))
        ay, by, cy = (corner[:, i] - y for i in (1, 3, 5))
        least = np.minimum(ax * by - ay * bx, bx * cy - by * cx)
        np.minimum(least, cx * ay - cy * ax, out=least)
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


def _careful_areas(points: FloatArray, corners: FloatArray) -> FloatArray:
    """Areas between points and the edges opposite to the corners (k, 3, 2), in any unit of each triangle; (3, k)."""
    extent = corners.max(axis=1) / 2 - corners.min(axis=1) / 2
    exponent = -1 - np.frexp(extent)[1]
    p, (a, b, c) = np.ldexp(points, exponent), np.ldexp(corners, exponent[:, None]).swapaxes(0, 1)
    return np.stack([twice_area(p, b, c), twice_area(p, c, a), twice_area(p, a, b)])
