"""Unwrap the model of a page with `unwrap`, and the seams that are kept."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np

from quasiharmonic.apps.unwrapping.model_files import polygon_costs, statement_labels
from quasiharmonic.apps.unwrapping.result import UnwrapStatus, UnwrapStep
from quasiharmonic.apps.unwrapping.unwrap import unwrap
from quasiharmonic.io import read_mesh
from quasiharmonic.io.seamed_mesh import SeamedMesh
from quasiharmonic.ui.studio import recipes
from quasiharmonic.ui.studio.operations import as_it_is, make_start, saved_start
from quasiharmonic.ui.studio.page import NAMES
from quasiharmonic.ui.studio.protocol import MessageFrame
from quasiharmonic.ui.studio.recipes import FACES, FORBIDDEN, SEAMS, Code, Given, Script, Source, public
from quasiharmonic.ui.studio.state import SessionState
from quasiharmonic.ui.studio.validation import RequestError
from quasiharmonic.util.options import UnwrapOptions

# Keywords of the statements that divide an OBJ file into parts.
_LABELS = {"groups": ("o", "g"), "materials": ("usemtl",)}


def read_options(frame: MessageFrame) -> dict[str, Any]:
    """Return the options of `unwrap` that a message has; ValueError or TypeError for invalid ones."""
    given = frame.header.get("options", {})
    if not isinstance(given, dict) or not set(given) <= set(NAMES):
        raise RequestError(f"options of unwrap are {', '.join(NAMES)}")
    if given.get("labels", "groups") not in _LABELS:
        raise RequestError(f"labels are {' or '.join(_LABELS)}")
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
    """
    sheet = state.sheet
    if not state.mapped and len(sheet.unmapped):
        return _unwrap_rest(state, callback, given)
    script, model = Script(), Code("model")
    options = {"max_stretch": 1.5, "resolution": 2048, "padding": 4.0, **given}
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
        words = _LABELS[which]
        labels = statement_labels(sheet.mesh, *words)
        options["labels"] = Given(labels, public(statement_labels)(model, *words), {"labels": which})
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
    result = unwrap(surface.V, surface.F[sheet.unmapped], callback=callback, **options)
    right = np.ceil(uv[np.delete(FT, sheet.unmapped, axis=0), 0].max())
    FT[sheet.unmapped] = result.indices + len(uv)
    mapped = SeamedMesh(surface.V, surface.F, FT, np.concatenate([uv, result.uvs + np.array([right, 0.0])]))
    after = as_it_is(state, mapped, saved_start(mapped))
    return replace(after, from_file=False, selected=tuple(range(len(after.islands))))
