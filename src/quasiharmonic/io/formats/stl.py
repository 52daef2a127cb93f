"""Read STL files. STL stores triangles without shared vertices, so vertices at equal positions are merged."""

from __future__ import annotations

import os
import re

import numpy as np

from quasiharmonic.geometry.mesh.splitting import weld_points
from quasiharmonic.io.errors import MeshFileError, report_damage
from quasiharmonic.io.models.meshdata import MeshData
from quasiharmonic.io.untrusted import read_bytes
from quasiharmonic.util.arrays import FloatArray

_FACET = np.dtype([("normal", "<f4", 3), ("corners", "<f4", (3, 3)), ("attribute", "<u2")])
_HEADER = 84
# Loops of three vertices, separated by any white space.
_NUMBER = rb"\s+([-+.0-9eE]+)"
_LOOP = re.compile(rb"outer\s+loop" + 3 * (rb"\s+vertex" + 3 * _NUMBER) + rb"\s+endloop\s+endfacet", re.IGNORECASE)
# Names of solids may contain the word "facet" alone.
_FACET_START = re.compile(rb"(?<!\S)facet\s+(?:normal|outer)\s", re.IGNORECASE)


def read_stl(path: str | os.PathLike[str]) -> MeshData:
    """Read a surface from an STL file, text or binary.

    Corners at exactly equal positions become one vertex.

    Returns
    -------
    MeshData
        Triangles in the order of the file, vertices in the order of their first occurrence. Normals, names of solids
        and attributes are dropped.

    Raises
    ------
    MeshFileError
        If the file is not STL, is damaged, or has no triangles.
    """
    data = read_bytes(path)
    # The header of a binary file may start with "solid" too, so its length decides.
    corners = _read_binary(data)
    if corners is None:
        corners = _read_text(data)
    if corners is None:
        raise MeshFileError(path, "is not a text or binary STL file, or is cut off")
    if not len(corners):
        raise MeshFileError(path, "has no triangles", remedy="give a mesh with triangles")
    V, F = weld_points(corners.reshape(-1, 3))
    with report_damage(path):
        return MeshData(V, F.reshape(-1, 3), source=os.fspath(path))


def _read_binary(data: bytes) -> FloatArray | None:
    """Return the corners (f, 3, 3) of a binary file; None if its length does not match its header."""
    count = int.from_bytes(data[_HEADER - 4 : _HEADER], "little")
    if len(data) < _HEADER or len(data) != _HEADER + count * _FACET.itemsize:
        return None
    # Converting a signalling NaN is invalid; it is reported later as not finite.
    with np.errstate(invalid="ignore"):
        return np.frombuffer(data, _FACET, offset=_HEADER)["corners"].astype(np.float64)


def _read_text(data: bytes) -> FloatArray | None:
    """Return the corners (f, 3, 3) of a text file; None if it is not STL text or a facet is malformed."""
    if data[:512].lstrip()[:5].lower() != b"solid" or b"endsolid" not in data.lower():
        return None
    facets = _LOOP.findall(data)
    if len(facets) != len(_FACET_START.findall(data)):
        return None
    try:
        return np.array([list(map(float, facet)) for facet in facets], dtype=np.float64).reshape(-1, 3, 3)
    except ValueError:
        return None
