"""Read and write surfaces in OFF, the Object File Format of Geomview."""

from __future__ import annotations

import os
import re
from array import array
from collections.abc import Iterator

import numpy as np

from quasiharmonic.io.atomic import write_whole
from quasiharmonic.io.errors import MeshFileError, report_damage
from quasiharmonic.io.models.mesh_maps import in_plane, vertex_places
from quasiharmonic.io.models.meshdata import MeshData, polygon_mesh
from quasiharmonic.io.untrusted import (
    content_lines,
    integer,
    integer_table,
    number,
    number_table,
    quote_token,
    read_text,
)
from quasiharmonic.util.arrays import FloatArray, IntArray, vertex_names

# Texture coordinates, colours and normals follow the coordinates, so the reader can skip them.
_HEADER = re.compile(rb"(?:ST)?C?N?OFF")
# More corners indicate a damaged file.
_MAX_CORNERS = 1000


def read_off(path: str | os.PathLike[str]) -> MeshData:
    """Read a mesh of triangles and other polygons from an OFF file.

    The counts may follow the header on the same line. Comments are ignored, and so are further numbers after the
    coordinates of a vertex or the corners of a face (colours, normals).

    Returns
    -------
    MeshData
        Vertices and faces in the order of the file, numbers correctly rounded to double.

    Raises
    ------
    MeshFileError
        With the line, for a face of fewer than three corners, a polygon with a repeated vertex, an index out of range,
        text that is not a finite number, or wrong counts. Also for another kind of OFF (binary, four-dimensional), and
        for a file that is missing or not text.
    """
    data = read_text(path)
    lines = content_lines(data)
    line, text = next(lines, (1, b""))
    header, *counts = text.split(None, 3) or [b""]
    if not _HEADER.fullmatch(header):
        raise MeshFileError(path, f"{quote_token(text)} and not OFF", line, "only the plain text form is supported")
    if not counts:
        line, text = next(lines, (line, b""))
        counts = text.split(None, 2)
    if len(counts) < 2:
        raise MeshFileError(path, "no counts of vertices and faces", line)
    with report_damage(path, "no counts of vertices and faces: ", line=line):
        vertices, faces = integer(counts[0]), integer(counts[1])
    if vertices < 1 or faces < 1:
        what = f"has {vertices} vertices and {faces} faces"
        raise MeshFileError(path, what, line, "give a mesh with vertices and faces")
    arrays = read_regular(data, line, vertices, faces) or _read_lines(path, lines, vertices, faces)
    return polygon_mesh(*arrays, source=os.fspath(path))


def write_off(path: str | os.PathLike[str], mesh: MeshData) -> None:
    """Write a mesh as an OFF file, atomically.

    Numbers are written so that reading them returns the same doubles.

    Parameters
    ----------
    path : str or path-like
        The file to write.
    mesh : MeshData
        The mesh; OFF stores its vertices and faces.

    Raises
    ------
    OutputError
        If the file cannot be written. An existing file is then unchanged.
    """
    head = f"OFF\n{len(mesh.V)} {mesh.faces} 0\n"
    points = "%r %r %r\n" * len(mesh.V) % tuple(mesh.V.ravel().tolist())
    forms = {size: f"{size}" + " %d" * size + "\n" for size in np.unique(mesh.rings.sizes).tolist()}
    faces = "".join(map(forms.__getitem__, mesh.rings.sizes.tolist()))
    faces %= tuple(mesh.F.ravel()[mesh.rings.corners].tolist())
    write_whole(path, (head + points + faces).encode())


def write_off_map(path: str | os.PathLike[str], mesh: MeshData) -> None:
    """Write the map of a mesh as a mesh in the plane; raise `MeshFileError` if it has seams, which OFF cannot store."""
    if mesh.FT is not None and (seam := vertex_places(mesh)[1]).any():
        what = f"OFF cannot store more than one pair of texture coordinates for {vertex_names(np.flatnonzero(seam))}"
        raise MeshFileError(path, what, remedy="write OBJ or PLY")
    write_off(path, in_plane(mesh))


def read_regular(data: bytes, line: int, vertices: int, faces: int) -> tuple[FloatArray, IntArray, IntArray] | None:
    """Read the vertices and triangles after ``line`` if all lines have the regular form; otherwise return None."""
    if data.count(b"\n") != line + vertices + faces:
        return None
    ends = np.flatnonzero(np.frombuffer(data, dtype=np.uint8) == ord("\n")) + 1
    first, middle = int(ends[line - 1]), int(ends[line + vertices - 1])
    V = number_table(data[first:middle], b"", vertices)
    F = integer_table(data[middle:], b"1 1 1 1\n", faces)
    if V is None or V.shape[1] < 3 or F is None or np.any(F[:, 0] != 3) or F.max() >= vertices:
        return None
    return np.ascontiguousarray(V[:, :3]), F[:, 1:].ravel(), 3 * np.arange(faces + 1)


def _read_lines(
    path: str | os.PathLike[str], lines: Iterator[tuple[int, bytes]], vertices: int, faces: int
) -> tuple[FloatArray, IntArray, IntArray]:
    """Read vertices and faces line by line; return positions, corners ring after ring, and starts of the rings."""
    # The sizes do not come from the counts, which may be wrong.
    V, corners, starts = array("d"), array("q"), array("q", [0])
    line = 0
    for line, text in lines:
        with report_damage(path, line=line):
            if len(V) < 3 * vertices:
                tokens = text.split(None, 3)[:3]
                if len(tokens) < 3:
                    raise MeshFileError(path, "a vertex with fewer than three coordinates", line)
                V.extend([number(token) for token in tokens])
                continue
            if len(starts) == faces + 1:
                raise MeshFileError(path, f"more follows the {faces} faces", line, "correct the counts")
            corners.extend(_ring(path, line, text, vertices))
            starts.append(len(corners))
    if len(starts) <= faces:
        have = f"{len(V) // 3} of {vertices} vertices and {len(starts) - 1} of {faces} faces"
        raise MeshFileError(path, f"ends after {have}", remedy="it was cut off, or its counts are wrong")
    return np.array(V).reshape(-1, 3), np.array(corners), np.array(starts)


def _ring(path: str | os.PathLike[str], line: int, text: bytes, vertices: int) -> list[int]:
    """Return the corners of the face on a line."""
    count, *rest = text.split(None, _MAX_CORNERS + 1)
    size = integer(count)
    if not 3 <= size <= _MAX_CORNERS:
        remedy = "a triangle has 3" if size < 3 else "triangulate it first"
        raise MeshFileError(path, f"face with {size} corners", line, remedy)
    if len(rest) < size:
        raise MeshFileError(path, f"face of {size} corners lists only {len(rest)}", line)
    ring = [integer(corner) for corner in rest[:size]]
    beyond = next((index for index in ring if not 0 <= index < vertices), None)
    if beyond is not None:
        raise MeshFileError(path, f"index {beyond}, but the file has {vertices} vertices", line, "OFF counts from 0")
    if size > 3 and len(set(ring)) < size:
        raise MeshFileError(path, f"face with {size} corners that uses a vertex twice", line, "remove the repetition")
    return ring
