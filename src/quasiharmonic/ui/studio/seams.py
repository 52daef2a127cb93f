"""Edits by hand: draw and erase seams; pack, move, stitch and weld the islands into which they cut the surface.

The seams are those of the map, until the user changes them. They are in chains with one colour on both sides; a chain
ends where seams meet.
"""

from __future__ import annotations

from dataclasses import replace
from typing import NamedTuple

import numpy as np
from scipy.sparse import csr_array
from scipy.sparse.csgraph import dijkstra

from quasiharmonic.apps.atlas import island_functions as atlas
from quasiharmonic.apps.atlas.atlas_verdict import MIRROR
from quasiharmonic.apps.unwrapping.symmetry import find_mirror
from quasiharmonic.geometry.mesh.topology import edge_keys, label_components, pair_keys
from quasiharmonic.ui.studio import recipes
from quasiharmonic.ui.studio.operations import find_source, rebuild_from_mesh, record_start
from quasiharmonic.ui.studio.recipes import public
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
        wanted, forbidden = state.wanted_seams, add_edges(state.forbidden, path)
    else:
        wanted, forbidden = add_edges(find_seams(state), path), remove_edges(state.forbidden, path, len(V))
    if wanted is not None:
        wanted = remove_edges(wanted, forbidden, len(V))
    return replace(state, wanted_seams=wanted, forbidden=forbidden)


def erase_seam(state: SessionState, vertex: int, axis: str | None) -> SessionState:
    """Return the state without the chain nearest to a vertex, of seams or of edges that must not become seams."""
    V, F, seams, forbidden = state.mesh.V, state.mesh.F, find_seams(state), state.forbidden
    forbids = _distances(forbidden, V, vertex).min(initial=np.inf) <= _distances(seams, V, vertex).min(initial=np.inf)
    chain = add_mirrored(find_chain(forbidden if forbids else seams, V, vertex), V, F, axis)
    if forbids:
        return replace(state, forbidden=remove_edges(forbidden, chain, len(V)))
    return replace(state, wanted_seams=remove_edges(seams, add_edges(forbidden, chain), len(V)))


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
    chains = _label_chains(seams)
    return seams[chains == chains[np.argmin(_distances(seams, V, vertex))]]


def _distances(edges: IntArray, V: FloatArray, vertex: int) -> FloatArray:
    """Return the distance (k,) of the middle of each edge from a vertex."""
    return np.asarray(np.linalg.norm((V[edges[:, 0]] + V[edges[:, 1]]) / 2 - V[vertex], axis=1))


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


def pack_all(state: SessionState, resolution: int, padding: float) -> SessionState:
    """Pack all islands into the unit square, at one texel density."""
    source = find_source(state, with_map=True)
    laid = atlas.flatten(state.mesh, start=True, max_iterations=0)
    mesh = atlas.pack(laid.mesh, resolution=resolution, padding=padding)
    size = {"resolution": resolution, "padding": padding}
    words = ["--start", "--max-iterations", "0", "--pack"]
    script = recipes.Script()
    flat = script.let("flat", public(atlas.flatten)(source.name, start=True, max_iterations=0).mesh)
    script.let("mesh", public(atlas.pack)(flat, **size))
    recipe = recipes.record_call("flatten", source, "packed.obj", size, script, words=words)
    return rebuild_from_mesh(state, mesh, recipe, keep=("pins",))


