"""What a mesh file holds after some of the mesh's edges were split."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from quasiharmonic.geometry.mesh.polygons import Polygons
from quasiharmonic.io.meshdata import MeshData
from quasiharmonic.util.arrays import FloatArray, IntArray

if TYPE_CHECKING:
    from quasiharmonic.geometry.mesh.refinement import Refined


def refined_mesh(mesh: MeshData, refined: Refined, uv: FloatArray) -> tuple[MeshData, IntArray]:
    """Carry all that stands in a mesh file over to a refinement of the mesh.

    Vertices keep their indices, new ones follow. The parts of a triangle stand where it stood, so that
    they stay in its group and have its material. Colours of new vertices are interpolated; triangles
    that were split have no normals any more, and a polygon of which one was split is in triangles.

    Parameters
    ----------
    mesh : MeshData
        The old mesh.
    refined : Refined
        What became of it.
    uv : (n, 2) float64
        Places in the plane for the old vertices.

    Returns
    -------
    mesh : MeshData
        The new mesh, with the same map.
    parent : (f,) int64
        The old triangle that each of its triangles is a part of, ascending.
    """
    order = np.argsort(refined.parent, kind="stable")
    parent, F = refined.parent[order], refined.F[order]
    normals = None
    if mesh.FN is not None:
        whole = np.bincount(parent, minlength=len(mesh.F))[parent] == 1
        normals = np.where(whole[:, None], mesh.FN[parent], -1)
    before = mesh.statement_faces
    polygons, first = _rings(mesh, parent)
    new = replace(
        mesh,
        V=refined.V,
        F=F,
        vt=refined.extend(uv),
        FT=F,
        extra=None if mesh.extra is None else refined.extend(mesh.extra),
        FN=normals,
        polygons=polygons,
        statement_faces=np.where(before < 0, before, first[before]),
    )
    return new, parent


def _rings(mesh: MeshData, parent: IntArray) -> tuple[Polygons | None, IntArray]:
    """The file's faces after some of its triangles were split.

    Parameters
    ----------
    mesh : MeshData
        The old mesh.
    parent : (f,) int64
        The old triangle that each new one is a part of, ascending.

    Returns
    -------
    polygons : Polygons or None
        None if all are triangles.
    first : (p + 1,) int64
        The first new face of each old one, and their number.
    """
    if mesh.polygons is None:
        return None, np.searchsorted(parent, np.arange(len(mesh.F) + 1))
    old = mesh.polygons
    face = old.of_triangle[parent]
    count = np.bincount(face, minlength=len(old))
    whole = count == old.sizes - 2
    first = np.concatenate([[0], np.cumsum(np.where(whole, 1, count))])
    # Of what is whole the old rings, by the new numbers of its triangles; of the others each triangle is a ring.
    kept = np.repeat(whole, old.sizes)
    triangle, corner = np.divmod(old.corners[kept], 3)
    rings = 3 * np.searchsorted(parent, triangle) + corner
    place = first[np.repeat(np.arange(len(old)), old.sizes)[kept]]
    split = np.flatnonzero(~whole[face])
    among = split - np.searchsorted(face, face[split])
    corners = np.concatenate([rings, (3 * split[:, None] + np.arange(3)).ravel()])
    places = np.concatenate([place, np.repeat(first[face[split]] + among, 3)])
    starts = np.concatenate([[0], np.cumsum(np.bincount(places, minlength=first[-1]))])
    polygons = Polygons(corners[np.argsort(places, kind="stable")], starts)
    return (None if (polygons.sizes == 3).all() else polygons), first
