"""States of a model: as opened without a map, with its first map, and turned over."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import replace
from typing import Any

import numpy as np

from quasiharmonic.io.seamed_mesh import SeamedMesh
from quasiharmonic.ui.studio.operations import (
    flatten_islands,
    is_flattenable,
    map_in_place,
    map_to_outline,
    rebuild_from_mesh,
    record_start,
)
from quasiharmonic.ui.studio.recipes import Recipe
from quasiharmonic.ui.studio.state import IslandState, SessionState
from quasiharmonic.ui.studio.surface import PageSurface
from quasiharmonic.ui.studio.unwrapping import unwrap_model
from quasiharmonic.ui.studio.validation import make_outline

_FIRST_OUTLINE = "rect:1x1"
#: Larger models are not cut and mapped before the user asks, because this takes longer than some seconds.
MAX_AUTOMATIC = 40_000


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
