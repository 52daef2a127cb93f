"""VTK's XML files of unstructured grids (.vtu): positions, elements, and data of points.

Arrays are either between their tags, as text or base64, or appended at the end of the file, as base64 or raw bytes.
Base64 and raw arrays may be compressed::

    <DataArray format="ascii">0 0 0 …</DataArray>      <DataArray format="appended" offset="84"/>
    <DataArray format="binary">AAAB…</DataArray>       <AppendedData encoding="raw">_ ▯▯▯▯▯▯▯ </AppendedData>
"""

from __future__ import annotations

import base64
import binascii
import lzma
import re
import zlib
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from functools import partial
from itertools import accumulate, pairwise
from pathlib import Path
from typing import Any
from xml.sax.saxutils import quoteattr

import numpy as np
from numpy.typing import NDArray

from quasiharmonic.io.atomic import write_whole
from quasiharmonic.io.fem.mesh_parts import MeshParts, find_sets_in_fields, select_elements
from quasiharmonic.io.fem.number_tables import TableReader, replace_numbers
from quasiharmonic.io.untrusted import check_end
from quasiharmonic.util.arrays import FloatArray, IntArray

_KINDS = {
    **{f"Int{8 * size}": f"i{size}" for size in (1, 2, 4, 8)},
    **{f"UInt{8 * size}": f"u{size}" for size in (1, 2, 4, 8)},
    "Float32": "f4",
    "Float64": "f8",
}
_APPENDED = re.compile(rb"<AppendedData[^>]*>")
_OFFSET = re.compile(rb"""(\soffset\s*=\s*["'])\s*(\d+)\s*(["'])""")
_TAG = re.compile(rb"""<(?:[^"'>]|"[^"]*"|'[^']*')*>""")
# Memory limit of LZMA decompression besides the output, in bytes; the densest preset needs half of it.
_LZMA_MEMORY = 128 << 20
# A function that compresses bytes, and a factory of decompressors.
_Coder = tuple[Callable[[bytes], bytes], Callable[[], Any]]
# A function of a file, a position and a number of bytes: these bytes, decoded, and the position after them.
_Take = Callable[[bytes, int, int], tuple[bytes, int]]
_CODERS: dict[str, _Coder] = {
    "vtkZLibDataCompressor": (zlib.compress, zlib.decompressobj),
    "vtkLZMADataCompressor": (lzma.compress, partial(lzma.LZMADecompressor, memlimit=_LZMA_MEMORY)),
}

# VTK's kinds of cells, by number of nodes; in space, cells of four nodes are tetrahedra.
_CELL_KINDS = {3: 5, 4: 9, 6: 22}
_TETRAHEDRON = 10
_TYPES = {"f": "Float64", "i": "Int64", "u": "UInt8"}


@dataclass(frozen=True)
class _Array:
    """A DataArray: its attributes, the start of its tag, and the start and the end of its text."""

    attributes: dict[str, str]
    tag: int
    begin: int
    end: int


def read_vtu(data: bytes, solid: bool = False) -> MeshParts:
    """Parse a VTU file, with its tetrahedra and hexahedra if ``solid``.

    ValueError if the file is not VTU, has several pieces or times, an unknown encoding, or other cells with area than
    triangles and quadrilaterals.
    """
    file = _VtuFile(data)
    points = file.find_only("Points", None)
    precision = points.attributes.get("type")
    components = points.attributes.get("NumberOfComponents", "1")
    if precision not in ("Float32", "Float64") or components != "3":
        raise ValueError(f"its positions must be 3 Float32 or Float64 each, not {components} {precision}")
    place = file.values(points, 3 * file.points).reshape(-1, 3)
    ends, kinds = (
        file.values(file.find_only("Cells", name), file.cells).astype(np.int64) for name in ("offsets", "types")
    )
    connectivity = file.values(file.find_only("Cells", "connectivity"), int(ends.max(initial=0))).astype(np.int64)
    starts = np.concatenate([[0], ends])
    F = select_elements(connectivity, starts, kinds, len(place), solid)
    fields, of_cells = (
        {
            name: partial(_rows, file, array, count)
            for name, array in file.last_arrays(parent).items()
            if array.attributes.get("type") in _KINDS
        }
        for parent, count in (("PointData", file.points), ("CellData", file.cells))
    )
    return MeshParts(
        place.astype(np.float64),
        F,
        np.dtype(_KINDS[precision]),
        fields,
        partial(file.replace_points, points),
        partial(find_sets_in_fields, fields, of_cells, connectivity, starts),
    )


