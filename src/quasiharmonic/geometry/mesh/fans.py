"""Fans: sets of triangles around a vertex that are joined by edges. A vertex with several fans can be split."""

from __future__ import annotations

import numpy as np

from quasiharmonic.geometry.mesh.topology import edge_keys, linked
from quasiharmonic.util.arrays import BoolArray, IntArray


def fans(F: IntArray, cut: BoolArray | None = None) -> tuple[IntArray, IntArray]:
    """Split vertices at which triangles touch without a common edge.

    Parameters
    ----------
    F : (f, 3) int64
        Any triangles.
    cut : (f, 3) bool, optional
        Sides, from each corner to the next, at which triangles are never joined.

    Returns
    -------
    split : (f, 3) int64
        The same triangles with a separate vertex for every fan. They form surfaces. An edge becomes a boundary unless
        exactly two triangles share it with opposite directions.
    component : (f,) int64
        Component of each triangle. Vertices and components are numbered by first appearance.
    """
    corner = np.arange(F.size).reshape(-1, 3)
    tail, head = F.ravel(), F[:, (1, 2, 0)].ravel()
    ahead = corner[:, (1, 2, 0)].ravel()
    key = edge_keys(tail, head, int(F.max(initial=0)) + 1)
    order = np.argsort(key, kind="stable")
    first = np.flatnonzero(np.diff(key[order], prepend=-1))
    first = first[np.diff(first, append=key.size) == 2]
    one, other = order[first], order[first + 1]
    opposed = (tail[one] == head[other]) & (tail[one] != tail[other])
    if cut is not None:
        opposed &= ~(cut.ravel()[one] | cut.ravel()[other])
    one, other = one[opposed], other[opposed]
    # The half-edge of a corner begins there. Joining two half-edges identifies the start of each with the end of the
    # other.
    split = linked(np.concatenate([one, ahead[one]]), np.concatenate([ahead[other], other]), F.size)
    component = linked(one // 3, other // 3, len(F))
    # Labels are smallest elements, so their rank is the order of appearance.
    split, component = ((np.cumsum(label == np.arange(label.size)) - 1)[label] for label in (split, component))
    return split.reshape(-1, 3), component


def renumbered(split: IntArray, F: IntArray) -> tuple[IntArray, IntArray]:
    """Number the vertices of some triangles without gaps.

    Parameters
    ----------
    split : (k, 3) int64
        Triangles, as returned by `fans`.
    F : (k, 3) int64
        The same triangles by the original vertices. New numbers follow their order, so a mesh without split vertices
        and without gaps keeps its numbers.

    Returns
    -------
    renumbered : (k, 3) int64
    first : (m,) int64
        One corner of every vertex, as an index into the flattened triangles.
    """
    _, first, own = np.unique(split.ravel(), return_index=True, return_inverse=True)
    order = np.argsort(F.ravel()[first], kind="stable")
    return np.argsort(order)[own.reshape(-1, 3)], first[order]


def numbered(F: IntArray, split: IntArray, n: int) -> tuple[IntArray, IntArray]:
    """Give every fan a vertex: the first fan around a vertex keeps its number, further fans follow all vertices.

    Parameters
    ----------
    F : (f, 3) int64
        Triangles.
    split : (f, 3) int64
        Their fans, as numbered by `fans`.
    n : int
        Number of vertices.

    Returns
    -------
    FT : (f, 3) int64
        The triangles by fans; equals ``F`` where a vertex was not split.
    origin : (n + c,) int64
        The vertex of each fan: ``origin[FT]`` is ``F``, and the first ``n`` entries are ``0 … n - 1``.
    """
    # Fans are numbered by first appearance.
    vertex = F.ravel()[np.unique(split.ravel(), return_index=True)[1]]
    order = np.argsort(vertex, kind="stable")
    keeps = np.diff(vertex[order], prepend=-1) > 0
    kept, copies = order[keeps], order[~keeps]
    own = np.empty(vertex.size, dtype=np.int64)
    own[kept] = vertex[kept]
    own[copies] = np.arange(n, n + copies.size)
    return own[split], np.concatenate([np.arange(n), vertex[copies]])
