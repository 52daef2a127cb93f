"""Lists of the triangles near every place of the unit box: a grid whose crowded cells are divided again.

The first grid has about as many cells as there are triangles, and each cell lists the triangles that meet it. A
cell with a long list is divided into 4 × 4, and those again, so that where triangles span many orders of magnitude
the lists are as short as in an even mesh::

    +-------+-------+-------+
    |       |+-+-+-+|       |      point ──▶ cell ──▶ its 4 × 4 parts, if it has any ──▶ … ──▶ list of triangles
    |   ·   |+-+-+-+|       |
    |       |+-+-+-+|       |
    +-------+-------+-------+
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from quasiharmonic.util.arrays import BoolArray, FloatArray, IntArray
from quasiharmonic.util.kernels import compiled

# The finest cells have integer coordinates below 2 to this power; a cell ``s`` levels of halving up has them
# shifted by ``s`` bits.
_BITS = 40
# Triangles in a cell's list from which on dividing the cell is considered. It is divided if one of two things holds:
_LONG = 12
# the lists of its parts have together no more than this many times its own triangles;
_MORE = 1.5
# or the parts that are not empty have on average no more than this fraction of its own.
_GAIN = 0.75
# A part that keeps all triangles of its cell is not divided once more if they are no more than this: they have a corner
# in common, as a rule, and would crowd around it however small the part.
_CROWD = 48
# Triangles in all lists together, for each triangle of the mesh, at most: the limit on memory.
_ENTRIES = 64
# The same for the cells of the first grid.
_AT_FIRST = 16
# A cell farther than this outside of an edge's line, in the unit box, is so whatever was rounded.
_MARGIN = 2.0**-48
# Added to it, so that this holds too where products underflow.
_TINY = 2.0**-1000
# Entries spread over cells at a time: what is in work stays in the cache. Room for their lists, for each of them.
_ROWS, _ROOM = 1 << 14, 4


@dataclass(frozen=True)
class _Level:
    """The cells that one division made, and their lists one after another."""

    place: IntArray
    """(k, 2) Coordinates of the cells."""
    length: IntArray
    """(k,) Length of each list."""
    triangle: IntArray
    """(sum of lengths,) The lists, each ascending."""
    crowded: BoolArray
    """(k,) Whether a cell has all of the few triangles that the one had that it is a part of."""

    def without(self, cells: IntArray) -> _Level:
        """The same cells with empty lists for some."""
        kept = np.ones(self.length.size, dtype=np.bool_)
        kept[cells] = False
        triangle = self.triangle[np.repeat(kept, self.length)]
        return _Level(self.place, np.where(kept, self.length, 0), triangle, self.crowded)


class NestedGrid:
    """Lists of triangles by place.

    Parameters
    ----------
    corners : (f, 3, 2) float64
        Counterclockwise triangles in the box [0, 1]².

    Attributes
    ----------
    listed : (m,) int32
        Triangles, list after list, each list ascending.
    """

    def __init__(self, corners: FloatArray) -> None:
        corners = np.ascontiguousarray(corners)
        finest = _coordinates(corners)
        self._low, self._high = finest.min(axis=1), finest.max(axis=1)
        self._lines = _lines(corners)
        self._shift = shift = self._first_shift()
        columns, lines = (int(m) + 1 for m in self._high.max(axis=0) >> shift)
        self._columns = columns
        everything = np.arange(len(corners))
        level = self._divided(everything, np.zeros_like(everything), np.zeros((1, 2), np.int64), columns, lines, shift)
        levels, parts, made = [level], [np.full(level.length.size, -1, dtype=np.int64)], level.length.size
        room = _ENTRIES * len(corners) + 1000 - level.triangle.size
        while shift >= 2:
            shift -= 2
            split, finer = self._refined(level, shift, room)
            if not split.size:
                break
            parts[-1][split] = made + 16 * np.arange(split.size)
            levels[-1] = level.without(split)
            levels.append(finer)
            parts.append(np.full(finer.length.size, -1, dtype=np.int64))
            made += finer.length.size
            room -= finer.triangle.size + levels[-2].triangle.size - level.triangle.size
            level = finer
        del self._low, self._high, self._lines
        # Cells are numbered level after level. Those of ``_begin`` are where their lists begin; ``_parts`` is the
        # first of 16 parts, row by row, or -1.
        self.listed = np.concatenate([level.triangle for level in levels]).astype(np.int32)
        self._begin = np.concatenate([[0], np.cumsum(np.concatenate([level.length for level in levels]))])
        self._parts = np.concatenate(parts)

    def lists(self, points: FloatArray) -> tuple[IntArray, IntArray]:
        """Where in ``listed`` the triangles are that may contain points of the unit box.

        The coordinates of points and corners must have been made by the same monotonic arithmetic: then no
        rounding parts a point from its triangle.

        Parameters
        ----------
        points : (k, 2) float64

        Returns
        -------
        begin, end : (k,) int64
        """
        cell = np.empty(len(points), dtype=np.int64)
        find_cells(np.ascontiguousarray(points), self._columns, self._shift, self._parts, cell)
        return self._begin[cell], self._begin[cell + 1]

    def _first_shift(self) -> int:
        """The size of the first grid's cells."""
        f = len(self._low)
        shift = max(_BITS - (f.bit_length() + 1) // 2, 0)
        while True:
            reach = (self._high >> shift) - (self._low >> shift) + 1
            # Long triangles across the grain of the grid meet many cells: then fewer must do at first.
            if int((reach[:, 0] * reach[:, 1]).sum()) <= _AT_FIRST * f or shift >= _BITS:
                return shift
            shift += 1

    def _refined(self, level: _Level, shift: int, room: int) -> tuple[IntArray, _Level]:
        """The cells of a level that should be divided, and their parts, ``room`` entries more at most."""
        split = np.flatnonzero((level.length > _LONG) & ~level.crowded)
        number = np.full(level.length.size, -1, dtype=np.int64)
        number[split] = np.arange(split.size)
        parent = np.repeat(number, level.length)
        concerned = np.flatnonzero(parent >= 0)
        finer = self._divided(level.triangle[concerned], parent[concerned], 4 * level.place[split], 4, 4, shift)
        parts = finer.length.reshape(-1, 16)
        before, after = level.length[split], parts.sum(axis=1)
        # Where triangles crowd in a corner of the cell, a few divisions bring nothing and cost nothing.
        chosen = (after <= _MORE * before) | (after <= _GAIN * before * (parts > 0).sum(axis=1))
        # The longest lists first.
        order = np.argsort(-before, kind="stable")
        more = np.cumsum(np.where(chosen, after - before, 0)[order])
        chosen[order[more > room]] = False
        part = np.repeat(chosen, 16)
        entry = np.repeat(part, finer.length)
        crowded = ((parts == before[:, None]) & (before <= _CROWD)[:, None])[chosen].ravel()
        return split[chosen], _Level(finer.place[part], finer.length[part], finer.triangle[entry], crowded)

    def _divided(
        self, triangle: IntArray, parent: IntArray, corner: IntArray, columns: int, lines: int, shift: int
    ) -> _Level:
        """Divide cells into grids of ``columns`` × ``lines``.

        Parameters
        ----------
        triangle, parent : (e,) int64
            Entries of the cells' lists, and which of the cells they are of; by cell, then by triangle.
        corner : (k, 2) int64
            Coordinates of each cell's first part.
        columns, lines, shift : int
        """
        size = len(corner) * columns * lines
        length, room = np.empty(size, dtype=np.int64), _ROOM * triangle.size
        while True:
            listed = np.empty(room, dtype=np.int64)
            room = divide_cells(
                self._low, self._high, *self._lines, triangle, parent, corner, columns, lines, shift, length, listed
            )
            if room <= listed.size:
                break
        inner = np.indices((lines, columns))[::-1].reshape(2, -1).T
        place = (corner[:, None, :] + inner).reshape(-1, 2)
        return _Level(place, length, listed[:room], np.zeros(size, dtype=np.bool_))


@compiled
def find_cells(points: FloatArray, columns: int, shift: int, parts: IntArray, cell: IntArray) -> None:
    """Fill in the numbers of the cells that points of the unit box lie in, (k,)."""
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
    """Fill in the lists of the parts of cells, and their lengths; how long they are together.

    Only the lengths where ``listed`` has no room for that. low, high: finest cells between which each triangle lies
    (f, 2); nx, ny, offset: as `_lines` has them; the others as of `NestedGrid._divided`.
    """
    from scipy.sparse import csr_array

    cells, counts = [np.empty(0, dtype=np.int64)], [np.zeros(1, dtype=np.int64)]
    for start in range(0, triangle.size, _ROWS):
        t, p = triangle[start : start + _ROWS], parent[start : start + _ROWS]
        first = np.maximum(low[t] >> shift, corner[p])
        last = np.minimum(high[t] >> shift, corner[p] + [columns - 1, lines - 1])
        wide, tall = (last - first + 1).T
        row = np.repeat(np.arange(t.size), wide * tall)
        step = np.arange(row.size) - np.repeat(np.cumsum(wide * tall) - wide * tall, wide * tall)
        across = wide[row]
        down = step // across
        x, y = first[row, 0] + step - down * across, first[row, 1] + down
        meets = _meet(nx[t], ny[t], offset[t], row, x, y, shift)
        row, x, y = row[meets], x[meets], y[meets]
        owner = p[row]
        cells.append((owner * lines + y - corner[owner, 1]) * columns + x - corner[owner, 0])
        counts.append(np.bincount(row, minlength=t.size))
    # Turning the table of entries and cells on its side sorts by cell and keeps the order of the entries.
    where = np.concatenate(cells)
    table = (np.ones(where.size, dtype=np.int8), where, np.cumsum(np.concatenate(counts)))
    turned = csr_array(table, shape=(triangle.size, length.size)).tocsc()
    length[:] = np.diff(turned.indptr)
    if where.size <= listed.size:
        listed[: where.size] = triangle[turned.indices]
    return where.size


def _lines(corners: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Lines through the edges of triangles, for telling which cells lie outside of them; (f, 3) each.

    A point is to the left of an edge where ``x nx + y ny`` exceeds the offset.
    """
    tail, head = corners, np.roll(corners, -1, axis=1)
    nx, ny = tail[..., 1] - head[..., 1], head[..., 0] - tail[..., 0]
    return nx, ny, nx * tail[..., 0] + ny * tail[..., 1]


def _meet(
    nx: FloatArray, ny: FloatArray, offset: FloatArray, row: IntArray, x: IntArray, y: IntArray, shift: int
) -> BoolArray:
    """Whether triangles, by row, meet cells that their boxes meet; if in doubt, they do."""
    size = 2.0 ** (shift - _BITS)
    middle_x, middle_y = (x + 0.5) * size, (y + 0.5) * size
    reach = offset - (0.5 * size + _MARGIN) * (np.abs(nx) + np.abs(ny)) - _TINY
    meets = np.ones(row.size, dtype=np.bool_)
    for i in range(3):
        meets &= middle_x * nx[row, i] + middle_y * ny[row, i] >= reach[row, i]
    return meets


def _coordinates(points: FloatArray) -> IntArray:
    """Coordinates of the finest cells that points of the unit box lie in."""
    return np.minimum((points * 2.0**_BITS).astype(np.int64), 2**_BITS - 1)
