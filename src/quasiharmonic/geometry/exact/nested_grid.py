"""A nested grid on the unit box: lists of the triangles near every position.

The first grid has about as many cells as there are triangles. Each cell lists the triangles that meet it. A cell with a
long list is divided into 4 × 4 parts, recursively. So the lists are short even if the sizes of triangles differ by many
orders of magnitude::

    +-------+-------+-------+
    |       |+-+-+-+|       |      point ──▶ cell ──▶ one of its 4 × 4 parts, if divided ──▶ … ──▶ list of triangles
    |   ·   |+-+-+-+|       |
    |       |+-+-+-+|       |
    +-------+-------+-------+
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from quasiharmonic.util.arrays import BoolArray, FloatArray, IntArray, enumerate_each, invert_indices, mark, repeat_each
from quasiharmonic.util.kernels import compiled

# Finest cells have integer coordinates below 2 to this power. A cell ``s`` halvings coarser has these coordinates
# shifted by ``s`` bits.
_BITS = 40
# Length of a list above which a division of its cell is considered. The cell is divided in one of two cases:
_LONG_LIST = 12
# the lists of its parts together have at most this many times its own triangles,
_MAX_GROWTH = 1.5
# or the non-empty parts have on average at most this fraction of its own triangles.
_MAX_FRACTION = 0.75
# A part that keeps all triangles of its cell is not divided again if they are at most this many. Such triangles usually
# share a corner and would crowd around it at any size.
_MAX_CROWD = 48
# Maximum total length of the lists per triangle of the mesh; limits the memory.
_MAX_ENTRIES = 64
# The same limit for the cells of the first grid.
_FIRST_ENTRIES = 16
# A cell beyond an edge's line by more than this, in the unit box, is outside in spite of rounding.
_MARGIN = 2.0**-48
# Additional margin for products that underflow.
_UNDERFLOW_MARGIN = 2.0**-1000
# Entries spread over cells per block, so that the data stay in the cache.
_ENTRIES_PER_BLOCK = 1 << 14
# Initial list capacity per entry.
_CAPACITY = 4


@dataclass(frozen=True)
class _GridLevel:
    """The cells made by one division, and their concatenated lists."""

    coordinates: IntArray
    """(k, 2) Coordinates of the cells."""
    length: IntArray
    """(k,) Length of each list."""
    triangle: IntArray
    """(sum of lengths,) The lists, each ascending."""
    crowded: BoolArray
    """(k,) Whether a cell has all of the few triangles that the one had that it is a part of."""

    def without(self, cells: IntArray) -> _GridLevel:
        """Return the level with empty lists for the given cells."""
        kept = ~mark(self.length.size, cells)
        triangle = self.triangle[repeat_each(kept, self.length)]
        return _GridLevel(self.coordinates, np.where(kept, self.length, 0), triangle, self.crowded)


class NestedGrid:
    """Lists of counterclockwise triangles (f, 3, 2) in the box [0, 1]², by position.

    ``listed`` (m,) int32 has the triangles, list after list; each list is ascending.
    """

    def __init__(self, corners: FloatArray) -> None:
        corners = np.ascontiguousarray(corners)
        finest = _coordinates(corners)
        self._low, self._high = finest.min(axis=1), finest.max(axis=1)
        self._lines = _lines(corners)
        self._shift = shift = self._choose_shift()
        columns, lines = (int(m) + 1 for m in self._high.max(axis=0) >> shift)
        self._columns = columns
        all_triangles = np.arange(len(corners))
        level = self._divide(
            all_triangles, np.zeros_like(all_triangles), np.zeros((1, 2), np.int64), columns, lines, shift
        )
        levels, parts, cell_count = [level], [np.full(level.length.size, -1, dtype=np.int64)], level.length.size
        capacity = _MAX_ENTRIES * len(corners) + 1000 - level.triangle.size
        while shift >= 2:
            shift -= 2
            split, finer = self._refine(level, shift, capacity)
            if not split.size:
                break
            parts[-1][split] = cell_count + 16 * np.arange(split.size)
            levels[-1] = level.without(split)
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
        shift = max(_BITS - (f.bit_length() + 1) // 2, 0)
        while True:
            reach = (self._high >> shift) - (self._low >> shift) + 1
            # Long triangles oblique to the grid meet many cells; then use a coarser first grid.
            if int((reach[:, 0] * reach[:, 1]).sum()) <= _FIRST_ENTRIES * f or shift >= _BITS:
                return shift
            shift += 1

    def _refine(self, level: _GridLevel, shift: int, capacity: int) -> tuple[IntArray, _GridLevel]:
        """Choose the cells of a level to divide; return them with their parts, of at most ``capacity`` entries."""
        split = np.flatnonzero((level.length > _LONG_LIST) & ~level.crowded)
        number = invert_indices(level.length.size, split)
        parent = repeat_each(number, level.length)
        concerned = np.flatnonzero(parent >= 0)
        finer = self._divide(level.triangle[concerned], parent[concerned], 4 * level.coordinates[split], 4, 4, shift)
        parts = finer.length.reshape(-1, 16)
        before, after = level.length[split], parts.sum(axis=1)
        # Divisions around a corner where triangles crowd do not shorten the lists at first, but add few entries.
        chosen = (after <= _MAX_GROWTH * before) | (after <= _MAX_FRACTION * before * (parts > 0).sum(axis=1))
        # Divide the cells with the longest lists first.
        order = np.argsort(-before, kind="stable")
        more = np.cumsum(np.where(chosen, after - before, 0)[order])
        chosen[order[more > capacity]] = False
        part = np.repeat(chosen, 16)
        entry = repeat_each(part, finer.length)
        crowded = ((parts == before[:, None]) & (before <= _MAX_CROWD)[:, None])[chosen].ravel()
        return split[chosen], _GridLevel(finer.coordinates[part], finer.length[part], finer.triangle[entry], crowded)

    def _divide(
        self, triangle: IntArray, parent: IntArray, corner: IntArray, columns: int, lines: int, shift: int
    ) -> _GridLevel:
        """Divide cells into grids of ``columns`` × ``lines``.

        ``triangle`` and ``parent`` (e,) are the entries of the lists of cells, and the cell of each entry; they are
        sorted by cell, then by triangle. ``corner`` (k, 2) has the coordinates of the first part of each cell.
        """
        size = len(corner) * columns * lines
        length, capacity = np.empty(size, dtype=np.int64), _CAPACITY * triangle.size
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
    for start in range(0, triangle.size, _ENTRIES_PER_BLOCK):
        t, p = triangle[start : start + _ENTRIES_PER_BLOCK], parent[start : start + _ENTRIES_PER_BLOCK]
        first = np.maximum(low[t] >> shift, corner[p])
        last = np.minimum(high[t] >> shift, corner[p] + [columns - 1, lines - 1])
        wide, tall = (last - first + 1).T
        row, step = enumerate_each(wide * tall)
        across = wide[row]
        down = step // across
        x, y = first[row, 0] + step - down * across, first[row, 1] + down
        meets = _meet(nx[t], ny[t], offset[t], row, x, y, shift)
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


def _meet(
    nx: FloatArray, ny: FloatArray, offset: FloatArray, row: IntArray, x: IntArray, y: IntArray, shift: int
) -> BoolArray:
    """Whether triangles, given by row, meet cells that their boxes meet; True if in doubt."""
    size = 2.0 ** (shift - _BITS)
    middle_x, middle_y = (x + 0.5) * size, (y + 0.5) * size
    reach = offset - (0.5 * size + _MARGIN) * (np.abs(nx) + np.abs(ny)) - _UNDERFLOW_MARGIN
    meets = np.ones(row.size, dtype=np.bool_)
    for i in range(3):
        meets &= middle_x * nx[row, i] + middle_y * ny[row, i] >= reach[row, i]
    return meets


def _coordinates(points: FloatArray) -> IntArray:
    """Coordinates of the finest cells that contain points of the unit box."""
    return np.minimum((points * 2.0**_BITS).astype(np.int64), 2**_BITS - 1)
