"""Islands of a map: pack, move, stitch and weld them."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from quasiharmonic.apps.atlas import island_functions as atlas
from quasiharmonic.apps.atlas.atlas_verdict import MIRROR
from quasiharmonic.geometry.mesh.topology import label_components
from quasiharmonic.ui.studio import recipes
from quasiharmonic.ui.studio.operations import find_source, rebuild_from_mesh, record_start
from quasiharmonic.ui.studio.recipes import public
from quasiharmonic.ui.studio.seams import find_chain, pair_sides
from quasiharmonic.ui.studio.state import SessionState
from quasiharmonic.ui.studio.validation import RequestError
from quasiharmonic.util.arrays import FloatArray, IntArray


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
