"""Exact search for the triangle that contains a point of the plane.

Candidates come from a `NestedGrid`. Corners and points are assigned to cells by the same rounded arithmetic, which is
monotonic. Floating point decides whether a candidate contains the point if the determinants exceed their error bound.
`quasiharmonic.geometry.exact.predicates` decides the remaining cases.

The nested grid has lists of the triangles near every position of the unit box. The first grid has about as many cells
as there are triangles. Each cell lists the triangles that meet it. A cell with a long list is divided into 4 × 4 parts,
recursively. So the lists are short even if the sizes of triangles differ by many orders of magnitude::

    +-------+-------+-------+
    |       |+-+-+-+|       |      point ──▶ cell ──▶ one of its 4 × 4 parts, if divided ──▶ … ──▶ list of triangles
    |   ·   |+-+-+-+|       |
    |       |+-+-+-+|       |
    +-------+-------+-------+
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from quasiharmonic.geometry.exact.predicates import orientation, twice_area
from quasiharmonic.util.arrays import (
    BoolArray,
    FloatArray,
    IntArray,
    enumerate_each,
    enumerate_ranges,
    invert_indices,
    mark,
    repeat_each,
)
from quasiharmonic.util.kernels import compiled


class LocationTuning(NamedTuple):
    """Bounds of rounding errors, the nested grid, and blocks. The C kernel has the same values of the grid."""

    # Error bound of the determinant l − r of differences of up to 1: (3u + O(u²)) · 2 with u = 2⁻⁵³.
    unsure: float = 2.0**-50
    # The same bound relative to |l| + |r|, and the bound on the loss by underflow.
    relative: float = 2.0**-51
    underflow: float = 2.0**-1000
    # Barycentric coordinates use determinants whose error is at most this fraction of the triangle's determinant.
    max_error: float = 2.0**-40
    # Finest cells have coordinates below 2 to this power. Cells ``s`` halvings coarser have them shifted by ``s`` bits.
    bits: int = 40
    # A cell beyond an edge's line by more than this, in the unit box, is outside. More if products underflow.
    margin: float = 2.0**-48
    underflow_margin: float = 2.0**-1000
    # Numbers per block, so that the data stay in the cache: points, pairs of a point and a candidate, entries of cells.
    points: int = 1 << 13
    pairs: int = 1 << 17
    entries: int = 1 << 14


_TUNING = LocationTuning()
# Result for a point whose triangle floating point cannot determine.
_UNDECIDED = -2


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
        for start in range(0, len(points), _TUNING.points):
            here = points[start : start + _TUNING.points]
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
        for start in range(0, len(points), _TUNING.points):
            chunk = slice(start, start + _TUNING.points)
            weights[chunk] = self._weights(points[chunk], triangle[chunk])
        return weights

    def _decide(self, points: FloatArray, begin: IntArray, end: IntArray) -> IntArray:
        """Compute the result of `find` for points that floating point cannot decide."""
        found = np.full(len(points), -1, dtype=np.int64)
        for point, entry in enumerate_ranges(begin, end, _TUNING.pairs):
            triangle = self._grid.listed[entry].astype(np.int64)
            # Candidates of a point ascend. Writing them backwards leaves the smallest.
            hits = np.flatnonzero(self._contain(points, point, triangle))[::-1]
            found[point[hits]] = triangle[hits]
        return found

    def _contain(self, points: FloatArray, point: IntArray, triangle: IntArray) -> BoolArray:
        """Whether each closed triangle contains the point paired with it."""
        lowest = _lowest_determinants(np.ldexp(points, self._exponent)[point], self._rows.take(triangle, axis=0))
        contain: BoolArray = lowest > _TUNING.unsure
        unsure = np.flatnonzero(np.abs(lowest) <= _TUNING.unsure)
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
        error = _TUNING.relative * (np.abs(left) + np.abs(right)).max(axis=0) + _TUNING.underflow
        inaccurate = np.flatnonzero((error > _TUNING.max_error * area.sum(axis=0)) | (area.min(axis=0) <= error))
        if inaccurate.size:
            area[:, inaccurate] = _accurate_areas(points[inaccurate], self._corners[triangle[inaccurate]])
        return (area / area.sum(axis=0)).T


@compiled
def sure_hits(
    points: FloatArray, begin: IntArray, end: IntArray, listed: NDArray[np.int32], rows: FloatArray, hits: IntArray
) -> None:
    """Fill in the first candidate of each point that is not surely outside, if it surely contains the point.

    Fill in -2 if this is not sure, and -1 if the point is surely outside all candidates. rows: corners (f, 6).
    """
    hits[:] = -1
    for point, entry in enumerate_ranges(begin, end, _TUNING.pairs):
        triangle = listed[entry]
        lowest = _lowest_determinants(points[point], rows.take(triangle, axis=0))
        possible = np.flatnonzero(lowest >= -_TUNING.unsure)[::-1]
        # Writing backwards leaves the first candidate.
        hits[point[possible]] = np.where(lowest > _TUNING.unsure, triangle, _UNDECIDED)[possible]


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


@dataclass(frozen=True)
class _GridLevel:
    """The cells made by one division, and their concatenated lists."""

    coordinates: IntArray  # (k, 2): coordinates of the cells
    length: IntArray  # (k,): length of each list
    triangle: IntArray  # (sum of lengths,): the lists, each ascending
    crowded: BoolArray  # (k,): whether a cell has all of the few triangles that the one had that it is a part of

    def empty_lists(self, cells: IntArray) -> _GridLevel:
        """Return the level with empty lists for the given cells."""
        kept = ~mark(self.length.size, cells)
        triangle = self.triangle[repeat_each(kept, self.length)]
        return _GridLevel(self.coordinates, np.where(kept, self.length, 0), triangle, self.crowded)


class NestedGrid:
    """Lists of counterclockwise triangles (f, 3, 2) in the box [0, 1]², by position.

    ``listed`` (m,) int32 has the triangles, list after list; each list is ascending.
    """

    # Length of a list above which a division of its cell is considered. The cell is divided in one of two cases:
    _LONG_LIST = 12
    # the lists of its parts together have at most this many times its own triangles,
    _MAX_GROWTH = 1.5
    # or the non-empty parts have on average at most this fraction of its own triangles.
    _MAX_FRACTION = 0.75
    # A part that keeps all triangles of its cell is not divided again if they are at most this many. Such triangles
    # usually share a corner and would crowd around it at any size.
    _MAX_CROWD = 48
    # Maximum total length of the lists per triangle of the mesh; limits the memory.
    _MAX_ENTRIES = 64
    # The same limit for the cells of the first grid.
    _FIRST_ENTRIES = 16
    # Initial list capacity per entry.
    _CAPACITY = 4

    def __init__(self, corners: FloatArray) -> None:
        corners = np.ascontiguousarray(corners)
        finest = _coordinates(corners)
        self._low, self._high = finest.min(axis=1), finest.max(axis=1)
        self._lines = _lines(corners)
        self._shift = shift = self._choose_shift()
        columns, lines = (int(m) + 1 for m in self._high.max(axis=0) >> shift)
        self._columns = columns
        every = np.arange(len(corners))
        level = self._divide(every, np.zeros_like(every), np.zeros((1, 2), np.int64), columns, lines, shift)
        levels, parts, cell_count = [level], [np.full(level.length.size, -1, dtype=np.int64)], level.length.size
        capacity = self._MAX_ENTRIES * len(corners) + 1000 - level.triangle.size
        while shift >= 2:
            shift -= 2
            split, finer = self._refine(level, shift, capacity)
            if not split.size:
                break
            parts[-1][split] = cell_count + 16 * np.arange(split.size)
            levels[-1] = level.empty_lists(split)
            levels.append(finer)
            parts.append(np.full(finer.length.size, -1, dtype=np.int64))
            cell_count += finer.length.size
            capacity -= finer.triangle.size + levels[-2].triangle.size - level.triangle.size
            level = finer
        del self._low, self._high, self._lines
        # Cells are numbered level after level. ``_begin`` has the start of each cell's list. ``_parts`` has the first
        # of the 16 parts of a cell, in row order, or -1.
        self.listed = np.concatenate([level.triangle for level in levels]).astype(np.int32)
        self._begin = np.concatenate([[0], np.cumsum(np.concatenate([level.length for level in levels]))])
        self._parts = np.concatenate(parts)

    def lists(self, points: FloatArray) -> tuple[IntArray, IntArray]:
        """Return where the list of triangles that may contain each point (k, 2) begins and ends in ``listed``.

        Points and corners must have been scaled by the same monotonic arithmetic, so that rounding does not separate a
        point from its triangle.
        """
        cell = np.empty(len(points), dtype=np.int64)
        find_cells(np.ascontiguousarray(points), self._columns, self._shift, self._parts, cell)
        return self._begin[cell], self._begin[cell + 1]

    def _choose_shift(self) -> int:
        """Number of halvings from the first grid's cells to the finest cells."""
        f = len(self._low)
        shift = max(_TUNING.bits - (f.bit_length() + 1) // 2, 0)
        while True:
            reach = (self._high >> shift) - (self._low >> shift) + 1
            # Long triangles oblique to the grid meet many cells; then use a coarser first grid.
            if int((reach[:, 0] * reach[:, 1]).sum()) <= self._FIRST_ENTRIES * f or shift >= _TUNING.bits:
                return shift
            shift += 1

    def _refine(self, level: _GridLevel, shift: int, capacity: int) -> tuple[IntArray, _GridLevel]:
        """Choose the cells of a level to divide; return them with their parts, of at most ``capacity`` entries."""
        split = np.flatnonzero((level.length > self._LONG_LIST) & ~level.crowded)
        number = invert_indices(level.length.size, split)
        parent = repeat_each(number, level.length)
        concerned = np.flatnonzero(parent >= 0)
        finer = self._divide(level.triangle[concerned], parent[concerned], 4 * level.coordinates[split], 4, 4, shift)
        parts = finer.length.reshape(-1, 16)
        before, after = level.length[split], parts.sum(axis=1)
        # Divisions around a corner where triangles crowd do not shorten the lists at first, but add few entries.
        chosen = (after <= self._MAX_GROWTH * before) | (after <= self._MAX_FRACTION * before * (parts > 0).sum(axis=1))
        # Divide the cells with the longest lists first.
        order = np.argsort(-before, kind="stable")
        more = np.cumsum(np.where(chosen, after - before, 0)[order])
        chosen[order[more > capacity]] = False
        part = np.repeat(chosen, 16)
        entry = repeat_each(part, finer.length)
        crowded = ((parts == before[:, None]) & (before <= self._MAX_CROWD)[:, None])[chosen].ravel()
        return split[chosen], _GridLevel(finer.coordinates[part], finer.length[part], finer.triangle[entry], crowded)

    def _divide(
        self, triangle: IntArray, parent: IntArray, corner: IntArray, columns: int, lines: int, shift: int
    ) -> _GridLevel:
        """Divide cells into grids of ``columns`` × ``lines``.

        ``triangle`` and ``parent`` (e,) are the entries of the lists of cells, and the cell of each entry; they are
        sorted by cell, then by triangle. ``corner`` (k, 2) has the coordinates of the first part of each cell.
        """
        size = len(corner) * columns * lines
        length, capacity = np.empty(size, dtype=np.int64), self._CAPACITY * triangle.size
        while True:
            listed = np.empty(capacity, dtype=np.int64)
            capacity = divide_cells(
                self._low, self._high, *self._lines, triangle, parent, corner, columns, lines, shift, length, listed
            )
            if capacity <= listed.size:
                break
        inner = np.indices((lines, columns))[::-1].reshape(2, -1).T
        coordinates = (corner[:, None, :] + inner).reshape(-1, 2)
        return _GridLevel(coordinates, length, listed[:capacity], np.zeros(size, dtype=np.bool_))


@compiled
def find_cells(points: FloatArray, columns: int, shift: int, parts: IntArray, cell: IntArray) -> None:
    """Fill in the cell number (k,) of each point of the unit box."""
    x, y = _coordinates(points).T
    cell[:] = (y >> shift) * columns + (x >> shift)
    deeper = np.flatnonzero(parts[cell] >= 0)
    while deeper.size:
        shift -= 2
        part = (((y[deeper] >> shift) & 3) << 2) | ((x[deeper] >> shift) & 3)
        cell[deeper] = parts[cell[deeper]] + part
        deeper = deeper[parts[cell[deeper]] >= 0]


@compiled
def divide_cells(
    low: IntArray,
    high: IntArray,
    nx: FloatArray,
    ny: FloatArray,
    offset: FloatArray,
    triangle: IntArray,
    parent: IntArray,
    corner: IntArray,
    columns: int,
    lines: int,
    shift: int,
    length: IntArray,
    listed: IntArray,
) -> int:
    """Fill in the lists of the parts of cells, and their lengths; return the total length.

    If the lists do not fit into ``listed``, only fill in the lengths. low, high: finest cells between which each
    triangle lies (f, 2); nx, ny, offset: as returned by `_lines`; others as in `NestedGrid._divide`.
    """
    from scipy.sparse import csr_array

    cells, counts = [np.empty(0, dtype=np.int64)], [np.zeros(1, dtype=np.int64)]
    for start in range(0, triangle.size, _TUNING.entries):
        t, p = triangle[start : start + _TUNING.entries], parent[start : start + _TUNING.entries]
        first = np.maximum(low[t] >> shift, corner[p])
        last = np.minimum(high[t] >> shift, corner[p] + [columns - 1, lines - 1])
        wide, tall = (last - first + 1).T
        row, step = enumerate_each(wide * tall)
        across = wide[row]
        down = step // across
        x, y = first[row, 0] + step - down * across, first[row, 1] + down
        meets = _triangles_meet_cells(nx[t], ny[t], offset[t], row, x, y, shift)
        row, x, y = row[meets], x[meets], y[meets]
        owner = p[row]
        cells.append((owner * lines + y - corner[owner, 1]) * columns + x - corner[owner, 0])
        counts.append(np.bincount(row, minlength=t.size))
    # Converting the sparse matrix of entries and cells to columns sorts by cell and keeps the order of the entries.
    where = np.concatenate(cells)
    table = (np.ones(where.size, dtype=np.int8), where, np.cumsum(np.concatenate(counts)))
    turned = csr_array(table, shape=(triangle.size, length.size)).tocsc()
    length[:] = np.diff(turned.indptr)
    if where.size <= listed.size:
        listed[: where.size] = triangle[turned.indices]
    return where.size


def _lines(corners: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Lines through the edges of triangles, to find the cells outside of them; (f, 3) each.

    A point is to the left of an edge where ``x nx + y ny`` exceeds the offset.
    """
    tail, head = corners, np.roll(corners, -1, axis=1)
    nx, ny = tail[..., 1] - head[..., 1], head[..., 0] - tail[..., 0]
    return nx, ny, nx * tail[..., 0] + ny * tail[..., 1]


def _triangles_meet_cells(
    nx: FloatArray, ny: FloatArray, offset: FloatArray, row: IntArray, x: IntArray, y: IntArray, shift: int
) -> BoolArray:
    """Whether triangles, given by row, meet cells that their boxes meet; True if in doubt."""
    size = 2.0 ** (shift - _TUNING.bits)
    middle_x, middle_y = (x + 0.5) * size, (y + 0.5) * size
    reach = offset - (0.5 * size + _TUNING.margin) * (np.abs(nx) + np.abs(ny)) - _TUNING.underflow_margin
    meets = np.ones(row.size, dtype=np.bool_)
    for i in range(3):
        meets &= middle_x * nx[row, i] + middle_y * ny[row, i] >= reach[row, i]
    return meets


def _coordinates(points: FloatArray) -> IntArray:
    """Coordinates of the finest cells that contain points of the unit box."""
    return np.minimum((points * 2.0**_TUNING.bits).astype(np.int64), 2**_TUNING.bits - 1)
