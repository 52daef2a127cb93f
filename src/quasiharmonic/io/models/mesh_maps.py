"""The map of a mesh from a file: its texture coordinates, with or without seams, or a planar mesh itself."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from quasiharmonic.io.errors import MeshFileError
from quasiharmonic.io.models.meshdata import MeshData
from quasiharmonic.io.seamed_mesh import SeamedMesh
from quasiharmonic.util.arrays import FloatArray, IntArray, find_exponent, mark, names_of, vertex_names


def with_corner_map(mesh: MeshData, corners: FloatArray) -> MeshData:
    """Return a mesh with texture coordinates (f, 3, 2) of its corners, NaN for none; equal ones of a vertex are one."""
    known = ~np.isnan(corners[:, :, 0])
    rows = np.column_stack([mesh.F[known], corners[known] + 0.0])
    unique, which = np.unique(rows, axis=0, return_inverse=True)
    FT = np.full(mesh.F.shape, -1)
    FT[known] = which.reshape(-1)
    return replace(mesh, vt=unique[:, 1:], FT=FT, map_lines=None, lower_maps=())


def vertex_places(mesh: MeshData) -> tuple[FloatArray, NDArray[np.bool_]]:
    """Return the texture coordinates of every vertex, and which vertices are on a seam.

    Returns
    -------
    uv : (n, 2) float64
        Texture coordinates of each vertex; NaN if no face gives it any. At a seam, one of its texture coordinates.
    seam : (n,) bool
        Whether the vertex has more than one texture coordinate. Equal numbers under different indices count as one.
    """
    uv = np.full((len(mesh.V), 2), np.nan)
    seam = np.zeros(len(mesh.V), dtype=np.bool_)
    if mesh.vt is not None and mesh.FT is not None and np.array_equal(mesh.FT, mesh.F):
        uv[mesh.F] = mesh.vt[mesh.F]
        return uv, seam
    places = mesh.corner_uv
    given = ~np.isnan(places[:, :, 0])
    vertex, place = mesh.F[given], places[given]
    uv[vertex] = place
    seam[vertex[(uv[vertex] != place).any(axis=1)]] = True
    return uv, seam


def map_of(mesh: MeshData) -> FloatArray:
    """Return the map of a mesh: a position in the plane for every vertex.

    The map is the texture coordinates. For a planar mesh without texture coordinates, it is the vertex positions.

    Parameters
    ----------
    mesh : MeshData
        A mesh whose map has no seams.

    Returns
    -------
    (n, 2) float64
        The map; NaN at vertices that no face uses.

    Raises
    ------
    MeshFileError
        If the mesh has no map, has it on some faces only, or has seams, that is, vertices with several positions. The
        message names the first such elements.
    """
    check_mapped(mesh)
    if mesh.FT is None:
        return mesh.V[:, :2].copy()
    uv, seam = vertex_places(mesh)
    if seam.any():
        torn = vertex_names(np.flatnonzero(seam))
        raise MeshFileError(
            mesh.source,
            f"more than one pair of texture coordinates for {torn} (0-based)",
            remedy="split the vertices along the seams of the map",
        )
    return uv


def in_plane(mesh: MeshData) -> MeshData:
    """Return the map of a mesh as a mesh in the plane z = 0; errors as `map_of`.

    A vertex that no face uses gets the row of ``vt`` with its own index if ``vt`` has one row per vertex, and zero
    otherwise.
    """
    uv = map_of(mesh)
    idle = np.isnan(uv).any(axis=1)
    uv[idle] = mesh.vt[idle] if mesh.vt is not None and len(mesh.vt) == len(uv) else 0.0
    return mesh.as_plane(uv)


def is_planar(points: FloatArray) -> bool:
    """Return whether points (n, 3) lie in a plane z = constant, up to rounding to single precision."""
    # Scaling by a power of two avoids overflow in differences of the largest doubles.
    exponent = find_exponent(points)
    extent = np.ptp(np.ldexp(points, -exponent - 1), axis=0)
    return bool(extent[2] <= 1e-6 * extent[:2].max())


def has_map(mesh: MeshData) -> bool:
    """Return whether a mesh has texture coordinates on some faces, or is planar."""
    return mesh.FT is not None or _is_flat(mesh)


def _is_flat(mesh: MeshData) -> bool:
    """Return whether the vertices that triangles use lie in a plane z = constant."""
    used = mark(len(mesh.V), mesh.F)
    return is_planar(mesh.V) or (not used.all() and bool(used.any()) and is_planar(mesh.V[used]))


def find_unmapped(mesh: MeshData) -> IntArray:
    """Return the faces, ascending, without texture coordinates at a corner; none if the mesh has none at all."""
    bare = np.zeros(0, dtype=np.int64) if mesh.FT is None else np.flatnonzero((mesh.FT < 0).any(axis=1))
    return np.unique(mesh.rings.of_triangle[bare])


def check_mapped(mesh: MeshData) -> None:
    """Raise `MeshFileError` if a mesh has no map, or has it on some faces only."""
    if mesh.FT is None:
        if not _is_flat(mesh):
            raise MeshFileError(
                mesh.source,
                "has no map: the mesh has no texture coordinates and is not planar",
                remedy="export it with uv coordinates",
            )
        return
    bare = find_unmapped(mesh)
    if bare.size:
        raise MeshFileError(
            mesh.source,
            f"{names_of('face', 'faces', bare)} (0-based) without texture coordinates, which other faces have",
            remedy="map these faces (qhm unwrap --faces) or the whole mesh (qhm unwrap, or qhm flatten --seams none), "
            "or remove these faces",
        )


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
