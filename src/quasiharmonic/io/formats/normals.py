"""Convert normals between the OBJ lines of `MeshData` and arrays of numbers."""

from __future__ import annotations

import numpy as np

from quasiharmonic.util.arrays import FloatArray


def normal_lines(normals: FloatArray) -> bytes:
    """Return normals (k, 3) as lines of an OBJ file."""
    return ("vn %r %r %r\n" * len(normals) % tuple(normals.ravel().tolist())).encode()


def normal_rows(lines: bytes) -> FloatArray | None:
    """Return the normals (k, 3) of lines of an OBJ file; None if a line has anything but three numbers."""
    try:
        rows = [[float(word) for word in line.split(b"#")[0].split()[1:]] for line in lines.splitlines()]
        return np.array(rows, dtype=np.float64).reshape(len(rows), 3)
    except ValueError:
        return None
