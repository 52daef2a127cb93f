"""What the readers of finite-element files share: `MeshParts`, which they return, tables of numbers, and VTK's cells.

A table has the byte position of each number of a file, text or binary. With these positions, numbers can be replaced
without changing any other byte. In VTK's formats, cells are a concatenated list of points, and a kind for each cell.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from quasiharmonic.geometry.mesh.elements import join_elements, join_solids
from quasiharmonic.io.untrusted import check_end
from quasiharmonic.util.arrays import FloatArray, IntArray

#: Arrays of points or cells by name; each callable returns (n, k) values.
Fields = Mapping[str, Callable[[], FloatArray]]

#: Kinds without area: vertices, lines, lists of them, and second-order lines.
_POINTS_AND_LINES = (1, 2, 3, 4, 21)
# Number of nodes of the kinds that are elements. Polygons of three or four corners are elements too.
_ELEMENTS = {5: 3, 9: 4, 22: 6}
_POLYGON = 7
# The same for meshes in space, and the kinds with area that these meshes may have on their boundary.
_SOLIDS = {10: 4, 12: 8}
_SURFACES = (5, 6, 7, 8, 9, 22, 23, 28)
#: What can be used instead of other cells, in the plane and in space.
SUPPORTED = "triangles of three or six nodes or quadrilaterals", "tetrahedra of four nodes or hexahedra of eight"
# Maximum number of different values of an array that defines sets.
_MAX_SETS = 1000
_NAMES = {
    6: "triangle strip",
    8: "pixel",
    10: "tetrahedron",
    11: "voxel",
    12: "hexahedron",
    13: "wedge",
    14: "pyramid",
    23: "second-order quadrilateral",
    24: "second-order tetrahedron",
    25: "second-order hexahedron",
}


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


def find_counts(numbers: IntArray) -> IntArray | None:
    """Return the indices of the counts in a list (count, points, count, …); None for other numbers."""
    step = int(numbers[0]) + 1 if len(numbers) else 0
    if step > 0 and len(numbers) % step == 0 and (numbers[::step] == step - 1).all():
        return np.arange(0, len(numbers), step)
    found, at, values = [], 0, numbers.tolist()
    while at < len(values):
        if values[at] < 0:
            return None
        found.append(at)
        at += 1 + values[at]
    return np.array(found, dtype=np.int64) if at == len(values) else None


def find_sets(points: Fields, cells: Fields, connectivity: IntArray, starts: IntArray) -> dict[str, IntArray]:
    """Return the sets of points that arrays of integers at points or cells define.

    ``NAME`` has the points, or the points of the cells, where the array NAME is not zero, ``NAME=VALUE`` those where it
    has this value. Arrays of more than `_MAX_SETS` values define none.
    """
    sets: dict[str, IntArray] = {}
    for fields, of_cells in ((points, False), (cells, True)):
        for name, find in fields.items():
            values = find()
            if values.shape[1] != 1 or not len(values) or (values != np.rint(values)).any():
                continue
            values = values[:, 0]
            nodes = np.arange(len(values))
            if of_cells:
                nodes, values = connectivity[: starts[-1]], np.repeat(values, np.diff(starts))
            found = np.unique(values)
            if len(found) <= _MAX_SETS:
                sets[name] = np.unique(nodes[values != 0])
                sets |= {f"{name}={value:.0f}": np.unique(nodes[values == value]) for value in found}
    return sets


def select_elements(
    connectivity: IntArray, starts: IntArray, kinds: IntArray, points: int, solid: bool = False
) -> IntArray:
    """Return the triangles and quadrilaterals; (f, 3), (f, 4) or (f, 6) int64, as in `geometry.mesh.elements`.

    ``connectivity`` (m,) has the points of all cells, one cell after another. Cell i begins at ``starts[i]``, and
    ``kinds[i]`` is VTK's kind of it. A polygon with three corners is a triangle, one with four a quadrilateral.
    ValueError for a cell with area of another kind, six-node triangles with other elements, or a point out of range. If
    ``solid``, return the tetrahedra and hexahedra instead (`MeshParts.F`), and skip cells without volume.
    """
    if len(starts) != len(kinds) + 1 or (np.diff(starts) < 0).any() or starts[-1] > len(connectivity):
        raise ValueError("its lists of cells contradict each other")
    sizes = np.diff(starts)
    wanted = (kinds == _POLYGON) & np.isin(sizes, (3, 4)) & (not solid)
    for kind, size in (_SOLIDS if solid else _ELEMENTS).items():
        wanted |= (kinds == kind) & (sizes == size)
    skipped = (*_POINTS_AND_LINES, *(_SURFACES if solid else ()))
    other = np.unique(kinds[~wanted & ~np.isin(kinds, skipped)])
    if other.size:
        names = (_NAMES.get(kind, "polygon" if kind == _POLYGON else f"number {kind}") for kind in other.tolist())
        raise ValueError(f"cells of type {', '.join(names)} are not supported: use {SUPPORTED[solid]}")
    begins, sizes = starts[:-1][wanted], sizes[wanted]
    changes = np.flatnonzero(np.diff(sizes)) + 1
    F = (join_solids if solid else join_elements)(
        [
            connectivity[block[:, None] + np.arange(size[0])]
            for block, size in zip(np.split(begins, changes), np.split(sizes, changes), strict=True)
            if len(block)
        ]
    )
    if F.size and (F.min() < 0 or F.max() >= points):
        wrong = F.min() if F.min() < 0 else F.max()
        raise ValueError(f"an element refers to point {wrong}, but there are {points}")
    return F
