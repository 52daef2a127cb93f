"""Find cuts that are few and short, and that let the surface be flattened with little distortion.

References
----------
.. [1] J. Erickson, K. Whittlesey, Greedy optimal homotopy and homology generators. SODA (2005).
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from numbers import Real

import numpy as np
from numpy.typing import ArrayLike
from scipy.sparse import csr_array
from scipy.sparse.csgraph import minimum_spanning_tree

from quasiharmonic.geometry.coarsening import Removal
from quasiharmonic.geometry.mesh.splitting import open_along
from quasiharmonic.geometry.mesh.topology import components, edge_keys, manifold_edges, mark_sides, pair_keys
from quasiharmonic.io.accepts_mesh import accepts_mesh
from quasiharmonic.targets.cuts.graph import EdgeGraph, edge_graph
from quasiharmonic.targets.cuts.reaching import extend_cuts
from quasiharmonic.targets.cuts.shortening import cut_by_levels, shorten_cuts
from quasiharmonic.util.arrays import (
    BoolArray,
    FloatArray,
    IntArray,
    check_range,
    edge_array,
    real_array,
    reject,
    triangle_array,
    vertex_array,
)

# A surface with more vertices is cut on a coarse mesh first, which has this number of vertices.
_LARGE, _COARSE = 5_000, 4_000
# The search for charts of a surface with more vertices begins on a mesh with this number of vertices.
_LARGER, _COARSER = 10_000, 2_500
# A surface with more vertices is cut on a mesh with this share of them, smoothed by this number of sweeps, if its cuts
# are found on a coarser mesh in turn.
_HUGE, _SHARE, _SWEEPS = 80_000, 1 / 8, 3
# The seams of coarse charts are shortened on every third mesh only: where they stay, the charts keep their maps.
_EVERY = 3
# `crease_costs` saves this share of the cost where the surface bends inwards by this angle or more.
_SAVED, _CONCAVE = 0.75, np.pi / 3
# Rings of triangles by which cuts may move on each finer mesh. Longer moves would shorten cuts at the expense of
# distortion; cuts that only make disks may move further.
_RINGS, _RINGS_OF_SHORTEST = 3, 10
# Cost factor of forbidden edges; it exceeds the length of any detour.
_DEAR = 1e6


@accepts_mesh
def find_cuts(
    V: ArrayLike,
    F: ArrayLike,
    *,
    edges: ArrayLike | None = None,
    forbidden_edges: ArrayLike | None = None,
    edge_costs: ArrayLike | None = None,
    min_gain: float = 0.1,
) -> IntArray:
    """Find edges along which to cut a surface so that each part is a disk and flattens with little distortion.

    First, cuts are made that the topology requires. They open handles and connect boundary loops; a closed surface
    without handles is cut along a long path. Then cuts are extended to protruding or saddle-shaped parts, where a map
    would otherwise shrink or stretch most, as long as the gain justifies their length. Finally all cuts are shortened.
    Cuts prefer creases, above all concave ones. On surfaces of more than 5,000 vertices, cuts are found on a coarse
    mesh, carried to the surface, and shortened there.

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
    edge_costs : (f, 3) array, optional
        Cost of a cut along each side of each triangle, from corner 0 to 1, 1 to 2 and 2 to 0, relative to a cut of the
        same length elsewhere. An edge has the mean of its two sides. Positive; 1 by default. For example, costs above 1
        keep cuts away from visible parts. `crease_costs` returns costs that keep cuts in creases.
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
        When an array has the wrong shape or an index is out of range, a coordinate is not finite, or ``min_gain`` or a
        cost is not positive. When the triangles are not a surface: an edge has three triangles, the winding is
        inconsistent, or a triangle repeats a vertex. The message lists the first elements.

    See Also
    --------
    cut_open : Cuts the surface along the edges.
    crease_costs : Costs that keep cuts in creases.
    unwrap : Cuts, flattens and packs.

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
    given, spared = (
        edge_array(name, [] if pairs is None else pairs)
        for name, pairs in (("edges", edges), ("forbidden_edges", forbidden_edges))
    )
    check_range("forbidden_edges", spared, len(V))
    if not isinstance(min_gain, Real) or not float(min_gain) > 0:
        raise ValueError(f"min_gain must be a positive number, not {min_gain!r}")
    costs = _costs_of_sides(F, len(V), spared, edge_costs)
    return find_cuts_by(V, F, given, costs, float(min_gain))


