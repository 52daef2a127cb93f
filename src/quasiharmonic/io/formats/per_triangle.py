"""Write values per triangle to files for other tools: CSV, NPZ and PLY."""

from __future__ import annotations

import os
from collections.abc import Mapping
from io import BytesIO

import numpy as np
from numpy.typing import ArrayLike

from quasiharmonic.io.atomic import write_whole
from quasiharmonic.io.formats.plytables import Column, Element, PlyTables, encode_tables
from quasiharmonic.io.registry import find_function
from quasiharmonic.util.arrays import (
    FloatArray,
    IntArray,
    check_instance,
    map_array,
    pad_to_space,
    triangle_rows,
    vertex_array,
)

# Names that a format or its writer reserves.
_RESERVED = {"triangle", "F", "uv", "file", "args", "kwds", "allow_pickle", "vertex_indices", "quality"}


def write_per_triangle(
    path: str | os.PathLike[str], V: ArrayLike, F: ArrayLike, uv: ArrayLike, values: Mapping[str, ArrayLike]
) -> None:
    """Write a mesh, its map and values per triangle; the suffix selects the format.

    ``.csv``
        A header line, then a line for each triangle in the order of the mesh, with its index (from 0) first.
    ``.npz``
        The arrays ``F``, ``uv`` and one for each name, for `numpy.load`.
    ``.ply``
        The surface with the map as texture coordinates (``s``, ``t``) of its vertices and the values as properties of
        its faces. The first value is also written as ``quality``, which MeshLab and others use as colour. Positions and
        values are doubles.

    Numbers are written so that reading them returns the same doubles.

    Parameters
    ----------
    path : str or path-like
        The file to write; an existing file is replaced when the new one is complete.
    V : (n, 2) or (n, 3) float
        Rest positions.
    F : (f, 3) int
        Triangles.
    uv : (n, 2) float
        Positions in the plane.
    values : mapping of str to (f,) float
        For example `quasiharmonic.Distortion.per_triangle`. Names consist of letters, digits and ``_``, and must not be
        reserved by a format.

    Raises
    ------
    ValueError
        If an array has the wrong shape, or a name is not a word or is reserved.
    MeshFileError
        If the format is not supported.
    OutputError
        If the file cannot be written.
    """
    check_instance("values", values, Mapping)
    encode = find_function(path, "encode_values")
    V, F = vertex_array(V, finite=False), triangle_rows(F)
    uv = map_array("uv", uv, len(V), finite=False)
    columns = {name: np.asarray(value, dtype=np.float64) for name, value in values.items()}
    for name, column in columns.items():
        if not (name.isascii() and name.isidentifier()):
            raise ValueError(f"{name!r} is not a word of letters, digits and _")
        if name in _RESERVED:
            raise ValueError(f"{name!r} has a reserved meaning in this format: choose another name")
        if column.shape != (len(F),):
            raise ValueError(f"{name} must have shape ({len(F)},), one for each triangle, not {column.shape}")
    write_whole(path, encode(V, F, uv, columns))


def encode_csv(V: FloatArray, F: IntArray, uv: FloatArray, columns: Mapping[str, FloatArray]) -> bytes:
    """Return a CSV file of the columns; the positions are not stored."""
    rows = zip(range(len(F)), *(column.tolist() for column in columns.values()), strict=True)
    lines = [",".join(["triangle", *columns]), *(",".join(map(repr, row)) for row in rows)]
    return ("\n".join(lines) + "\n").encode()


def encode_npz(V: FloatArray, F: IntArray, uv: FloatArray, columns: Mapping[str, FloatArray]) -> bytes:
    """Return an NPZ file of the triangles, the map and the columns."""
    file = BytesIO()
    np.savez_compressed(file, F=F, uv=uv, **columns)  # type: ignore[arg-type]
    return file.getvalue()


def encode_ply(V: FloatArray, F: IntArray, uv: FloatArray, columns: Mapping[str, FloatArray]) -> bytes:
    """Return a binary PLY file of the surface, the map and the columns."""
    # MeshLab colours by "quality": write the first value under this name.
    properties = {"quality": next(iter(columns.values())), **columns} if columns else {}
    places = np.column_stack([pad_to_space(V), uv]).T
    vertices = [Column(name, values) for name, values in zip(("x", "y", "z", "s", "t"), places, strict=True)]
    corners = Column("vertex_indices", F.ravel().astype(np.int32), np.full(len(F), 3))
    faces = [corners, *(Column(name, values) for name, values in properties.items())]
    elements = Element("vertex", len(V), tuple(vertices)), Element("face", len(F), tuple(faces))
    return encode_tables(PlyTables(elements))
