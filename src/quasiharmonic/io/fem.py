"""Planar meshes of finite-element programs: Gmsh, VTK/VTU and what else meshlane reads and writes.

Only positions are ever changed. Cells, point and cell data, physical groups and their names, and the order of
everything come through as they were.
"""

from __future__ import annotations

import contextlib
import os
import shutil
import tempfile
from dataclasses import dataclass
from io import StringIO
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from quasiharmonic.mesh.topology import named

from .atomic import check_writable, write_whole
from .errors import MeshFileError

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]

#: Cells without area, which a triangle mesh may have besides its triangles.
_LOWER = ("vertex", "line")
_MSH = {"2": "gmsh22", "4.0": "gmsh40", "4.1": "gmsh"}


@dataclass(frozen=True, eq=False)
class FemMesh:
    """A planar triangle mesh and all else that its file holds.

    Attributes
    ----------
    points : (n, 2) float64
        Every point of the file, in its order.
    F : (f, 3) int64
        Triangles of all blocks of the file, in their order.
    source : Path
    content : meshlane.Mesh
        The file as it was read.
    """

    points: FloatArray
    F: IntArray
    source: Path
    content: Any

    def point_field(self, name: str) -> FloatArray:
        """A vector at every point, (n, 2) float64, from the file's point data."""
        fields = self.content.point_data
        if name not in fields:
            there = ", ".join(map(repr, sorted(fields))) or "none"
            raise MeshFileError(self.source, f"there is no point data {name!r}", remedy=f"there are: {there}")
        values = np.asarray(fields[name], dtype=np.float64)
        if values.ndim != 2 or values.shape[1] not in (2, 3) or (values[:, 2:] != 0).any():
            raise MeshFileError(self.source, f"the point data {name!r} are no vectors in the plane")
        lost = np.flatnonzero(~np.isfinite(values).all(axis=1))
        if lost.size:
            raise MeshFileError(self.source, f"{name!r} is not finite at {named('point', 'points', lost)} (0-based)")
        return values[:, :2].copy()


def read_fem(path: str | os.PathLike[str]) -> FemMesh:
    """Read a planar triangle mesh for finite elements.

    Parameters
    ----------
    path : str or path-like
        A ``.msh``, ``.vtu``, ``.vtk``, or another format that meshlane reads.

    Raises
    ------
    ImportError
        When meshlane is not installed.
    MeshFileError
        When the file cannot be read, has cells with area other than three-node triangles, no triangles, or
        is not planar.
    """
    meshlane = _meshlane()
    source = Path(path)
    try:
        # The library prints blank lines as it goes.
        with contextlib.redirect_stdout(StringIO()):
            content = meshlane.read(source)
    except (Exception, SystemExit) as error:
        # The library's readers raise what they come across, and some of them end the program.
        raise MeshFileError(path, f"cannot be read: {str(error) or type(error).__name__}") from error
    other = sorted({block.type for block in content.cells} - {"triangle", *_LOWER})
    if other:
        raise MeshFileError(
            path, f"has cells of the kind {', '.join(other)}", remedy="three-node triangles are needed: split them"
        )
    blocks = [np.asarray(block.data, dtype=np.int64) for block in content.cells if block.type == "triangle"]
    if not blocks:
        raise MeshFileError(path, "has no triangles")
    points = np.asarray(content.points, dtype=np.float64)
    F = np.concatenate(blocks)
    lost = np.flatnonzero(~np.isfinite(points).all(axis=1))
    if lost.size:
        raise MeshFileError(path, f"not finite at {named('point', 'points', lost)} (0-based)")
    if points.shape[1] == 3 and (points[F, 2] != points[F[0, 0], 2]).any():
        raise MeshFileError(path, "is not planar", remedy="a mesh in the plane z = constant is needed")
    return FemMesh(points[:, :2].copy(), F, source, content)


def write_fem(path: str | os.PathLike[str], mesh: FemMesh, points: ArrayLike) -> None:
    """Write a mesh that was read, with other positions in the plane.

    Parameters
    ----------
    path : str or path-like
        Replaced as a whole once the file is complete. With the suffix that was read, the file gets the
        version and encoding of the one that was read.
    mesh : FemMesh
    points : (n, 2) array

    Raises
    ------
    ValueError
        When ``points`` has another shape or is not finite.
    MeshFileError
        When the format cannot be written.
    OutputError
        When the file cannot be written.
    """
    meshlane = _meshlane()
    points = np.asarray(points, dtype=np.float64)
    if points.shape != mesh.points.shape or not np.isfinite(points).all():
        raise ValueError(f"points must be {mesh.points.shape} finite numbers")
    check_writable(path)
    content = mesh.content.copy()
    content.points = np.array(content.points, dtype=np.float64)
    content.points[:, :2] = points
    with tempfile.TemporaryDirectory() as folder:
        part = Path(folder) / Path(path).name
        try:
            with contextlib.redirect_stdout(StringIO()):
                meshlane.write(part, content, **_like(mesh.source, part.suffix))
        except (Exception, SystemExit) as error:
            raise MeshFileError(path, f"cannot be written: {str(error) or type(error).__name__}") from error
        with open(part, "rb") as whole:
            write_whole(path, lambda file: shutil.copyfileobj(whole, file))


def _like(source: Path, suffix: str) -> dict[str, Any]:
    """Options to write a Gmsh file in the version and encoding of another; nothing for other formats."""
    if not source.suffix.lower() == suffix.lower() == ".msh":
        return {}
    with open(source, "rb") as file:
        head = file.read(4096).partition(b"$MeshFormat")[2].split()
    version, binary = head[0].decode(), head[1] == b"1"
    return {"file_format": _MSH.get(version, _MSH.get(version[0], "gmsh")), "binary": binary}


def _meshlane() -> Any:
    try:
        import meshlane
    except ImportError as error:
        raise ImportError("meshes of finite elements need meshlane: pip install 'quasiharmonic[fem]'") from error
    return meshlane
