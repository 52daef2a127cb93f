"""Tables of numbers in a file, as text or as bytes, and where they stand.

What knows where each number stands can put others in their places and leave every other byte alone.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from quasiharmonic.util.arrays import FloatArray, IntArray


@dataclass(frozen=True, eq=False)
class Table:
    """Numbers and where they stand.

    Attributes
    ----------
    values : (m, k) array
        In the file's own precision and byte order.
    start : (m, k) int64
        The first byte of each, row after row ascending.
    end : (m, k) int64 or None
        Behind the last byte of each; None where they are not text.
    """

    values: NDArray[Any]
    start: IntArray
    end: IntArray | None


class TableReader:
    """Reads tables one after another.

    Parameters
    ----------
    data : bytes
        The file.
    position : int
        Where to begin.
    end : int
        Where to end.
    order : {"<", ">"} or None
        Byte order; None for text.

    Attributes
    ----------
    position : int
        The next byte.
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
        """Whether numbers are text."""
        return self._order is None

    def line(self) -> bytes:
        """The rest of the line, or b"" at the end."""
        stop = self.data.find(b"\n", self.position, self._end)
        stop = self._end if stop < 0 else stop
        found = self.data[self.position : stop]
        self.position = min(stop + 1, self._end)
        return found.strip()

    def words(self) -> list[bytes]:
        """The words of the next line that has any; none at the end."""
        while self.position < self._end:
            found = self.line().split()
            if found:
                return found
        return []

    def take(self, kind: str, count: int) -> NDArray[Any]:
        """The next numbers; (count,).

        Parameters
        ----------
        kind : str
            A NumPy type code without byte order, such as ``"f8"``.
        count : int
        """
        return self.tables(count, (kind, 1))[0].values[:, 0]

    def skip(self, kind: str, count: int) -> None:
        """Go past numbers without looking at them."""
        if self._order is None:
            if not count:
                return
            last = int(np.searchsorted(self._starts, self.position)) + count - 1
            if last >= len(self._ends):
                raise ValueError("it ends too early")
            self.position = int(self._ends[last])
        else:
            self.position += count * np.dtype(kind).itemsize
            if self.position > self._end:
                raise ValueError("it ends too early")

    def tables(self, rows: int, *columns: tuple[str, int]) -> list[Table]:
        """The next rows, each of some columns of one kind and then some of others.

        Raises
        ------
        ValueError
            When the file ends before, or what stands there is no number.
        """
        if rows < 0 or any(count < 1 for _, count in columns):
            raise ValueError("a count is negative or too small")
        if self._order is None:
            return self._words(rows, columns)
        row = np.dtype([(str(i), self._order + kind, (count,)) for i, (kind, count) in enumerate(columns)])
        if self.position + rows * row.itemsize > self._end:
            raise ValueError("it ends too early")
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
        if last > len(self._starts):
            raise ValueError("it ends too early")
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
                # Through double, as readers do.
                numbers = text[:, here].astype(np.float64 if kind[0] == "f" else np.int64).astype(kind)
            found.append(Table(numbers, starts[:, here], ends[:, here]))
            column += count
        return found


def stacked(tables: Sequence[Table], columns: int) -> Table:
    """Tables one below the other, the first columns of each."""
    ends = [table.end[:, :columns] for table in tables if table.end is not None]
    return Table(
        # Concatenating alone would lose the byte order.
        np.concatenate([table.values[:, :columns] for table in tables]).astype(tables[0].values.dtype),
        np.concatenate([table.start[:, :columns] for table in tables]),
        np.concatenate(ends) if ends else None,
    )


def replaced(data: bytes, table: Table, values: FloatArray) -> bytes:
    """The file with other numbers in a table; those that are equal stay as they are written.

    Parameters
    ----------
    data : bytes
        The file.
    table : Table
    values : (m, j) float64
        For the first columns of the table. Text gets the fewest digits that tell the number from its neighbours in
        the table's precision.
    """
    columns = values.shape[1]
    with np.errstate(over="ignore"):
        new = values.astype(table.values.dtype)
    changed = new != table.values[:, :columns]
    start = table.start[:, :columns][changed]
    if table.end is None:
        whole = np.frombuffer(data, dtype=np.uint8).copy()
        whole[start[:, None] + np.arange(new.itemsize)] = new[changed].view(np.uint8).reshape(-1, new.itemsize)
        return whole.tobytes()
    pieces, at = [], 0
    texts = map(str, new[changed].tolist() if new.itemsize == 8 else new[changed])
    for begin, end, text in zip(start.tolist(), table.end[:, :columns][changed].tolist(), texts, strict=True):
        pieces += [data[at:begin], text.encode()]
        at = end
    return b"".join([*pieces, data[at:]])
