"""glTF 2.0 files, binary (.glb) or JSON (.gltf): read the document and its numbers, change them, and encode the file.

The module runs no code from a file and fetches nothing. It reads bytes only from the file itself and from files in its
folder.
"""

from __future__ import annotations

import base64
import binascii
import json
import os
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import suppress
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from quasiharmonic.io.errors import MeshFileError, printable_path, report_damage
from quasiharmonic.io.untrusted import check_end, read_bytes, resolve_beside

_KINDS = {5120: "<i1", 5121: "<u1", 5122: "<i2", 5123: "<u2", 5125: "<u4", 5126: "<f4"}
_CODES = {np.dtype(kind): code for code, kind in _KINDS.items()}
_WIDTHS = {"SCALAR": 1, "VEC2": 2, "VEC3": 3, "VEC4": 4}
_SHAPES = {width: shape for shape, width in _WIDTHS.items()}
# Compression extensions, which need external libraries and are rejected.
_COMPRESSIONS = "KHR_draco_mesh_compression", "EXT_meshopt_compression", "KHR_meshopt_compression"
_LISTS = (
    *("accessors", "bufferViews", "buffers", "images", "materials", "textures"),
    *("animations", "cameras", "meshes", "nodes", "scenes", "skins"),
)
# Media types of the images that glTF supports, by the first bytes.
_PICTURES = {b"\x89PNG": "image/png", b"\xff\xd8\xff": "image/jpeg", b"RIFF": "image/webp", b"\xabKTX 20": "image/ktx2"}
# Errors that reading a damaged document may raise.
DAMAGE = (ValueError, KeyError, IndexError, TypeError, AttributeError, OverflowError, RecursionError)


