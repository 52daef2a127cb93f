"""What a mesh file holds after some of the mesh's edges were split."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from quasiharmonic.arrays import FloatArray, IntArray
from quasiharmonic.io.meshdata import MeshData

if TYPE_CHECKING:
    from quasiharmonic.mesh.refinement import Refined


def refined_mesh(mesh: MeshData, refined: Refined, uv: FloatArray) -> tuple[MeshData, IntArray]:
    """Carry all that stands in a mesh file over to a refinement of the mesh.

    Vertices keep their indices, new ones follow. The parts of a triangle stand where it stood, so that
    they stay in its group and have its material. Colours of new vertices are interpolated; triangles
    that were split have no normals any more.

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
    new = replace(
        mesh,
        V=refined.V,
        F=F,
        vt=refined.extend(uv),
        FT=F,
        extra=None if mesh.extra is None else refined.extend(mesh.extra),
        FN=normals,
        statement_faces=np.where(before < 0, before, np.searchsorted(parent, before)),
    )
    return new, parent
