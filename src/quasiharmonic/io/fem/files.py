"""Meshes of finite-element programs, in the plane and in space: Gmsh's MSH, VTK's legacy and XML files.

Writing changes only the positions, in place. Every other byte is unchanged: cells, data, time steps, physical groups
and their names, numbering.
"""

from __future__ import annotations

import os
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike

from quasiharmonic.io.errors import MeshFileError
from quasiharmonic.io.fem.meshparts import MeshParts
from quasiharmonic.io.lowlevel.atomic import check_writable, write_whole
from quasiharmonic.io.models.meshdata import is_planar
from quasiharmonic.io.registry import find_format, suffixes
from quasiharmonic.util.arrays import FloatArray, IntArray, map_array, names_of

# Errors that readers may raise on damaged files.
_DAMAGE = (ValueError, IndexError, KeyError, OverflowError)


@dataclass(frozen=True, eq=False)
class FemMesh:
    """A planar mesh and all other data of its file."""

    points: FloatArray  # (n, 2): every point of the file, in its order
    # (f, 3), (f, 4) or (f, 6): triangles and quadrilaterals of all blocks of the file, in order, in the format of
    # `geometry.mesh.elements`
    F: IntArray
    source: Path  # The file
    parts: MeshParts  # The parsed file

    def point_field(self, name: str, vertices: ArrayLike) -> FloatArray:
        """Return vectors at some points, (k, 2) float64, from the file's point data at the last time.

        MeshFileError if the data do not exist, are not vectors in the plane, or a value at these points is not finite.
        """
        values = _point_field(self.source, self.parts, name, vertices)
        if values.shape[1] not in (2, 3):
            raise MeshFileError(
                self.source,
                f"the point data {name!r} are not plane vectors: they have {values.shape[1]} numbers for each point",
            )
        if values[:, 2:].any():
            raise MeshFileError(self.source, f"the point data {name!r} have displacements out of the plane")
        return values[:, :2].copy()


@dataclass(frozen=True, eq=False)
class VolumeMesh:
    """A mesh of tetrahedra and hexahedra and all other data of its file."""

    points: FloatArray  # (n, 3): every point of the file, in its order
    T: IntArray  # (t, 4): tetrahedra of all blocks of the file, in order
    H: IntArray  # (h, 8): hexahedra
    source: Path  # The file
    parts: MeshParts  # The parsed file

    def point_field(self, name: str, vertices: ArrayLike) -> FloatArray:
        """Return vectors at some points, (k, 3) float64, from the file's point data at the last time.

        MeshFileError if the data do not exist, are not vectors in space, or a value at these points is not finite.
        """
        values = _point_field(self.source, self.parts, name, vertices)
        if values.shape[1] != 3:
            raise MeshFileError(
                self.source,
                f"the point data {name!r} are not vectors in space: they have {values.shape[1]} numbers for each point",
            )
        return values


def _point_field(source: Path, parts: MeshParts, name: str, vertices: ArrayLike) -> FloatArray:
    """Return finite values at some points, (k, m) float64."""
    which, fields = np.asarray(vertices, dtype=np.int64), parts.fields
    if name not in fields:
        there = ", ".join(map(repr, sorted(fields))) or "none"
        raise MeshFileError(source, f"there is no point data {name!r}", remedy=f"available: {there}")
    try:
        # Converting a signalling NaN to double raises a warning.
        with np.errstate(invalid="ignore"):
            values = fields[name]()[which]
    except _DAMAGE as error:
        raise MeshFileError(source, f"the point data {name!r} cannot be read: {error}") from error
    lost = which[~np.isfinite(values).all(axis=1)]
    if lost.size:
        raise MeshFileError(
            source,
            f"{name!r} has no finite value at {names_of('boundary point', 'boundary points', lost)} (0-based)",
            remedy="give every boundary point a value, 0 for points that do not move",
        )
    return values


def read_fem(path: str | os.PathLike[str]) -> FemMesh:
    """Read a planar mesh for finite elements: .msh of version 2 or 4, legacy .vtk or .vtu, as text or binary.

    MeshFileError if the format is not supported, the file cannot be read, or the mesh is not planar. Also if the file
    has no triangles or quadrilaterals, or cells with area other than triangles of three or six nodes and quadrilaterals
    of four.
    """
    source = Path(path)
    return _mesh(source, _read_bytes(source))


def read_volume(path: str | os.PathLike[str]) -> VolumeMesh:
    """Read the tetrahedra and hexahedra of a file as for `read_fem`; cells without volume are allowed.

    MeshFileError if the format is not supported, the file cannot be read, or it has other cells with volume.
    """
    source = Path(path)
    return _volume(source, _read_bytes(source))


