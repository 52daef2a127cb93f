"""Series of VTU files with a .pvd file that lists them, as ParaView opens it."""

from __future__ import annotations

from base64 import b64encode
from collections.abc import Iterable
from pathlib import Path
from xml.sax.saxutils import quoteattr

import numpy as np
from numpy.typing import NDArray

from quasiharmonic.io.lowlevel.atomic import write_whole
from quasiharmonic.util.arrays import FloatArray, IntArray

# VTK's kinds of cells, by number of nodes; in space, cells of four nodes are tetrahedra.
_KINDS = {3: 5, 4: 9, 6: 22}
_TETRAHEDRON = 10
_TYPES = {"f": "Float64", "i": "Int64", "u": "UInt8"}


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
    kinds = np.full(len(F), _TETRAHEDRON if points.shape[1] == 3 else _KINDS[F.shape[1]], dtype=np.uint8)
    if points.shape[1] == 2 and F.shape[1] == 4:
        triangular = F[:, 2] == F[:, 3]
        sizes[triangular], kinds[triangular] = 3, _KINDS[3]
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
    return f'{head} format="binary">{b64encode(len(data).to_bytes(8, "little") + data).decode()}</DataArray>\n'
