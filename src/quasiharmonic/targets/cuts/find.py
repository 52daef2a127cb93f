"""Find cuts that are few and short, and that let the surface be flattened with little distortion."""

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

# Cost factor of forbidden edges; it exceeds the length of any detour.
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
    """Find edges along which to cut a surface so that each part is a disk and flattens with little distortion.

    First, cuts are made that the topology requires. They open handles and connect boundary loops; a closed surface
    without handles is cut along a long path. Then cuts are extended to protruding or saddle-shaped parts, where a map
    would otherwise shrink or stretch most, as long as the gain justifies their length. Finally all cuts are shortened.
    Cuts prefer creases, above all concave ones.

    Parameters
    ----------
    V : (n, 2) or (n, 3) array, or a mesh in place of ``V`` and ``F``
        Vertices. The result does not depend on their unit and origin.
    F : (f, 3) array of int
        Triangles of any number of surfaces, closed or not, with handles and holes. Each surface is treated separately.
    edges : (l, 2) array of int, optional
        Edges to cut in any case. If they separate a part, that part is made a disk too. A single edge with both ends in
        the interior opens nothing and is ignored.
    forbidden_edges : (d, 2) array of int, optional
        Edges not to cut, such as diagonals of quadrilateral faces. Every vertex must have other edges.
    min_gain : float
        Minimum decrease of the mean symmetric Dirichlet energy (0 without distortion) per unit length of a cut. The
        unit is the square root of the surface's area. A loose end of a cut in the interior counts as a tenth of this
        unit. Positive; larger values give fewer cuts. `numpy.inf` gives only the cuts that make disks.

    Returns
    -------
    (k, 2) int64
        Edges, smaller vertex first, in ascending order: the given interior edges and the edges found. Empty if no cut
        is needed.

    Raises
    ------
    ValueError
        When an array has the wrong shape or an index is out of range, a coordinate is not finite, or ``min_gain`` is
        not positive. When the triangles are not a surface: an edge has three triangles, the winding is inconsistent, or
        a triangle repeats a vertex. The message lists the first elements.

    Examples
    --------
    A starfish is cut to the end of each of its three arms; the cuts between the arms are nearly the shortest:

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
    # Open along the given edges. Surfaces that touch at a vertex are also separated.
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
    """Return the edges (k, 2) along which to cut a connected surface."""
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
    """Keys of the given edges that are open, so that their two sides are separate edges."""
    tail, head = F.ravel(), np.roll(F, -1, axis=1).ravel()
    key = edge_keys(tail, head, n)
    there = np.isin(key, edge_keys(given[:, 0], given[:, 1], n))
    side = edge_keys(FT.ravel(), np.roll(FT, -1, axis=1).ravel(), int(FT.max()) + 1)[there]
    _, which, count = np.unique(side, return_inverse=True, return_counts=True)
    return key[there][count[which] == 1]


def _parts(F: IntArray, n: int) -> list[tuple[IntArray, IntArray]]:
    """Return vertices and triangles of every connected surface, ordered by smallest vertex."""
    label = components(F, n)[F[:, 0]]
    order = np.argsort(label, kind="stable")
    pieces = np.split(order, np.flatnonzero(np.diff(label[order])) + 1)
    return [(np.unique(F[triangles]), triangles) for triangles in pieces]
