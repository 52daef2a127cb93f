"""Normals as `MeshData` has them, lines of an OBJ file, and as numbers."""

from __future__ import annotations

import numpy as np

from quasiharmonic.util.arrays import FloatArray


def normal_lines(normals: FloatArray) -> bytes:
    """Normals (k, 3) as the lines of an OBJ file."""
    return ("vn %r %r %r\n" * len(normals) % tuple(normals.ravel().tolist())).encode()


def normal_rows(lines: bytes) -> FloatArray | None:
    """Normals (k, 3) of the lines of an OBJ file; None where one is not three numbers."""
    try:
        rows = [[float(word) for word in line.split(b"#")[0].split()[1:]] for line in lines.splitlines()]
        return np.array(rows, dtype=np.float64).reshape(len(rows), 3)
    except ValueError:
        return None
