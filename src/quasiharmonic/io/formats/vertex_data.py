"""Data of vertices that several formats treat alike.

Normals are OBJ lines in `MeshData`, and colours the numbers after the coordinates. Vertices at equal positions are
merged if files store triangles without shared vertices.
"""

from __future__ import annotations

import numpy as np

from quasiharmonic.io.models.meshdata import MeshData
from quasiharmonic.util.arrays import FloatArray, IntArray


def normal_lines(normals: FloatArray) -> bytes:
    """Return normals (k, 3) as lines of an OBJ file."""
    return ("vn %r %r %r\n" * len(normals) % tuple(normals.ravel().tolist())).encode()


def normals_of(mesh: MeshData) -> FloatArray | None:
    """Return all normals (k, 3) of a mesh; None if a corner has none, or a line has anything but three numbers."""
    if mesh.FN is None or (mesh.FN < 0).any():
        return None
    try:
        rows = [[float(word) for word in line.split(b"#")[0].split()[1:]] for line in mesh.normals.splitlines()]
        return np.array(rows, dtype=np.float64).reshape(len(rows), 3)
    except ValueError:
        return None


def colours_of(mesh: MeshData) -> FloatArray | None:
    """Return colours of vertices from 0 to 1, with or without opacity; None unless all vertices have one."""
    extra = mesh.extra
    if extra is None or extra.shape[1] not in (3, 4) or not ((extra >= 0) & (extra <= 1)).all():
        return None
    return extra


def weld(points: FloatArray) -> tuple[FloatArray, IntArray]:
    """Return the distinct points of (k, d), in the order of their first occurrence, and the row of each point (k,)."""
    _, first, which = np.unique(points + 0.0, axis=0, return_index=True, return_inverse=True)
    order = np.argsort(first)
    return points[first[order]], np.argsort(order)[which.ravel()]
