"""STL: triangles without a word on how they are joined, which equal positions tell; read only."""

from __future__ import annotations

import os
import re

import numpy as np

from quasiharmonic.io.errors import MeshFileError
from quasiharmonic.io.formats.welding import welded
from quasiharmonic.io.meshdata import MeshData
from quasiharmonic.io.textual import read_bytes
from quasiharmonic.util.arrays import FloatArray

_FACET = np.dtype([("normal", "<f4", 3), ("corners", "<f4", (3, 3)), ("attribute", "<u2")])
_HEADER = 84
# Loops of three vertices; blanks are any.
_NUMBER = rb"\s+([-+.0-9eE]+)"
_LOOP = re.compile(rb"outer\s+loop" + 3 * (rb"\s+vertex" + 3 * _NUMBER) + rb"\s+endloop\s+endfacet", re.IGNORECASE)
_FACET_WORD = re.compile(rb"^\s*facet\s", re.IGNORECASE | re.MULTILINE)


def read_stl(path: str | os.PathLike[str]) -> MeshData:
    """Read a surface from an STL file, text or binary.

    Corners at equal positions, to the last bit, are one vertex.

    Parameters
    ----------
    path : str or path-like
        The file.

    Returns
    -------
    MeshData
        Triangles in the order of the file, vertices in that in which they come first. Of normals, names of solids and
        attributes nothing is kept.

    Raises
    ------
    MeshFileError
        When it is no STL file, is damaged, or has no triangles.
    """
    data = read_bytes(path)
    # The header of a binary file may say anything, "solid" too; its length does not lie.
    corners = _binary(data)
    if corners is None:
        corners = _text(data)
    if corners is None:
        raise MeshFileError(path, "is not a text or binary STL file, or is cut off")
    if not len(corners):
        raise MeshFileError(path, "has no triangles", remedy="give a mesh with triangles")
    V, F = welded(corners.reshape(-1, 3))
    try:
        return MeshData(V, F.reshape(-1, 3), source=os.fspath(path))
    except ValueError as error:
        raise MeshFileError(path, str(error)) from error


def _binary(data: bytes) -> FloatArray | None:
    """Corners (f, 3, 3) in a binary file; None where its length is not what its header says."""
    count = int.from_bytes(data[_HEADER - 4 : _HEADER], "little")
    if len(data) < _HEADER or len(data) != _HEADER + count * _FACET.itemsize:
        return None
    # A signalling NaN, which is invalid in a conversion, is reported as what is not finite.
    with np.errstate(invalid="ignore"):
        return np.frombuffer(data, _FACET, offset=_HEADER)["corners"].astype(np.float64)


def _text(data: bytes) -> FloatArray | None:
    """Corners (f, 3, 3) in a text; None where it is none, or a facet is not what it should be."""
    if data[:512].lstrip()[:5].lower() != b"solid" or b"endsolid" not in data.lower():
        return None
    facets = _LOOP.findall(data)
    if len(facets) != len(_FACET_WORD.findall(data)):
        return None
    try:
        return np.array([list(map(float, facet)) for facet in facets], dtype=np.float64).reshape(-1, 3, 3)
    except ValueError:
        return None
