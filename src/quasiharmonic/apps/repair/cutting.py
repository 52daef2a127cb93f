"""Cut closed surfaces and surfaces with handles open, so that they fit into the plane."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from quasiharmonic.geometry.mesh.opening import opened_along
from quasiharmonic.io.adapters.accepts_mesh import accepts_mesh
from quasiharmonic.targets.cuts.find import find_cuts
from quasiharmonic.util.arrays import FloatArray, IntArray, triangle_array, vertex_array


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
    """
    V = vertex_array(V)
    F = triangle_array(F, len(V))
    opened, origin = opened_along(F, find_cuts(V, F, edges=edges, min_gain=min_gain), len(V))
    return CutMesh(V[origin], opened, origin)
