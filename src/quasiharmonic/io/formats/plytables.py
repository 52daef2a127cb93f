"""PLY files as tables: elements with rows of numbers and of lists of numbers."""

from __future__ import annotations

import re
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from quasiharmonic.io.untrusted import check_end, quote_token
from quasiharmonic.util.arrays import IntArray, repeat_each

_KINDS = {
    **dict.fromkeys(("char", "int8"), "i1"),
    **dict.fromkeys(("uchar", "uint8"), "u1"),
    **dict.fromkeys(("short", "int16"), "i2"),
    **dict.fromkeys(("ushort", "uint16"), "u2"),
    **dict.fromkeys(("int", "int32"), "i4"),
    **dict.fromkeys(("uint", "uint32"), "u4"),
    **dict.fromkeys(("float", "float32"), "f4"),
    **dict.fromkeys(("double", "float64"), "f8"),
}
_WORDS = {kind: word for word, kind in reversed(_KINDS.items())}
_ORDERS = {b"binary_little_endian": "<", b"binary_big_endian": ">", b"ascii": ""}
_FIRST_LINE = re.compile(rb"ply[ \t]*(\r\n|\n|\r)")


@dataclass(frozen=True, eq=False)
class Column:
    """One property of all rows of an element."""

    name: str
    #: The numbers (k,), in the type of the file; the lists of all rows one after another.
    values: NDArray[Any]
    #: Length of each row's list, (r,); None if each row has one number.
    sizes: IntArray | None = None


@dataclass(frozen=True, eq=False)
class Element:
    """A table: its name, its number of rows, and its columns in order."""

    name: str
    rows: int
    columns: tuple[Column, ...]

    def find(self, *names: str) -> Column | None:
        """Return the first column that has one of the names, or None."""
        return next((column for column in self.columns if column.name in names), None)


@dataclass(frozen=True, eq=False)
class PlyTables:
    """All tables of a file, and the remaining lines of its header."""

    elements: tuple[Element, ...]
    remarks: tuple[bytes, ...] = ()

    def find(self, name: str) -> Element | None:
        """Return the element with this name, or None."""
        return next((element for element in self.elements if element.name == name), None)


@dataclass(frozen=True)
class _Property:
    """A column as the header declares it: the type of its numbers and, for lists, of their lengths."""

    name: str
    kind: str
    count: str | None


def parse_tables(data: bytes) -> PlyTables:
    """Parse a PLY file, text or binary, in memory of a few times its size; raise a ValueError if it is damaged."""
    first = _FIRST_LINE.match(data)
    if first is None:
        raise ValueError("does not start like a PLY file")
    newline = first.group(1)
    ending = re.compile(rb"end_header[ \t]*" + newline).search(data)
    if ending is None:
        raise ValueError("its header does not end")
    order, declared, remarks = _header(data[first.end() : ending.start()].split(newline))
    reader = _PlyReader(data, ending.end(), order)
    return PlyTables(tuple(Element(name, rows, reader.columns(rows, of)) for name, rows, of in declared), remarks)


def encode_tables(tables: PlyTables) -> bytes:
    """Return the bytes of a PLY file, binary and little-endian."""
    lines = [b"ply", b"format binary_little_endian 1.0", *tables.remarks]
    for element in tables.elements:
        lines.append(f"element {element.name} {element.rows}".encode())
        for column in element.columns:
            word = _WORDS[column.values.dtype.str[1:]]
            form = word if column.sizes is None else f"list {_WORDS[_count_kind(column.sizes)]} {word}"
            lines.append(f"property {form} {column.name}".encode())
    head = b"\n".join([*lines, b"end_header\n"])
    return head + b"".join(_rows(element) for element in tables.elements)


