"""Open a mesh along edges without changing its vertices and triangles.

The result is a second set of triangles, ``FT``, whose indices differ on the two sides of a cut. ``FT`` relates to ``F``
as texture corners relate to vertices.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from quasiharmonic.geometry.mesh.fans import fans, numbered
from quasiharmonic.geometry.mesh.topology import edge_keys
from quasiharmonic.util.arrays import IntArray, check_range, named_edges


class Corners(NamedTuple):
    """Corners of the triangles of a mesh that was opened along edges.

    Attributes
    ----------
    FT : (f, 3) int64
        The triangles, by copies of vertices. It equals ``F`` where a vertex was not split. One copy of a split vertex
        keeps its number; the others follow all vertices.
    origin : (n + c,) int64
        The vertex of each copy: ``origin[FT]`` is ``F``, and the first ``n`` entries are ``0 … n - 1``.
    """

    FT: IntArray
    origin: IntArray


def opened_along(F: IntArray, cut: IntArray, n: int) -> Corners:
    """Open a mesh along edges.

    Parameters
    ----------
    F : (f, 3) int64
        Any triangles. Where they touch at a vertex without a common edge, the vertex is split, too.
    cut : (k, 2) int64
        Edges of the mesh, either end first. Boundary edges have no effect. A single edge with two interior ends opens
        nothing.
    n : int
        Number of vertices.

    Returns
    -------
    Corners

    Raises
    ------
    ValueError
        If a cut is not an edge of the mesh; the message names the first ones.
    """
    check_range("edges", cut, n)
    sides, wanted = edge_keys(F, np.roll(F, -1, axis=1), n), edge_keys(cut[:, 0], cut[:, 1], n)
    strange = ~np.isin(wanted, sides)
    if strange.any():
        raise ValueError(f"{named_edges(cut[strange])}: not an edge of the mesh")
    return Corners(*numbered(F, fans(F, np.isin(sides, wanted))[0], n))
