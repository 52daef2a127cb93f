"""States of a model: as opened without a map, with its first map, unwrapped, and turned over.

All of a model is unwrapped, only the selected islands, or only triangles without texture coordinates.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import replace
from typing import Any

import numpy as np

from quasiharmonic.apps.unwrapping.model_files import PARTS, has_parts, polygon_costs, statement_labels
from quasiharmonic.apps.unwrapping.result import UnwrapResult, UnwrapStatus, UnwrapStep
from quasiharmonic.apps.unwrapping.symmetry import describe_symmetry
from quasiharmonic.apps.unwrapping.unwrap import unwrap
from quasiharmonic.geometry.mesh.topology import are_sides
from quasiharmonic.io import read_mesh
from quasiharmonic.io.seamed_mesh import SeamedMesh
from quasiharmonic.ui.studio import recipes
from quasiharmonic.ui.studio.operations import (
    flatten_islands,
    is_flattenable,
    make_start,
    map_in_place,
    map_to_outline,
    rebuild_from_mesh,
    record_start,
)
from quasiharmonic.ui.studio.recipes import FACES, FORBIDDEN, SEAMS, Code, Given, Recipe, Script, Source, public
from quasiharmonic.ui.studio.state import IslandState, SessionState
from quasiharmonic.ui.studio.surface import PageSurface
from quasiharmonic.ui.studio.validation import PADDING, RESOLUTION, RequestError, make_outline
from quasiharmonic.util.arrays import IntArray

Callback = Callable[[UnwrapStep], object] | None
# Options that the recorded command states in any case, so that another version of `unwrap` makes the same map.
_DEFAULTS = {"max_stretch": 1.5, "resolution": RESOLUTION, "padding": PADDING}
# The file from which the script unwraps.
_MODEL = Code("model")
_FIRST_OUTLINE = "rect:1x1"
#: Larger models are not cut and mapped before the user asks, because this takes longer than some seconds.
MAX_AUTOMATIC = 40_000


def unwrap_model(
    state: SessionState, callback: Callback = None, *, keep_seams: bool = False, selected: bool = False, **given: Any
) -> SessionState:
    """Unwrap the model with options of `unwrap`; seams that the user changed become seams of the map.

    With ``keep_seams`` the seams of the map are kept. With ``selected`` only the selected islands are unwrapped.
    Triangles that have texture coordinates in the file keep them if there is no map yet.

    The command starts from the file, with its polygons, if the page shows the file's surface, or a cleaned one without
    drawn seams; `unwrap` then cleans the file's mesh in the same way. Otherwise it starts from a saved file with the
    surface: if a map is kept in part, if the model is turned over, or if seams were drawn on a cleaned surface.
    """
    sheet = state.sheet
    if not state.mapped and len(sheet.unmapped):
        return _unwrap_rest(state, callback, given)
    kept, edits = _keep_parts(state, keep_seams, selected), _record_edits(state)
    from_file = not kept and not sheet.turned and (sheet.is_file or not edits)
    mesh = state.mesh if kept else SeamedMesh(sheet.surface.V, sheet.surface.F)
    source = Source(sheet.name, None) if from_file else make_start(mesh)
    options = {**_DEFAULTS, **given, **kept, **edits}
    if options.get("symmetry", "") is None:
        options["symmetry"] = Given(None, None, {"symmetry": "none"})
    if from_file and (costs := polygon_costs(sheet.mesh)) is not None:
        options["edge_costs"] = Given(costs, public(polygon_costs)(_MODEL))
    if which := given.get("labels"):
        if not from_file:
            raise RequestError("the file's parts are unknown after the mesh has changed: undo, or choose no parts")
        labels = _label_triangles(sheet, which)
        options["labels"] = Given(labels, public(statement_labels)(_MODEL, *PARTS[which]), {"labels": which})
    model = sheet.mesh if from_file else mesh
    result = unwrap(model, callback=callback, **recipes.values(options))
    used = np.unique(model.F)
    if from_file and sheet.is_file and (result.cleaned.representatives[used] != used).any():
        # Charts reach across vertices at equal positions, so these become one.
        sheet = sheet.clean_up()
        state = replace(state, sheet=sheet, forbidden=sheet.find_edges(state.forbidden))
    FT = sheet.from_file(result.indices) if from_file else result.indices
    mapped = SeamedMesh(sheet.surface.V, sheet.surface.F, FT, result.uvs)
    # A call that was stopped cannot be repeated.
    stopped = result.status is UnwrapStatus.TIME_LIMIT
    recipe = record_start(mapped) if stopped else _record_unwrap(source, options)
    recipe = replace(recipe, note=_describe_missing_symmetry(result, given))
    return replace(rebuild_from_mesh(state, mapped, recipe), from_file=False).select_all()


def _keep_parts(state: SessionState, keep_seams: bool, selected: bool) -> dict[str, Given]:
    """Return the options of `unwrap` that keep the seams of the map, or islands that are not selected; {} for none."""
    mesh = state.mesh
    if mesh.uv is None or not state.mapped:
        return {}
    uv, code = mesh.uv[mesh.FT], _MODEL.vt[_MODEL.FT]
    if selected and len(state.selected) < len(state.islands):
        triangles = np.sort(np.concatenate([state.islands[k].island.triangles for k in state.selected]))
        return {"uv": Given(uv, code), "faces": recipes.saved_rows(FACES, "faces", triangles)}
    if keep_seams and state.wanted_seams is None:
        return {"uv": Given(uv, code, {"keep_seams": True})}
    return {}


def _record_edits(state: SessionState) -> dict[str, Given]:
    """Return the options of `unwrap` for the seams that the user changed, and for edges that must not become seams."""
    edits = {}
    if state.wanted_seams is not None and len(state.wanted_seams):
        edits["seams"] = recipes.saved_rows(SEAMS, "seams", state.wanted_seams)
    if len(state.forbidden):
        edits["no_seams"] = recipes.saved_rows(FORBIDDEN, "no_seams", state.forbidden)
    return edits


def _record_unwrap(source: Source, options: dict[str, Any]) -> Recipe:
    """Return the recipe of a call of `unwrap` on a file."""
    script = Script()
    script.let("model", public(read_mesh)(source.name))
    code = script.let("result", public(unwrap)(_MODEL, **options))
    script.let("mesh", public(SeamedMesh)(_MODEL.V, _MODEL.F, code.indices, code.uvs))
    return recipes.record_call("unwrap", source, "unwrapped.obj", options, script)


def _unwrap_rest(state: SessionState, callback: Callback, options: dict[str, Any]) -> SessionState:
    """Unwrap the triangles without texture coordinates, into the tile of the texture right of the others."""
    sheet, surface, options = state.sheet, state.sheet.surface, dict(options)
    assert sheet.mesh.vt is not None
    assert sheet.mesh.FT is not None
    FT, uv = sheet.from_file(sheet.mesh.FT).copy(), sheet.mesh.vt
    F = surface.F[sheet.unmapped]
    if which := options.get("labels"):
        labels = np.repeat(_label_triangles(sheet, which)[:, None], 3, axis=1)
        options["labels"] = sheet.from_file(labels)[sheet.unmapped, 0]
    for name, edit in _record_edits(state).items():
        options[name] = edit.value[are_sides(edit.value, F, len(surface.V))]
    if sheet.is_file and (costs := polygon_costs(sheet.mesh)) is not None:
        options["edge_costs"] = costs[sheet.unmapped]
    if sheet.is_file:
        options["meshes"] = sheet.meshes
    result = unwrap(surface.V, F, callback=callback, **options)
    right = np.ceil(uv[np.delete(FT, sheet.unmapped, axis=0), 0].max())
    FT[sheet.unmapped] = result.indices + len(uv)
    mapped = SeamedMesh(surface.V, surface.F, FT, np.concatenate([uv, result.uvs + np.array([right, 0.0])]))
    recipe = replace(record_start(mapped), note=_describe_missing_symmetry(result, options))
    return replace(rebuild_from_mesh(state, mapped, recipe), from_file=False).select_all()


def _describe_missing_symmetry(result: UnwrapResult, options: dict[str, Any]) -> str:
    """Return why seams and charts are not mirrored along the axis in the options; empty if they are, or without one."""
    chosen = options.get("symmetry") in ("x", "y", "z") and not result.symmetry.applied
    return "".join(describe_symmetry(result.symmetry)) if chosen else ""


def _label_triangles(sheet: PageSurface, which: str) -> IntArray:
    """Return the part (f,) of each of the file's triangles; RequestError if the file has no such parts."""
    if not has_parts(sheet.mesh, which):
        raise RequestError(f"the file has no {which}: choose other parts, or none")
    return statement_labels(sheet.mesh, *PARTS[which])


