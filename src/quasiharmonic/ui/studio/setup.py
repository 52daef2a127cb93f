"""Set up the problems of a page: target of the boundary, and pins."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any, Literal

import numpy as np

from quasiharmonic.apps.flattening.flattened import flatten
from quasiharmonic.apps.repair.fitting import at_corners, held_in_place, laid_along
from quasiharmonic.geometry.exact.certificate import certify
from quasiharmonic.geometry.mesh.topology import boundary_loops
from quasiharmonic.problem import Problem
from quasiharmonic.problem.result import MapResult, Status, Step
from quasiharmonic.targets import filled, nearest_on_boundary
from quasiharmonic.targets.boundary.corner_spec import AskedCorners
from quasiharmonic.ui.studio.outlines import Outline, outline_named
from quasiharmonic.ui.studio.recipes import Recipe
from quasiharmonic.ui.studio.state import SessionState
from quasiharmonic.ui.studio.surface import Sheet
from quasiharmonic.ui.studio.validation import Refused

_FIRST_OUTLINE = "rect:1x1"


def first_moment(sheet: Sheet) -> SessionState:
    """Return the initial state of a surface: the boundary of its own map, or a square.

    If a surface without a map has holes or was cut open, its boundary is free.

    Raises
    ------
    ValueError
        If the surface cannot be mapped.
    """
    island = sheet.island
    if np.isnan(island.uv).any():
        loops = boundary_loops(island.F, len(island.V))
        # At the end of a cut two boundary edges belong to one triangle, which a straight side would make degenerate.
        if len(loops) > 1 or "--cut" in sheet.flags:
            V, F, fixed = island.V, island.F, np.concatenate(loops)
            return freed(Problem(V, F, fixed, np.zeros((len(fixed), 2))), Recipe(sheet))
        return laid(sheet, outline_named(_FIRST_OUTLINE))
    problem = held_in_place(island, None).problem
    edge = np.concatenate(problem.domain.loops)
    pins = np.empty(0, dtype=np.int64) if sheet.fixed is None else np.setdiff1d(sheet.fixed, edge)
    fixed = np.concatenate([edge, pins])
    posed = Problem(island.V, island.F, fixed, island.uv[fixed])
    return SessionState(posed, _unsolved(posed), Recipe(sheet, pinned=len(pins) > 0))


def laid(sheet: Sheet, outline: Outline, corners: Sequence[tuple[int, int]] | Literal["auto"] = ()) -> SessionState:
    """Map a surface's boundary to an outline.

    Parameters
    ----------
    sheet : Sheet
    outline : Outline
    corners : sequence of (vertex, corner), or "auto"
        Boundary vertices for corners of the outline. "auto" chooses vertices by angle; without corners arc length
        decides.

    Raises
    ------
    ValueError
        As for `quasiharmonic.targets.boundary_to`.
    """
    island = sheet.island
    asked = AskedCorners(corners if corners == "auto" else tuple(corners)) if corners else None
    fitted = laid_along(island.V, island.F, outline.contours, corners=asked)
    contours = filled(outline.contours) if fitted.filled else outline.contours
    problem = fitted.problem
    at = tuple(at_corners(problem.fixed, problem.target, contours))
    told = corners if corners == "auto" else ",".join(f"{sheet.numbers([v])[0]}:{k}" for v, k in corners)
    chosen = () if corners == "auto" else tuple(corners)
    return SessionState(problem, _unsolved(problem), Recipe(sheet, outline, told or None), at, chosen)


def with_corner(moment: SessionState, vertex: int) -> SessionState:
    """Assign the boundary vertex nearest to ``vertex`` to the next corner of the outline.

    Raises
    ------
    ValueError
        If there is no outline, or the order of the corners differs from that of the vertices.
    """
    recipe, problem = moment.recipe, moment.problem
    if recipe.outline is None:
        raise Refused("corners need an outline: choose one first")
    near = int(nearest_on_boundary(problem.V, problem.F, problem.V[vertex][None])[0])
    before = tuple((v, k) for v, k in moment.chosen if v != near)
    count = max(len(moment.corners), 1)
    if len(before) >= count:
        before = ()
    return laid(recipe.sheet, recipe.outline, (*before, (near, len(before))))


def holding(moment: SessionState, pins: Sequence[int]) -> SessionState:
    """Return a state with these pins at their positions in the map, and the boundary unchanged."""
    problem = moment.problem
    fixed = np.concatenate([*problem.domain.loops, np.array(pins, dtype=np.int64)])
    held = Problem(problem.V, problem.F, fixed, moment.result.uv[fixed])
    other = replace(moment, problem=held).with_target(held.target)
    return replace(other, recipe=replace(other.recipe, pinned=bool(pins), anew=False))


def freed(
    problem: Problem, recipe: Recipe, pins: Sequence[int] = (), callback: Callable[[Step], object] | None = None
) -> SessionState:
    """Flatten a surface with free boundary; pins keep their target positions.

    Raises
    ------
    ValueError
        If no injective map was found; the message names the cause.
    """
    held = np.array(pins, dtype=np.int64)
    edge = len(problem.fixed) - len(held)
    given: dict[str, Any] = {"fixed": held, "target": problem.target[edge:]} if len(held) else {}
    result = flatten(problem.V, problem.F, callback=callback, **given)
    if not result.injective:
        raise Refused(result.status.value)
    recipe = Recipe(recipe.sheet, pinned=len(held) > 0, free=True)
    return SessionState(problem.with_target(result.uv[problem.fixed]), result, recipe)


def _unsolved(problem: Problem) -> MapResult:
    """Return a placeholder result with all vertices at the centre of the target; it is never shown."""
    uv = np.broadcast_to(problem.target.mean(axis=0), (problem.n, 2)).copy()
    return MapResult(uv=uv, status=Status.INTERRUPTED, certificate=certify(problem.F, uv, boundary=False))
