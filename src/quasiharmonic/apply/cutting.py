"""Closed surfaces, and surfaces with handles, cut open until they fit into the plane."""

from __future__ import annotations

import itertools
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from quasiharmonic.arrays import FloatArray, IntArray, triangle_array, vertex_array
from quasiharmonic.mesh.surface import surface_edges
from quasiharmonic.mesh.topology import edge_keys


class Opened(NamedTuple):
    """A surface that was cut open.

    Attributes
    ----------
    V : (n + c, d) float64
        Vertices: the old ones first, then copies of those along the cuts.
    F : (f, 3) int64
        The same triangles in the same order; those on one side of a cut refer to the copies.
    origin : (n + c,) int64
        The old vertex that each one is or is a copy of.
    """

    V: FloatArray
    F: IntArray
    origin: IntArray


def cut_open(V: ArrayLike, F: ArrayLike) -> Opened:
    """Cut a surface along edges into a disk, which has one boundary loop and fits into any outline without holes.

    Handles and further boundary loops are opened by libigl's ``cut_to_disk``, whose cuts are not the
    shortest. A closed surface without handles, of which that would leave nothing to cut, is cut along a
    shortest path between two vertices far from each other. To choose cuts yourself, use ``igl.cut_mesh``.

    Parameters
    ----------
    V : (n, 2) or (n, 3) array
        Vertices.
    F : (f, 3) array of int
        Triangles of one connected surface.

    Returns
    -------
    Opened

    Raises
    ------
    ValueError
        As `Problem` for what is no connected surface; for one that is a disk already.
    ModuleNotFoundError
        When libigl is not installed.
    """
    try:
        import igl
    except ModuleNotFoundError as error:
        raise ModuleNotFoundError("cutting a surface needs libigl: pip install 'quasiharmonic[cut]'") from error

    V = vertex_array(V)
    F = triangle_array(F, len(V))
    found = surface_edges(F, len(V), closed=True)
    euler = len(V) - len(found.interior) - len(found.boundary) + len(F)
    if euler == 1:
        raise ValueError("the surface is a disk already: nothing to cut")
    paths = [_long_path(V, found.interior)] if euler == 2 else igl.cut_to_disk(F)
    cut = np.array([pair for path in paths for pair in itertools.pairwise(path)], dtype=np.int64)
    tail, head = F, np.roll(F, -1, axis=1)
    # Which sides of triangles are cut, from each corner to the next.
    marked = np.isin(edge_keys(tail, head, len(V)), edge_keys(cut[:, 0], cut[:, 1], len(V)))
    opened = Opened(*igl.cut_mesh(V, F, marked))
    return Opened(opened.V, opened.F.astype(np.int64), opened.origin.astype(np.int64))


def _long_path(V: FloatArray, interior: IntArray) -> list[int]:
    """A shortest path along edges between two vertices that are far from each other, of two edges at least."""
    from scipy.sparse import csr_array
    from scipy.sparse.csgraph import dijkstra

    n = len(V)
    # Of about unit size, so that no square overflows or vanishes.
    V = np.ldexp(V, -int(np.frexp(np.abs(V).max())[1]))
    # No length is zero, which would be no edge at all.
    lengths = np.maximum(np.linalg.norm(V[interior[:, 0]] - V[interior[:, 1]], axis=1), np.finfo(np.float64).tiny)
    graph = csr_array((lengths, interior.T), shape=(n, n))
    first = int(np.argmax(np.linalg.norm(V - V.mean(axis=0), axis=1)))
    distance, before = dijkstra(graph, directed=False, indices=first, return_predecessors=True)
    path = [int(np.argmax(distance))]
    while path[-1] != first:
        path.append(int(before[path[-1]]))
    if len(path) == 2:
        # Cutting one edge opens nothing; around a neighbour of both ends it does.
        of_end = [set(interior[(interior == end).any(axis=1)].ravel().tolist()) for end in path]
        path.insert(1, min((of_end[0] & of_end[1]) - set(path)))
    return path
