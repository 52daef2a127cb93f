"""Tables of numbers in a file, text or binary, with the byte position of each number.

With these positions, numbers can be replaced without changing any other byte.
`MeshParts`, the common result of the finite-element readers, consists of such tables.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from quasiharmonic.util.arrays import FloatArray, IntArray
from quasiharmonic.util.untrusted import check_end


@dataclass(frozen=True, eq=False)
class Table:
    """Numbers and their byte positions."""

    values: NDArray[Any]  # (m, k): the numbers, in the file's own precision and byte order
    start: IntArray  # (m, k): the first byte of each number, ascending row by row
    end: IntArray | None  # (m, k): the byte after each number; None in binary files


class TableReader:
    """Reads tables one after another, from the byte ``position`` of a file, which advances, to the byte ``end``.

    ``order`` is the byte order, "<" or ">"; None for text.
    """

    def __init__(self, data: bytes, position: int, end: int, order: str | None) -> None:
        self.data, self.position, self._end, self._order = data, position, end, order
        if order is None:
            gap = np.frombuffer(data, dtype=np.uint8, count=end - position, offset=position) <= ord(" ")
            edge = np.diff(np.concatenate([[True], gap, [True]]).astype(np.int8))
            self._starts = np.flatnonzero(edge == -1) + position
            self._ends = np.flatnonzero(edge == 1) + position

    @property
    def text(self) -> bool:
        """Whether the numbers are text."""
        return self._order is None

    def line(self) -> bytes:
        """Return the rest of the line, or b"" at the end."""
        stop = self.data.find(b"\n", self.position, self._end)
        stop = self._end if stop < 0 else stop
        found = self.data[self.position : stop]
        self.position = min(stop + 1, self._end)
        return found.strip()

    def words(self) -> list[bytes]:
        """Return the words of the next non-empty line, or an empty list at the end."""
        while self.position < self._end:
            found = self.line().split()
            if found:
                return found
        return []

    def take(self, kind: str, count: int) -> NDArray[Any]:
        """Return the next numbers, (count,); ``kind`` is a NumPy type code without byte order, such as ``"f8"``."""
        return self.tables(count, (kind, 1))[0].values[:, 0]

    def skip(self, kind: str, count: int) -> None:
        """Skip numbers without parsing them."""
        if self._order is None:
            if not count:
                return
            end = int(np.searchsorted(self._starts, self.position)) + count
            check_end(end, len(self._ends))
            self.position = int(self._ends[end - 1])
        else:
            self.position += count * np.dtype(kind).itemsize
            check_end(self.position, self._end)

    def tables(self, rows: int, *columns: tuple[str, int]) -> list[Table]:
        """Return the next rows as a table for each group of columns, given by its type code and number of columns.

        Raise a ValueError if the file ends before, or contains anything but numbers there.
        """
        if rows < 0 or any(count < 1 for _, count in columns):
            raise ValueError("a count is negative or too small")
        if self._order is None:
            return self._words(rows, columns)
        row = np.dtype([(str(i), self._order + kind, (count,)) for i, (kind, count) in enumerate(columns)])
        check_end(self.position + rows * row.itemsize, self._end)
        block = np.frombuffer(self.data, row, rows, self.position)
        begin = self.position + row.itemsize * np.arange(rows, dtype=np.int64)[:, None]
        self.position += rows * row.itemsize
        found = []
        offset = 0
        for i, (kind, count) in enumerate(columns):
            size = np.dtype(kind).itemsize
            found.append(Table(block[str(i)], begin + offset + size * np.arange(count), None))
            offset += count * size
        return found

    def _words(self, rows: int, columns: Sequence[tuple[str, int]]) -> list[Table]:
        width = sum(count for _, count in columns)
        first = int(np.searchsorted(self._starts, self.position))
        last = first + rows * width
        check_end(last, len(self._starts))
        starts, ends = (every[first:last].reshape(rows, width) for every in (self._starts, self._ends))
        if last > first:
            text = np.array(self.data[starts[0, 0] : ends[-1, -1]].split(), dtype=np.bytes_).reshape(rows, width)
            self.position = int(ends[-1, -1])
        else:
            text = np.empty((0, width), dtype=np.bytes_)
        found, column = [], 0
        for kind, count in columns:
            here = slice(column, column + count)
            with np.errstate(over="ignore"):
                # Convert to double first, as other readers do.
                numbers = text[:, here].astype(np.float64 if kind[0] == "f" else np.int64).astype(kind)
            found.append(Table(numbers, starts[:, here], ends[:, here]))
            column += count
        return found


def stack_tables(tables: Sequence[Table], columns: int) -> Table:
    """Stack the first columns of tables vertically."""
    ends = [table.end[:, :columns] for table in tables if table.end is not None]
    return Table(
        # np.concatenate alone would lose the byte order.
        np.concatenate([table.values[:, :columns] for table in tables]).astype(tables[0].values.dtype),
        np.concatenate([table.start[:, :columns] for table in tables]),
        np.concatenate(ends) if ends else None,
    )


def replace_numbers(data: bytes, table: Table, values: FloatArray) -> bytes:
    """Return the file with new numbers (m, j) in the first columns of a table; equal numbers keep their bytes.

    Text gets the shortest decimals that are unique in the table's precision.
    """
    columns = values.shape[1]
    with np.errstate(over="ignore"):
        new = values.astype(table.values.dtype)
    changed = new != table.values[:, :columns]
    start = table.start[:, :columns][changed]
    if table.end is None:
        changed_bytes = np.frombuffer(data, dtype=np.uint8).copy()
        changed_bytes[start[:, None] + np.arange(new.itemsize)] = new[changed].view(np.uint8).reshape(-1, new.itemsize)
        return changed_bytes.tobytes()
    pieces, at = [], 0
    texts = map(str, new[changed].tolist() if new.itemsize == 8 else new[changed])
    for begin, end, text in zip(start.tolist(), table.end[:, :columns][changed].tolist(), texts, strict=True):
        pieces += [data[at:begin], text.encode()]
        at = end
    return b"".join([*pieces, data[at:]])


@dataclass(frozen=True, eq=False)
class MeshParts:
    """Positions and elements of a file, and a function that changes only the positions."""

    points: FloatArray  # (n, 3): positions, converted to double
    # (f, 3), (f, 4) or (f, 6): elements in the format of `geometry.mesh.elements`. Of a mesh in space (t, 4) or (t, 8):
    # tetrahedra and hexahedra; a tetrahedron among hexahedra repeats its last node.
    F: IntArray
    precision: np.dtype[np.floating]  # Precision of the positions in the file
    # Each callable returns values at all points, (n, k) float64, NaN at points without value. It raises `ValueError`
    # if the data are damaged.
    fields: Mapping[str, Callable[[], FloatArray]]
    # Returns the bytes of the file with the first coordinates of its points replaced, by (n, 2) or (n, 3) float64
    replace_points: Callable[[FloatArray], bytes]
    # Returns the nodes of each named set of the file, ascending. It raises `ValueError` if the sets are damaged.
    find_sets: Callable[[], dict[str, IntArray]]
