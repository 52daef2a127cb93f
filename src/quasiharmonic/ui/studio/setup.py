"""States of a whole model: without a map, with its first map, unwrapped, turned over, with other corners and pins."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import replace
from typing import Any

import numpy as np

from quasiharmonic.apps.unwrapping.model_files import PARTS, has_parts, polygon_costs, statement_labels
from quasiharmonic.apps.unwrapping.result import UnwrapStatus, UnwrapStep
from quasiharmonic.apps.unwrapping.unwrap import unwrap
from quasiharmonic.geometry.mesh.topology import are_sides
from quasiharmonic.io import read_mesh
from quasiharmonic.io.seamed_mesh import SeamedMesh
from quasiharmonic.targets import nearest_on_boundary
from quasiharmonic.ui.studio import recipes
from quasiharmonic.ui.studio.operations import (
    as_it_is,
    fix_where_it_is,
    flatten_islands,
    is_flattenable,
    make_start,
    map_in_place,
    map_to_outline,
    saved_start,
)
from quasiharmonic.ui.studio.page import NAMES
from quasiharmonic.ui.studio.protocol import MessageFrame
from quasiharmonic.ui.studio.recipes import FACES, FORBIDDEN, SEAMS, Code, Given, Recipe, Script, Source, public
from quasiharmonic.ui.studio.state import IslandState, SessionState
from quasiharmonic.ui.studio.surface import PageSurface
from quasiharmonic.ui.studio.validation import RequestError, make_outline
from quasiharmonic.util.arrays import FloatArray, IntArray
from quasiharmonic.util.options import UnwrapOptions

_FIRST_OUTLINE = "rect:1x1"
# Options that the recorded command states in any case.
_DEFAULTS = {"max_stretch": 1.5, "resolution": 2048, "padding": 4.0}
#: Larger models are not cut and mapped before the user asks, because this takes longer than some seconds.
MAX_AUTOMATIC = 40_000


def read_options(frame: MessageFrame) -> dict[str, Any]:
    """Return the options of `unwrap` that a message has; ValueError or TypeError for invalid ones."""
    given = frame.header.get("options", {})
    if not isinstance(given, dict) or not set(given) <= set(NAMES):
        raise RequestError(f"options of unwrap are {', '.join(NAMES)}")
    if given.get("labels", "groups") not in PARTS:
        raise RequestError(f"labels are {' or '.join(PARTS)}")
    if given.get("symmetry") == "none":
        given["symmetry"] = None
    UnwrapOptions(**given)
    return given


def unwrap_model(
    state: SessionState,
    callback: Callable[[UnwrapStep], object] | None = None,
    *,
    keep_seams: bool = False,
    selected: bool = False,
    **given: Any,
) -> SessionState:
    """Unwrap the model with options of `unwrap`, along the seams that the user drew at least.

    With ``keep_seams`` the seams of the map are kept. With ``selected`` only the selected islands are unwrapped.
    Triangles that have texture coordinates in the file keep them if there is no map yet.

    The command starts from the file, with its polygons, if the page shows the file's surface, or a cleaned one without
    drawn seams; `unwrap` then cleans the file's mesh in the same way. Otherwise it starts from a saved file with the
    surface: if a map is kept in part, if the model is turned over, or if seams were drawn on a cleaned surface.
    """
    sheet = state.sheet
    if not state.mapped and len(sheet.unmapped):
        return _unwrap_rest(state, callback, given)
    script, model = Script(), Code("model")
    options = {**_DEFAULTS, **given}
    if options.get("symmetry", "") is None:
        options["symmetry"] = Given(None, None, {"symmetry": "none"})
    some = selected and state.mapped and len(state.selected) < len(state.islands)
    if some or (keep_seams and state.drawn is None and state.mapped):
        mesh = state.mesh
        assert mesh.uv is not None
        options["uv"] = Given(mesh.uv[mesh.FT], model.vt[model.FT], {} if some else {"keep_seams": True})
    else:
        mesh = SeamedMesh(sheet.surface.V, sheet.surface.F)
    if some:
        triangles = np.sort(np.concatenate([state.islands[k].island.triangles for k in state.selected]))
        options["faces"] = recipes.saved_rows(FACES, "faces", triangles)
    edited = state.drawn is not None or len(state.forbidden) > 0
    source, V, F = make_start(mesh), mesh.V, mesh.F
    if "uv" not in options and not sheet.turned and (sheet.is_file or not edited):
        source, V, F = Source(sheet.name, None), sheet.mesh.V, sheet.mesh.F
        if (costs := polygon_costs(sheet.mesh)) is not None:
            options["edge_costs"] = Given(costs, public(polygon_costs)(model))
    if which := given.get("labels"):
        if source.start is not None:
            raise RequestError("the file's parts are unknown after the mesh has changed: undo, or choose no parts")
        labels = _label_triangles(sheet, which)
        options["labels"] = Given(labels, public(statement_labels)(model, *PARTS[which]), {"labels": which})
    if state.drawn is not None and len(state.drawn):
        options["seams"] = recipes.saved_rows(SEAMS, "seams", state.drawn)
    if len(state.forbidden):
        options["no_seams"] = recipes.saved_rows(FORBIDDEN, "no_seams", state.forbidden)
    result = unwrap(V, F, callback=callback, **recipes.values(options))
    FT = sheet.from_file(result.indices) if source.start is None else result.indices
    script.let("model", public(read_mesh)(source.name))
    code = script.let("result", public(unwrap)(model.V, model.F, **options))
    script.let("mesh", public(SeamedMesh)(model.V, model.F, code.indices, code.uvs))
    recipe = recipes.record_call("unwrap", source, "unwrapped.obj", options, script)
    mapped = SeamedMesh(sheet.surface.V, sheet.surface.F, FT, result.uvs)
    if result.status is UnwrapStatus.TIME_LIMIT:
        # The call was stopped, so it cannot be repeated.
        recipe = saved_start(mapped)
    after = as_it_is(state, mapped, recipe)
    return replace(after, from_file=False, selected=tuple(range(len(after.islands))))


def _unwrap_rest(
    state: SessionState, callback: Callable[[UnwrapStep], object] | None, options: dict[str, Any]
) -> SessionState:
    """Unwrap the triangles without texture coordinates, into the tile of the texture right of the others."""
    sheet, surface = state.sheet, state.sheet.surface
    assert sheet.mesh.vt is not None
    assert sheet.mesh.FT is not None
    FT, uv = sheet.from_file(sheet.mesh.FT).copy(), sheet.mesh.vt
    F = surface.F[sheet.unmapped]
    if which := options.get("labels"):
        labels = np.repeat(_label_triangles(sheet, which)[:, None], 3, axis=1)
        options = {**options, "labels": sheet.from_file(labels)[sheet.unmapped, 0]}
    for name, edges in (("seams", state.drawn), ("no_seams", state.forbidden)):
        if edges is not None and len(edges):
            options = {**options, name: edges[are_sides(edges, F, len(surface.V))]}
    costs = polygon_costs(sheet.mesh) if sheet.is_file else None
    if costs is not None:
        options = {**options, "edge_costs": costs[sheet.unmapped]}
    result = unwrap(surface.V, F, callback=callback, **options)
    right = np.ceil(uv[np.delete(FT, sheet.unmapped, axis=0), 0].max())
    FT[sheet.unmapped] = result.indices + len(uv)
    mapped = SeamedMesh(surface.V, surface.F, FT, np.concatenate([uv, result.uvs + np.array([right, 0.0])]))
    after = as_it_is(state, mapped, saved_start(mapped))
    return replace(after, from_file=False, selected=tuple(range(len(after.islands))))


def _label_triangles(sheet: PageSurface, which: str) -> IntArray:
    """Return the part (f,) of each of the file's triangles; RequestError if the file has no such parts."""
    if not has_parts(sheet.mesh, which):
        raise RequestError(f"the file has no {which}: choose other parts, or none")
    return statement_labels(sheet.mesh, *PARTS[which])


