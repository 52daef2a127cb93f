"""The nearest point of a triangulated surface to points in space."""

from __future__ import annotations

import numpy as np

from quasiharmonic.util.arrays import FloatArray, IntArray, enumerate_each
from quasiharmonic.util.threads import count_cores, make_executor

# Nearest samples of the surface that are tried first, and the factor by which their number grows.
_FIRST = 24
_GROWTH = 4
# Largest number of samples for each triangle, on average.
_SAMPLES = 4
# Points per block, so that the arrays fit into the cache.
_POINTS = 1 << 14


class NearestPoint:
    """Finds the nearest points of a surface: exact up to rounding, by samples of the surface in a k-d tree.

    Parameters
    ----------
    V : (n, 3) float64
    F : (f, 3) int64
        At least one triangle.
    """

    def __init__(self, V: FloatArray, F: IntArray) -> None:
        from scipy.spatial import cKDTree

        self._corners = V[F]
        reach = np.linalg.norm(self._corners - self._corners.mean(axis=1, keepdims=True), axis=2).max(axis=1)
        # Large triangles have several samples.
        bound = float(np.median(reach)) or float(reach.max()) or 1.0
        while (parts := np.ceil(reach / bound).clip(1, 1e6) ** 2).sum() > _SAMPLES * len(F) + 100:
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
        # Row r has 2 r + 1 parts, which are upright and inverted by turns.
        upright = along % 2 == 0
        second = along // 2 + np.where(upright, 1 / 3, 2 / 3)
        total = row + np.where(upright, 2 / 3, 1 / 3)
        weights = np.stack([sides - total, total - second, second], axis=1) / sides[:, None]
        placed: FloatArray = np.einsum("kc,kcd->kd", weights, self._corners[self._triangle])
        return placed

    def find(self, points: FloatArray) -> tuple[IntArray, FloatArray, FloatArray]:
        """Return triangle (k,), barycentric coordinates (k, 3) and distance (k,) of the nearest points to (k, 3)."""
        triangle, weights = np.full(len(points), -1), np.zeros((len(points), 3))
        squared = np.full(len(points), np.inf)

        def work(begin: int) -> None:
            block = slice(begin, begin + _POINTS)
            self._find(points[block], triangle[block], weights[block], squared[block])

        with make_executor(count_cores(), "quasiharmonic-nearest") as pool:
            list(pool.map(work, range(0, len(points), _POINTS)))
        return triangle, weights, np.sqrt(squared)

    def _find(self, points: FloatArray, triangle: IntArray, weights: FloatArray, squared: FloatArray) -> None:
        """Set the nearest points of a block."""
        many = len(self._triangle)
        waiting, count = np.arange(len(points)), min(_FIRST, many)
        while waiting.size:
            distance, sample = self._tree.query(points[waiting], count)
            distance, sample = distance.reshape(-1, count), sample.reshape(-1, count)
            reach = distance - self._radius[sample]
            for j in range(count):
                candidate = self._triangle[sample[:, j]]
                # A triangle can only be nearer than the best one if its part around the sample is.
                close = np.flatnonzero((reach[:, j] < np.sqrt(squared[waiting])) & (candidate != triangle[waiting]))
                self._improve(points, waiting[close], candidate[close], triangle, weights, squared)
            if count == many:
                return
            waiting = waiting[distance[:, -1] < np.sqrt(squared[waiting]) + self._largest]
            count = min(_GROWTH * count, many)

    def _improve(
        self,
        points: FloatArray,
        which: IntArray,
        candidate: IntArray,
        triangle: IntArray,
        weights: FloatArray,
        squared: FloatArray,
    ) -> None:
        """Replace the nearest points of some points by those of candidates, where these are nearer."""
        found, distance = nearest_in_triangles(points[which], self._corners[candidate])
        better = distance < squared[which]
        which = which[better]
        triangle[which], weights[which], squared[which] = candidate[better], found[better], distance[better]


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