def open_without_map(sheet: PageSurface) -> SessionState:
    """Return the state of a model before it has a map."""
    mesh = SeamedMesh(sheet.surface.V, sheet.surface.F)
    islands = tuple(IslandState(island) for island in mesh.islands)
    return SessionState(sheet, mesh, islands, Recipe()).select_all()


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
    islands = tuple(_add_file_pins(IslandState(island), pins) for island in mesh.islands)
    state = SessionState(sheet, mesh, islands, Recipe()).select_all()
    found = rebuild_from_mesh(state, mesh, Recipe(), keep=("pins",))
    if not sheet.posed:
        return found
    try:
        return map_in_place(state, mesh, None, callback)
    except ValueError:
        return found


def _add_file_pins(one: IslandState, pins: Sequence[int]) -> IslandState:
    """Return an island with those of its interior vertices pinned that are in a list of the surface's vertices."""
    if not pins:
        return one
    edge = np.concatenate([np.empty(0, dtype=np.int64), *one.loops])
    own = np.setdiff1d(np.flatnonzero(np.isin(one.island.vertices, pins)), edge)
    return replace(one, pins=tuple(own.tolist()))


def turn_over(state: SessionState) -> SessionState:
    """Return the state with the triangles reversed; the map is mirrored, so that it stays injective."""
    sheet, mesh = state.sheet.turn_over(), state.mesh
    if mesh.uv is None:
        return replace(open_without_map(sheet), from_file=False, forbidden=state.forbidden)
    middle = float(mesh.uv[:, 0].max()) + float(mesh.uv[:, 0].min())
    uv = np.stack([middle - mesh.uv[:, 0], mesh.uv[:, 1]], axis=1)
    turned = SeamedMesh(sheet.surface.V, sheet.surface.F, mesh.FT[:, (0, 2, 1)], uv)
    return rebuild_from_mesh(replace(state, sheet=sheet, from_file=False), turned, record_start(turned))
