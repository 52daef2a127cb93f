"""Connectivity of triangle meshes: edges, boundary loops, components.

One sort of the half-edges by their undirected edges gives all edges. It separates edges shared by two triangles,
boundary edges, and edges that do not occur in a surface.
"""

from __future__ import annotations

import sys
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from quasiharmonic.util.arrays import BoolArray, IntArray, check_range, named, own_triangles, unchangeable
from quasiharmonic.util.kernels import compiled

# Number of half-edges from which the sparse matrix is faster than a sort.
_MANY = 10_000


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
    """Sort the half-edges of ``F`` and classify the edges.

    Parameters
    ----------
    F : (f, 3) int
        Triangles; every index in ``0 … n - 1``.
    n : int
        Number of vertices, below 2³¹.

    Returns
    -------
    Edges
        Each kind in ascending order of its undirected edge.
    """
    T = own_triangles(F)
    pairs, sizes = np.empty((T.size, 2), dtype=np.int64), np.empty(4, dtype=np.int64)
    if not sort_edges(T, n, pairs, sizes):
        check_range("F", T, n)
    # Most edges have two half-edges. Release the rest of the memory, which was never touched.
    pairs.resize((int(sizes.sum()), 2), refcheck=False)
    end = np.cumsum(sizes).tolist()
    rest = (pairs[start:stop].copy() for start, stop in pairwise(end))
    return Edges(pairs[: end[0]], *rest)


@compiled
def sort_edges(F: IntArray, n: int, pairs: IntArray, sizes: IntArray) -> int:
    """Fill in the edges, kind after kind as in `Edges`, and their numbers; return 0 if F is out of range, else 1."""
    if F.size and (F.min() < 0 or F.max() >= n):
        return 0
    T = np.ascontiguousarray(F.T, dtype=np.int32)
    tail, head = T.ravel(), T[(1, 2, 0), :].ravel()
    # SciPy halves the time for large meshes, but importing it for this alone takes longer.
    by_edge = _by_rows if tail.size >= _MANY and "scipy.sparse" in sys.modules else _by_keys
    low, high, direction = by_edge(tail, head, n)
    del T, tail, head
    starts = np.ones(low.size, dtype=bool)
    np.not_equal(high[1:], high[:-1], out=starts[1:])
    starts[1:] |= low[1:] != low[:-1]
    first = np.flatnonzero(starts)
    count = np.diff(first, append=low.size)
    pair, single = first[count == 2], first[count == 1]
    opposed = direction[pair] != direction[pair + 1]
    filled = 0
    for kind, start in enumerate((pair[opposed], single, pair[~opposed], first[count > 2])):
        sizes[kind] = start.size
        some = pairs[filled : filled + start.size]
        some[:, 0], some[:, 1] = low[start], high[start]
        if kind == 1:
            flip = direction[single]
            some[flip] = some[flip, ::-1]
        filled += start.size
    return 1


_Integers = NDArray[np.integer]


def _by_keys(tail: NDArray[np.int32], head: NDArray[np.int32], n: int) -> tuple[_Integers, _Integers, BoolArray]:
    """Sort half-edges by edge: smaller end, larger end, and whether the half-edge starts at the larger end."""
    key = edge_keys(tail, head, n)
    key *= 2
    key += tail > head
    key.sort()
    direction = (key & 1).astype(bool)
    low, high = np.divmod(np.right_shift(key, 1, out=key), max(n, 1))
    return low, high, direction


def _by_rows(tail: NDArray[np.int32], head: NDArray[np.int32], n: int) -> tuple[_Integers, _Integers, BoolArray]:
    """As `_by_keys`, by a sparse matrix; half-edges of the same edge may come in another order."""
    from scipy.sparse import csr_array

    table = (tail > head, np.minimum(tail, head), np.arange(tail.size + 1))
    # Converting the matrix of half-edges and smaller ends to columns sorts the half-edges by their smaller ends.
    turned = csr_array(table, shape=(tail.size, n)).tocsc()
    del table
    by_low = csr_array((turned.data, np.maximum(tail, head).take(turned.indices), turned.indptr), shape=(n, n))
    by_low.sort_indices()
    low: _Integers = np.repeat(np.arange(n, dtype=by_low.indices.dtype), np.diff(by_low.indptr))
    return low, by_low.indices, by_low.data