def find_cuts_by(
    V: FloatArray,
    F: IntArray,
    given: IntArray,
    costs: FloatArray | None,
    min_gain: float,
    find_coarse: Callable[[EdgeGraph, IntArray, list[list[Removal]]], BoolArray] | None = None,
) -> IntArray:
    """Find cuts as `find_cuts` does, from checked arrays.

    On the coarse mesh of a large surface, ``find_coarse`` may find other cuts (e,) bool of an `EdgeGraph`, which are
    carried to the surface. It also gets the indices (m,) of the graph's vertices, and the removed ones by rounds. Its
    coarse mesh may be large, too.
    """
    inner = manifold_edges(F, len(V)).interior
    # Open along the given edges. Surfaces that touch at a vertex are also separated.
    FT, origin = open_along(F, given, len(V))
    found = [inner[np.isin(pair_keys(inner, len(V)), _open_keys(F, FT, given, len(V)))]] if given.size else [given]
    rings = _RINGS if np.isfinite(min_gain) else _RINGS_OF_SHORTEST
    for vertices, triangles, T in _parts(FT, len(origin)):
        names, own = origin[vertices], None if costs is None else costs[triangles]
        if vertices.size > _LARGE:

            def find(
                graph: EdgeGraph, some: IntArray, rounds: list[list[Removal]], names: IntArray = names
            ) -> BoolArray:
                if find_coarse is None:
                    return _cut_part(graph, min_gain)
                own = [[Removal(names[gone], names[rings]) for gone, rings in removals] for removals in rounds]
                return find_coarse(graph, names[some], own)

            goal, sweeps, every = _COARSE, 0, 1
            if find_coarse is not None:
                every = _EVERY
                if vertices.size > _HUGE:
                    goal, sweeps = int(_SHARE * vertices.size), _SWEEPS
                elif vertices.size > _LARGER:
                    goal = _COARSER
            cut = cut_by_levels(V[names], T, own, find, rings, goal=goal, sweeps=sweeps, every=every)
        else:
            graph = edge_graph(V[names], T, own)
            cut = graph.ends[_cut_part(graph, min_gain)]
        found.append(np.sort(names[cut], axis=1))
    return np.unique(np.concatenate(found), axis=0)


@accepts_mesh
def crease_costs(V: ArrayLike, F: ArrayLike) -> FloatArray:
    """Return costs with which `find_cuts` keeps cuts in concave creases, where seams are least visible.

    Parameters
    ----------
    V : (n, 2) or (n, 3) array, or a mesh in place of ``V`` and ``F``
        Vertices.
    F : (f, 3) array of int
        Triangles of any number of surfaces.

    Returns
    -------
    (f, 3) float64
        Cost of each side of each triangle, as for ``edge_costs`` of `find_cuts`: 1 where the surface is flat or convex,
        and less the more it is concave, down to 0.25 from a bend of 60 degrees.

    Raises
    ------
    ValueError
        As `find_cuts`.

    See Also
    --------
    find_cuts : Takes the costs.

    Examples
    --------
    Costs can be combined with others, such as costs of visible vertices:

    >>> import numpy as np
    >>> from quasiharmonic import crease_costs, find_cuts
    >>> from quasiharmonic.surfaces import starfish
    >>> V, F = starfish(3, 8)
    >>> visible = np.where(V[:, 2] > 0, 3.0, 1.0)
    >>> costs = crease_costs(V, F) * (visible[F] + visible[np.roll(F, -1, axis=1)]) / 2
    >>> cut = find_cuts(V, F, edge_costs=costs)
    """
    V = vertex_array(V)
    F = triangle_array(F, len(V))
    manifold_edges(F, len(V))
    graph = edge_graph(V, F)
    return 1 - (_SAVED * np.clip(-graph.bends / _CONCAVE, 0, 1))[graph.side.T]


def side_costs(edge_costs: ArrayLike, count: int) -> FloatArray:
    """Return a copy of the costs (f, 3) of the sides of all triangles, after checking them."""
    costs = real_array("edge_costs", edge_costs)
    if costs.shape != (count, 3):
        raise ValueError(f"edge_costs must have shape ({count}, 3), not {costs.shape}")
    wrong = np.flatnonzero(~((costs > 0) & np.isfinite(costs)).all(axis=1))
    reject(wrong, "triangle", "triangles", "edge_costs must be positive and finite: {}")
    return costs


def _costs_of_sides(F: IntArray, n: int, spared: IntArray, edge_costs: ArrayLike | None) -> FloatArray | None:
    """Return the costs (f, 3) of all sides, high at the spared edges (d, 2); None if all are 1."""
    costs = np.ones(F.shape) if edge_costs is None else side_costs(edge_costs, len(F))
    if spared.size:
        costs[mark_sides(F, spared, n)] *= _DEAR
    elif edge_costs is None:
        return None
    return costs


def _cut_part(graph: EdgeGraph, min_gain: float) -> BoolArray:
    """Return the edges (e,) along which to cut a connected surface."""
    cut = shorten_cuts(graph, opening_cuts(graph))
    if np.isfinite(min_gain):
        cut = extend_cuts(graph, cut, min_gain)
    return cut


def _open_keys(F: IntArray, FT: IntArray, given: IntArray, n: int) -> IntArray:
    """Keys of the given edges that are open, so that their two sides are separate edges."""
    there = mark_sides(F, given, n)
    side = edge_keys(FT[there], FT[:, (1, 2, 0)][there], int(FT.max()) + 1)
    _, which, count = np.unique(side, return_inverse=True, return_counts=True)
    return edge_keys(F[there], F[:, (1, 2, 0)][there], n)[count[which] == 1]


