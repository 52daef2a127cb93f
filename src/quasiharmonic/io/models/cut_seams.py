"""Maps with seams in files: the mesh cut open along its seams."""

from __future__ import annotations

import numpy as np

from quasiharmonic.io.models.meshdata import MeshData, check_mapped, vertex_places
from quasiharmonic.io.seamed_mesh import SeamedMesh
from quasiharmonic.util.arrays import FloatArray, IntArray, mark


def seamed(mesh: MeshData) -> SeamedMesh:
    """Return a mesh with its map as a `SeamedMesh`, without map if the mesh has none.

    If some corners have no texture coordinates and there are no seams, vertices without one are at NaN.

    Raises
    ------
    MeshFileError
        If the mesh has the map on some faces only and has seams.
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
    """Return a mesh with its map: its texture coordinates, or the vertex positions if a planar mesh has none.

    Raises
    ------
    MeshFileError
        If the mesh has no map, or has it on some faces only.
    """
    check_mapped(mesh)
    if mesh.FT is None:
        return SeamedMesh(mesh.V, mesh.F, mesh.F, mesh.V[:, :2])
    return SeamedMesh(mesh.V, mesh.F, mesh.FT, mesh.vt)


def cut_at_seams(mesh: MeshData) -> tuple[FloatArray, IntArray, FloatArray]:
    """Return a mesh and its map, with a separate vertex for each position of a vertex at a seam.

    Parameters
    ----------
    mesh : MeshData
        A mesh with texture coordinates on every triangle, or a planar mesh without any.

    Returns
    -------
    V : (m, 3) float64
        The vertices of the mesh, then a copy for each further position of a vertex.
    F : (f, 3) int64
        The triangles of the mesh in their order. Without seams they are unchanged.
    uv : (m, 2) float64
        Positions in the plane; NaN at vertices that no triangle uses.

    Raises
    ------
    MeshFileError
        If the mesh has no map, or has it on some faces only.
    """
    opened = mapped(mesh).opened()
    assert opened.uv is not None
    return opened.V, opened.F, opened.uv


def without_idle(V: FloatArray, F: IntArray, uv: FloatArray) -> tuple[FloatArray, IntArray, FloatArray]:
    """Return a mesh and its map without the vertices that no triangle uses; the others keep their order.

    Parameters
    ----------
    V, F, uv
        As `cut_at_seams` returns them.

    Returns
    -------
    V, F, uv
        The same arrays without the unused vertices, and renumbered triangles.
    """
    used = mark(len(V), F)
    return V[used], (np.cumsum(used) - 1)[F], uv[used]
