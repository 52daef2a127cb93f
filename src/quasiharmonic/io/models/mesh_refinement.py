"""The contents of a mesh file after some of its edges were split."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from quasiharmonic.geometry.mesh.polygons import Polygons
from quasiharmonic.io.models.meshdata import MeshData
from quasiharmonic.util.arrays import FloatArray, IntArray, repeat_each

if TYPE_CHECKING:
    from quasiharmonic.geometry.mesh.refinement import Refined


def refined_mesh(mesh: MeshData, refined: Refined, uv: FloatArray) -> tuple[MeshData, IntArray]:
    """Transfer all data of a mesh file to a refinement of the mesh.

    The given vertices keep their indices, and new vertices follow. The parts of a triangle replace it in order, so they
    stay in its group and keep its material. Colours of new vertices are interpolated. Triangles that were split lose
    their normals. A polygon is replaced by triangles if one of its triangles was split.

    Parameters
    ----------
    mesh : MeshData
        The given mesh.
    refined : Refined
        Its refinement.
    uv : (n, 2) float64
        Positions of the given vertices in the plane.

    Returns
    -------
    mesh : MeshData
        The refined mesh, with the same map.
    parent : (f,) int64
        The given triangle that contains each new triangle, ascending.
    """
    order = np.argsort(refined.parent, kind="stable")
    parent, F = refined.parent[order], refined.F[order]
    normals = None
    if mesh.FN is not None:
        unsplit = np.bincount(parent, minlength=len(mesh.F))[parent] == 1
        normals = np.where(unsplit[:, None], mesh.FN[parent], -1)
    before = mesh.statement_faces
    polygons, first = _refine_polygons(mesh, parent)
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


def _refine_polygons(mesh: MeshData, parent: IntArray) -> tuple[Polygons | None, IntArray]:
    """Return the file's faces after some of its triangles were split, None if all are triangles.

    ``parent`` (f,) is the given triangle that contains each new triangle, ascending. The second result is the first new
    face of each given face, then the number of new faces.
    """
    old = mesh.rings
    face = old.of_triangle[parent]
    count = np.bincount(face, minlength=len(old))
    unsplit = count == old.sizes - 2
    first = np.concatenate([[0], np.cumsum(np.where(unsplit, 1, count))])
    # Unsplit faces keep their rings, with the new indices of their triangles. Each triangle of a split face is a ring.
    unsplit_corners = repeat_each(unsplit, old.sizes)
    triangle, corner = np.divmod(old.corners[unsplit_corners], 3)
    rings = 3 * np.searchsorted(parent, triangle) + corner
    place = first[repeat_each(np.arange(len(old)), old.sizes)[unsplit_corners]]
    split = np.flatnonzero(~unsplit[face])
    among = split - np.searchsorted(face, face[split])
    corners = np.concatenate([rings, (3 * split[:, None] + np.arange(3)).ravel()])
    places = np.concatenate([place, np.repeat(first[face[split]] + among, 3)])
    starts = np.concatenate([[0], np.cumsum(np.bincount(places, minlength=first[-1]))])
    polygons = Polygons(corners[np.argsort(places, kind="stable")], starts)
    return (None if (polygons.sizes == 3).all() else polygons), first
