"""Queries for many points at once.

The queries are the nearest point of a triangulated surface to each point in space, and the triangle of the plane that
contains the centre of each texel of an image.
"""

from __future__ import annotations

import numpy as np

from quasiharmonic.util.arrays import BoolArray, FloatArray, IntArray, enumerate_each
from quasiharmonic.util.kernels import compiled
from quasiharmonic.util.threads import count_cores, make_executor


class NearestPoint:
    """Finds the nearest points of a surface: exact up to rounding, by samples of the surface in a k-d tree.

    Parameters
    ----------
    V : (n, 3) float64
    F : (f, 3) int64
        At least one triangle.
    """

    # Nearest samples of the surface that are tried first, and the factor by which their number grows.
    _FIRST = 24
    _GROWTH = 4
    # Largest number of samples for each triangle, on average.
    _SAMPLES = 4
    # Points per block, so that the arrays fit into the cache.
    _POINTS = 1 << 13

    def __init__(self, V: FloatArray, F: IntArray) -> None:
        from scipy.spatial import cKDTree

        self._corners = V[F]
        reach = np.linalg.norm(self._corners - self._corners.mean(axis=1, keepdims=True), axis=2).max(axis=1)
        # Large triangles have several samples.
        bound = float(np.median(reach)) or float(reach.max()) or 1.0
        while (parts := np.ceil(reach / bound).clip(1, 1e6) ** 2).sum() > self._SAMPLES * len(F) + 100:
            bound *= 1.25
        sides = np.sqrt(parts).astype(np.int64)
        self._triangle, number = enumerate_each(sides**2)
        self._tree = cKDTree(self._place(sides[self._triangle], number))
        # Every point of a triangle has a sample of this triangle within this radius.
        self._radius = (reach / sides)[self._triangle]
        self._largest = float(self._radius.max())

    def _place(self, sides: IntArray, number: IntArray) -> FloatArray:
        """Return the centres of the parts, by their numbers, of triangles whose sides are divided evenly."""
        row = np.floor(np.sqrt(number)).astype(np.int64)
        along = number - row**2
        # Row r has 2 r + 1 parts, which are alternately upright and inverted.
        upright = along % 2 == 0
        second = along // 2 + np.where(upright, 1 / 3, 2 / 3)
        total = row + np.where(upright, 2 / 3, 1 / 3)
        weights = np.stack([sides - total, total - second, second], axis=1) / sides[:, None]
        return np.einsum("kc,kcd->kd", weights, self._corners[self._triangle])

    def find(self, points: FloatArray) -> tuple[IntArray, FloatArray, FloatArray]:
        """Return triangle (k,), barycentric coordinates (k, 3) and distance (k,) of the nearest points to (k, 3)."""
        triangle, weights = np.full(len(points), -1), np.zeros((len(points), 3))
        squared = np.full(len(points), np.inf)

        def work(begin: int) -> None:
            block = slice(begin, begin + self._POINTS)
            self._find(points[block], triangle[block], weights[block], squared[block])

        with make_executor(count_cores(), "quasiharmonic-nearest") as pool:
            list(pool.map(work, range(0, len(points), self._POINTS)))
        return triangle, weights, np.sqrt(squared)

    def _find(self, points: FloatArray, triangle: IntArray, weights: FloatArray, squared: FloatArray) -> None:
        """Set the nearest points of a block."""
        many = len(self._triangle)
        waiting, count = np.arange(len(points)), min(self._FIRST, many)
        while waiting.size:
            distance, sample = self._tree.query(points[waiting], count)
            distance, sample = distance.reshape(-1, count), sample.reshape(-1, count)
            reach = distance - self._radius[sample]
            best, nearest, apart = triangle[waiting], weights[waiting], squared[waiting]
            improve_nearest(points[waiting], self._corners, self._triangle[sample], reach, best, nearest, apart)
            triangle[waiting], weights[waiting], squared[waiting] = best, nearest, apart
            if count == many:
                return
            waiting = waiting[distance[:, -1] < np.sqrt(squared[waiting]) + self._largest]
            count = min(self._GROWTH * count, many)