def _header(lines: list[bytes]) -> tuple[str, list[tuple[str, int, list[_Property]]], tuple[bytes, ...]]:
    """Return the byte order (empty for text), the elements with their properties, and the other lines."""
    order: str | None = None
    declared: list[tuple[str, int, list[_Property]]] = []
    remarks = []
    for line in lines:
        match line.split():
            case []:
                continue
            case [b"format", form, _] if form in _ORDERS:
                order = _ORDERS[form]
            case [b"comment" | b"obj_info", *_]:
                remarks.append(line)
            case [b"element", name, rows] if rows.isdigit() and len(rows) < 19:
                declared.append((name.decode("ascii", "replace"), int(rows), []))
            case [b"property", *form, name] if declared and len(form) in (1, 3):
                kinds = [_KINDS.get(word.decode("ascii", "replace")) for word in form[-2:]]
                if None in kinds or (len(form) == 3 and (form[0] != b"list" or str(kinds[0])[0] == "f")):
                    raise ValueError(f"its header has {quote_token(line)}")
                count = kinds[0] if len(form) == 3 else None
                declared[-1][2].append(_Property(name.decode("ascii", "replace"), str(kinds[-1]), count))
            case _:
                raise ValueError(f"its header has {quote_token(line)}")
    if order is None:
        raise ValueError("its header has no supported format")
    for element, many, of in declared:
        if many and not of:
            raise ValueError(f"element {element!r} has no properties")
        if len({property_.name for property_ in of}) < len(of):
            raise ValueError(f"element {element!r} has two properties with the same name")
    return order, declared, tuple(remarks)


class _PlyReader:
    """Reads the tables of a file one after another; the numbers of a text file as if they were stored as doubles."""

    def __init__(self, data: bytes, at: int, order: str) -> None:
        self._data, self._at, self._order, self._text = data, at, order, not order
        if self._text:
            text = data[at:]
            if b"_" in text:
                raise ValueError("it has an underscore in its numbers")
            self._data, self._at = np.array(list(map(float, text.split())), dtype="<f8").tobytes(), 0

    def columns(self, rows: int, properties: list[_Property]) -> tuple[Column, ...]:
        """Return the next table."""
        return self._read_at_once(rows, properties) or self._read_row_by_row(rows, properties)

    def _read_at_once(self, rows: int, properties: list[_Property]) -> tuple[Column, ...] | None:
        """Return the next table if all its lists are as long as those of its first row, else None."""
        begin, sizes = self._at, []
        fields: list[Any] = []
        for i, of in enumerate(properties):
            sizes.append(self._size(of) if rows else 0)
            self._take(of.kind, sizes[-1])
            if of.count is not None:
                fields.append((f"n{i}", self._stored(of.count)))
            fields.append((f"v{i}", self._stored(of.kind), () if of.count is None else (sizes[-1],)))
        self._at = begin
        dtype = np.dtype(fields)
        if rows * dtype.itemsize > len(self._data) - begin:
            return None
        table = np.frombuffer(self._data, dtype, count=rows, offset=begin)
        columns = []
        for i, (of, size) in enumerate(zip(properties, sizes, strict=True)):
            if of.count is not None and (table[f"n{i}"] != size).any():
                return None
            lists = None if of.count is None else np.full(rows, size)
            columns.append(Column(of.name, self._convert(table[f"v{i}"], of.kind).ravel(), lists))
        self._at += rows * dtype.itemsize
        return tuple(columns)

    def _read_row_by_row(self, rows: int, properties: list[_Property]) -> tuple[Column, ...]:
        """Return the next table, read row by row."""
        parts: list[list[bytes]] = [[] for _ in properties]
        sizes: list[list[int]] = [[] for _ in properties]
        for _ in range(rows):
            for of, numbers, lengths in zip(properties, parts, sizes, strict=True):
                lengths.append(self._size(of))
                numbers.append(self._take(of.kind, lengths[-1]))
        columns = []
        for of, numbers, lengths in zip(properties, parts, sizes, strict=True):
            values = self._convert(np.frombuffer(b"".join(numbers), self._stored(of.kind)), of.kind)
            columns.append(Column(of.name, values, None if of.count is None else np.array(lengths, dtype=np.int64)))
        return tuple(columns)

    def _size(self, of: _Property) -> int:
        """Return how many numbers of a property come next, 1 if it is no list, and go to the first of them."""
        if of.count is None:
            return 1
        stored = self._take(of.count, 1)
        if self._text:
            size = int(_convert(np.frombuffer(stored), of.count)[0])
        else:
            size = int.from_bytes(stored, "little" if self._order == "<" else "big", signed=of.count[0] == "i")
        if size < 0 or size > len(self._data):
            raise ValueError(f"it has a list of {size} numbers")
        return size

    def _take(self, kind: str, count: int) -> bytes:
        """Return the bytes of the next numbers of a type."""
        begin, self._at = self._at, self._at + count * (8 if self._text else int(kind[1]))
        check_end(self._at, len(self._data))
        return self._data[begin : self._at]

    def _stored(self, kind: str) -> str:
        """Return the type in which numbers of a type are stored."""
        return "<f8" if self._text else self._order + kind

    def _convert(self, numbers: NDArray[Any], kind: str) -> NDArray[Any]:
        return _convert(numbers, kind) if self._text else numbers.astype(kind)


