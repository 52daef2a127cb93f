"""Choose the seams of a surface: cuts into disks, or given edges."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from quasiharmonic.geometry.mesh.polygons import Polygons
from quasiharmonic.geometry.mesh.seams import SeamedMesh
from quasiharmonic.geometry.mesh.topology import edge_keys, edges, trace_loops
from quasiharmonic.targets.cuts.find import find_cuts
from quasiharmonic.util.arrays import IntArray, named_edges


def cut_apart(
    mesh: SeamedMesh, *, polygons: Polygons | None = None, disks_too: bool = True, reach: bool = True
) -> SeamedMesh:
    """Cut every island of a surface into disks that flatten with low distortion; see `quasiharmonic.find_cuts`.

    Parameters
    ----------
    mesh : SeamedMesh
        The mesh. Its seams are kept.
    polygons : Polygons, optional
        The polygonal faces that the triangles belong to. Edges inside a face are not cut.
    disks_too : bool
        Also cut islands that already are disks, if it is worth it. If false and all islands are disks, the mesh is
        returned unchanged.
    reach : bool
        Extend the cuts to protruding parts. Cuts that only make a disk are shorter, and rarely leave too little space
        for an outline.

    Returns
    -------
    SeamedMesh
        Without positions; ``mesh`` itself if nothing was cut.

    Raises
    ------
    ValueError
        As `quasiharmonic.find_cuts`.
    """
    if not disks_too and all(_is_disk(island.F, len(island.vertices)) for island in mesh.islands):
        return mesh
    seams = mesh.seams
    inside = np.empty((0, 2), dtype=np.int64) if polygons is None else polygons.diagonals(mesh.F)
    found = find_cuts(mesh.V, mesh.F, edges=seams, forbidden_edges=inside, min_gain=0.1 if reach else np.inf)
    return mesh if len(found) == len(seams) else mesh.cut(found)


def cut_along(mesh: SeamedMesh, pairs: ArrayLike, *, polygons: Polygons | None = None) -> SeamedMesh:
    """Cut a surface along edges, ignoring the seams of its map.

    Parameters
    ----------
    mesh : SeamedMesh
    pairs : (k, 2) array of int
        Vertices at both ends of each edge.
    polygons : Polygons, optional
        The polygonal faces that the triangles belong to.

    Returns
    -------
    SeamedMesh
        Without positions.

    Raises
    ------
    ValueError
        If a pair is not an edge, or is inside a face; the message names the first ones.
    """
    cut = SeamedMesh(mesh.V, mesh.F).cut(pairs)
    if polygons is not None:
        inside, given = polygons.diagonals(mesh.F), np.asarray(pairs, dtype=np.int64).reshape(-1, 2)
        within = np.isin(_keys(given, len(mesh.V)), _keys(inside, len(mesh.V)))
        if within.any():
            raise ValueError(f"{named_edges(given[within])} inside a polygon: give only edges of the polygons")
    return cut


def _keys(pairs: IntArray, n: int) -> IntArray:
    return edge_keys(pairs[:, 0], pairs[:, 1], n)


def _is_disk(F: IntArray, n: int) -> bool:
    found = edges(F, n)
    euler = n - len(found.interior) - len(found.boundary) + len(F)
    return euler == 1 and len(found.boundary) > 0 and len(trace_loops(found.boundary)) == 1
