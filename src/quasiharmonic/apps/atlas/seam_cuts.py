"""Cut surfaces: into disks that flatten well, or along given edges."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from quasiharmonic.geometry.mesh.polygons import Polygons
from quasiharmonic.geometry.mesh.splitting import open_along
from quasiharmonic.geometry.mesh.topology import edges, pair_keys, trace_loops
from quasiharmonic.io.accepts_mesh import accepts_mesh
from quasiharmonic.io.seamed_mesh import SeamedMesh
from quasiharmonic.targets.cuts.find import find_cuts
from quasiharmonic.util.arrays import FloatArray, IntArray, edge_names, triangle_array, vertex_array


def cut_apart(
    mesh: SeamedMesh, *, polygons: Polygons | None = None, disks_too: bool = True, reach: bool = True
) -> SeamedMesh:
    """Cut every island of a surface into disks that flatten with low distortion; see `quasiharmonic.find_cuts`.

    Seams are kept, and edges inside one of the ``polygons`` are not cut. With ``disks_too``, islands that already are
    disks are cut too, if it is worth it. With ``reach``, cuts extend to protruding parts. Cuts that only make a disk
    are shorter, and rarely leave too little space for an outline. The result is without positions; it is ``mesh``
    itself if nothing was cut.
    """
    if not disks_too and all(_is_disk(island.F, len(island.vertices)) for island in mesh.islands):
        return mesh
    seams = mesh.seams
    inside = np.empty((0, 2), dtype=np.int64) if polygons is None else polygons.diagonals(mesh.F)
    found = find_cuts(mesh.V, mesh.F, edges=seams, forbidden_edges=inside, min_gain=0.1 if reach else np.inf)
    return mesh if len(found) == len(seams) else mesh.cut(found)


def cut_along(mesh: SeamedMesh, pairs: ArrayLike, *, polygons: Polygons | None = None) -> SeamedMesh:
    """Cut a surface along edges (k, 2) instead of the seams of its map; the result has no positions.

    Raises ValueError if a pair is not an edge, or is inside one of the polygonal faces; the message names the first
    ones.
    """
    cut = SeamedMesh(mesh.V, mesh.F).cut(pairs)
    if polygons is not None:
        inside, given = polygons.diagonals(mesh.F), np.asarray(pairs, dtype=np.int64).reshape(-1, 2)
        within = np.isin(pair_keys(given, len(mesh.V)), pair_keys(inside, len(mesh.V)))
        if within.any():
            raise ValueError(f"{edge_names(given[within])} inside a polygon: give only edges of the polygons")
    return cut


def _is_disk(F: IntArray, n: int) -> bool:
    found = edges(F, n)
    euler = n - len(found.interior) - len(found.boundary) + len(F)
    return euler == 1 and len(found.boundary) > 0 and len(trace_loops(found.boundary)) == 1


class CutMesh(NamedTuple):
    """A surface after cutting.

    Attributes
    ----------
    V : (n + c, d) float64
        Vertices: the old ones first, then copies of those along the cuts.
    F : (f, 3) int64
        The same triangles in the same order. Triangles on one side of a cut refer to the copies.
    origin : (n + c,) int64
        The old index of each vertex or copy.

    See Also
    --------
    cut_open : Makes it.

    Examples
    --------
    >>> from quasiharmonic import cut_open
    >>> from quasiharmonic.surfaces import grid
    >>> V, F = grid(2, 2)
    >>> opened = cut_open(V, F, edges=[[1, 4]])
    >>> opened.origin.tolist()
    [0, 1, 2, 3, 4, 5, 6, 7, 8, 1]
    """

    V: FloatArray
    F: IntArray
    origin: IntArray


@accepts_mesh
def cut_open(V: ArrayLike, F: ArrayLike, *, edges: ArrayLike | None = None, min_gain: float = np.inf) -> CutMesh:
    """Cut a surface along edges into disks, each with one boundary loop.

    Parameters
    ----------
    V : (n, 2) or (n, 3) array, or a mesh in place of ``V`` and ``F``
        Vertices.
    F : (f, 3) array of int
        Triangles of any number of surfaces. Each becomes a disk, and disks are left unchanged by default.
    edges : (k, 2) array of int, optional
        Edges that are always cut.
    min_gain : float
        Minimum gain of additional cuts, as in `quasiharmonic.find_cuts`; 0.1 for surfaces that should flatten with low
        distortion. By default there are no additional cuts.

    Returns
    -------
    CutMesh

    Raises
    ------
    ValueError
        As `quasiharmonic.find_cuts`.

    See Also
    --------
    find_cuts : Finds edges along which to cut.
    unwrap : Cuts, flattens and packs.

    Examples
    --------
    >>> from quasiharmonic import cut_open, inspect_mesh
    >>> from quasiharmonic.surfaces import starfish
    >>> V, F = starfish(3, 4)
    >>> opened = cut_open(V, F)
    >>> inspect_mesh(V, F).loops, inspect_mesh(opened.V, opened.F).loops
    (0, 1)
    """
    V = vertex_array(V)
    F = triangle_array(F, len(V))
    opened, origin = open_along(F, find_cuts(V, F, edges=edges, min_gain=min_gain), len(V))
    return CutMesh(V[origin], opened, origin)
