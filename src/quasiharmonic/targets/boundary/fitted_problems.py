"""Mapping problems with target positions for the boundary of an island: on an outline, or in place.

Each of several islands is mapped onto its own copy of the outline, and the copies lie in a row.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from quasiharmonic.geometry.mesh.reference import Reference
from quasiharmonic.geometry.mesh.topology import boundary_edges, boundary_loops
from quasiharmonic.io.seamed_mesh import Island
from quasiharmonic.problem import Problem
from quasiharmonic.targets.boundary.boundary_to import DEFAULT_CORNER_ANGLE, boundary_to
from quasiharmonic.targets.boundary.corner_pins import CornerSpec
from quasiharmonic.targets.outlines.contours import corners as corners_of
from quasiharmonic.targets.outlines.contours import filled, in_unit
from quasiharmonic.util.arrays import FloatArray, IntArray, names_of

# Gap between copies of an outline, relative to the outline's width.
_GAP = 0.05


@dataclass(frozen=True, eq=False)
class FittedProblem:
    """The mapping problem of a surface.

    ``corner_vertices`` are boundary vertices whose positions the caller chose, or that were assigned to the outline's
    corners. ``filled_holes`` is the number of holes of the outline that were filled because the surface has no holes.
    """

    problem: Problem
    corner_vertices: list[int] = field(default_factory=list)
    filled_holes: int = 0


def fix_in_place(
    island: Island, fixed: NDArray[np.integer] | None = None, *, reference: Reference | None = None
) -> FittedProblem:
    """Fix an island's boundary, or other vertices of its mesh, at their current positions.

    Raise the ValueErrors of `Problem`, and one if there is no boundary to fix or a fixed vertex has no position.
    """
    if fixed is None:
        own = np.unique(boundary_edges(island.F, len(island.vertices)))
        if not own.size:
            raise ValueError("the mesh has no boundary to fix: cut it open, or give fixed vertices")
    else:
        own = np.flatnonzero(np.isin(island.vertices, fixed))
    nowhere = own[np.isnan(island.uv[own]).any(axis=1)]
    if nowhere.size:
        which = names_of("vertex", "vertices", island.vertices[nowhere])
        raise ValueError(f"no texture coordinates for the fixed {which}: give every fixed vertex a vt")
    return FittedProblem(Problem(island.V, island.F, own, island.uv[own], reference=reference))


def fit_boundary(
    V: FloatArray,
    F: IntArray,
    contours: Sequence[FloatArray],
    *,
    corners: CornerSpec | None = None,
    corner_angle: float = DEFAULT_CORNER_ANGLE,
    reference: Reference | None = None,
    beside: int = 0,
) -> FittedProblem:
    """Lay a surface's boundary along an outline; the outline's holes are filled if the surface has none.

    ``contours``, ``corners`` and ``corner_angle`` are those of `boundary_to`. ``beside`` is the index of the outline's
    copy, from the left; each of several islands has its own. Raises ValueError as `boundary_to` and `Problem`, or if a
    corner is not on the boundary.
    """
    contours = place_beside(contours, beside)
    without_holes = filled(contours)
    holes = len(contours) - len(without_holes)
    try:
        fills = holes > 0 and len(boundary_loops(F, len(V))) == 1
    except ValueError:
        # A mesh without boundary loops is not a valid surface; the error is raised below.
        fills = False
    chosen = None if corners is None else corners.on(V, F)
    onto = without_holes if fills else list(contours)
    fixed, target = boundary_to(V, F, onto, corners=chosen, corner_angle=corner_angle)
    marked = find_corner_vertices(fixed, target, onto, corner_angle) if isinstance(chosen, str) else list(chosen or [])
    problem = Problem(V, F, fixed, target, reference=reference)
    return FittedProblem(problem, marked, holes if fills else 0)


def place_beside(contours: Sequence[FloatArray], beside: int) -> list[FloatArray]:
    """Return a copy of an outline, the one of index ``beside`` from the left; copies are 5 % of their width apart."""
    if not beside:
        return list(contours)
    right = beside * (1 + _GAP) * float(np.ptp(np.concatenate(contours)[:, 0]))
    return [contour + np.array([right, 0.0]) for contour in contours]


def find_corner_vertices(
    fixed: IntArray, target: FloatArray, contours: Sequence[FloatArray], angle: float = DEFAULT_CORNER_ANGLE
) -> list[int]:
    """Find the boundary vertices at the corners of an outline, in the order of the corners.

    ``fixed`` and ``target`` are results of `boundary_to`. ``angle`` is the minimum turning angle of a corner, in
    degrees.
    """
    sharp = [corners_of(unit, angle) for unit in in_unit(list(contours))[0]]
    goals = np.concatenate([contour[marks] for contour, marks in zip(contours, sharp, strict=True)])
    return [int(fixed[(target == goal).all(axis=1)][0]) for goal in goals]