@dataclass(frozen=True, eq=False)
class Document:
    """A glTF file: its JSON, and the bytes of each of ``tree["bufferViews"]``."""

    tree: dict[str, Any]
    views: list[bytes | memoryview]

    @property
    def size(self) -> int:
        """Total number of bytes of all views."""
        return sum(map(len, self.views))

    def __reduce__(self) -> tuple[type[Document], tuple[dict[str, Any], list[bytes]]]:
        """Return the contents for pickling, which cannot store a memoryview."""
        return Document, (self.tree, list(map(bytes, self.views)))

    def copy(self) -> Document:
        """Return a copy to modify; the bytes are shared."""
        return Document(json.loads(json.dumps(self.tree)), list(self.views))

    def numbers(self, index: int) -> NDArray[Any]:
        """Return the numbers of an accessor, (count, width), in the type of the file; raise one of `DAMAGE`."""
        accessor = self.tree["accessors"][whole(index)]
        kind = np.dtype(_look_up(accessor, "componentType", _KINDS, index))
        width = _look_up(accessor, "type", _WIDTHS, index)
        count, sparse = whole(accessor["count"]), accessor.get("sparse")
        if "bufferView" in accessor:
            table = self._rows(accessor, count, kind, width)
        elif sparse is None or count > self.size:
            raise ValueError(f"accessor {index} has no data")
        else:
            table = np.zeros((count, width), dtype=kind)
        if sparse is not None:
            many, of = whole(sparse["count"]), sparse["indices"]
            rows = self._rows(of, many, np.dtype(_look_up(of, "componentType", _KINDS, index)), 1)[:, 0]
            table[rows] = self._rows(sparse["values"], many, kind, width)
        return table

    def reals(self, index: int) -> NDArray[np.float64]:
        """Return the values of an accessor, (count, width); normalised integers are divided by the largest one."""
        table = self.numbers(index)
        if table.dtype.kind == "f" or not self.tree["accessors"][index].get("normalized"):
            return table.astype(np.float64)
        return np.maximum(table / np.iinfo(table.dtype).max, -1.0)

    def add(self, table: NDArray[Any], *, indices: bool = False) -> int:
        """Add an accessor for numbers (count, width), either indices or vertex data; return its index."""
        accessors = self.tree.setdefault("accessors", [])
        accessors.append({})
        self.put(len(accessors) - 1, table, indices=indices)
        return len(accessors) - 1

    def put(self, index: int, table: NDArray[Any], *, indices: bool = False, repeated: bool = False) -> None:
        """Replace the numbers (count, width) of an accessor; ``repeated`` means that they only repeat its old rows."""
        accessor = self.tree["accessors"][index]
        old = accessor.get("bufferView")
        for stale in ("sparse", "byteOffset", *(() if repeated else ("min", "max", "normalized"))):
            accessor.pop(stale, None)
        table = np.ascontiguousarray(table)
        raw = table.view(np.uint8).reshape(len(table), -1)
        # Rows of vertex data start at multiples of four bytes.
        padding = 0 if indices else -raw.shape[1] % 4
        view = {"buffer": 0, "target": 34963 if indices else 34962}
        if padding:
            raw = np.pad(raw, ((0, 0), (0, padding)))
            view["byteStride"] = raw.shape[1]
        views = self.tree.setdefault("bufferViews", [])
        if old is None or self._references[old] > 1:
            self._references[old] -= 1
            old = len(views)
            views.append({})
            self.views.append(b"")
        views[old], self.views[old] = view, raw.tobytes()
        accessor |= {"bufferView": old, "count": len(table), "type": _SHAPES[table.shape[1]]}
        accessor["componentType"] = _CODES[table.dtype]

    def add_bytes(self, data: bytes) -> int:
        """Add a view of the bytes of an image; return its index."""
        self.tree.setdefault("bufferViews", []).append({"buffer": 0})
        self.views.append(data)
        return len(self.views) - 1

    def encode(self, *, binary: bool) -> bytes:
        """Return the bytes of the file: binary, or JSON with base64 data; raise `ValueError` if it is too large."""
        if self.size >= 1 << 31:
            raise ValueError("a glTF file has at most 2 GiB: write .ply or .obj")
        tree, buffer = dict(self.tree), bytearray()
        views = []
        for view, data in zip(self.tree.get("bufferViews", []), self.views, strict=True):
            buffer += b"\0" * (-len(buffer) % 4)
            views.append(view | {"buffer": 0, "byteOffset": len(buffer), "byteLength": len(data)})
            buffer += data
        buffer += b"\0" * (-len(buffer) % 4)
        tree["bufferViews"], tree["buffers"] = views, [{"byteLength": len(buffer)}]
        if not binary:
            uri = "data:application/octet-stream;base64," + base64.b64encode(buffer).decode()
            tree["buffers"][0]["uri"] = uri
            return json.dumps(tree, ensure_ascii=False, indent=1).encode() + b"\n"
        text = json.dumps(tree, ensure_ascii=False, separators=(",", ":")).encode()
        text += b" " * (-len(text) % 4)
        chunks = (b"JSON", text), (b"BIN\0", bytes(buffer))
        body = b"".join(len(data).to_bytes(4, "little") + name + data for name, data in chunks)
        return b"glTF" + (2).to_bytes(4, "little") + (12 + len(body)).to_bytes(4, "little") + body

    @cached_property
    def _references(self) -> Counter[int | None]:
        """The number of references to each view; `put` keeps it up to date."""
        holders = find_objects(self.tree, lambda node: isinstance(node.get("bufferView"), int))
        return Counter(node["bufferView"] for node in holders)

    def _rows(self, where: dict[str, Any], count: int, kind: np.dtype[Any], width: int) -> NDArray[Any]:
        """Return a copy of rows of numbers in a view."""
        index = whole(where["bufferView"])
        view, begin, row = self.views[index], whole(where.get("byteOffset", 0)), kind.itemsize * width
        stride = whole(self.tree["bufferViews"][index].get("byteStride", row))
        if count and (stride < row or begin + (count - 1) * stride + row > len(view)):
            raise ValueError(f"buffer view {index} is too short for its numbers")
        found = np.ndarray((count, row), np.uint8, view, begin if count else 0, (stride, 1))
        return np.array(found).view(kind).reshape(count, width)


def find_objects(node: Any, is_wanted: Callable[[dict[str, Any]], bool]) -> Iterator[dict[str, Any]]:
    """Yield the wanted objects in a part of a document, at any depth, except in extras."""
    if isinstance(node, list):
        for part in node:
            yield from find_objects(part, is_wanted)
    elif isinstance(node, dict):
        if is_wanted(node):
            yield node
        for key, part in node.items():
            if key != "extras":
                yield from find_objects(part, is_wanted)


def load(path: str | os.PathLike[str]) -> Document:
    """Read a glTF file.

    MeshFileError if the file is not glTF, is damaged or compressed, or refers to bytes outside its own folder.
    """
    data = read_bytes(path)
    with report_damage(path, "is not a glTF file: ", DAMAGE, describe=fault):
        text, chunk = _chunks(data) if data[:4] == b"glTF" else (data, None)
        tree = json.loads(text, parse_constant=_no_number)
        version = str(tree["asset"]["version"])
        _check_lists(tree)
    if not version.startswith("2."):
        raise MeshFileError(path, f"is glTF {version[:20]}", remedy="save it as glTF 2.0")
    compressed = [name for name in _COMPRESSIONS if f'"{name}"' in json.dumps(tree.get("extensionsUsed", []))]
    if compressed:
        raise MeshFileError(path, f"is compressed by {compressed[0]}", remedy="save it without compression")
    with report_damage(path, "is damaged: ", DAMAGE, describe=fault):
        buffers = [_buffer(path, buffer, chunk) for buffer in tree.get("buffers", [])]
        views = [_view(view, buffers) for view in tree.get("bufferViews", [])]
    return Document(tree, views)


