"""VTK's legacy files, text and binary: unstructured grids and polygons, and data of points."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from urllib.parse import unquote_to_bytes

import numpy as np

from quasiharmonic.io.fem.mesh_parts import MeshParts, find_counts, find_sets_in_fields, select_elements
from quasiharmonic.io.fem.number_tables import Table, TableReader, replace_numbers
from quasiharmonic.util.arrays import FloatArray, IntArray

_KINDS = {
    b"char": "i1",
    b"signed_char": "i1",
    b"unsigned_char": "u1",
    b"short": "i2",
    b"unsigned_short": "u2",
    b"int": "i4",
    b"unsigned_int": "u4",
    b"long": "i8",
    b"unsigned_long": "u8",
    b"float": "f4",
    b"double": "f8",
    b"vtkidtype": "i4",
    **{f"vtktype{kind}{8 * n}".encode(): f"{kind[0]}{n}" for kind in ("int", "uint") for n in (1, 2, 4, 8)},
    b"vtktypefloat32": "f4",
    b"vtktypefloat64": "f8",
}
# Number of values per point of the attributes whose name determines it.
_COMPONENTS = {b"VECTORS": 3, b"NORMALS": 3, b"TENSORS": 9, b"TENSORS6": 6, b"GLOBAL_IDS": 1, b"PEDIGREE_IDS": 1}
# VTK's kinds of cells by section of a polygon data set.
_POLY = {b"VERTICES": 2, b"LINES": 4, b"POLYGONS": 7, b"TRIANGLE_STRIPS": 6}


def read_legacy_vtk(data: bytes, solid: bool = False) -> MeshParts:
    """Parse a legacy VTK file, with its tetrahedra and hexahedra if ``solid``.

    ValueError if the file is not legacy VTK, ends early, has other cells with area than triangles and quadrilaterals,
    or has an unknown section or type.
    """
    return _LegacyReader(data).parts(solid)


class _LegacyReader:
    """A parser that reads a file section by section."""

    def __init__(self, data: bytes) -> None:
        self._data = data
        head = TableReader(data, 0, len(data), ">")
        if not head.read_line().startswith(b"# vtk DataFile Version"):
            raise ValueError("it does not start like a legacy VTK file")
        head.read_line()
        coding = head.read_line().upper()
        if coding not in (b"ASCII", b"BINARY"):
            raise ValueError("its third line must be ASCII or BINARY")
        self._reader = TableReader(data, head.position, len(data), None if coding == b"ASCII" else ">")
        self._points: Table | None = None
        self._lists: list[tuple[IntArray, IntArray, int]] = []
        self._kinds: IntArray | None = None
        # Arrays at points, and at cells.
        self._fields: dict[bool, dict[str, Callable[[], FloatArray]]] = {True: {}, False: {}}
        # Whether the following arrays belong to points (True), cells (False) or neither (None), and their length.
        self._of_points: bool | None = None
        self._count = 0

    def parts(self, solid: bool) -> MeshParts:
        """Read all sections and return the mesh."""
        while words := self._reader.read_words():
            self._section(words[0].upper(), words[1:])
        if self._points is None:
            raise ValueError("there is no section POINTS")
        starts, connectivity = [np.zeros(1, dtype=np.int64)], [np.empty(0, dtype=np.int64)]
        for offsets, corners, _ in self._lists:
            starts.append(offsets[1:] + starts[-1][-1])
            connectivity.append(corners)
        lists = [np.full(len(offsets) - 1, kind) for offsets, _, kind in self._lists]
        kinds = self._kinds if self._kinds is not None else np.concatenate([np.empty(0, dtype=np.int64), *lists])
        place = self._points
        corners, begins = np.concatenate(connectivity), np.concatenate(starts)
        F = select_elements(corners, begins, kinds, len(place.values), solid)
        points = place.values.astype(np.float64)
        change = partial(replace_numbers, self._data, place)
        precision, fields = np.dtype(place.values.dtype.newbyteorder("=")), self._fields
        sets = partial(find_sets_in_fields, fields[True], fields[False], corners, begins)
        return MeshParts(points, F, precision, fields[True], change, sets)

    def _section(self, name: bytes, words: list[bytes]) -> None:
        reader = self._reader
        if name == b"DATASET":
            if words[:1] not in ([b"UNSTRUCTURED_GRID"], [b"POLYDATA"]):
                raise ValueError(f"its data set is {_text(words)}: save it as an unstructured grid or polygons")
        elif name == b"POINTS":
            kind = _KINDS.get(words[1].lower(), "")
            if kind not in ("f4", "f8"):
                raise ValueError(f"its positions are {_text(words[1:])}: save them as float or double")
            (self._points,) = reader.read_tables(int(words[0]), (kind, 3))
        elif name == b"CELLS" or name in _POLY:
            self._cells(int(words[0]), int(words[1]), _POLY.get(name, 0))
        elif name == b"CELL_TYPES":
            self._kinds = reader.read_numbers("i4", int(words[0])).astype(np.int64)
        elif name in (b"POINT_DATA", b"CELL_DATA"):
            self._of_points, self._count = name == b"POINT_DATA", int(words[0])
        elif name == b"METADATA":
            while reader.read_line():
                pass
        elif name == b"FIELD":
            for _ in range(int(words[1])):
                self._field()
        elif name == b"SCALARS":
            begin = reader.position
            if reader.read_words()[:1] != [b"LOOKUP_TABLE"]:
                reader.position = begin
            self._array(words[0], words[1], int(words[2]) if len(words) > 2 else 1)
        elif name == b"LOOKUP_TABLE":
            reader.skip_numbers("u1", 4 * int(words[1]))
        elif name == b"COLOR_SCALARS":
            reader.skip_numbers("u1", self._count * int(words[1]))
        elif name == b"TEXTURE_COORDINATES":
            self._array(words[0], words[2], int(words[1]))
        elif name in _COMPONENTS:
            self._array(words[0], words[1], _COMPONENTS[name])
        else:
            raise ValueError(f"the section {_text([name])} is not supported")

    def _cells(self, count: int, size: int, kind: int) -> None:
        """Read a list of cells, in the format of version 5.1 or of earlier versions."""
        reader = self._reader
        begin = reader.position
        words = reader.read_words()
        if words[:1] == [b"OFFSETS"]:
            offsets = reader.read_numbers(_KINDS[words[1].lower()], count).astype(np.int64)
            connectivity = reader.read_numbers(_KINDS[reader.read_words()[1].lower()], size).astype(np.int64)
            self._lists.append((offsets if count else np.zeros(1, dtype=np.int64), connectivity, kind))
            return
        reader.position = begin
        mixed = reader.read_numbers("i4", size).astype(np.int64)
        counts = find_counts(mixed)
        if counts is None or len(counts) != count:
            raise ValueError("its lists of cells contradict each other")
        starts = np.append(counts, size) - np.arange(count + 1)
        self._lists.append((starts, np.delete(mixed, counts), kind))

    def _field(self) -> None:
        """Read an array of a field: name, components, tuples, kind."""
        words = self._reader.read_words()
        while words[:1] == [b"METADATA"]:
            self._section(b"METADATA", [])
            words = self._reader.read_words()
        if len(words) == 4:
            count, self._count = self._count, int(words[2])
            of_points, self._of_points = self._of_points, self._of_points if self._count == count else None
            self._array(words[0], words[3], int(words[1]))
            self._count, self._of_points = count, of_points
        elif words[:1] != [b"NULL_ARRAY"]:
            raise ValueError(f"an array of a field was expected, not {_text(words)[:60]!r}")

    def _array(self, name: bytes, kind: bytes, components: int) -> None:
        """Read past values at points, cells or neither; register those at points and cells."""
        start = self._reader.position
        self._skip(kind, self._count * components)
        if self._of_points is not None and kind.lower() in _KINDS:
            # In a name, %20 stands for a space.
            title = unquote_to_bytes(name).decode("utf-8", "replace")
            fields = self._fields[self._of_points]
            fields[title] = partial(self._values, start, kind.lower(), components, self._count)

    def _values(self, start: int, kind: bytes, components: int, count: int) -> FloatArray:
        order = None if self._reader.text else ">"
        reader = TableReader(self._data, start, len(self._data), order)
        return reader.read_tables(count, (_KINDS[kind], components))[0].values.astype(np.float64)

    def _skip(self, kind: bytes, count: int) -> None:
        """Skip numbers or strings."""
        reader, kind = self._reader, kind.lower()
        if kind == b"string":
            for _ in range(count):
                reader.read_line() if reader.text else self._skip_string()
        elif kind == b"bit":
            reader.read_numbers("u1", count if reader.text else (count + 7) // 8)
        elif kind not in _KINDS:
            raise ValueError(f"arrays of {_text([kind])} are not supported")
        else:
            reader.skip_numbers(_KINDS[kind], count)

    def _skip_string(self) -> None:
        """Skip a string; the first two bits encode the number of bytes of its length."""
        first = int(self._reader.read_numbers("u1", 1)[0])
        more = {3: 0, 2: 1, 1: 3, 0: 7}[first >> 6]
        length = first & 63
        for byte in self._reader.read_numbers("u1", more).tolist():
            length = 256 * length + byte
        self._reader.read_numbers("u1", length)


def _text(words: list[bytes]) -> str:
    return b" ".join(words).decode("ascii", "replace") or "nothing"