def edge_keys(tail: NDArray[np.integer], head: NDArray[np.integer], n: int) -> IntArray:
    """One integer for each undirected edge between vertices below ``n``, in either direction."""
    # Use 64 bits even for 32-bit indices, because products overflow 32 bits.
    keys: IntArray = np.minimum(tail, head, dtype=np.int64)
    keys *= n
    keys += np.maximum(tail, head)
    return keys


def boundary_edges(F: NDArray[np.integer], n: int) -> IntArray:
    """Half-edges ``i → j`` on the boundary, with their triangle to the left.

    Parameters
    ----------
    F : (f, 3) array of int
    n : int
        Number of vertices.

    Returns
    -------
    (k, 2) int64
    """
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
    """Order directed boundary edges into loops.

    Parameters
    ----------
    boundary : (k, 2) int64
        Half-edges ``i → j``, as in `Edges.boundary`.

    Returns
    -------
    list of (l,) int64
        Each loop in order with the surface to its left: counterclockwise around the outside of a
        planar mesh, clockwise around its holes (the direction of eq. 15). Each loop starts at its smallest
        vertex. Loops are sorted by their first vertex.

    Raises
    ------
    ValueError
        If the edges do not form loops: two fans of triangles touch at a vertex, or the mesh is
        not a consistently oriented surface.
    """
    vertices, lengths = np.empty(len(boundary), dtype=np.int64), np.empty(len(boundary), dtype=np.int64)
    number = follow_loops(boundary, vertices, lengths)
    if number < 0:
        tails, heads = np.sort(boundary, axis=0).T
        shared = np.unique(tails[1:][tails[1:] == tails[:-1]])
        if shared.size:
            raise ValueError(f"the boundary passes more than once through {named('vertex', 'vertices', shared)}")
        unpaired = np.setxor1d(tails, heads)
        raise ValueError(f"the boundary does not close at {named('vertex', 'vertices', unpaired)}")
    return np.split(vertices, np.cumsum(lengths[: number - 1])) if number > 1 else [vertices][:number]


@compiled
def follow_loops(boundary: IntArray, vertices: IntArray, lengths: IntArray) -> int:
    """Fill in the loops (k,) and their lengths in the order of `trace_loops`; return their number, or -1 on failure."""
    tails, heads = np.sort(boundary, axis=0).T
    if (tails[1:] == tails[:-1]).any() or not np.array_equal(tails, heads):
        return -1
    following = dict(zip(boundary[:, 0].tolist(), boundary[:, 1].tolist(), strict=True))
    passed: list[int] = []
    number = 0
    for start in tails.tolist():
        if start not in following:
            continue
        before, here = len(passed), start
        while here in following:
            passed.append(here)
            here = following.pop(here)
        lengths[number] = len(passed) - before
        number += 1
    vertices[:] = passed
    return number


def components(F: NDArray[np.integer], n: int) -> IntArray:
    """Label of the connected component of every vertex.

    Parameters
    ----------
    F : (f, 3) array of int
    n : int
        Number of vertices.

    Returns
    -------
    (n,) int64
        Smallest vertex of the component. A vertex without triangle is a component of its own.
    """
    T = own_triangles(F)
    # Two edges of a triangle connect its three vertices.
    return linked(T[:, :2], T[:, 1:], n)


def linked(tail: IntArray, head: IntArray, n: int) -> IntArray:
    """Label of the connected component of every node of a graph.

    Parameters
    ----------
    tail, head : (e,) or (e, k) int64
        Nodes ``0 … n - 1`` at the ends of each link.
    n : int
        Number of nodes.

    Returns
    -------
    (n,) int64
        Smallest node of the component.
    """
    label = np.empty(n, dtype=np.int64)
    tail, head = unchangeable(tail), unchangeable(head)
    if not link_nodes(tail, head, label):
        for nodes in (tail, head):
            check_range("a link", nodes, n, "node", "nodes")
    return label


@compiled
def link_nodes(tail: IntArray, head: IntArray, label: IntArray) -> int:
    """Fill in the smallest node of every node's component (n,); return 0 if a link is out of range, else 1."""
    # Importing SciPy's csgraph takes longer than all other work on a small mesh, so this is done here. Every edge
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
        apart = one != other
        if not apart.any():
            break
        tail, head, one, other = tail[apart], head[apart], one[apart], other[apart]
        np.minimum.at(here, np.maximum(one, other), np.minimum(one, other))
    label[:] = here
    return 1
