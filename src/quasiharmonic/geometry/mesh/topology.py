"""Connectivity of triangle meshes: edges, boundary loops, components.

One sort of the half-edges by their undirected edges gives all edges. It separates edges shared by two triangles,
boundary edges, and edges that do not occur in a surface.

Checks of whether triangles form a valid surface name the offending elements.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from quasiharmonic.util.arrays import (
    BoolArray,
    IntArray,
    check_range,
    first_equal,
    make_unchangeable,
    mark,
    own_triangles,
    reject,
    vertex_names,
)
from quasiharmonic.util.kernels import compiled


@dataclass(frozen=True)
class Edges:
    """The edges of a triangle mesh, by kind.

    Attributes
    ----------
    interior : (e, 2) int64
        Edges between two triangles that traverse them in opposite directions, smaller index first.
    boundary : (k, 2) int64
        Half-edges ``i → j`` without an opposite, directed so that their triangle lies to the left.
    inconsistent : (c, 2) int64
        Edges between two triangles that traverse them in the same direction (mixed winding).
    nonmanifold : (d, 2) int64
        Edges of three or more triangles.
    """

    interior: IntArray
    boundary: IntArray
    inconsistent: IntArray
    nonmanifold: IntArray


def edges(F: NDArray[np.integer], n: int) -> Edges:
    """Classify the edges of triangles, each kind in ascending order of its undirected edge; ``n`` must be below 2³¹."""
    T = own_triangles(F)
    pairs, sizes = np.empty((T.size, 2), dtype=np.int64), np.empty(4, dtype=np.int64)
    if not sort_edges(T, n, pairs, sizes):
        check_range("F", T, n)
    # Most edges have two half-edges. Release the rest of the memory, which was never touched.
    pairs.resize((int(sizes.sum()), 2), refcheck=False)
    end = np.cumsum(sizes).tolist()
    others = (pairs[start:stop].copy() for start, stop in pairwise(end))
    return Edges(pairs[: end[0]], *others)


@compiled
def sort_edges(F: IntArray, n: int, pairs: IntArray, sizes: IntArray) -> int:
    """Fill in the edges, kind after kind as in `Edges`, and their numbers; return 0 if F is out of range, else 1."""
    if F.size and (F.min() < 0 or F.max() >= n):
        return 0
    tail, head = F.ravel(), F[:, (1, 2, 0)].ravel()
    # Sort half-edges by edge, those that start at the smaller end first.
    key = edge_keys(tail, head, n)
    key *= 2
    key += tail > head
    del tail, head
    key.sort()
    direction = (key & 1).astype(bool)
    key >>= 1
    starts = np.ones(key.size, dtype=bool)
    np.not_equal(key[1:], key[:-1], out=starts[1:])
    first = np.flatnonzero(starts)
    count = np.diff(first, append=key.size)
    pair, single = first[count == 2], first[count == 1]
    opposed = direction[pair] != direction[pair + 1]
    filled = 0
    for kind, start in enumerate((pair[opposed], single, pair[~opposed], first[count > 2])):
        sizes[kind] = start.size
        some = pairs[filled : filled + start.size]
        some[:, 0], some[:, 1] = np.divmod(key[start], max(n, 1))
        if kind == 1:
            flip = direction[single]
            some[flip] = some[flip, ::-1]
        filled += start.size
    return 1


def find_sides(F: NDArray[np.integer], n: int) -> tuple[IntArray, IntArray]:
    """Return the undirected edges (e, 2) of triangles in ascending order, smaller end first, and those of the sides.

    The latter are (f, 3), from each corner to the next. ``n`` must be below 2³¹.
    """
    T = own_triangles(F)
    side, ends = np.empty(T.shape, dtype=np.int64), np.empty((T.size, 2), dtype=np.int64)
    count = number_sides(T, n, side, ends)
    if count < 0:
        check_range("F", T, n)
    return ends[:count].copy(), side


@compiled
def number_sides(F: IntArray, n: int, side: IntArray, ends: IntArray) -> int:
    """Fill in the result of `find_sides`; return the number of edges, or -1 if F is out of range."""
    if F.size and (F.min() < 0 or F.max() >= n):
        return -1
    keys, number = np.unique(edge_keys(F, F[:, (1, 2, 0)], n), return_inverse=True)
    side[:] = number.reshape(-1, 3)
    ends[: keys.size] = np.stack(np.divmod(keys, max(n, 1)), axis=1)
    return keys.size


def find_pairs(F: IntArray) -> tuple[IntArray, IntArray]:
    """Return the two sides of each edge of exactly two triangles (f, 3), the smaller first, in order of the first ones.

    Side 3 t + k runs from corner k of triangle t to the next.
    """
    opposite = opposite_sides(find_sides(F, int(F.max(initial=-1)) + 1)[1])
    one = first_of_pairs(opposite)
    return one, opposite[one]


def opposite_sides(side: IntArray) -> IntArray:
    """Return the other side (3 f,) of each side's edge, given the edge (f, 3) of each; -1 if there is not exactly one.

    Side 3 t + k is that of triangle t from corner k to the next.
    """
    opposite = np.empty(side.size, dtype=np.int64)
    edges = int(side.max(initial=-1)) + 1
    if not find_opposite(side, edges, opposite):
        check_range("side", side, edges)
    return opposite


def first_of_pairs(opposite: IntArray) -> IntArray:
    """Return the smaller side of each pair, ascending, given the `opposite_sides` (3 f,)."""
    return np.flatnonzero(opposite > np.arange(opposite.size))


def ahead(side: IntArray) -> IntArray:
    """Return the next side of the same triangle."""
    return side + 1 - 3 * (side % 3 == 2)


def previous_sides(side: IntArray) -> IntArray:
    """Return the previous side of the same triangle."""
    return side - 1 + 3 * (side % 3 == 0)


@compiled
def find_opposite(side: IntArray, edges: int, opposite: IntArray) -> int:
    """Fill in the result (3 f,) of `opposite_sides`; return 0 if an edge is out of range, else 1."""
    side = side.ravel()
    if side.min(initial=0) < 0 or side.max(initial=-1) >= edges:
        return 0
    first, last = np.empty((2, edges), dtype=np.int64)
    here = np.arange(side.size)
    last[side] = here
    first[side[::-1]] = here[::-1]
    two = np.bincount(side, minlength=edges) == 2
    opposite[:] = -1
    opposite[first[two]], opposite[last[two]] = last[two], first[two]
    return 1


def edge_keys(tail: NDArray[np.integer], head: NDArray[np.integer], n: int) -> IntArray:
    """One integer for each undirected edge between vertices below ``n``, in either direction."""
    # Use 64 bits even for 32-bit indices, because products overflow 32 bits.
    keys: IntArray = np.minimum(tail, head, dtype=np.int64)
    keys *= n
    keys += np.maximum(tail, head)
    return keys


def pair_keys(pairs: IntArray, n: int) -> IntArray:
    """The `edge_keys` of edges (k, 2) given by their ends; (k,) int64."""
    return edge_keys(pairs[:, 0], pairs[:, 1], n)


def mark_sides(F: IntArray, pairs: IntArray, n: int) -> BoolArray:
    """Return a mask (f, 3) of the sides of triangles (f, 3) at edges (k, 2), given by their ends."""
    # Few sides have both ends on an edge, and only these are searched.
    sides, keys = _sides_between(F, pairs, n)
    sides[sides] = np.isin(keys, pair_keys(pairs, n))
    return sides


def are_sides(pairs: IntArray, F: IntArray, n: int) -> BoolArray:
    """Return which pairs of vertices (k, 2) are sides of triangles (f, 3)."""
    found: BoolArray = np.isin(pair_keys(pairs, n), _sides_between(F, pairs, n)[1])
    return found


def _sides_between(F: IntArray, pairs: IntArray, n: int) -> tuple[BoolArray, IntArray]:
    """Return a mask (f, 3) of the sides with both ends in some pairs, and the keys of these sides."""
    at_corner = mark(n, pairs)[F]
    sides: BoolArray = at_corner & at_corner[:, (1, 2, 0)]
    return sides, edge_keys(F[sides], F[:, (1, 2, 0)][sides], n)


def are_collapsed(F: IntArray) -> BoolArray:
    """Whether each triangle (f, 3) uses a vertex twice; (f,) bool."""
    return (F[:, 0] == F[:, 1]) | (F[:, 1] == F[:, 2]) | (F[:, 2] == F[:, 0])


def find_twins(F: IntArray) -> IntArray:
    """Return for each triangle (f, 3) the first one with the same three vertices, in any order."""
    twin = np.arange(len(F))
    # The sum of hashed vertices does not depend on their order. Only triangles with equal sums are compared. The hash
    # uses the increment and the first multiplier of SplitMix64 (Steele, Lea and Flood 2014).
    hashed = np.arange(int(F.max(initial=-1)) + 1, dtype=np.uint64)
    for shift in (np.uint64(31), np.uint64(29)):
        hashed += np.uint64(0x9E3779B97F4A7C15)
        hashed ^= hashed >> shift
        hashed *= np.uint64(0xBF58476D1CE4E5B9)
    sums = hashed[F].sum(axis=1)
    ordered = np.sort(sums)
    several = np.flatnonzero(np.isin(sums, ordered[1:][ordered[1:] == ordered[:-1]]))
    if several.size:
        twin[several] = several[first_equal(np.sort(F[several], axis=1))]
    return twin


def boundary_edges(F: NDArray[np.integer], n: int) -> IntArray:
    """Half-edges ``i → j`` (k, 2) on the boundary, with their triangle to the left."""
    return edges(F, n).boundary


def boundary_loops(F: NDArray[np.integer], n: int) -> list[IntArray]:
    """Boundary vertices, loop by loop, with the surface to the left.

    Parameters
    ----------
    F : (f, 3) array of int
        Triangles, consistently oriented.
    n : int
        Number of vertices.

    Returns
    -------
    list of (k,) int64
        Each loop once, in the order of `trace_loops`.
    """
    return trace_loops(boundary_edges(F, n))


def trace_loops(boundary: IntArray) -> list[IntArray]:
    """Order directed boundary edges (k, 2) into loops, sorted by their first vertex, which is their smallest.

    The surface is to the left: loops run counterclockwise around the outside of a planar mesh and clockwise around its
    holes (the direction of eq. 15). Raises a ValueError if the edges do not form loops: two fans of triangles touch at
    a vertex, or the mesh is not a consistently oriented surface.
    """
    vertices, lengths = np.empty(len(boundary), dtype=np.int64), np.empty(len(boundary), dtype=np.int64)
    number = follow_loops(boundary, vertices, lengths)
    if number < 0:
        tails, heads = np.sort(boundary, axis=0).T
        shared = np.unique(tails[1:][tails[1:] == tails[:-1]])
        remedy = "inspect_mesh (qhm check) lists defects, and vertices at equal positions that may need to be merged"
        reject(shared, "vertex", "vertices", f"the boundary passes more than once through {{}}; {remedy}")
        unpaired = np.setxor1d(tails, heads)
        raise ValueError(
            f"the boundary does not close at {vertex_names(unpaired)}; orient all triangles alike with clean"
        )
    return np.split(vertices, np.cumsum(lengths[: number - 1])) if number > 1 else [vertices][:number]


@compiled
def follow_loops(boundary: IntArray, vertices: IntArray, lengths: IntArray) -> int:
    """Fill in the loops (k,) and their lengths in the order of `trace_loops`; return their number, or -1 on failure."""
    tails, heads = np.sort(boundary, axis=0).T
    if (tails[1:] == tails[:-1]).any() or not np.array_equal(tails, heads):
        return -1
    following = dict(zip(boundary[:, 0].tolist(), boundary[:, 1].tolist(), strict=True))
    visited: list[int] = []
    number = 0
    for start in tails.tolist():
        if start not in following:
            continue
        before, here = len(visited), start
        while here in following:
            visited.append(here)
            here = following.pop(here)
        lengths[number] = len(visited) - before
        number += 1
    vertices[:] = visited
    return number


def components(F: NDArray[np.integer], n: int) -> IntArray:
    """Label of the connected component of every vertex, (n,) int64: its smallest vertex.

    A vertex without triangle is a component of its own.
    """
    T = own_triangles(F)
    # Two edges of a triangle connect its three vertices.
    return label_components(T[:, :2], T[:, 1:], n)


def label_components(tail: IntArray, head: IntArray, n: int) -> IntArray:
    """Label of the connected component of every node of a graph, (n,) int64: its smallest node.

    ``tail`` and ``head`` (e,) or (e, k) are the nodes at the ends of each link.
    """
    label = np.empty(n, dtype=np.int64)
    tail, head = make_unchangeable(tail), make_unchangeable(head)
    if not link_nodes(tail, head, label):
        for nodes in (tail, head):
            check_range("a link", nodes, n, "node", "nodes")
    return label


def number_components(tail: IntArray, head: IntArray, n: int) -> IntArray:
    """Number of the connected component of every node of a graph, (n,) int64, by first appearance.

    The arguments are those of `label_components`.
    """
    return rank_labels(label_components(tail, head, n))


def rank_labels(label: IntArray) -> IntArray:
    """Return labels without gaps, (n,) int64, in the same order, given labels that are elements of their sets."""
    return (np.cumsum(label == np.arange(label.size)) - 1).take(label)


def group_by_label(label: IntArray) -> list[IntArray]:
    """Return the elements (k,) with each label (f,) that is not negative, by ascending labels."""
    order = np.argsort(label, kind="stable")
    order = order[label[order] >= 0]
    return np.split(order, np.flatnonzero(np.diff(label[order])) + 1) if order.size else []


@compiled
def link_nodes(tail: IntArray, head: IntArray, label: IntArray) -> int:
    """Fill in the smallest node of every node's component (n,); return 0 if a link is out of range, else 1."""
    # This function replaces SciPy's csgraph, whose import takes longer than all other work on a small mesh. Every edge
    # attaches the larger label of its ends to the smaller one, and labels follow their labels to the root
    # (Shiloach and Vishkin 1982). The number of rounds grows with the logarithm of the size.
    tail, head = tail.ravel(), head.ravel()
    here, low, high = np.arange(label.size), np.minimum(tail, head), np.maximum(tail, head)
    if low.min(initial=0) < 0 or high.max(initial=-1) >= label.size:
        return 0
    # Any smaller neighbour is a valid first label.
    here[high] = low
    del low, high
    while True:
        while not np.array_equal(here, root := here[here]):
            here = root
        one, other = here[tail], here[head]
        differ = one != other
        if not differ.any():
            break
        tail, head, one, other = tail[differ], head[differ], one[differ], other[differ]
        np.minimum.at(here, np.maximum(one, other), np.minimum(one, other))
    label[:] = here
    return 1


