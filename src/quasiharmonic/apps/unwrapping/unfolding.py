"""Unfold small closed components into the plane without stretch, like paper models.

Triangles are joined across the flattest edges, along a tree. All components are unfolded at once, because thousands of
them would take minutes one by one.
"""

from __future__ import annotations

import numpy as np
from scipy.sparse import csr_array
from scipy.sparse.csgraph import breadth_first_order, minimum_spanning_tree

from quasiharmonic.apps.unwrapping.flat_parts import covers_once
from quasiharmonic.geometry.mesh.fans import fans
from quasiharmonic.geometry.mesh.reference import rest_frames
from quasiharmonic.util.arrays import BoolArray, FloatArray, IntArray


def unfold(V: FloatArray, F: IntArray, undivided: BoolArray) -> tuple[IntArray, IntArray, FloatArray, BoolArray]:
    """Unfold closed surfaces.

    Parameters
    ----------
    V : (n, 3) float64
    F : (f, 3) int64
        Triangles of closed surfaces.
    undivided : (f, 3) bool
        Sides across which triangles are joined first, such as those inside polygons.

    Returns
    -------
    split : (f, 3) int64
        Triangles by vertices of the unfolded surfaces.
    component : (f,) int64
        Surface of each triangle, by first appearance.
    uv : (m, 2) float64
        Positions of the unfolded vertices.
    good : (c,) bool
        Which surfaces do not overlap themselves.
    """
    first, second, side, opposite = _pairs(F)
    z1, z2 = rest_frames(V, F)
    z = np.stack([np.zeros(len(F), dtype=np.complex128), z1.astype(np.complex128), z2], axis=1)
    corners = V[F]
    normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    normal = normal / np.linalg.norm(normal, axis=1)[:, None]
    bend = 1 - (normal[first] * normal[second]).sum(axis=1)
    bend[undivided[first, side] | undivided[second, opposite]] = -1.0
    rank = np.empty(bend.size)
    rank[np.argsort(bend, kind="stable")] = np.arange(1, bend.size + 1)
    size = len(F)
    tree = minimum_spanning_tree(
        csr_array((rank, (first.astype(np.int32), second.astype(np.int32))), shape=(size, size))
    )
    joined = np.isin(rank, tree.data)
    cut = np.ones(F.shape, dtype=bool)
    cut[first[joined], side[joined]] = False
    cut[second[joined], opposite[joined]] = False
    split, component = fans(F, cut)
    place = _unfold_along(z, first[joined], second[joined], side[joined], opposite[joined], component)
    uv = np.zeros((int(split.max()) + 1, 2))
    flat = place.ravel()[np.unique(split.ravel(), return_index=True)[1]]
    uv[:, 0], uv[:, 1] = flat.real, flat.imag
    return split, component, uv, covers_once(split, uv, component, np.ones(int(component.max()) + 1, dtype=bool))


def _unfold_along(
    z: FloatArray, first: IntArray, second: IntArray, side: IntArray, opposite: IntArray, component: IntArray
) -> FloatArray:
    """Place triangles with corners ``z`` (f, 3) complex128 next to each other along a forest of joined sides."""
    f = len(z)
    roots = np.unique(component, return_index=True)[1]
    tails, heads = np.concatenate([first, np.full(roots.size, f)]), np.concatenate([second, roots])
    forest = csr_array((np.ones(tails.size), (tails.astype(np.int32), heads.astype(np.int32))), shape=(f + 1, f + 1))
    order, before = breadth_first_order(forest, f, directed=False)
    depth = np.zeros(f + 1, dtype=np.int64)
    for k in order[1:].tolist():
        depth[k] = depth[before[k]] + 1
    # The sides that join each triangle to the one before it: its own and the other's.
    own, other = np.zeros((2, f), dtype=np.int64)
    forward = before[second] == first
    own[second[forward]], other[second[forward]] = opposite[forward], side[forward]
    own[first[~forward]], other[first[~forward]] = side[~forward], opposite[~forward]
    place = z.copy()
    levels = np.split(np.argsort(depth[:f], kind="stable"), np.cumsum(np.bincount(depth[:f])[1:-1]))
    for rows in levels[1:]:
        parent, k, m = before[rows], own[rows], other[rows]
        start, end = place[parent, (m + 1) % 3], place[parent, m]
        here = z[rows]
        tail, head = here[np.arange(rows.size), k], here[np.arange(rows.size), (k + 1) % 3]
        turn = (end - start) / (head - tail)
        turn /= np.abs(turn)
        place[rows] = (here - tail[:, None]) * turn[:, None] + start[:, None]
    return place


def _pairs(F: IntArray) -> tuple[IntArray, IntArray, IntArray, IntArray]:
    """The two triangles at each interior edge, and the number of the edge's side in each."""
    n = int(F.max()) + 1
    tail, head = F.ravel(), F[:, (1, 2, 0)].ravel()
    key = np.minimum(tail, head) * n + np.maximum(tail, head)
    order = np.argsort(key, kind="stable")
    at = np.flatnonzero(np.diff(key[order]) == 0)
    one, other = order[at], order[at + 1]
    return one // 3, other // 3, one % 3, other % 3
