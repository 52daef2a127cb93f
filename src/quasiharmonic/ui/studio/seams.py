"""Seams of the surface: those of the map, those that the user draws or erases, and where their sides are on the page.

Seams are in chains with one colour on both sides; a chain ends where seams meet.
"""

from __future__ import annotations

from dataclasses import replace
from typing import NamedTuple

import numpy as np
from scipy.sparse import csr_array
from scipy.sparse.csgraph import dijkstra

from quasiharmonic.apps.unwrapping.symmetry import find_mirror
from quasiharmonic.geometry.mesh.topology import edge_keys, label_components, pair_keys
from quasiharmonic.ui.studio.state import SessionState
from quasiharmonic.ui.studio.validation import RequestError
from quasiharmonic.util.arrays import FloatArray, IntArray, pad_to_space


def find_seams(state: SessionState) -> IntArray:
    """Return the edges (k, 2) of the wanted seams: those of the map, until the user changes them."""
    return state.mesh.seams if state.wanted_seams is None else state.wanted_seams


def draw_seam(state: SessionState, start: int, end: int, axis: str | None, *, forbid: bool) -> SessionState:
    """Return the state in which the shortest path between two vertices, with its mirror image, is a wanted seam.

    With ``forbid``, its edges are those that must not become seams. Vertices are those of the surface.
    """
    V, F = state.mesh.V, state.mesh.F
    path = add_mirrored(shortest_path(V, F, start, end), V, F, axis)
    if forbid:
        return replace(state, forbidden=add_edges(state.forbidden, path))
    forbidden = remove_edges(state.forbidden, path, len(V))
    return replace(state, wanted_seams=add_edges(find_seams(state), path), forbidden=forbidden)


def erase_seam(state: SessionState, vertex: int, axis: str | None) -> SessionState:
    """Return the state without the chain nearest to a vertex, of seams or of edges that must not become seams."""
    V, F, seams = state.mesh.V, state.mesh.F, find_seams(state)
    chain = add_mirrored(find_chain(add_edges(seams, state.forbidden), V, vertex), V, F, axis)
    left = remove_edges(seams, chain, len(V))
    wanted = state.wanted_seams if len(left) == len(seams) else left
    return replace(state, wanted_seams=wanted, forbidden=remove_edges(state.forbidden, chain, len(V)))


def shortest_path(V: FloatArray, F: IntArray, start: int, end: int) -> IntArray:
    """Return the edges (k, 2) of the shortest path along edges between two vertices.

    RequestError if no path joins them.
    """
    tail, head = F.ravel(), F[:, (1, 2, 0)].ravel()
    low, high = np.minimum(tail, head), np.maximum(tail, head)
    _, once = np.unique(edge_keys(low, high, len(V)), return_index=True)
    low, high = low[once], high[once]
    lengths = np.maximum(np.linalg.norm(V[high] - V[low], axis=1), np.finfo(np.float64).tiny)
    graph = csr_array((lengths, (low, high)), shape=(len(V), len(V)))
    _, before = dijkstra(graph, directed=False, indices=start, return_predecessors=True)
    path = [end]
    while path[-1] != start:
        if before[path[-1]] < 0:
            raise RequestError("no edges join these two vertices, which are on different parts of the model")
        path.append(int(before[path[-1]]))
    return np.stack([path[:-1], path[1:]], axis=1).astype(np.int64)


def add_edges(seams: IntArray, more: IntArray) -> IntArray:
    """Return seams with further edges, ascending."""
    return np.unique(np.sort(np.concatenate([seams, more.reshape(-1, 2)]), axis=1), axis=0)


def remove_edges(seams: IntArray, fewer: IntArray, n: int) -> IntArray:
    """Return seams without some edges, of a surface with n vertices."""
    return seams[~np.isin(pair_keys(seams, n), pair_keys(fewer, n))]


def find_chain(seams: IntArray, V: FloatArray, vertex: int) -> IntArray:
    """Return the chain of seams (k, 2) that is nearest to a vertex; RequestError if there are none."""
    if not len(seams):
        raise RequestError("there are no seams")
    middle = (V[seams[:, 0]] + V[seams[:, 1]]) / 2
    nearest = int(np.argmin(((middle - V[vertex]) ** 2).sum(axis=1)))
    chains = _label_chains(seams)
    return seams[chains == chains[nearest]]


def add_mirrored(edges: IntArray, V: FloatArray, F: IntArray, axis: str | None) -> IntArray:
    """Return edges with their mirror images in the middle plane normal to an axis; without axis unchanged.

    RequestError if the surface is not symmetric.
    """
    if axis is None:
        return edges
    mirror, found = find_mirror(pad_to_space(V), F, axis)
    if mirror is None:
        raise RequestError(f"the model is not symmetric in {axis}: {found.reason}. Choose another symmetry of Unwrap")
    return add_edges(edges, mirror.vertex[edges])


class SeamSides(NamedTuple):
    """Sides of seams, by vertices of the page."""

    edges: IntArray  # (k, 2): every seam edge twice, once for each side
    chains: IntArray  # (k,): the chain of each, the same on both sides; a chain ends where seams meet


def find_sides(state: SessionState, pairs: IntArray) -> SeamSides:
    """Return edges (k, 2) of the surface by vertices of the page, every copy of them."""
    numbering = state.numbering
    tail, head = numbering.F.ravel(), numbering.F[:, (1, 2, 0)].ravel()
    n = len(state.mesh.V)
    key = edge_keys(numbering.origin[tail], numbering.origin[head], n)
    wanted = pair_keys(pairs, n)
    order = np.argsort(wanted, kind="stable")
    at = np.flatnonzero(np.isin(key, wanted))
    row = order[np.searchsorted(wanted[order], key[at])]
    return SeamSides(np.stack([tail[at], head[at]], axis=1), _label_chains(pairs)[row])


def _label_chains(pairs: IntArray) -> IntArray:
    """Return the chain (k,) of each edge: edges are joined at vertices where exactly two of them meet."""
    if not len(pairs):
        return np.empty(0, dtype=np.int64)
    ends = pairs.ravel()
    edge = np.repeat(np.arange(len(pairs)), 2)
    order = np.argsort(ends, kind="stable")
    _, first, times = np.unique(ends[order], return_index=True, return_counts=True)
    joints = first[times == 2]
    labels = label_components(edge[order[joints]], edge[order[joints + 1]], len(pairs))
    return np.unique(labels, return_inverse=True)[1]


def pair_sides(state: SessionState, seams: IntArray) -> IntArray:
    """Return both ends (k, 2, 2) of both sides of edges of seams, by vertices of the page: edge, end, side."""
    sides, origin = find_sides(state, seams).edges, state.numbering.origin
    swapped = origin[sides[:, 0]] > origin[sides[:, 1]]
    ends = np.where(swapped[:, None], sides[:, ::-1], sides)
    key = pair_keys(origin[ends], len(state.mesh.V))
    order = np.argsort(key, kind="stable")
    same = np.diff(key[order]) == 0
    return np.stack([ends[order[:-1][same]], ends[order[1:][same]]], axis=2)
