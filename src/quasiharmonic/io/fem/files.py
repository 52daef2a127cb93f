"""Meshes of finite-element programs, in the plane and in space: Gmsh's MSH, VTK's legacy and XML files.

Writing changes only the positions, in place. Every other byte is unchanged: cells, data, time steps, physical groups
and their names, numbering.
"""

from __future__ import annotations

import os
from collections import Counter
from dataclasses import dataclass
from itertools import islice
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike

from quasiharmonic.io.atomic import check_writable, write_whole
from quasiharmonic.io.errors import MeshFileError, report_damage
from quasiharmonic.io.fem.mesh_parts import MeshParts
from quasiharmonic.io.models.mesh_maps import is_planar
from quasiharmonic.io.registry import find_function, suffixes
from quasiharmonic.io.untrusted import read_bytes
from quasiharmonic.util.arrays import FloatArray, IntArray, names_of, vertex_array

# Errors that readers may raise on damaged files.
_DAMAGE = (ValueError, IndexError, KeyError, OverflowError)


@dataclass(frozen=True, eq=False)
class FemMesh:
    """A mesh of finite elements, in the plane or in space, and all other data of its file."""

    points: FloatArray  # (n, 2) or, in space, (n, 3): every point of the file, in its order
    # (f, 3), (f, 4) or (f, 6): triangles and quadrilaterals of all blocks of the file, in order, in the format of
    # `geometry.mesh.elements`. Of a mesh in space (t, 4) or (t, 8): tetrahedra and hexahedra, as from `join_solids`
    F: IntArray
    source: Path  # The file
    parts: MeshParts  # The parsed file

    def point_field(self, name: str, vertices: ArrayLike) -> FloatArray:
        """Return vectors at some points, (k, 2) or (k, 3) float64, from the file's point data at the last time.

        MeshFileError if the data do not exist, are not vectors in the plane or in space, or a value at these points is
        not finite.
        """
        values, axes = self._finite_values(name, vertices), self.points.shape[1]
        if values.shape[1] not in (axes, 3):
            vectors = "plane vectors" if axes == 2 else "vectors in space"
            raise MeshFileError(
                self.source,
                f"the point data {name!r} are not {vectors}: they have {values.shape[1]} numbers for each point",
            )
        if values[:, axes:].any():
            raise MeshFileError(self.source, f"the point data {name!r} have displacements out of the plane")
        return values[:, :axes].copy()

    def find_set(self, name: str) -> IntArray:
        """Return the nodes (k,) of a named set of the file, ascending; MeshFileError if there is no such set.

        Gmsh: a physical group of any dimension, by its name or number. VTK: the points, or the nodes of the cells, at
        which an array of integers is not zero; ``NAME=VALUE`` for those where it has this value. MFEM: a named set of
        attributes of the boundary or of elements, or the number of an attribute of the boundary.

        What the set belongs to may precede its name, as in ``curve:NAME``: ``point``, ``curve``, ``surface`` or
        ``volume`` of Gmsh, ``point`` or ``cell`` of VTK, ``boundary`` or ``elements`` of MFEM. MeshFileError if several
        sets have the name without it.
        """
        with report_damage(self.source, "the groups cannot be read: ", _DAMAGE):
            sets = {full: nodes for full, nodes in self.parts.find_sets().items() if nodes.size}
        names = {full: full.partition(":")[2] for full in sets}
        wanted = [name] if name in sets else [full for full in sets if names[full] == name]
        if len(wanted) > 1:
            remedy = f"use {' or '.join(map(repr, wanted))}"
            raise MeshFileError(self.source, f"several groups are called {name!r}", remedy=remedy)
        if not wanted:
            count = Counter(names.values())
            there = [repr(own if count[own] == 1 else full) for full, own in islice(names.items(), 20)]
            remedy = f"available: {', '.join(there) or 'none'}" + ", …" * (len(names) > 20)
            raise MeshFileError(self.source, f"there is no group {name!r}", remedy=remedy)
        return sets[wanted[0]]

    def _finite_values(self, name: str, vertices: ArrayLike) -> FloatArray:
        """Return finite values at some points, (k, m) float64."""
        which, fields = np.asarray(vertices, dtype=np.int64), self.parts.fields
        if name not in fields:
            there = ", ".join(map(repr, sorted(fields))) or "none"
            raise MeshFileError(self.source, f"there is no point data {name!r}", remedy=f"available: {there}")
        # Converting a signalling NaN to double raises a warning.
        with (
            report_damage(self.source, f"the point data {name!r} cannot be read: ", _DAMAGE),
            np.errstate(invalid="ignore"),
        ):
            values = fields[name]()[which]
        lost = which[~np.isfinite(values).all(axis=1)]
        if lost.size:
            raise MeshFileError(
                self.source,
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
    parts = _parse(path, read_bytes(path), solid=False)
    points, F = parts.points, parts.F
    if not F.size:
        raise MeshFileError(path, "has no triangles")
    lost = np.flatnonzero(~np.isfinite(points).all(axis=1))
    if lost.size:
        raise MeshFileError(path, f"not finite at {names_of('point', 'points', lost)} (0-based)")
    used = points[np.unique(F)]
    if not is_planar(used):
        raise MeshFileError(
            path,
            f"is not planar: z goes from {used[:, 2].min():.6g} to {used[:, 2].max():.6g}",
            remedy="only meshes in a plane z = constant are supported",
        )
    return FemMesh(points[:, :2].copy(), F, Path(path), parts)


def read_volume(path: str | os.PathLike[str]) -> FemMesh:
    """Read the tetrahedra and hexahedra of a file as for `read_fem`; cells without volume are allowed.

    MeshFileError if the format is not supported, the file cannot be read, or it has other cells with volume.
    """
    parts = _parse(path, read_bytes(path), solid=True)
    return FemMesh(parts.points, parts.F, Path(path), parts)


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
    """Write a mesh with new positions, (n, 2) or (n, 3) as before; every other byte of its file is unchanged.

    Positions are rounded to single precision if the file has single precision. ValueError if they have the wrong shape
    or are not finite; MeshFileError if they are too large for the file's precision. Other errors as `check_fem_output`.
    """
    points = vertex_array(points, "points")
    if points.shape != mesh.points.shape:
        shape = f"{mesh.points.shape}, one position for each vertex"
        raise ValueError(f"points must have shape {shape}, not {points.shape}")
    check_fem_output(path, mesh.source)
    axes, parts = points.shape[1], mesh.parts
    with np.errstate(over="ignore"):
        rounded = points.astype(parts.precision).astype(np.float64)
    if not np.isfinite(rounded).all():
        raise MeshFileError(path, "positions are too large for the file's single precision")
    data = parts.replace_points(points)
    written = _parse(mesh.source, data, solid=axes == 3)
    if not (
        np.array_equal(written.points[:, :axes], rounded)
        and np.array_equal(written.F, parts.F)
        and np.array_equal(written.points[:, axes:], parts.points[:, axes:])
    ):
        raise MeshFileError(path, "nothing was written, because the new file would not read back correctly")
    write_whole(path, data)


def _parse(source: str | os.PathLike[str], data: bytes, *, solid: bool) -> MeshParts:
    """Parse a file, with its tetrahedra and hexahedra if ``solid``."""
    parse = find_function(source, "read_elements")
    with report_damage(source, "cannot be read: ", _DAMAGE, describe=_describe_damage), np.errstate(invalid="ignore"):
        parts: MeshParts = parse(data, solid)
    return parts


def _describe_damage(error: Exception) -> str:
    return str(error) if isinstance(error, ValueError) else f"an entry is missing ({error})"
