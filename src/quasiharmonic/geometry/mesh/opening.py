"""A mesh opened along edges, its own vertices and triangles left as they are.

What is cut gets corners of its own: a second set of triangles, ``FT``, whose indices tell apart what lies on either
side of a cut. It is to ``F`` what texture corners are to vertices.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from quasiharmonic.geometry.mesh.fans import fans, numbered
from quasiharmonic.geometry.mesh.topology import edge_keys
from quasiharmonic.util.arrays import IntArray, check_range, named_edges


class Corners(NamedTuple):
    """The corners of triangles once a mesh is open along edges.

    Attributes
    ----------
    FT : (f, 3) int64
        The triangles, by copies of vertices. It is ``F`` where a vertex was not split; of a vertex that was, one copy
        keeps its number and the others come after all vertices.
    origin : (n + c,) int64
        The vertex that each copy is of: ``origin[FT]`` is ``F``, and the first ``n`` are themselves.
    """

    FT: IntArray
    origin: IntArray


def opened_along(F: IntArray, cut: IntArray, n: int) -> Corners:
    """Open a mesh along edges.

    Parameters
    ----------
    F : (f, 3) int64
        Triangles, of any kind. Where they touch at a vertex without being joined by edges they come apart, too.
    cut : (k, 2) int64
        Edges of the mesh, either end first. Those on the boundary are open already, and one alone, with both ends
        inside, opens nothing.
    n : int
        Number of vertices.

    Returns
    -------
    Corners

    Raises
    ------
    ValueError
        When a cut is no edge of the mesh; the message names the first.
    """
    check_range("edges", cut, n)
    sides, wanted = edge_keys(F, np.roll(F, -1, axis=1), n), edge_keys(cut[:, 0], cut[:, 1], n)
    strange = ~np.isin(wanted, sides)
    if strange.any():
        raise ValueError(f"{named_edges(cut[strange])}: not an edge of the mesh")
    return Corners(*numbered(F, fans(F, np.isin(sides, wanted))[0], n))
