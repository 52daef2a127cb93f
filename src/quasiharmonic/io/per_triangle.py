"""Values per triangle in files that other tools read: CSV, NPZ and PLY."""

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

#: Suffixes that `write_per_triangle` knows.
FORMATS = (".csv", ".npz", ".ply")
# Names that one of the formats, or what writes it, has a use of its own for.
_TAKEN = {"triangle", "F", "uv", "file", "args", "kwds", "allow_pickle", "vertex_indices", "quality"}


def write_per_triangle(
    path: str | os.PathLike[str], V: ArrayLike, F: ArrayLike, uv: ArrayLike, values: Mapping[str, ArrayLike]
) -> None:
    """Write values per triangle beside a mesh, in the format that the suffix says.

    ``.csv``
        A line of names and a line for each triangle, in the mesh's order, its number (from 0) first.
    ``.npz``
        The arrays ``F``, ``uv`` and one for each name, for `numpy.load`.
    ``.ply``
        The surface with the map as texture coordinates (``s``, ``t``) of its vertices and the values as
        properties of its faces, the first of them also as ``quality``, by which MeshLab and others colour.
        Positions and values are doubles.

    Numbers are written such that reading them gives the same double.

    Parameters
    ----------
    path : str or path-like
        Replaced as a whole once the file is complete.
    V : (n, 2) or (n, 3) float
    F : (f, 3) int
    uv : (n, 2) float
    values : mapping of str to (f,) float
        For example `quasiharmonic.Distortion.per_triangle`; names are words of letters, digits and ``_``, and none
        that the formats have a use of their own for.

    Raises
    ------
    ValueError
        When an array has another shape, or a name is not a word or is taken.
    OutputError
        When the suffix is another, or the file cannot be written.
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
    # By the first of them MeshLab colours.
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
