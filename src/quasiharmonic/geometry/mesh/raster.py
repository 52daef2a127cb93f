"""Which triangle of the plane contains the centre of each texel of an image."""

from __future__ import annotations

import numpy as np

from quasiharmonic.util.arrays import BoolArray, FloatArray, IntArray, enumerate_each

# Texels per block, so that the arrays fit into the cache.
_BLOCK = 1 << 16


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
        size = (end - begin) * self.width
        triangle, weights = np.full(size, -1), np.empty((2, size))
        spans = slice(self._starts[begin], self._starts[end])
        before = np.cumsum(self._count[spans])
        total = int(before[-1]) if before.size else 0
        cuts = np.searchsorted(before, np.arange(_BLOCK, total, _BLOCK))
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
