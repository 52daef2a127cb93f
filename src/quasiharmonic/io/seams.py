"""Maps with seams in files: the mesh cut open along them."""

from __future__ import annotations

import numpy as np

from quasiharmonic.geometry.mesh.seams import SeamedMesh
from quasiharmonic.io.meshdata import MeshData, check_mapped, vertex_places
from quasiharmonic.util.arrays import FloatArray, IntArray


def seamed(mesh: MeshData) -> SeamedMesh:
    """Return a mesh with the map that it carries, or without places where it carries none.

    Raises
    ------
    MeshFileError
        When it has the map on some faces only, and there are seams. Without seams the vertices that have a place are
        all that is known, and those without are at NaN.
    """
    if mesh.FT is None or mesh.vt is None:
        return SeamedMesh(mesh.V, mesh.F)
    if (mesh.FT >= 0).all():
        return SeamedMesh(mesh.V, mesh.F, mesh.FT, mesh.vt)
    uv, seam = vertex_places(mesh)
    if seam.any():
        check_mapped(mesh)
    return SeamedMesh(mesh.V, mesh.F, mesh.F, uv)


def mapped(mesh: MeshData) -> SeamedMesh:
    """Return a mesh with the map that it carries: its texture coordinates, or the plane that it lies in without any.

    Raises
    ------
    MeshFileError
        When the mesh has no map, or has it on some faces only.
    """
    check_mapped(mesh)
    if mesh.FT is None:
        return SeamedMesh(mesh.V, mesh.F, mesh.F, mesh.V[:, :2])
    return SeamedMesh(mesh.V, mesh.F, mesh.FT, mesh.vt)


def cut_at_seams(mesh: MeshData) -> tuple[FloatArray, IntArray, FloatArray]:
    """Return a mesh and the map that it carries, with a vertex for each of a vertex's places.

    Parameters
    ----------
    mesh : MeshData
        With texture coordinates on every triangle, or planar and without any.

    Returns
    -------
    V : (m, 3) float64
        The mesh's own vertices, then a further one for each further place of one.
    F : (f, 3) int64
        The mesh's triangles in their order. Where there are no seams, nothing is changed.
    uv : (m, 2) float64
        Their places; NaN at vertices that no triangle uses.

    Raises
    ------
    MeshFileError
        When the mesh has no map, or has it on some faces only.
    """
    opened = mapped(mesh).opened()
    assert opened.uv is not None
    return opened.V, opened.F, opened.uv


def without_idle(V: FloatArray, F: IntArray, uv: FloatArray) -> tuple[FloatArray, IntArray, FloatArray]:
    """Return a mesh and its map without the vertices that no triangle uses, which have no place; the others in order.

    Parameters
    ----------
    V, F, uv
        As `cut_at_seams` returns them.

    Returns
    -------
    V, F, uv
        Of the same shapes but for the vertices left out.
    """
    used = np.zeros(len(V), dtype=bool)
    used[F] = True
    return V[used], (np.cumsum(used) - 1)[F], uv[used]
