"""Set up the problem of mapping a surface, with its boundary fixed in place or laid along an outline."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from quasiharmonic.geometry.mesh.reference import Reference
from quasiharmonic.geometry.mesh.seams import Island
from quasiharmonic.geometry.mesh.topology import boundary_edges, boundary_loops
from quasiharmonic.problem import Problem
from quasiharmonic.targets.boundary.boundary_to import boundary_to
from quasiharmonic.targets.boundary.corner_spec import AskedCorners
from quasiharmonic.targets.outlines.contours import corners as corners_of
from quasiharmonic.targets.outlines.contours import in_unit
from quasiharmonic.targets.outlines.nesting import filled
from quasiharmonic.util.arrays import FloatArray, IntArray, named

# Distance between the outlines of several islands, relative to their width.
_GAP = 0.05


@dataclass(frozen=True, eq=False)
class Fitted:
    """The mapping problem of a surface.

    Attributes
    ----------
    problem : Problem
    held : list of int
        Boundary vertices whose positions the caller chose, or that were assigned to the outline's corners.
    filled : int
        Number of holes of the outline that were filled because the surface has no holes.
    """

    problem: Problem
    held: list[int] = field(default_factory=list)
    filled: int = 0


def held_in_place(
    island: Island, fixed: NDArray[np.integer] | None = None, *, reference: Reference | None = None
) -> Fitted:
    """Fix an island's boundary, or other vertices, at their current positions.

    Parameters
    ----------
    island : Island
    fixed : (k,) int, optional
        Vertices of the mesh that contains the island; the island's boundary by default.
    reference : {"equilateral", "rest", "corrected"}, optional
        As for `Problem`.

    Returns
    -------
    Fitted

    Raises
    ------
    ValueError
        As `Problem`. If there is no boundary to fix, or a fixed vertex has no position.
    """
    if fixed is None:
        own = np.unique(boundary_edges(island.F, len(island.vertices)))
        if not own.size:
            raise ValueError("the mesh has no boundary to fix: cut it open, or give fixed vertices")
    else:
        own = np.flatnonzero(np.isin(island.vertices, fixed))
    nowhere = own[np.isnan(island.uv[own]).any(axis=1)]
    if nowhere.size:
        which = named("vertex", "vertices", island.vertices[nowhere])
        raise ValueError(f"no texture coordinates for the fixed {which}: give every fixed vertex a vt")
    return Fitted(Problem(island.V, island.F, own, island.uv[own], reference=reference))


def laid_along(
    V: FloatArray,
    F: IntArray,
    contours: Sequence[FloatArray],
    *,
    corners: AskedCorners | None = None,
    corner_angle: float = 20.0,
    reference: Reference | None = None,
    beside: int = 0,
) -> Fitted:
    """Lay a surface's boundary along an outline; the outline's holes are filled if the surface has none.

    Parameters
    ----------
    V : (n, 2) or (n, 3) float64
    F : (f, 3) int64
    contours : sequence of (k, 2) float64
    corners : AskedCorners, optional
    corner_angle : float
        As for `boundary_to`.
    reference : {"equilateral", "rest", "corrected"}, optional
        As for `Problem`.
    beside : int
        Index of the outline's copy, from the left; each of several islands has its own.

    Returns
    -------
    Fitted

    Raises
    ------
    ValueError
        As `boundary_to` and `Problem`. If a corner is not on the boundary.
    """
    if beside:
        right = beside * (1 + _GAP) * float(np.ptp(np.concatenate(contours)[:, 0]))
        contours = [contour + np.array([right, 0.0]) for contour in contours]
    whole = filled(contours)
    holes = len(contours) - len(whole)
    try:
        fills = holes > 0 and len(boundary_loops(F, len(V))) == 1
    except ValueError:
        # A mesh without boundary loops is not a valid surface; the error is raised below.
        fills = False
    chosen = None if corners is None else corners.on(V, F)
    onto = whole if fills else list(contours)
    fixed, target = boundary_to(V, F, onto, corners=chosen, corner_angle=corner_angle)
    held = at_corners(fixed, target, onto, corner_angle) if isinstance(chosen, str) else list(chosen or [])
    problem = Problem(V, F, fixed, target, reference=reference)
    return Fitted(problem, held, holes if fills else 0)


def at_corners(fixed: IntArray, target: FloatArray, contours: Sequence[FloatArray], angle: float = 20.0) -> list[int]:
    """Find the boundary vertices at the corners of an outline, in the order of the corners.

    Parameters
    ----------
    fixed : (b,) int64
    target : (b, 2) float64
        Results of `boundary_to`.
    contours : sequence of (k, 2) float64
        The outline that they were laid along.
    angle : float
        Minimum turning angle of a corner, in degrees.
    """
    sharp = [corners_of(unit, angle) for unit in in_unit(list(contours))[0]]
    goals = np.concatenate([contour[marks] for contour, marks in zip(contours, sharp, strict=True)])
    return [int(fixed[(target == goal).all(axis=1)][0]) for goal in goals]
