"""Set up the problems of a page: target of the boundary, and pins."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any, Literal

import numpy as np

from quasiharmonic.apps.flattening.free_boundary import flatten
from quasiharmonic.apps.repair.fitting import find_corner_vertices, fit_boundary, fix_in_place
from quasiharmonic.geometry.exact.certificate import certify
from quasiharmonic.geometry.mesh.topology import boundary_loops
from quasiharmonic.problem import Problem
from quasiharmonic.problem.result import MapResult, Status, Step
from quasiharmonic.targets import filled, nearest_on_boundary
from quasiharmonic.targets.boundary.corner_spec import CornerSpec
from quasiharmonic.ui.studio.session.outlines import Outline, make_outline
from quasiharmonic.ui.studio.session.recipes import Recipe
from quasiharmonic.ui.studio.session.state import SessionState
from quasiharmonic.ui.studio.session.surface import Sheet
from quasiharmonic.ui.studio.session.validation import RequestError

_FIRST_OUTLINE = "rect:1x1"


def make_first_state(sheet: Sheet) -> SessionState:
    """Return the initial state of a surface: the boundary of its own map, or a square.

    If a surface without a map has holes or was cut open, its boundary is free. ValueError if the surface cannot be
    mapped.
    """
    island = sheet.island
    if np.isnan(island.uv).any():
        loops = boundary_loops(island.F, len(island.V))
        # At the end of a cut two boundary edges belong to one triangle, which a straight side would make degenerate.
        if len(loops) > 1 or "--cut" in sheet.flags:
            V, F, fixed = island.V, island.F, np.concatenate(loops)
            return free_boundary(Problem(V, F, fixed, np.zeros((len(fixed), 2))), Recipe(sheet))
        return fit_to_outline(sheet, make_outline(_FIRST_OUTLINE))
    problem = fix_in_place(island, None).problem
    edge = np.concatenate(problem.domain.loops)
    pins = np.empty(0, dtype=np.int64) if sheet.fixed is None else np.setdiff1d(sheet.fixed, edge)
    fixed = np.concatenate([edge, pins])
    posed = Problem(island.V, island.F, fixed, island.uv[fixed])
    return SessionState(posed, _make_placeholder(posed), Recipe(sheet, pinned=len(pins) > 0))


def fit_to_outline(
    sheet: Sheet, outline: Outline, corners: Sequence[tuple[int, int]] | Literal["auto"] = ()
) -> SessionState:
    """Map a surface's boundary to an outline; errors as `boundary_to`.

    ``corners`` are boundary vertices and the outline's corners that they go to. "auto" chooses vertices by angle;
    without corners arc length decides.
    """
    island = sheet.island
    spec = CornerSpec(corners if corners == "auto" else tuple(corners)) if corners else None
    fitted = fit_boundary(island.V, island.F, outline.contours, corners=spec)
    contours = filled(outline.contours) if fitted.filled_holes else outline.contours
    problem = fitted.problem
    at = tuple(find_corner_vertices(problem.fixed, problem.target, contours))
    option = corners if corners == "auto" else ",".join(f"{sheet.numbers([v])[0]}:{k}" for v, k in corners)
    chosen = () if corners == "auto" else tuple(corners)
    return SessionState(problem, _make_placeholder(problem), Recipe(sheet, outline, option or None), at, chosen)


def with_corner(state: SessionState, vertex: int) -> SessionState:
    """Assign the boundary vertex nearest to ``vertex`` to the next corner of the outline.

    ValueError if there is no outline, or the order of the corners differs from that of the vertices.
    """
    recipe, problem = state.recipe, state.problem
    if recipe.outline is None:
        raise RequestError("corners need an outline: choose one first")
    near = int(nearest_on_boundary(problem.V, problem.F, problem.V[vertex][None])[0])
    before = tuple((v, k) for v, k in state.chosen if v != near)
    count = max(len(state.corners), 1)
    if len(before) >= count:
        before = ()
    return fit_to_outline(recipe.sheet, recipe.outline, (*before, (near, len(before))))


def pin_vertices(state: SessionState, pins: Sequence[int]) -> SessionState:
    """Return a state with these pins at their positions in the map, and the boundary unchanged."""
    problem = state.problem
    fixed = np.concatenate([*problem.domain.loops, np.array(pins, dtype=np.int64)])
    held = Problem(problem.V, problem.F, fixed, state.result.uv[fixed])
    other = replace(state, problem=held).with_target(held.target)
    return replace(other, recipe=replace(other.recipe, pinned=bool(pins), anew=False))


def free_boundary(
    problem: Problem, recipe: Recipe, pins: Sequence[int] = (), callback: Callable[[Step], object] | None = None
) -> SessionState:
    """Flatten a surface with free boundary; pins keep their target positions.

    ValueError if no injective map was found; the message names the cause.
    """
    held = np.array(pins, dtype=np.int64)
    edge = len(problem.fixed) - len(held)
    given: dict[str, Any] = {"fixed": held, "target": problem.target[edge:]} if len(held) else {}
    result = flatten(problem.V, problem.F, callback=callback, **given)
    if not result.injective:
        raise RequestError(result.status.value)
    recipe = Recipe(recipe.sheet, pinned=len(held) > 0, free=True)
    return SessionState(problem.with_target(result.uv[problem.fixed]), result, recipe)


def _make_placeholder(problem: Problem) -> MapResult:
    """Return a placeholder result with all vertices at the centre of the target; it is never shown."""
    uv = np.broadcast_to(problem.target.mean(axis=0), (problem.n, 2)).copy()
    return MapResult(uv=uv, status=Status.INTERRUPTED, certificate=certify(problem.F, uv, boundary=False))
