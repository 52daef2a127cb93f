"""Read OBJ files line by line: every form of OBJ, with the line of every error."""

from __future__ import annotations

import io
import os
import re
from array import array
from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

from quasiharmonic.io.errors import MeshFileError
from quasiharmonic.io.models.meshdata import MeshData, OriginalLines, polygon_mesh
from quasiharmonic.io.untrusted import integer, number, quote_token
from quasiharmonic.util.arrays import count_of

# Statements that are rejected: reading would lose their geometry.
REFUSED = {b"curv", b"curv2", b"surf", b"bsp", b"bzp", b"cdc", b"cdp", b"fo", b"call"}
_PLAIN_ELEMENT = re.compile(rb"[lp][ \t0-9]*")
# Most numbers after the coordinates of a vertex: weight and colour with opacity.
_MAX_EXTRA = 5
# More corners indicate a damaged file.
_MAX_CORNERS = 1000


def read_obj_lines(path: str | os.PathLike[str], data: bytes) -> MeshData:
    """Read the text of an OBJ file; `read_obj` documents the input and the errors."""
    return _ObjReader(path, data).read()


class _ObjReader:
    """The state of reading one file; compact arrays limit memory to a few times the file size."""

    def __init__(self, path: str | os.PathLike[str], data: bytes) -> None:
        self.path = path
        self.data = data
        self.coordinates, self.width = array("d"), array("b")
        self.vt = array("d")
        self.positions, self.places = bytearray(), bytearray()
        self.normals = bytearray()
        self.normal_count = 0
        self.corners = array("q")
        self.face_line = array("q")
        self.starts = array("q", [0])
        self.statements = bytearray()
        self.statement_faces = array("q")
        self.begun = False

    def read(self) -> MeshData:
        take = {b"v": self.vertex, b"vt": self.texture, b"vn": self.normal, b"f": self.face}
        for line, text in _logical_lines(self.data):
            keyword = text.split(None, 1)[0]
            try:
                if keyword in take:
                    self.begun = True
                    take[keyword](line, text)
                else:
                    self.statement(keyword, text)
            except ValueError as error:
                raise MeshFileError(self.path, str(error), line, getattr(error, "remedy", "")) from None
        return self.result()

    def vertex(self, line: int, text: bytes) -> None:
        row = _numbers(text, 3 + _MAX_EXTRA)
        if len(row) < 3:
            raise _FaultError(f"a vertex with {count_of('coordinate', 'coordinates', len(row))}", "give three")
        self.coordinates.extend(row)
        self.width.append(len(row))
        self.positions += text + b"\n"

    def texture(self, line: int, text: bytes) -> None:
        row = _numbers(text, 3)
        if len(row) < 2:
            raise _FaultError(f"a texture coordinate with {count_of('number', 'numbers', len(row))}", "give two")
        self.vt.extend(row[:2])
        self.places += text + b"\n"

    def normal(self, line: int, text: bytes) -> None:
        self.normals += text + b"\n"
        self.normal_count += 1

    def face(self, line: int, text: bytes) -> None:
        # Split only as many corners as the error message needs, because a line may be very long.
        corners = _strip_comment(text).split(None, _MAX_CORNERS + 1)[1:]
        if len(corners) < 3:
            raise _FaultError(f"face with {count_of('corner', 'corners', len(corners))}", "a triangle has 3")
        if len(corners) > _MAX_CORNERS:
            raise _FaultError(f"face with more than {_MAX_CORNERS} corners", "triangulate it first")
        counts = (len(self.width), len(self.vt) // 2, self.normal_count)
        begin = len(self.corners)
        for corner in corners:
            self.corners.extend(_corner(corner, counts))
        if len(corners) > 3 and len(set(self.corners[begin::3])) < len(corners):
            raise _FaultError(f"face with {len(corners)} corners that uses a vertex twice", "remove the repetition")
        self.face_line.append(line)
        self.starts.append(len(self.corners) // 3)

    def statement(self, keyword: bytes, text: bytes) -> None:
        if keyword in REFUSED:
            raise _FaultError(f"{keyword.decode()!r} statement", "only polygons can be read; convert it first")
        if keyword in (b"l", b"p") and not _PLAIN_ELEMENT.fullmatch(text.rstrip()):
            raise _FaultError(f"{keyword.decode()!r} element with relative or texture indices", "remove it")
        self.statements += text + b"\n"
        self.statement_faces.append(len(self.face_line) if self.begun else -1)

    def result(self) -> MeshData:
        count, faces = len(self.width), len(self.face_line)
        if not count:
            raise MeshFileError(self.path, "has no vertices", remedy="is it an OBJ file?")
        if not faces:
            raise MeshFileError(self.path, "has no faces", remedy="give a mesh with faces")
        corners = np.array(self.corners, dtype=np.int64).reshape(-1, 3)
        starts = np.array(self.starts, dtype=np.int64)
        counts = (count, len(self.vt) // 2, self.normal_count)
        names = ("vertices", "texture coordinates", "normals")
        for part, (count, what) in enumerate(zip(counts, names, strict=True)):
            beyond = np.flatnonzero(corners[:, part] >= count)
            if beyond.size:
                face = int(np.searchsorted(starts, beyond[0], side="right")) - 1
                fault = f"index {corners[beyond[0], part] + 1}, but the file has {count} {what}"
                raise MeshFileError(self.path, fault, self.face_line[face])
        vertices, places, normals = (np.ascontiguousarray(corners[:, part]) for part in range(3))
        V, extra = self.vertices()
        return polygon_mesh(
            V,
            vertices,
            starts,
            places=places if (places >= 0).any() else None,
            normal_lines=normals if (normals >= 0).any() else None,
            vt=np.array(self.vt, dtype=np.float64).reshape(-1, 2) if self.vt else None,
            extra=extra,
            lines=OriginalLines(bytes(self.positions), V if extra is None else np.hstack([V, extra])),
            map_lines=OriginalLines(bytes(self.places), np.array(self.vt, dtype=np.float64).reshape(-1, 2)),
            normals=bytes(self.normals),
            statements=bytes(self.statements),
            statement_faces=np.array(self.statement_faces, dtype=np.int64),
            source=os.fspath(self.path),
        )

    def vertices(self) -> tuple[NDArray[np.float64], NDArray[np.float64] | None]:
        """Return the coordinates, and further numbers after them."""
        width = np.array(self.width, dtype=np.int64)
        rows = np.full((width.size, int(width.max())), np.nan)
        rows[np.arange(rows.shape[1]) < width[:, None]] = self.coordinates
        extra = np.ascontiguousarray(rows[:, 3:]) if rows.shape[1] > 3 else None
        return np.ascontiguousarray(rows[:, :3]), extra


class _FaultError(ValueError):
    """A fault on the current line, with the remedy for the user."""

    def __init__(self, what: str, remedy: str) -> None:
        super().__init__(what)
        self.remedy = remedy


def _logical_lines(data: bytes) -> Iterator[tuple[int, bytes]]:
    """Yield non-empty lines, each with its number; continued lines are joined under the first number."""
    # The buffer grows in place, because a hostile file may continue one line a million times.
    joined, start = bytearray(), 0
    for line, raw in enumerate(io.BytesIO(data), 1):
        text = raw[:-1]
        # A comment that ends in a backslash (often a path) does not continue on the next line.
        if text.endswith(b"\\") and (joined or not text.lstrip().startswith(b"#")):
            joined += text[:-1] + b" "
            start = start or line
            continue
        if start:
            text = bytes(joined + text)
            line, start = start, 0
            joined.clear()
        if text := text.lstrip():
            yield line, text
    if start and (text := bytes(joined).lstrip()):
        yield start, text


def _strip_comment(text: bytes) -> bytes:
    return text.split(b"#", 1)[0]


def _numbers(text: bytes, max_count: int) -> list[float]:
    tokens = _strip_comment(text).split(None, max_count + 1)[1:]
    if len(tokens) > max_count:
        raise _FaultError(
            f"{quote_token(text.split(None, 1)[0])} with more than {max_count} numbers", "remove the rest"
        )
    return [number(token) for token in tokens]


def _corner(text: bytes, counts: tuple[int, int, int]) -> list[int]:
    """Return the 0-based references of ``a``, ``a/b``, ``a//c`` or ``a/b/c``; -1 for an absent one."""
    parts = text.split(b"/", 3)
    if len(parts) > 3 or not parts[0]:
        raise ValueError(f"{quote_token(text)} is not a corner of a face")
    references = [-1, -1, -1]
    for i, part in enumerate(parts):
        if not part:
            continue
        index = integer(part)
        if index > 0:
            references[i] = index - 1
        elif index == 0:
            raise _FaultError(f"index 0 in {quote_token(text)}", "OBJ counts from 1")
        elif index < -counts[i]:
            raise ValueError(f"index {index} reaches back beyond the {counts[i]} that come before it")
        else:
            references[i] = counts[i] + index
    return references