def _parts(F: IntArray, n: int) -> Iterator[tuple[IntArray, IntArray, IntArray]]:
    """Yield vertices (m,), triangles (k,) and the triangles' corners (k, 3), as indices into these vertices.

    There is one entry for every connected surface, in the order of smallest vertices.
    """
    label = components(F, n)
    label[np.bincount(F.ravel(), minlength=n) == 0] = n
    by_vertex, by_triangle = np.argsort(label, kind="stable"), np.argsort(label[F[:, 0]], kind="stable")
    first = np.unique(label[F[:, 0]])
    starts = np.searchsorted(label[by_vertex], np.append(first, n))
    number = np.empty(n, dtype=np.int64)
    number[by_vertex] = np.arange(n)
    stops = np.searchsorted(label[F[by_triangle, 0]], first, side="right")
    for k, triangles in enumerate(np.split(by_triangle, stops[:-1])):
        yield by_vertex[starts[k] : starts[k + 1]], triangles, number[F[triangles]] - starts[k]


def opening_cuts(graph: EdgeGraph) -> BoolArray:
    """Cut a connected surface into a disk, across handles and between boundary loops, as short as possible.

    A spanning tree of triangles, joined across edges, unfolds to a disk. Cutting all edges that it does not cross opens
    the surface. Most of these cuts are unnecessary: after removing loose ends, only a few paths remain, which depend on
    the tree. The tree used here is that of Erickson and Whittlesey [1]_. Shortest paths lead from every vertex to the
    boundary (to one vertex on closed surfaces). The tree crosses the edges that close the longest loops. The remaining
    edges, two per handle and one per further boundary loop, together with the paths from both their ends, form the
    shortest set of cuts of this kind. `shorten_cuts` then moves them away from the root.

    Parameters
    ----------
    graph : EdgeGraph

    Returns
    -------
    (e,) bool
        Mask of the cut edges; all False for a disk. A closed surface without handles is cut along a path between two
        distant vertices.
    """
    cut = np.zeros(len(graph.ends), dtype=bool)
    closed = not graph.rim.any()
    roots = np.array([0]) if closed else np.flatnonzero(graph.rim_vertices)
    distance, before = graph.distances(roots, graph.cost)
    for number in _extra_edges(graph, distance, before).tolist():
        cut[number] = True
        for end in graph.ends[number].tolist():
            cut[graph.way_back(before, end)] = True
    cut = without_loose_ends(graph, cut)
    if closed and not cut.any():
        cut[_long_path(graph)] = True
    return cut


def without_loose_ends(graph: EdgeGraph, cut: BoolArray) -> BoolArray:
    """Remove from cuts (e,) all paths that end in the interior.

    A disk remains a disk. A tree of cuts is removed completely.
    """
    cut = cut.copy()
    on_rim = graph.rim_vertices
    while True:
        degree = np.bincount(graph.ends[cut].ravel(), minlength=graph.n)
        loose = cut & ((degree == 1) & ~on_rim)[graph.ends].any(axis=1)
        if not loose.any():
            return cut
        cut &= ~loose


def _extra_edges(graph: EdgeGraph, distance: FloatArray, before: IntArray) -> IntArray:
    """Edges that are neither in the forest of shortest paths nor crossed by the tree of triangles."""
    free = ~graph.rim
    reached = np.flatnonzero(before >= 0)
    free[graph.numbers(reached, before[reached])] = False
    one, other, number = graph.list_pairs()
    keep = free[number]
    number, one, other = number[keep], one[keep], other[keep]
    around = graph.cost[number] + distance[graph.ends[number]].sum(axis=1)
    # Ranks as weights: the longest loops get the lowest rank. No rank is zero, and only their order matters.
    rank = np.empty(number.size)
    rank[np.lexsort((number, -around))] = np.arange(1, number.size + 1)
    # Before version 1.17, SciPy's spanning trees accept 32-bit indices only.
    ends = one.astype(np.int32), other.astype(np.int32)
    tree = minimum_spanning_tree(csr_array((rank, ends), shape=(len(graph.F), len(graph.F))))
    crossed = np.isin(rank, tree.data)
    return np.sort(number[~crossed])


def _long_path(graph: EdgeGraph) -> IntArray:
    """Path between two distant vertices of a closed surface; at least two edges, since one edge opens nothing."""
    start = int(np.argmax(np.linalg.norm(graph.V - graph.V.mean(axis=0), axis=1)))
    for _ in range(2):
        away, _ = graph.distances(np.array([start]), graph.length)
        start, end = int(np.argmax(away)), start
    _, before = graph.distances(np.array([end]), graph.cost)
    path = graph.way_back(before, start)
    if path.size == 1:
        # Go through a common neighbour of both ends.
        corners = graph.F[np.isin(graph.F, (start, end)).sum(axis=1) == 2][0]
        around = int(corners[(corners != start) & (corners != end)][0])
        path = graph.numbers(np.array([start, around]), np.array([around, end]))
    return path
