"""Problems that a page poses: where a surface's boundary goes, and what is held inside."""

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
    """The problem that a surface comes with: its boundary where its own map has it, or else on a square.

    With holes, or cut open, the boundary is free.

    Raises
    ------
    ValueError
        When the surface is none that can be mapped.
    """
    island = sheet.island
    if np.isnan(island.uv).any():
        loops = boundary_loops(island.F, len(island.V))
        # A cut turns at its ends within one triangle, which a straight side would flatten.
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
    """Lay a surface's boundary along an outline.

    Parameters
    ----------
    sheet : Sheet
    outline : Outline
    corners : sequence of (vertex, corner), or "auto"
        Which boundary vertices go to which of the outline's corners; those at sharp bends, or as lengths have it.

    Raises
    ------
    ValueError
        As `quasiharmonic.targets.boundary_to`.
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
    """Send the boundary vertex nearest to another one to the next corner of the outline.

    Raises
    ------
    ValueError
        When there is no outline, or the corners would follow each other in another order than the vertices do.
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
    """Hold these vertices inside, where the map has them, and the boundary where it is."""
    problem = moment.problem
    fixed = np.concatenate([*problem.domain.loops, np.array(pins, dtype=np.int64)])
    held = Problem(problem.V, problem.F, fixed, moment.result.uv[fixed])
    other = replace(moment, problem=held).with_target(held.target)
    return replace(other, recipe=replace(other.recipe, pinned=bool(pins), anew=False))


def freed(
    problem: Problem, recipe: Recipe, pins: Sequence[int] = (), callback: Callable[[Step], object] | None = None
) -> SessionState:
    """Lay a surface flat, its boundary going where distortion is least, and pins held where a problem holds them.

    Raises
    ------
    ValueError
        When it cannot be laid flat, or the pins forbid it; the message says why.
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
    """No map yet: every vertex at the middle of the target, which is not shown."""
    uv = np.broadcast_to(problem.target.mean(axis=0), (problem.n, 2)).copy()
    return MapResult(uv=uv, status=Status.INTERRUPTED, certificate=certify(problem.F, uv, boundary=False))