def move_islands(
    state: SessionState, by: FloatArray, turn: float, scale: float, mirror: bool, texels: int | None
) -> SessionState:
    """Move the selected islands together by a vector (2,).

    Before, they are rotated by ``turn`` degrees and scaled around their centre, and mirrored there. Then each is moved
    to the nearest texel of a texture with ``texels`` on each side: the lower left corner of its box goes there.
    """
    places = [island.uv for island in state.mesh.islands]
    moving = np.concatenate([places[k] for k in state.selected])
    centre = (moving.min(axis=0) + moving.max(axis=0)) / 2
    cos, sin = np.cos(np.radians(turn)), np.sin(np.radians(turn))
    if turn % 90 == 0:  # Quarter turns are exact.
        cos, sin = np.rint(cos), np.rint(sin)
    matrix = scale * (np.diag(MIRROR) if mirror else np.eye(2)) @ np.array([[cos, sin], [-sin, cos]])
    still = np.array_equal(matrix, np.eye(2))
    for k in state.selected:
        places[k] = places[k] + by if still else (places[k] - centre) @ matrix + centre + by
        if texels is not None:
            low = places[k].min(axis=0)
            places[k] = places[k] - low + np.rint(low * texels) / texels
    mesh = state.mesh.with_places(places)
    return rebuild_from_mesh(state, mesh, record_start(mesh), keep=("pins",))


def stitch_seam(state: SessionState, vertex: int) -> SessionState:
    """Join the two sides of the chain of seams that is nearest to a vertex of the surface.

    Of two islands the smaller one is moved, rotated, scaled and perhaps mirrored to the larger one. The sides then meet
    in the middle. RequestError if that inverts a triangle.
    """
    pairs = pair_sides(state, find_chain(state.mesh.seams, state.mesh.V, vertex)).reshape(-1, 2)
    places, starts = state.uv.copy(), state.numbering.starts
    one, other = (state.numbering.find(int(v))[0] for v in pairs[0])
    if one != other:
        if len(state.islands[one].island.F) < len(state.islands[other].island.F):
            one, other, pairs = other, one, pairs[:, ::-1]
        moving = slice(starts[other], starts[other + 1])
        if state.islands[one].mirrored != state.islands[other].mirrored:
            places[moving] *= MIRROR
        # A similarity by least squares, as numbers in the complex plane.
        z = places.view(np.complex128).ravel()
        to, at = z[pairs[:, 0]], z[pairs[:, 1]]
        factor = np.vdot(at - at.mean(), to - to.mean()) / np.vdot(at - at.mean(), at - at.mean())
        z[moving] = factor * (z[moving] - at.mean()) + to.mean()
    return _join(state, places, pairs)


def weld_seams(state: SessionState, distance: float) -> SessionState:
    """Join the sides of all seams whose ends are no further apart than ``distance``."""
    pairs, places = pair_sides(state, state.mesh.seams), state.uv.copy()
    apart = np.abs(places[pairs[:, :, 0]] - places[pairs[:, :, 1]]).max(axis=(1, 2), initial=0.0)
    if not (apart <= distance).any():
        raise RequestError("no two sides of a seam are closer than a texel: move the islands together, or use Stitch")
    return _join(state, places, pairs[apart <= distance].reshape(-1, 2))


def _join(state: SessionState, places: FloatArray, pairs: IntArray) -> SessionState:
    """Return the state with the map ``places`` (n, 2), changed so that pairs (k, 2) of vertices of the page coincide.

    RequestError if the state was injective and the new map is not, or has one island, which is mirrored.
    """
    label = label_components(pairs[:, 0], pairs[:, 1], len(places))
    count = np.bincount(label, minlength=len(places))
    middle = np.stack([np.bincount(label, places[:, k], len(places)) for k in range(2)], axis=1)
    joined = count[label] > 1
    places[joined] = (middle[label] / count[label][:, None])[joined]
    mesh = state.mesh.with_places(np.split(places, state.numbering.starts[1:-1]))
    after = rebuild_from_mesh(state, mesh, record_start(mesh))
    if state.injective and after.is_mirrored:
        raise RequestError("joined there, the only island would be mirrored: select all islands and press Mirror first")
    if state.injective and not after.injective:
        bad = sum(len(one.result.certificate.inverted) for one in after.islands if one.result is not None)
        raise RequestError(f"joined there, {bad} triangles would be inverted: erase the seam and press Unwrap")
    return replace(after, from_file=False).select_all()
