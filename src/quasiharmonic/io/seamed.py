"""Maps with seams in files: the mesh cut open along them."""

from __future__ import annotations

import numpy as np

from quasiharmonic.arrays import FloatArray, IntArray
from quasiharmonic.io.meshdata import MeshData, check_mapped, map_of, vertex_places
from quasiharmonic.mesh.seams import islands


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
    check_mapped(mesh)
    if mesh.vt is None or mesh.FT is None or not vertex_places(mesh)[1].any():
        return mesh.V, mesh.F, map_of(mesh)
    parts = islands(mesh.F, mesh.vt, mesh.FT)
    start = np.cumsum([0, *(len(part.vertices) for part in parts)])
    own = np.empty_like(mesh.F)
    for offset, part in zip(start, parts, strict=False):
        own[part.triangles] = part.F + offset
    vertices = np.concatenate([part.vertices for part in parts])
    further = np.ones(len(vertices), dtype=np.bool_)
    further[np.unique(vertices, return_index=True)[1]] = False
    number = vertices.copy()
    number[further] = len(mesh.V) + np.arange(np.count_nonzero(further))
    origin = np.concatenate([np.arange(len(mesh.V)), vertices[further]])
    uv = np.full((len(origin), 2), np.nan)
    uv[number] = np.concatenate([part.uv for part in parts])
    return mesh.V[origin], number[own], uv


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
    used = np.unique(F)
    return V[used], np.searchsorted(used, F), uv[used]