def open_without_map(sheet: PageSurface) -> SessionState:
    """Return the state of a model before it has a map."""
    mesh = SeamedMesh(sheet.surface.V, sheet.surface.F)
    islands = tuple(IslandState(island) for island in mesh.islands)
    return SessionState(sheet, mesh, islands, Recipe(), tuple(range(len(islands))))


def make_first_state(sheet: PageSurface, callback: Callable[[Any], object] | None = None) -> SessionState:
    """Return the initial state of a model: with the map of the file; otherwise a square, a flat map, or charts.

    A disk is mapped to a square if possible. Another connected surface is flattened, and cut before if necessary. Any
    other model is unwrapped. Large models that must be cut have no map. If only some triangles of the file have texture
    coordinates, these stay, and the others are unwrapped.
    """
    bare = open_without_map(sheet)
    if sheet.has_complete_map or (sheet.fixed is not None and sheet.is_file and sheet.mesh.FT is not None):
        return _take_map(sheet, callback)
    if len(sheet.unmapped):
        return bare if len(sheet.unmapped) > MAX_AUTOMATIC else unwrap_model(bare, callback)
    if len(bare.islands) == 1 and sheet.is_file:
        if len(bare.islands[0].loops) == 1 and is_flattenable(bare.islands[0].island):
            # Some disks have no map to a square: a boundary of three vertices, triangles with all corners on one side.
            with suppress(ValueError):
                square = map_to_outline(bare, make_outline(_FIRST_OUTLINE), callback=callback)
                if square.result.certificate.bijective:
                    return square
        if len(sheet.surface.F) <= MAX_AUTOMATIC:
            try:
                return flatten_islands(bare, callback)
            except (ValueError, RuntimeError):
                pass
    return bare if len(sheet.surface.F) > MAX_AUTOMATIC else unwrap_model(bare, callback)


