"""A square as the lines of an OBJ file, and comparisons of meshes that were read to the last bit."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from quasiharmonic.io import MeshData
from quasiharmonic.io.formats.obj import read_regular
from quasiharmonic.io.formats.objlines import read_obj_lines
from quasiharmonic.io.untrusted import read_text

SQUARE = "v 0 0 0\nv 1 0 0\nv 1 1 0\nv 0 1 0\n"
SQUARE_VT = "vt 0 0\nvt 2 0\nvt 2 2\nvt 0 2\n"
SQUARE_VN = "vn 0 0 1\nvn 0 0 -1\n"
SQUARE_F = [[0, 1, 2], [0, 2, 3]]


def bits(a: np.ndarray) -> list:
    """Return doubles as integers: equal means equal to the last bit, including -0.0 and NaN."""
    return np.ascontiguousarray(a, dtype=np.float64).view(np.int64).tolist()


def same(a: MeshData, b: MeshData) -> bool:
    """Test whether two meshes agree in all data, bit by bit."""
    for name in ("V", "vt", "extra"):
        x, y = getattr(a, name), getattr(b, name)
        if (x is None) != (y is None) or (x is not None and (x.shape != y.shape or bits(x) != bits(y))):
            return False
    for name in ("F", "FT", "FN", "statement_faces"):
        x, y = getattr(a, name), getattr(b, name)
        if (x is None) != (y is None) or (x is not None and not np.array_equal(x, y)):
            return False
    return (a.normals, a.statements) == (b.normals, b.statements)


def both_readers_agree(path: Path) -> bool:
    """Test whether the fast reader accepts a file and reads the same data as the reader of any file."""
    data = read_text(path)
    regular = read_regular(path, data)
    return regular is not None and same(regular, read_obj_lines(path, data))