def _rows(file: _VtuFile, array: _Array, count: int) -> FloatArray:
    components = int(array.attributes.get("NumberOfComponents", "1"))
    values = file.values(array, count * components)
    if len(values) != count * components:
        name = array.attributes.get("Name", "")
        raise ValueError(f"the array {name[:40]!r} has {len(values)} numbers, not {count * components}")
    return values.astype(np.float64).reshape(count, components)


class _VtuFile:
    """A VTU file, parsed into its arrays."""

    def __init__(self, data: bytes) -> None:
        from xml.parsers.expat import ExpatError, ParserCreate

        self._data = data
        self._arrays: dict[tuple[str, str], list[_Array]] = {}
        self._all: list[_Array] = []
        self._path: list[str] = []
        self._open: tuple[dict[str, str], int] | None = None
        self._file: dict[str, str] = {}
        self._pieces: list[dict[str, str]] = []
        self._in_empty_piece = False
        tag = _APPENDED.search(data)
        # Appended data need not be XML, so parse only the part before.
        head = data if tag is None else data[: tag.end()] + b"</AppendedData></VTKFile>"
        self._parser = ParserCreate()
        self._parser.StartElementHandler = self._open_element
        self._parser.EndElementHandler = self._close_element
        try:
            self._parser.Parse(head, True)
        except ExpatError as error:
            raise ValueError(f"it is not well-formed XML: {error}") from error
        if self._file.get("type") != "UnstructuredGrid":
            raise ValueError("it is not a VTU file with an unstructured grid")
        if len(self._pieces) != 1:
            raise ValueError(f"it has {len(self._pieces)} pieces: merge them into one")
        self.points, self.cells = (int(self._pieces[0].get(f"NumberOf{what}", "0")) for what in ("Points", "Cells"))
        self._order = {"LittleEndian": "<", "BigEndian": ">"}.get(self._file.get("byte_order", "LittleEndian"), "<")
        word = self._file.get("header_type", "UInt32")
        if word not in ("UInt32", "UInt64"):
            raise ValueError(f"its header_type must be UInt32 or UInt64, not {word[:40]}")
        self._word = np.dtype(self._order + _KINDS[word])
        compressor = self._file.get("compressor")
        if compressor is not None and compressor not in _CODERS:
            raise ValueError(f"it is compressed by {compressor}: save it with ZLib or without compression")
        self._coder = None if compressor is None else _CODERS[compressor]
        self._appended, self._take_appended = -1, _take_base64
        if tag is not None:
            self._appended = data.index(b"_", tag.end()) + 1
            if b'"raw"' in tag.group().replace(b"'", b'"'):
                self._take_appended = _take_raw

    def last_arrays(self, parent: str) -> dict[str, _Array]:
        """Return the arrays of an element by name; the last one for several times."""
        return {name: arrays[-1] for (of, name), arrays in self._arrays.items() if of == parent}

    def find_only(self, parent: str, name: str | None) -> _Array:
        """Return the only array of an element, or the only one with this name."""
        found = [a for (p, n), arrays in self._arrays.items() if p == parent and name in (None, n) for a in arrays]
        if len(found) != 1:
            what = parent if name is None else f"{parent} called {name}"
            raise ValueError(f"it has {len(found)} arrays of {what}: save one array at one time step")
        return found[0]

    def values(self, array: _Array, max_count: int) -> NDArray[Any]:
        """Return the numbers of an array, at most ``max_count`` of them if compressed."""
        kind = _KINDS.get(array.attributes.get("type", ""))
        if kind is None:
            raise ValueError(f"arrays of {array.attributes.get('type', 'unknown type')[:40]} are not numbers")
        if array.attributes.get("format") == "ascii":
            text = self._data[array.begin : array.end].split()
            return np.array(text, dtype=np.bytes_).astype(np.float64 if kind[0] == "f" else np.int64).astype(kind)
        number = np.dtype(self._order + kind)
        return np.frombuffer(self._block(array, max_count * number.itemsize)[0], number)

    def replace_points(self, array: _Array, points: FloatArray) -> bytes:
        """Return the file with the first of every three numbers of an array replaced, by (n, 2) or (n, 3)."""
        if array.attributes.get("format") == "ascii":
            reader = TableReader(self._data, array.begin, array.end, None)
            table = reader.read_tables(len(points), (_KINDS[array.attributes["type"]], 3))[0]
            return replace_numbers(self._data, table, points)
        number = np.dtype(self._order + _KINDS[array.attributes["type"]])
        block, begin, end = self._block(array, 3 * self.points * number.itemsize)
        numbers = np.frombuffer(block, number).reshape(-1, 3).copy()
        with np.errstate(over="ignore"):
            numbers[:, : points.shape[1]] = points
        if numbers.tobytes() == block:
            return self._data
        encoded = self._encode(numbers.tobytes(), array)
        whole = self._data[:begin] + encoded + self._data[end:]
        longer = len(encoded) - (end - begin)
        if not longer or array.attributes.get("format") == "binary":
            return whole
        # Correct the offsets of the arrays after this one.
        for other in sorted(self._all, key=lambda a: -a.tag):
            offset = int(other.attributes.get("offset", "-1"))
            if offset + self._appended > begin:
                tag = _OFFSET.sub(rb"\g<1>%d\g<3>" % (offset + longer), whole[other.tag : other.begin], count=1)
                whole = whole[: other.tag] + tag + whole[other.begin :]
        return whole

    def _open_element(self, name: str, attributes: dict[str, str]) -> None:
        if name == "VTKFile":
            self._file = attributes
        elif name == "Piece":
            self._in_empty_piece = attributes.get("NumberOfPoints") == "0"
            self._pieces += [attributes] * (not self._in_empty_piece)
        elif name in ("DataArray", "Array"):
            self._open = attributes, self._parser.CurrentByteIndex
        self._path.append(name)

    def _close_element(self, name: str) -> None:
        self._path.pop()
        if name in ("DataArray", "Array") and self._open is not None:
            attributes, tag = self._open
            quoted = _TAG.match(self._data, tag)
            begin = tag if quoted is None else quoted.end()
            # Child elements with further information may follow the numbers.
            array = _Array(attributes, tag, begin, self._data.find(b"<", begin))
            self._all.append(array)
            if not self._in_empty_piece:
                self._arrays.setdefault((self._path[-1], attributes.get("Name", "")), []).append(array)
            self._open = None

    def _block(self, array: _Array, max_bytes: int) -> tuple[bytes, int, int]:
        """Return the bytes of an array, and the start and end of their encoded form in the file.

        Compressed data of more than ``max_bytes`` bytes raise a `ValueError`.
        """
        begin, take = self._find_bytes(array)
        size = self._word.itemsize
        # The length in bytes, or the number of compressed parts.
        (count,) = np.frombuffer(take(self._data, begin, size)[0], self._word).tolist()
        if self._coder is None:
            block, end = take(self._data, begin, size + count)
            return block[size:], begin, end
        header, at = take(self._data, begin, size * (3 + count))
        part, last, *lengths = np.frombuffer(header, self._word)[1:].tolist()
        sizes = [part] * (count - 1) + [last or part] * (count > 0)
        if sum(sizes) > max_bytes:
            raise ValueError(f"compressed data have {sum(sizes)} bytes, but at most {max_bytes} are expected")
        packed, end = take(self._data, at, sum(lengths))
        ends = accumulate(lengths, initial=0)
        whole = b"".join(self._decompress(packed[a:b], n) for (a, b), n in zip(pairwise(ends), sizes, strict=True))
        return whole, begin, end

    def _decompress(self, packed: bytes, size: int) -> bytes:
        """Decompress bytes to a given size."""
        assert self._coder is not None
        coder = self._coder[1]()
        try:
            # Ask for one more byte, to detect data that are too long.
            whole: bytes = coder.decompress(packed, size + 1)
        except (zlib.error, lzma.LZMAError, OverflowError) as error:
            raise ValueError(f"compressed data are damaged: {error}") from error
        if len(whole) != size or not coder.eof:
            raise ValueError(f"compressed data are damaged: {size} bytes were expected")
        return whole

    def _encode(self, block: bytes, array: _Array) -> bytes:
        """Encode bytes in the same way as an array of the same length in the file."""
        begin, take = self._find_bytes(array)
        code: Callable[[bytes], bytes] = bytes if take is _take_raw else base64.b64encode
        if self._coder is None:
            return code(np.array([len(block)], dtype=self._word).tobytes() + block)
        # Number of parts, their size, and the size of the last part if it is shorter.
        head = np.frombuffer(take(self._data, begin, 3 * self._word.itemsize)[0], self._word)
        count, size, _ = head.tolist()
        packed = [self._coder[0](block[i * size : (i + 1) * size]) for i in range(count)]
        header = np.concatenate([head, np.array([len(part) for part in packed], dtype=self._word)])
        return code(header.astype(self._word).tobytes()) + code(b"".join(packed))

    def _find_bytes(self, array: _Array) -> tuple[int, _Take]:
        """Return the start of an array's bytes, and the function that takes bytes from there."""
        if array.attributes.get("format") != "appended":
            inline = self._data[array.begin : array.end]
            return array.begin + len(inline) - len(inline.lstrip()), _take_base64
        if "offset" not in array.attributes:
            raise ValueError(f"the array {array.attributes.get('Name', '')[:40]!r} has no offset in the appended data")
        begin = self._appended + int(array.attributes["offset"])
        if self._appended < 0 or begin > len(self._data):
            raise ValueError("an array refers to appended data that do not exist")
        return begin, self._take_appended