def _take_map(sheet: PageSurface, callback: Callable[[Any], object] | None) -> SessionState:
    """Return the state with the map of the file; of a problem, with a map that has its fixed vertices in place."""
    mesh = sheet.initial_map()
    pins = [] if sheet.fixed is None else sheet.fixed.tolist()
    islands = tuple(_with_file_pins(IslandState(island), pins) for island in mesh.islands)
    state = SessionState(sheet, mesh, islands, Recipe(), tuple(range(len(islands))))
    found = as_it_is(state, mesh, Recipe(), keep=("pins",))
    if not sheet.posed:
        return found
    try:
        return map_in_place(state, mesh, None, callback)
    except ValueError:
        return found


def _with_file_pins(one: IslandState, pins: Sequence[int]) -> IslandState:
    """Return an island with those of its interior vertices pinned that are in a list of the surface's vertices."""
    if not pins:
        return one
    edge = np.concatenate([np.empty(0, dtype=np.int64), *one.loops])
    own = np.setdiff1d(np.flatnonzero(np.isin(one.island.vertices, pins)), edge)
    return replace(one, pins=tuple(own.tolist()))


def with_corner(state: SessionState, k: int, vertex: int, callback: Callable[[Any], object] | None) -> SessionState:
    """Assign the boundary vertex of island ``k`` nearest to ``vertex`` to the next corner of its outline.

    ValueError if there is no outline, or the order of the corners differs from that of the vertices.
    """
    one = state.islands[k]
    if one.outline is None:
        raise RequestError("corners need an outline: choose one under Boundary first")
    near = int(nearest_on_boundary(one.island.V, one.island.F, one.island.V[vertex][None])[0])
    before = tuple((v, c) for v, c in one.chosen if v != near)
    if len(before) >= max(len(one.corners), 1):
        before = ()
    chosen = (*before, (near, len(before)))
    return map_to_outline(replace(state, selected=(k,)), one.outline, chosen, callback)


def pin_vertices(state: SessionState, k: int, pins: Sequence[int]) -> SessionState:
    """Return a state with these pins of island ``k`` at their positions; the map stays the same."""
    one = state.islands[k]
    assert one.result is not None
    held = fix_where_it_is(replace(one, pins=tuple(pins)))
    return replace(state.with_island(k, held), selected=(k,))


def turn_over(state: SessionState) -> SessionState:
    """Return the state with the triangles reversed; the map is mirrored, so that it stays injective."""
    sheet, mesh = state.sheet.turn_over(), state.mesh
    if mesh.uv is None:
        return replace(open_without_map(sheet), from_file=False)
    middle = float(mesh.uv[:, 0].max()) + float(mesh.uv[:, 0].min())
    uv = np.stack([middle - mesh.uv[:, 0], mesh.uv[:, 1]], axis=1)
    turned = SeamedMesh(sheet.surface.V, sheet.surface.F, mesh.FT[:, (0, 2, 1)], uv)
    return as_it_is(replace(state, sheet=sheet, from_file=False), turned, saved_start(turned))


def with_start(
    state: SessionState, k: int, target: FloatArray, uv: FloatArray | None
) -> tuple[SessionState, SeamedMesh]:
    """Return the state with one island selected and moved to ``target`` (k, 2), and its mesh with these positions.

    ``uv`` (m, 2) is an injective map with this target, if there is one.
    """
    one = state.islands[k]
    places = [island.uv for island in state.mesh.islands]
    assert one.result is not None
    assert one.fixed is not None
    own = (one.result.uv if uv is None else uv).copy()
    own[one.fixed] = target
    places[k] = own * one.sign
    moved = replace(state.with_island(k, one.with_target(target)), selected=(k,))
    return moved, state.mesh.with_places(places)
