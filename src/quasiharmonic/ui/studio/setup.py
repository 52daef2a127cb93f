"""The first state of a model, and changes of its constraints: corners and pins."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import replace
from typing import Any

import numpy as np

from quasiharmonic.io.seamed_mesh import SeamedMesh
from quasiharmonic.targets import nearest_on_boundary
from quasiharmonic.ui.studio.operations import (
    as_it_is,
    fix_where_it_is,
    flatten_islands,
    is_flattenable,
    map_in_place,
    map_to_outline,
    saved_start,
)
from quasiharmonic.ui.studio.recipes import Recipe
from quasiharmonic.ui.studio.state import IslandState, SessionState
from quasiharmonic.ui.studio.surface import PageSurface
from quasiharmonic.ui.studio.unwrapping import unwrap_model
from quasiharmonic.ui.studio.validation import RequestError, make_outline
from quasiharmonic.util.arrays import FloatArray

_FIRST_OUTLINE = "rect:1x1"
#: Larger models are not cut and mapped before the user asks, because this takes longer than some seconds.
MAX_AUTOMATIC = 40_000


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
