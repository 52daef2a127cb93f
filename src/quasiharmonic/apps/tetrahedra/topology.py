"""Faces of tetrahedral meshes: the boundary, and defects of the mesh."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from quasiharmonic.util.arrays import IntArray, repeat_each

#: Faces of a positive tetrahedron, counterclockwise seen from outside; face k is opposite vertex k.
FACES = np.array([(1, 2, 3), (0, 3, 2), (0, 1, 3), (0, 2, 1)])
#: Edges of a tetrahedron.
EDGES = np.array([(0, 1), (0, 2), (0, 3), (1, 2), (1, 3), (2, 3)])
_EDGES_OF_TRIANGLE = np.array([(0, 1), (1, 2), (2, 0)])
# Vertex counts up to this have three vertices in one integer.
_MAX_PACKED = 1 << 21


@dataclass(frozen=True, eq=False)
class FaceReport:
    """The faces of a tetrahedral mesh.

    Attributes
    ----------
    boundary : (b, 3) int64
        Triangles in one tetrahedron only, counterclockwise seen from outside if the tetrahedron is positive.
    owner : (b,) int64
        The tetrahedron of each boundary triangle.
    nonmanifold : (k, 3) int64
        Faces of three or more tetrahedra.
    inconsistent : (k, 3) int64
        Faces of two tetrahedra that traverse them in the same direction.
    repeated : (k,) int64
        Tetrahedra with the same four vertices as an earlier one, and those with a vertex twice.
    neighbours : (m, 2) int64
        Pairs of tetrahedra with a common face.
    """

    boundary: IntArray
    owner: IntArray
    nonmanifold: IntArray
    inconsistent: IntArray
    repeated: IntArray
    neighbours: IntArray


def inspect_faces(T: IntArray, n: int) -> FaceReport:
    """Find the boundary and the defects of tetrahedra (t, 4) among ``n`` vertices."""
    faces = T[:, FACES].reshape(-1, 3)
    ordered, odd = _sort_triples(faces)
    order, first = _group(ordered, n)
    size = np.diff(np.append(first, len(order)))
    alone = np.sort(order[first[size == 1]])
    pair = first[size == 2]
    one, other = order[pair], order[pair + 1]
    many = order[first[size > 2]]
    opposite = T.ravel()  # face k of a tetrahedron is opposite its vertex k
    twins = opposite[one] == opposite[other]
    twice = np.flatnonzero((np.sort(T, axis=1)[:, 1:] == np.sort(T, axis=1)[:, :-1]).any(axis=1)) if len(T) else one
    crowded = np.unique(order[repeat_each(size > 2, size)] // 4)
    repeated = [np.maximum(one, other)[twins] // 4, twice]
    if crowded.size:
        keys = np.sort(T[crowded], axis=1)
        _, index, number = np.unique(keys, axis=0, return_index=True, return_inverse=True)
        repeated.append(crowded[index[number.ravel()] != np.arange(len(crowded))])
    return FaceReport(
        boundary=faces[alone],
        owner=alone // 4,
        nonmanifold=ordered[many],
        inconsistent=ordered[one[odd[one] == odd[other]]],
        repeated=np.unique(np.concatenate(repeated)),
        neighbours=np.stack([one // 4, other // 4], axis=1),
    )


def _sort_triples(faces: IntArray) -> tuple[IntArray, IntArray]:
    """Sort the vertices of every face; also return whether the permutation is odd."""
    a, b, c = faces.T
    odd = (a > b).astype(np.int64) + (a > c) + (b > c)
    low, high = np.minimum(np.minimum(a, b), c), np.maximum(np.maximum(a, b), c)
    return np.stack([low, a + b + c - low - high, high], axis=1), odd & 1


def _group(ordered: IntArray, n: int) -> tuple[IntArray, IntArray]:
    """Return an order in which equal rows are adjacent, and the start of each group of equal rows."""
    if not len(ordered):
        return np.empty(0, dtype=np.int64), np.empty(0, dtype=np.int64)
    if n <= _MAX_PACKED:
        key = (ordered[:, 0] * n + ordered[:, 1]) * n + ordered[:, 2]
        order = np.argsort(key, kind="stable")
        key = key[order]
        differs = key[1:] != key[:-1]
    else:
        order = np.lexsort(ordered.T[::-1])
        rows = ordered[order]
        differs = (rows[1:] != rows[:-1]).any(axis=1)
    return order, np.flatnonzero(np.concatenate([[True], differs]))


def find_patches(boundary: IntArray) -> IntArray:
    """Number the parts (b,) of a boundary (b, 3) that are connected across edges of exactly two of its triangles."""
    from scipy.sparse import coo_array
    from scipy.sparse.csgraph import connected_components

    edges = np.sort(boundary[:, _EDGES_OF_TRIANGLE].reshape(-1, 2), axis=1)
    key = edges[:, 0] * (boundary.max(initial=0) + 1) + edges[:, 1]
    order = np.argsort(key, kind="stable")
    key = key[order]
    first = np.flatnonzero(np.concatenate([[True], key[1:] != key[:-1]]))
    pair = first[np.diff(np.append(first, len(key))) == 2]
    one, other = order[pair] // 3, order[pair + 1] // 3
    graph = coo_array((np.ones(len(one), dtype=np.int8), (one, other)), shape=(len(boundary), len(boundary)))
    labels: IntArray = connected_components(graph, directed=False)[1].astype(np.int64)
    return labels


def find_mesh_edges(T: IntArray) -> IntArray:
    """Return the edges (e, 2) of tetrahedra, each once, lower vertex first."""
    pairs = np.sort(T[:, EDGES].reshape(-1, 2), axis=1)
    n = int(T.max(initial=0)) + 1
    key = np.unique(pairs[:, 0] * n + pairs[:, 1])
    return np.stack(np.divmod(key, n), axis=1)