def surface_edges(F: IntArray, n: int) -> Edges:
    """Edges of triangles that form one connected, consistently oriented surface with a boundary.

    Raises a ValueError that names the first offending elements. Causes: a triangle that uses a vertex twice or is
    repeated, a vertex without triangle, non-manifold edges, mixed winding, no boundary, several components.
    """
    label = components(F, n)
    connected = not label.any()
    if not connected:
        # A vertex without triangle is a component of its own.
        reject(np.setdiff1d(np.arange(n), F), "vertex", "vertices", "{}: no triangle uses them; remove them")
    found = manifold_edges(F, n)
    if not found.boundary.size:
        raise ValueError(
            "the surface is closed: it has no boundary; cut it open first (cut_open; --cut of qhm map and qhm flatten)"
        )
    if not connected:
        first = np.unique(label)
        raise ValueError(
            f"the mesh has {first.size} components, the first ones around {vertex_names(first)}: "
            "map each component separately; if vertices at equal positions belong together, weld them first with clean"
        )
    return found


def manifold_edges(F: IntArray, n: int) -> Edges:
    """Edges of triangles that form any number of surfaces, each consistently oriented.

    Raises a ValueError that names the first offending elements. Causes: a triangle that uses a vertex twice or is
    repeated, non-manifold edges, mixed winding.
    """
    found = edges(F, n)
    # An edge from a vertex to itself is never interior, so only the other kinds of edges need a test.
    if found.nonmanifold.size or found.inconsistent.size or np.any(found.boundary[:, 0] == found.boundary[:, 1]):
        _check_triangles(F)
    crowded = "{} in more than two triangles: not a surface; cut it open with clean, or use unwrap, which does so"
    reject(found.nonmanifold, "edge", "edges", crowded)
    mixed = "mixed winding: {} traversed in the same direction by both triangles; orient all triangles alike with clean"
    reject(found.inconsistent, "edge", "edges", f"{mixed}, or use unwrap, which does so")
    return found


def _check_triangles(F: IntArray) -> None:
    message = "{}: a vertex is used twice in a triangle; remove such triangles with clean"
    reject(are_collapsed(F), "triangle", "triangles", message)
    message = (
        "{} repeated (a polygon counts as its triangles): the same vertices occur before; remove repetitions with clean"
    )
    reject(find_twins(F) < np.arange(len(F)), "triangle", "triangles", message)
