"""Unroll developable pieces: lay one triangle after another into the plane, without stretch."""

from __future__ import annotations

import numpy as np
from scipy.sparse import csr_array
from scipy.sparse.csgraph import breadth_first_order, minimum_spanning_tree

from quasiharmonic.apps.unwrapping.hinges import Hinges, ahead
from quasiharmonic.geometry.mesh.reference import rest_frames
from quasiharmonic.util.arrays import BoolArray, ComplexArray, FloatArray, IntArray

#: Two sides of an edge are at one place if their ends are at most this fraction of its length apart.
SAME = 1e-3


def spanning_links(first: IntArray, second: IntArray, rank: FloatArray, size: int) -> BoolArray:
    """Return which links (e,) between nodes below ``size`` form the spanning forest of smallest ranks, all distinct."""
    links = csr_array((rank, (first.astype(np.int32), second.astype(np.int32))), shape=(size, size))
    return np.isin(rank, minimum_spanning_tree(links).data)


def lay_along(V: FloatArray, F: IntArray, one: IntArray, other: IntArray, component: IntArray) -> ComplexArray:
    """Lay triangles next to each other along a forest of joined sides.

    Parameters
    ----------
    V : (n, 3) float64
    F : (f, 3) int64
    one, other : (k,) int64
        The sides that are joined. They connect the triangles of each component without circles.
    component : (f,) int64
        Component of each triangle.

    Returns
    -------
    (f, 3) complex128
        Position of every corner. The first triangle of a component keeps the frame of `rest_frames`.
    """
    f = len(F)
    z1, z2 = rest_frames(V, F)
    z = np.stack([np.zeros(f, dtype=np.complex128), z1.astype(np.complex128), z2], axis=1)
    first, second = one // 3, other // 3
    roots = np.unique(component, return_index=True)[1]
    tails, heads = np.concatenate([first, np.full(roots.size, f)]), np.concatenate([second, roots])
    forest = csr_array((np.ones(tails.size), (tails.astype(np.int32), heads.astype(np.int32))), shape=(f + 1, f + 1))
    order, before = breadth_first_order(forest, f, directed=False)
    depth = np.zeros(f + 1, dtype=np.int64)
    for k in order[1:].tolist():
        depth[k] = depth[before[k]] + 1
    # The sides that join each triangle to the one before it: its own and the other's.
    own, there = np.zeros((2, f), dtype=np.int64)
    forward = before[second] == first
    own[second[forward]], there[second[forward]] = other[forward] % 3, one[forward] % 3
    own[first[~forward]], there[first[~forward]] = one[~forward] % 3, other[~forward] % 3
    place = z.copy()
    levels = np.split(np.argsort(depth[:f], kind="stable"), np.cumsum(np.bincount(depth[:f])[1:-1]))
    for rows in levels[1:]:
        parent, k, m = before[rows], own[rows], there[rows]
        start, end = place[parent, (m + 1) % 3], place[parent, m]
        here = z[rows]
        tail, head = here[np.arange(rows.size), k], here[np.arange(rows.size), (k + 1) % 3]
        turn = (end - start) / (head - tail)
        turn /= np.abs(turn)
        place[rows] = (here - tail[:, None]) * turn[:, None] + start[:, None]
    return place


def meet(place: ComplexArray, hinges: Hinges, chosen: IntArray) -> BoolArray:
    """Return which of some hinges (k,) have both sides at one place, up to `SAME`, given the corners' places (f, 3)."""
    z, one, other = place.ravel(), hinges.one[chosen], hinges.other[chosen]
    apart = np.maximum(np.abs(z[one] - z[ahead(other)]), np.abs(z[ahead(one)] - z[other]))
    same: BoolArray = apart <= SAME * hinges.length[chosen]
    return same
