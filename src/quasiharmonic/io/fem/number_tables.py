"""Read tables of numbers, text or binary, with the byte position of each number in the file.

With these positions, `replace_numbers` changes numbers without changing any other byte of the file.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from quasiharmonic.io.untrusted import check_end
from quasiharmonic.util.arrays import FloatArray, IntArray


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

    def read_line(self) -> bytes:
        """Return the rest of the line, or b"" at the end."""
        stop = self.data.find(b"\n", self.position, self._end)
        stop = self._end if stop < 0 else stop
        found = self.data[self.position : stop]
        self.position = min(stop + 1, self._end)
        return found.strip()

    def read_words(self) -> list[bytes]:
        """Return the words of the next non-empty line, or an empty list at the end."""
        while self.position < self._end:
            found = self.read_line().split()
            if found:
                return found
        return []

    def read_numbers(self, kind: str, count: int) -> NDArray[Any]:
        """Return the next numbers, (count,); ``kind`` is a NumPy type code without byte order, such as ``"f8"``."""
        return self.read_tables(count, (kind, 1))[0].values[:, 0]

    def skip_numbers(self, kind: str, count: int) -> None:
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

    def read_tables(self, rows: int, *columns: tuple[str, int]) -> list[Table]:
        """Return the next rows as a table for each group of columns, given by its type code and number of columns.

        Raise a ValueError if the file ends before, or contains anything but numbers there.
        """
        if rows < 0 or any(count < 1 for _, count in columns):
            raise ValueError("a count is negative or too small")
        if self._order is None:
            return self._read_text_tables(rows, columns)
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

    def _read_text_tables(self, rows: int, columns: Sequence[tuple[str, int]]) -> list[Table]:
        """Parse numbers in text; see `read_tables`."""
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
