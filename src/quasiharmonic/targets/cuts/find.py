"""Seams found: few and short, and yet such that what is cut along them lies flat with little distortion."""

from __future__ import annotations

from dataclasses import replace
from numbers import Real

import numpy as np
from numpy.typing import ArrayLike

from quasiharmonic.geometry.mesh.opening import opened_along
from quasiharmonic.geometry.mesh.surface import manifold_edges
from quasiharmonic.geometry.mesh.topology import components, edge_keys
from quasiharmonic.io.adapters.accepts_mesh import accepts_mesh
from quasiharmonic.targets.cuts.graph import EdgeGraph, edge_graph
from quasiharmonic.targets.cuts.reaching import reached
from quasiharmonic.targets.cuts.shortening import shortened
from quasiharmonic.targets.cuts.topological import opening_cuts
from quasiharmonic.util.arrays import IntArray, check_range, index_array, triangle_array, vertex_array

# An edge that is not to be cut costs so many times its length: more than any way around.
_DEAR = 1e6


@accepts_mesh
def find_cuts(
    V: ArrayLike,
    F: ArrayLike,
    *,
    edges: ArrayLike | None = None,
    forbidden_edges: ArrayLike | None = None,
    min_gain: float = 0.1,
) -> IntArray:
    """Find edges along which to cut a surface so that each of its parts is a disk and lies flat with little distortion.

    First comes what topology asks for: handles and further boundary loops are opened, closed surfaces without handles
    cut from one end to the other. Then cuts go to what sticks out or is saddled, wherever a map without them would
    have to shrink or stretch most, as long as they are worth their length. All of them are then made shorter. They
    prefer creases, inward ones above all.

    Parameters
    ----------
    V : (n, 2) or (n, 3) array, or a mesh in place of ``V`` and ``F``
        Vertices. Their unit and place do not matter.
    F : (f, 3) array of int
        Triangles of any number of surfaces, each treated as if it were alone: closed or not, with handles and holes.
    edges : (l, 2) array of int, optional
        Edges to be cut in any case. Where they cut a part off, that part is one to be made a disk. One alone with both
        ends inside opens nothing and is ignored.
    forbidden_edges : (d, 2) array of int, optional
        Edges not to be cut, such as diagonals of faces of four corners; every vertex must have others.
    min_gain : float
        By how much a cut must lower the mean symmetric Dirichlet energy (0 without distortion), for each piece of
        its length that is as long as the square root of the surface's area. An end inside counts as a tenth of such a
        piece. Positive; more of it means fewer cuts, and `numpy.inf` none but those that make disks.

    Returns
    -------
    (k, 2) int64
        Edges, smaller vertex first, in ascending order: those given, as far as they are not on the boundary, and the
        ones found. None if there is nothing to cut.

    Raises
    ------
    ValueError
        When an array has the wrong shape or refers to what there is not, a coordinate is not finite, ``min_gain`` is
        not positive, or the triangles are no surface: edges of three triangles, mixed winding, a vertex twice in a
        triangle. The message names the first elements.

    Examples
    --------
    A starfish is cut to the end of each of its three arms and nearly the shortest way from one to the next:

    >>> import numpy as np
    >>> from quasiharmonic import find_cuts
    >>> from quasiharmonic.surfaces import starfish
    >>> V, F = starfish(3, 12)
    >>> cut = find_cuts(V, F, min_gain=0.5)
    >>> _, times = np.unique(cut, return_counts=True)
    >>> int((times == 1).sum())
    3
    """
    V = vertex_array(V)
    F = triangle_array(F, len(V))
    given, spared = _edge_array("edges", edges), _edge_array("forbidden_edges", forbidden_edges)
    check_range("forbidden_edges", spared, len(V))
    if not isinstance(min_gain, Real) or not float(min_gain) > 0:
        raise ValueError(f"min_gain must be a positive number, not {min_gain!r}")
    inner = manifold_edges(F, len(V)).interior
    inner_key = edge_keys(inner[:, 0], inner[:, 1], len(V))
    # Open along what is given, and where surfaces touch at a vertex, each is one of its own.
    FT, origin = opened_along(F, given, len(V))
    found = [inner[np.isin(inner_key, _open_keys(F, FT, given, len(V)))]]
    for vertices, triangles in _parts(FT, len(origin)):
        number = np.zeros(len(origin), dtype=np.int64)
        number[vertices] = np.arange(vertices.size)
        graph = edge_graph(V[origin[vertices]], number[FT[triangles]])
        ends = origin[vertices[graph.ends]]
        dear = np.isin(_keys(ends, len(V)), _keys(spared, len(V)))
        cut = _cut_part(replace(graph, cost=np.where(dear, _DEAR, 1.0) * graph.cost), float(min_gain))
        found.append(np.sort(origin[vertices[cut]], axis=1))
    return np.unique(np.concatenate(found), axis=0)


def _cut_part(graph: EdgeGraph, min_gain: float) -> IntArray:
    """The edges (k, 2) that a connected surface is cut along."""
    cut = shortened(graph, opening_cuts(graph))
    if np.isfinite(min_gain):
        cut = reached(graph, cut, min_gain)
    return graph.ends[cut]


def _edge_array(name: str, edges: ArrayLike | None) -> IntArray:
    array = index_array(name, [] if edges is None else edges)
    if array.size == 0:
        return np.zeros((0, 2), dtype=np.int64)
    if array.ndim != 2 or array.shape[1] != 2:
        raise ValueError(f"{name} must have shape (k, 2), two vertices each, not {array.shape}")
    return array


def _keys(pairs: IntArray, n: int) -> IntArray:
    return edge_keys(pairs[:, 0], pairs[:, 1], n)


def _open_keys(F: IntArray, FT: IntArray, given: IntArray, n: int) -> IntArray:
    """Keys of the given edges that are open, their two sides no longer one edge."""
    tail, head = F.ravel(), np.roll(F, -1, axis=1).ravel()
    key = edge_keys(tail, head, n)
    there = np.isin(key, edge_keys(given[:, 0], given[:, 1], n))
    side = edge_keys(FT.ravel(), np.roll(FT, -1, axis=1).ravel(), int(FT.max()) + 1)[there]
    _, which, count = np.unique(side, return_inverse=True, return_counts=True)
    return key[there][count[which] == 1]


def _parts(F: IntArray, n: int) -> list[tuple[IntArray, IntArray]]:
    """Vertices and triangles of every connected surface, by its smallest vertex."""
    label = components(F, n)[F[:, 0]]
    order = np.argsort(label, kind="stable")
    pieces = np.split(order, np.flatnonzero(np.diff(label[order])) + 1)
    return [(np.unique(F[triangles]), triangles) for triangles in pieces]