def fault(error: Exception) -> str:
    """Return a description of a document's fault, from the error that it raised."""
    match error:
        case ValueError():
            return str(error)
        case KeyError():
            return f"an entry lacks {printable_path(str(error.args[0]))[:80]}"
        case IndexError():
            return "an entry refers to another entry that does not exist"
        case RecursionError():
            return "its entries are nested too deeply"
    return "an entry has the wrong type"


def embed_pictures(document: Document, folder: Path) -> list[str]:
    """Embed images from files in the document's folder; return the names of those that cannot be embedded."""
    missing = []
    for image in document.tree.get("images", []):
        uri = image.get("uri")
        if not isinstance(uri, str) or uri.startswith("data:"):
            continue
        data = b""
        with suppress(ValueError):
            data = read_uri(folder, uri)
        if (kind := next((kind for start, kind in _PICTURES.items() if data.startswith(start)), None)) is None:
            missing.append(uri)
            continue
        del image["uri"]
        image |= {"bufferView": document.add_bytes(data), "mimeType": kind}
    return missing


def read_uri(folder: Path, uri: str) -> bytes:
    """Return the bytes in a data URI, or those of a file in the folder of the document; ValueError if it is damaged."""
    if not uri.startswith("data:"):
        return read_bytes(resolve_beside(folder, uri))
    head, _, text = uri.partition(",")
    if not head.endswith(";base64"):
        raise ValueError("a buffer is not base64")
    try:
        return base64.b64decode(text, validate=True)
    except binascii.Error as error:
        raise ValueError(f"a buffer is not base64: {error}") from error


def whole(value: object) -> int:
    """Return a non-negative integer of a document; raise `ValueError` for anything else."""
    if not isinstance(value, int) or isinstance(value, bool) or not 0 <= value < 1 << 53:
        raise ValueError(f"{ascii(value)[:40]} is not a whole number")
    return value


def _look_up(accessor: dict[str, Any], name: str, table: dict[Any, Any], index: int) -> Any:
    """What an entry of an accessor stands for; `ValueError` for a value that is not in the table."""
    value = accessor[name]
    if value not in table:
        choices = ", ".join(map(str, table))
        raise ValueError(f"{name} of accessor {index} must be one of {choices}, not {ascii(value)[:40]}")
    return table[value]


def _no_number(word: str) -> float:
    raise ValueError(f"{word} is not JSON")


def _check_lists(tree: dict[str, Any]) -> None:
    """Raise a ValueError if an entry that must be a list of objects is not."""
    for name in _LISTS:
        there = tree.get(name, [])
        if not isinstance(there, list) or not all(isinstance(one, dict) for one in there):
            raise ValueError(f"its {name} must be a list of objects")


def _chunks(data: bytes) -> tuple[bytes, bytes | None]:
    """Return the JSON and the binary chunk of a binary file."""
    if data[4:8] != b"\2\0\0\0":
        raise ValueError("its binary version is not 2")
    found: dict[bytes, bytes] = {}
    at = 12
    while at + 8 <= len(data):
        size, name = int.from_bytes(data[at : at + 4], "little"), data[at + 4 : at + 8]
        check_end(at + 8 + size, len(data))
        found.setdefault(name, data[at + 8 : at + 8 + size])
        at += 8 + size
    if b"JSON" not in found:
        raise ValueError("it has no JSON chunk")
    return found[b"JSON"], found.get(b"BIN\0")


def _buffer(path: str | os.PathLike[str], buffer: dict[str, Any], chunk: bytes | None) -> bytes:
    """Return the bytes of a buffer."""
    size, uri = whole(buffer["byteLength"]), buffer.get("uri")
    data = chunk if uri is None else read_uri(Path(path).parent, uri)
    if data is None or len(data) < size:
        raise ValueError("a buffer is shorter than its length states")
    return data[:size]


def _view(view: dict[str, Any], buffers: list[bytes]) -> bytes | memoryview:
    begin, size = whole(view.get("byteOffset", 0)), whole(view["byteLength"])
    buffer = buffers[whole(view["buffer"])]
    if begin + size > len(buffer):
        raise ValueError("a buffer view ends after the end of its buffer")
    # No copy, so that many views of one buffer need no more memory than the buffer.
    return memoryview(buffer)[begin : begin + size]