def _convert(numbers: NDArray[np.float64], kind: str) -> NDArray[Any]:
    """Convert numbers of a text file to the type in the header."""
    if kind[0] == "f":
        with np.errstate(over="ignore"):
            return numbers.astype(kind)
    limits = np.iinfo(kind)
    if not ((numbers >= limits.min) & (numbers <= limits.max) & (numbers == np.floor(numbers))).all():
        raise ValueError(f"it has a number that is not {_WORDS[kind]}, as its header states")
    return numbers.astype(kind)


def _count_kind(sizes: IntArray) -> str:
    return "u1" if sizes.max(initial=0) < 256 else "i4"


def _rows(element: Element) -> bytes:
    """Return the bytes of a table."""
    return _even_rows(element) or _uneven_rows(element)


def _even_rows(element: Element) -> bytes | None:
    """Return the bytes of a table if the lists of each column are equally long, else None."""
    fields: list[Any] = []
    for i, column in enumerate(element.columns):
        size = 1
        if column.sizes is not None:
            size = int(column.sizes[0]) if element.rows else 0
            if (column.sizes != size).any():
                return None
            fields.append((f"n{i}", "<" + _count_kind(column.sizes)))
        fields.append((f"v{i}", column.values.dtype.newbyteorder("<"), (size,)))
    table = np.empty(element.rows, np.dtype(fields))
    for i, column in enumerate(element.columns):
        if column.sizes is not None:
            table[f"n{i}"] = column.sizes
        table[f"v{i}"] = column.values.reshape(table[f"v{i}"].shape)
    return table.tobytes()


def _uneven_rows(element: Element) -> bytes:
    """Return the bytes of a table."""
    width = np.zeros(element.rows, dtype=np.int64)
    fields: list[tuple[IntArray, NDArray[Any], IntArray | None]] = []
    for column in element.columns:
        if column.sizes is not None:
            counts = column.sizes.astype("<" + _count_kind(column.sizes))
            fields.append((width.copy(), counts, None))
            width += counts.itemsize
        values = column.values.astype(column.values.dtype.newbyteorder("<"))
        fields.append((width.copy(), values, column.sizes))
        width += values.itemsize * (1 if column.sizes is None else column.sizes)
    begin = np.cumsum(width) - width
    out = np.empty(int(width.sum()), dtype=np.uint8)
    for within, values, sizes in fields:
        at = begin + within
        if sizes is not None:
            at = repeat_each(at - values.itemsize * (np.cumsum(sizes) - sizes), sizes)
            at += values.itemsize * np.arange(len(values))
        out[at[:, None] + np.arange(values.itemsize)] = values.view(np.uint8).reshape(-1, values.itemsize)
    return out.tobytes()