def _take_raw(data: bytes, begin: int, length: int) -> tuple[bytes, int]:
    """Return a number of bytes, and the position after them."""
    check_end(begin + length, len(data))
    return data[begin : begin + length], begin + length


def _take_base64(data: bytes, begin: int, length: int) -> tuple[bytes, int]:
    """Return a number of bytes decoded from base64, and the position after them."""
    end = begin + 4 * -(-length // 3)
    try:
        found = base64.b64decode(data[begin:end], validate=True)[:length]
    except binascii.Error as error:
        raise ValueError(f"base64 data are damaged: {error}") from error
    check_end(length, len(found))
    return found, end


def list_series(path: Path, steps: int) -> list[Path]:
    """Return the paths of a series beside a file: the .pvd file, then a .vtu file for the start and each step."""
    return [path.with_suffix(".pvd"), *(path.with_name(f"{path.stem}_{k:04d}.vtu") for k in range(steps + 1))]


def write_series(paths: list[Path], F: IntArray, frames: Iterable[tuple[FloatArray, FloatArray]]) -> None:
    """Write one VTU file for the positions (n, d) and the quality (f,) of each frame, then the file that lists them.

    ``paths`` are those of `list_series`; ``F`` are triangles, quadrilaterals, six-node triangles or tetrahedra. Raises
    OutputError if a file cannot be written.
    """
    collection, *parts = paths
    written = []
    for path, (points, quality) in zip(parts, frames, strict=False):
        write_whole(path, _encode_grid(F, points, quality))
        written.append(path.name)
    lines = [f'<DataSet timestep="{k}" part="0" file={quoteattr(name)}/>' for k, name in enumerate(written)]
    text = '<VTKFile type="Collection" version="0.1">\n<Collection>\n' + "\n".join(lines)
    write_whole(collection, f"{text}\n</Collection>\n</VTKFile>\n".encode())


def _encode_grid(F: IntArray, points: FloatArray, quality: FloatArray) -> bytes:
    space = np.zeros((len(points), 3))
    space[:, : points.shape[1]] = points
    sizes = np.full(len(F), F.shape[1])
    kinds = np.full(len(F), _TETRAHEDRON if points.shape[1] == 3 else _CELL_KINDS[F.shape[1]], dtype=np.uint8)
    if points.shape[1] == 2 and F.shape[1] == 4:
        triangular = F[:, 2] == F[:, 3]
        sizes[triangular], kinds[triangular] = 3, _CELL_KINDS[3]
    connectivity = F[np.arange(F.shape[1]) < sizes[:, None]]
    sections = {
        "Points": _encode_array("positions", space),
        "Cells": _encode_array("connectivity", connectivity)
        + _encode_array("offsets", np.cumsum(sizes))
        + _encode_array("types", kinds),
        "CellData": _encode_array("quality", quality),
    }
    body = "".join(f"<{name}>\n{text}</{name}>\n" for name, text in sections.items())
    return (
        '<VTKFile type="UnstructuredGrid" version="1.0" byte_order="LittleEndian" header_type="UInt64">\n'
        f'<UnstructuredGrid>\n<Piece NumberOfPoints="{len(points)}" NumberOfCells="{len(F)}">\n{body}</Piece>\n'
        "</UnstructuredGrid>\n</VTKFile>\n"
    ).encode()


def _encode_array(name: str, values: NDArray[np.generic]) -> str:
    data = np.ascontiguousarray(values, dtype=values.dtype.newbyteorder("<")).tobytes()
    components = values.shape[1] if values.ndim == 2 else 1
    head = f'<DataArray type="{_TYPES[values.dtype.kind]}" Name="{name}" NumberOfComponents="{components}"'
    return f'{head} format="binary">{base64.b64encode(len(data).to_bytes(8, "little") + data).decode()}</DataArray>\n'
