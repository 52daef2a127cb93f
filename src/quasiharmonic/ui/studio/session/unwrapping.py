"""Unwrap the model of a page with `unwrap`, and the seams that are kept."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np

from quasiharmonic.apps.unwrapping.model_files import polygon_costs
from quasiharmonic.apps.unwrapping.result import UnwrapStep
from quasiharmonic.apps.unwrapping.unwrap import unwrap
from quasiharmonic.io.seamed_mesh import SeamedMesh
from quasiharmonic.ui.studio.session import recipes
from quasiharmonic.ui.studio.session.operations import as_it_is, make_start
from quasiharmonic.ui.studio.session.recipes import Code, Given, Source
from quasiharmonic.ui.studio.session.state import SessionState


def unwrap_model(
    state: SessionState,
    callback: Callable[[UnwrapStep], object] | None = None,
    *,
    max_stretch: float = 1.5,
    resolution: int = 2048,
    padding: float = 4.0,
    keep_seams: bool = False,
) -> SessionState:
    """Unwrap the whole model; with ``keep_seams``, or after seams were drawn, along the current seams at least.

    The other options are those of `unwrap`.
    """
    sheet = state.sheet
    kept: SeamedMesh | None = None
    if state.drawn is not None:
        kept = _with_any_positions(SeamedMesh(sheet.surface.V, sheet.surface.F).cut(state.drawn))
    elif keep_seams and state.mapped:
        kept = state.mesh
    options: dict[str, Any] = {"max_stretch": max_stretch, "resolution": resolution, "padding": padding}
    if kept is None and not sheet.turned:
        source, V, F = Source(sheet.name, None), sheet.mesh.V, sheet.mesh.F
        if (costs := polygon_costs(sheet.mesh)) is not None:
            options["edge_costs"] = Given(costs, Code("polygon_costs(model)"))
    else:
        mesh = SeamedMesh(sheet.surface.V, sheet.surface.F) if kept is None else kept
        source, V, F = make_start(mesh), mesh.V, mesh.F
        if mesh.uv is not None:
            options["uv"] = Given(mesh.uv[mesh.FT], Code("model.vt[model.FT]"), {"keep_seams": True})
    result = unwrap(V, F, callback=callback, **recipes.values(options))
    FT = sheet.from_file(result.indices) if source.start is None else result.indices
    lines = [
        f"model = io.read_mesh({source.name!r})",
        f"result = unwrap(model.V, model.F{recipes.arguments(**options)})",
        "mesh = atlas.SeamedMesh(model.V, model.F, result.indices, result.uvs)",
    ]
    recipe = recipes.record_call("unwrap", source, "unwrapped.obj", options, lines=lines)
    mesh = SeamedMesh(sheet.surface.V, sheet.surface.F, FT, result.uvs)
    after = as_it_is(state, mesh, recipe)
    return replace(after, from_file=False, selected=tuple(range(len(after.islands))))


def _with_any_positions(mesh: SeamedMesh) -> SeamedMesh:
    """Return a cut mesh with a separate position for each of its rows, so that a file keeps the seams."""
    rows = int(mesh.FT.max()) + 1
    number = np.arange(rows)
    return SeamedMesh(mesh.V, mesh.F, mesh.FT, np.stack([number % 1024, number // 1024], axis=1).astype(np.float64))
