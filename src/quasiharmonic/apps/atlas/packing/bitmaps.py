"""Bitmaps of shapes: the cells of a square grid that are within a distance of a shape."""

from __future__ import annotations

from math import sqrt

import numpy as np

from quasiharmonic.apps.atlas.packing.shapes import Shape
from quasiharmonic.util.arrays import BoolArray, ComplexArray, FloatArray, enumerate_each

# If the cells of two bitmaps with this radius plus half a distance are disjoint, the shapes are at least this distance
# apart: the centre of some cell is within half a diagonal of the middle between the closest points.
HALF_DIAGONAL = sqrt(0.5)


def draw(shape: Shape, direction: complex, scale: float, radius: float) -> BoolArray:
    """Cells whose centres are within a distance of a shape.

    Parameters
    ----------
    shape : Shape
    direction : complex
        Unit vector that becomes the x-axis.
    scale : float
        Cells per unit of length.
    radius : float
        Distance in cells, at least `HALF_DIAGONAL`.

    Returns
    -------
    (h, w) bool
        Rows are from the lowest up. The centre of the shape's box is the centre of the bitmap.
    """
    turn = scale * direction.conjugate()
    hull = shape.hull * turn
    low, high = (complex(f(hull.real), f(hull.imag)) for f in (np.min, np.max))
    w, h = (max(int(side + 2 * radius), 1) for side in ((high - low).real, (high - low).imag))
    shift = complex(w, h) / 2 - (low + high) / 2
    tails, heads = shape.tails * turn + shift, shape.heads * turn + shift
    found = _fill(tails, heads, h, w)
    _mark_near(found, tails, heads, radius)
    return found


def draw_in_place(shape: Shape, rows: int, columns: int, radius: float) -> BoolArray:
    """Cells (rows, columns) of a rectangle at the origin within a distance of a shape; the unit is a cell."""
    near = radius + 1
    tails, heads = shape.tails, shape.heads
    lowest, highest = np.minimum(tails.imag, heads.imag), np.maximum(tails.imag, heads.imag)
    leftmost, rightmost = np.minimum(tails.real, heads.real), np.maximum(tails.real, heads.real)
    beside = (highest < -near) | (lowest > rows + near) | (rightmost < -near) | (leftmost > columns + near)
    found = _fill(tails, heads, rows, columns)
    _mark_near(found, tails[~beside], heads[~beside], radius)
    return found


def _fill(tails: ComplexArray, heads: ComplexArray, h: int, w: int) -> BoolArray:
    """Cells around whose centres the edges wind."""
    up = heads.imag > tails.imag
    lower, upper = np.where(up, tails, heads), np.where(up, heads, tails)
    # Rows of centres y with lower ≤ y < upper.
    first, end = (np.clip(np.ceil(ends.imag - 0.5), 0, h).astype(np.int64) for ends in (lower, upper))
    edge, step = enumerate_each(end - first)
    row = first[edge] + step
    ahead = upper[edge] - lower[edge]
    x = lower.real[edge] + (row + 0.5 - lower.imag[edge]) * (ahead.real / ahead.imag)
    column = np.clip(np.ceil(x - 0.5).astype(np.int64), 0, w)
    change = np.bincount(row * (w + 1) + column, np.where(up[edge], 1.0, -1.0), h * (w + 1))
    return np.asarray(np.cumsum(change.reshape(h, w + 1), axis=1)[:, :w] != 0)


def _mark_near(cells: BoolArray, tails: ComplexArray, heads: ComplexArray, radius: float) -> None:
    """Mark the cells whose centres are within a distance of an edge."""
    # Maximum distance between samples of an edge, in cells.
    spacing = 0.5
    h, w = cells.shape
    count = np.maximum(np.ceil(np.abs(heads - tails) / spacing), 1).astype(np.int64)
    edge, step = enumerate_each(count)
    samples = tails[edge] + (heads - tails)[edge] * (step / count[edge])
    # Every point of an edge is at most half the spacing from a sample.
    reach = radius**2 + spacing**2 / 4
    i, j = np.floor(samples.imag).astype(np.int64), np.floor(samples.real).astype(np.int64)
    y, x = samples.imag - i, samples.real - j
    k = int(sqrt(reach)) + 2
    inside = (i > -k) & (i < h + k) & (j > -k) & (j < w + k)
    i, j, y, x = i[inside], j[inside], y[inside], x[inside]
    padded = np.zeros((h + 4 * k, w + 4 * k), dtype=bool)
    flat, place = padded.ravel(), (i + 2 * k) * padded.shape[1] + j + 2 * k
    for di in range(-k + 1, k):
        vertical: FloatArray = (di + 0.5 - y) ** 2
        for dj in range(-k + 1, k):
            flat[place[vertical + (dj + 0.5 - x) ** 2 <= reach] + di * padded.shape[1] + dj] = True
    cells |= padded[2 * k : 2 * k + h, 2 * k : 2 * k + w]