def _read_bytes(path: Path) -> bytes:
    try:
        return path.read_bytes()
    except OSError as error:
        raise MeshFileError(path, f"cannot be read: {error.strerror or error}") from error


def check_fem_output(path: str | os.PathLike[str], source: str | os.PathLike[str]) -> None:
    """Check before a computation whether a mesh could be written.

    MeshFileError if the suffix differs from that of the source, because a conversion would lose data; OutputError if
    the file cannot be written.
    """
    there, here = Path(path).suffix.lower(), Path(source).suffix.lower()
    if here in suffixes("read_elements") and there != here:
        raise MeshFileError(
            path,
            f"a {here} file can only be written as {here}: {there or 'a file without suffix'} could lose groups, "
            "data or times",
            remedy="convert the written file if you need another format",
        )
    check_writable(path)


def write_fem(path: str | os.PathLike[str], mesh: FemMesh, points: ArrayLike) -> None:
    """Write a mesh with new positions (n, 2) in the plane; every other byte of its file is unchanged.

    Positions are rounded to single precision if the file has single precision. ValueError if they have the wrong shape
    or are not finite; MeshFileError if they are too large for the file's precision. Other errors as `check_fem_output`.
    """
    points = map_array("points", points, len(mesh.points))
    check_fem_output(path, mesh.source)
    data = _replace_points(path, mesh.parts, points)
    written = _mesh(mesh.source, data)
    _check_written(path, mesh.parts, written.parts, points)
    write_whole(path, data)


def write_volume(path: str | os.PathLike[str], mesh: VolumeMesh, points: FloatArray) -> None:
    """Write a mesh with new positions (n, 3), finite; as `write_fem`."""
    check_fem_output(path, mesh.source)
    data = _replace_points(path, mesh.parts, points)
    _check_written(path, mesh.parts, _volume(mesh.source, data).parts, points)
    write_whole(path, data)


def _replace_points(path: str | os.PathLike[str], parts: MeshParts, points: FloatArray) -> bytes:
    if not np.isfinite(_rounded(parts, points)).all():
        raise MeshFileError(path, "positions are too large for the file's single precision")
    return parts.replace_points(points)


def _rounded(parts: MeshParts, points: FloatArray) -> FloatArray:
    with np.errstate(over="ignore"):
        return points.astype(parts.precision).astype(np.float64)


def _check_written(path: str | os.PathLike[str], parts: MeshParts, written: MeshParts, points: FloatArray) -> None:
    """Raise a MeshFileError unless a new file has the new positions and the old cells."""
    axes = points.shape[1]
    if not (
        np.array_equal(written.points[:, :axes], _rounded(parts, points))
        and np.array_equal(written.F, parts.F)
        and np.array_equal(written.points[:, axes:], parts.points[:, axes:])
    ):
        raise MeshFileError(path, "nothing was written, because the new file would not read back correctly")


def _parse(source: Path, data: bytes, solid: bool) -> MeshParts:
    """Parse a file, with its tetrahedra and hexahedra if ``solid``."""
    reader = find_format(source, "read_elements").read_elements
    assert reader is not None
    try:
        with np.errstate(invalid="ignore"):
            parts = reader(data, solid)
    except _DAMAGE as error:
        what = str(error) if isinstance(error, ValueError) else f"an entry is missing ({error})"
        raise MeshFileError(source, f"cannot be read: {what}") from error
    return parts


def _volume(source: Path, data: bytes) -> VolumeMesh:
    """Parse a mesh in space."""
    parts = _parse(source, data, True)
    tetrahedra = np.full(len(parts.F), parts.F.shape[1] == 4) | (parts.F[:, 3] == parts.F[:, -1])
    H = parts.F[~tetrahedra] if parts.F.shape[1] == 8 else np.empty((0, 8), dtype=np.int64)
    return VolumeMesh(parts.points, parts.F[tetrahedra, :4], H, source, parts)


def _mesh(source: Path, data: bytes) -> FemMesh:
    """Parse a file and check it."""
    parts = _parse(source, data, False)
    points, F = parts.points, parts.F
    if not F.size:
        raise MeshFileError(source, "has no triangles")
    lost = np.flatnonzero(~np.isfinite(points).all(axis=1))
    if lost.size:
        raise MeshFileError(source, f"not finite at {names_of('point', 'points', lost)} (0-based)")
    used = points[np.unique(F)]
    if not is_planar(used):
        raise MeshFileError(
            source,
            f"is not planar: z goes from {used[:, 2].min():.6g} to {used[:, 2].max():.6g}",
            remedy="only meshes in a plane z = constant are supported",
        )
    return FemMesh(points[:, :2].copy(), F, source, parts)