@compiled
def improve_nearest(
    points: FloatArray,
    corners: FloatArray,
    candidate: IntArray,
    reach: FloatArray,
    triangle: IntArray,
    weights: FloatArray,
    squared: FloatArray,
) -> None:
    """Replace the nearest points of a surface to points (n, 3) by those of candidate triangles that are nearer.

    Triangle, weights and squared distance (n,) are changed. ``corners`` (f, 3, 3) are those of the surface. Candidates
    (n, k) are tried in their order if a bound on their distance, ``reach`` (n, k), is below the smallest one so far.
    """
    for j in range(candidate.shape[1]):
        one = candidate[:, j]
        close = np.flatnonzero((reach[:, j] < np.sqrt(squared)) & (one != triangle))
        found, distance = nearest_in_triangles(points[close], corners[one[close]])
        better = distance < squared[close]
        which = close[better]
        triangle[which], weights[which], squared[which] = one[which], found[better], distance[better]


def nearest_in_triangles(points: FloatArray, corners: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return the nearest point of one triangle (k, 3, 3) each to points (k, 3): weights (k, 3), squared distance (k,).

    Triangles may be degenerate.
    """
    a, b, c = (np.ascontiguousarray(corners[:, i].T) for i in range(3))
    p = np.ascontiguousarray(points.T)
    u, v, w = b - a, c - a, p - a
    uu, uv, vv, uw, vw = ((x * y).sum(axis=0) for x, y in ((u, u), (u, v), (v, v), (u, w), (v, w)))
    area = uu * vv - uv * uv
    with np.errstate(divide="ignore", invalid="ignore"):
        second, third = (vv * uw - uv * vw) / area, (uu * vw - uv * uw) / area
        inside = (area > 0) & (second >= 0) & (third >= 0) & (second + third <= 1)
    weights = np.stack([1 - second - third, second, third])
    outside = np.flatnonzero(~inside)
    if outside.size:
        weights[:, outside] = _nearest_on_sides(p[:, outside], [corner[:, outside] for corner in (a, b, c)])
    apart = weights[0] * a + weights[1] * b + weights[2] * c - p
    return weights.T, (apart * apart).sum(axis=0)


def _nearest_on_sides(p: FloatArray, corners: list[FloatArray]) -> FloatArray:
    """Return the weights (3, k) of the points of triangles' sides that are nearest to points (3, k)."""
    best, weights = np.full(p.shape[1], np.inf), np.zeros(p.shape)
    for i, (tail, head) in enumerate(zip(corners, [*corners[1:], corners[0]], strict=True)):
        side = head - tail
        length = (side * side).sum(axis=0)
        along = ((p - tail) * side).sum(axis=0)
        share = np.clip(np.divide(along, length, out=np.zeros_like(along), where=length > 0), 0, 1)
        apart = tail + share * side - p
        distance = (apart * apart).sum(axis=0)
        nearer = distance < best
        best[nearer] = distance[nearer]
        rows = np.flatnonzero(nearer)
        weights[:, rows] = 0
        weights[i, rows], weights[(i + 1) % 3, rows] = 1 - share[rows], share[rows]
    return weights


class Raster:
    """Triangles over an image; `rows` finds the triangle at the centre of each texel, without a loop over triangles.

    Parameters
    ----------
    corners : (f, 3, 2) float64
        Positions in texels: the centre of the texel in column i and row j is (i + 1/2, j + 1/2).
    width, height : int
        Size of the image.
    leave_out : (f,) bool
        Triangles that are not drawn. Triangles without area are not drawn, either.
    """

    def __init__(self, corners: FloatArray, width: int, height: int, leave_out: BoolArray) -> None:
        self.width, self.height, self._corners = width, height, corners
        a, b, c = corners[:, 0], corners[:, 1], corners[:, 2]
        self._area = (b[:, 0] - a[:, 0]) * (c[:, 1] - a[:, 1]) - (b[:, 1] - a[:, 1]) * (c[:, 0] - a[:, 0])
        drawn = np.flatnonzero((self._area != 0) & np.isfinite(self._area) & ~leave_out)
        y = corners[drawn, :, 1]
        # Clipped, so that numbers far outside the image fit into integers.
        first = np.ceil(np.clip(y.min(axis=1) - 0.5, 0, height)).astype(np.int64)
        last = np.floor(np.clip(y.max(axis=1) - 0.5, -1, height - 1)).astype(np.int64)
        # The rows of each triangle are spans of texels.
        of, row = enumerate_each(np.maximum(last - first + 1, 0))
        row += first[of]
        # Of several triangles at a texel the last one counts, which is the one with the smallest index.
        order = np.lexsort((-of, row))
        self._triangle, self._row = drawn[of[order]], row[order]
        self._column, self._count = self._find_columns()
        self._starts = np.searchsorted(self._row, np.arange(height + 1))

    def _find_columns(self) -> tuple[IntArray, IntArray]:
        """Return the first column of each span, and its number of columns."""
        y = self._row + 0.5
        low, high = np.full(len(y), np.inf), np.full(len(y), -np.inf)
        for i in range(3):
            p, q = self._corners[self._triangle, i].T, self._corners[self._triangle, (i + 1) % 3].T
            # Both triangles of an edge compute the same crossing, so that no texel between them is missed.
            swap = (p[1] > q[1]) | ((p[1] == q[1]) & (p[0] > q[0]))
            p, q = np.where(swap, q, p), np.where(swap, p, q)
            crossed = (p[1] <= y) & (y <= q[1]) & (p[1] < q[1])
            with np.errstate(divide="ignore", invalid="ignore"):
                x = p[0] + (y - p[1]) / (q[1] - p[1]) * (q[0] - p[0])
            low, high = np.where(crossed, np.minimum(low, x), low), np.where(crossed, np.maximum(high, x), high)
        first = np.ceil(np.clip(low - 0.5, 0, self.width)).astype(np.int64)
        last = np.floor(np.clip(high - 0.5, -1, self.width - 1)).astype(np.int64)
        return first, np.maximum(last - first + 1, 0)

    def rows(self, begin: int, end: int) -> tuple[IntArray, IntArray, FloatArray]:
        """Find the texels of rows ``begin`` to ``end`` whose centres are in triangles.

        Returns
        -------
        texel : (k,) int64
            Ascending; the texel in column i and row j has the number (j - begin) · width + i.
        triangle : (k,) int64
            The triangle with the smallest index that contains the centre, or touches it.
        barycentric : (k, 3) float64
        """
        # Texels per block, so that the arrays fit into the cache.
        block = 1 << 16
        size = (end - begin) * self.width
        triangle, weights = np.full(size, -1), np.empty((2, size))
        spans = slice(self._starts[begin], self._starts[end])
        before = np.cumsum(self._count[spans])
        total = int(before[-1]) if before.size else 0
        cuts = np.searchsorted(before, np.arange(block, total, block))
        for part in np.split(np.arange(spans.start, spans.stop), np.unique(cuts)):
            self._draw(part, begin, triangle, weights)
        texel = np.flatnonzero(triangle >= 0)
        second, third = weights[:, texel]
        return texel, triangle[texel], np.stack([np.maximum(1 - second - third, 0), second, third], axis=1)

    def _draw(self, spans: IntArray, begin: int, triangle: IntArray, weights: FloatArray) -> None:
        """Set the triangle, and the weights (2, k) of its second and third corner, at the texels of some spans."""
        of = self._triangle[spans]
        a, b, c = self._corners[of].transpose(1, 2, 0)
        x, y = self._column[spans] + 0.5 - a[0], self._row[spans] + 0.5 - a[1]
        area, (bx, by), (cx, cy) = self._area[of], b - a, c - a
        span, along = enumerate_each(self._count[spans])
        texel = ((self._row[spans] - begin) * self.width + self._column[spans])[span] + along
        triangle[texel] = of[span]
        for row, start, slope in ((0, x * cy - y * cx, cy), (1, bx * y - by * x, -by)):
            weights[row, texel] = np.clip((start / area)[span] + along * (slope / area)[span], 0, 1)
