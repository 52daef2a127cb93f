"""Write values per triangle to files for other tools: CSV, NPZ and PLY."""

from __future__ import annotations

import os
from collections.abc import Mapping
from io import BytesIO
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike, NDArray

from quasiharmonic.io.atomic import write_whole
from quasiharmonic.io.errors import OutputError
from quasiharmonic.util.arrays import FloatArray, map_array, triangle_rows, vertex_array

#: Suffixes that `write_per_triangle` supports.
FORMATS = (".csv", ".npz", ".ply")
# Names that a format or its writer reserves.
_TAKEN = {"triangle", "F", "uv", "file", "args", "kwds", "allow_pickle", "vertex_indices", "quality"}


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
    OutputError
        If the suffix is not supported, or the file cannot be written.
    """
    V, F = vertex_array(V, finite=False), triangle_rows(F)
    uv = map_array("uv", uv, len(V), finite=False)
    columns = {name: np.asarray(value, dtype=np.float64) for name, value in values.items()}
    for name, column in columns.items():
        if not (name.isascii() and name.isidentifier()):
            raise ValueError(f"{name!r} is not a word of letters, digits and _")
        if name in _TAKEN:
            raise ValueError(f"{name!r} has a reserved meaning in this format: choose another name")
        if column.shape != (len(F),):
            raise ValueError(f"{name} must have shape ({len(F)},), one for each triangle, not {column.shape}")
    suffix = Path(path).suffix.lower()
    if suffix == ".csv":
        data = _csv(columns, len(F))
    elif suffix == ".npz":
        file = BytesIO()
        np.savez_compressed(file, F=F, uv=uv, **columns)  # type: ignore[arg-type]
        data = file.getvalue()
    elif suffix == ".ply":
        data = _ply(V, F, uv, columns)
    else:
        raise OutputError(f"cannot write {path}: values per triangle are written as {', '.join(FORMATS)}")
    write_whole(path, data)


def _csv(columns: Mapping[str, FloatArray], count: int) -> bytes:
    rows = zip(range(count), *(column.tolist() for column in columns.values()), strict=True)
    lines = [",".join(["triangle", *columns]), *(",".join(map(repr, row)) for row in rows)]
    return ("\n".join(lines) + "\n").encode()


def _ply(V: FloatArray, F: NDArray[np.int64], uv: FloatArray, columns: Mapping[str, FloatArray]) -> bytes:
    if V.shape[1] == 2:
        V = np.column_stack([V, np.zeros(len(V))])
    # MeshLab colours by "quality": write the first value under this name.
    properties = {"quality": next(iter(columns.values())), **columns} if columns else {}
    header = [
        "ply",
        "format binary_little_endian 1.0",
        f"element vertex {len(V)}",
        *(f"property double {name}" for name in ("x", "y", "z", "s", "t")),
        f"element face {len(F)}",
        "property list uchar int vertex_indices",
        *(f"property double {name}" for name in properties),
        "end_header\n",
    ]
    faces = np.empty(len(F), dtype=[("n", "u1"), ("corners", "<i4", 3), *((name, "<f8") for name in properties)])
    faces["n"], faces["corners"] = 3, F
    for name, column in properties.items():
        faces[name] = column
    vertices = np.column_stack([V, uv]).astype("<f8")
    return "\n".join(header).encode() + vertices.tobytes() + faces.tobytes()
