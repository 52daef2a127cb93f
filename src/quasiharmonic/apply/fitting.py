"""What a file holds made ready for a map onto an outline: cut open, its boundary laid along it, edges split."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from quasiharmonic.apply.cutting import cut_open
from quasiharmonic.apply.refining import refine_problem
from quasiharmonic.arrays import FloatArray
from quasiharmonic.io import MeshData
from quasiharmonic.io.refined import refined_mesh
from quasiharmonic.mesh.reference import Reference
from quasiharmonic.mesh.refinement import Refined, refine
from quasiharmonic.mesh.topology import boundary_loops, edges, trace_loops
from quasiharmonic.problem import Problem
from quasiharmonic.targets.asked_corners import AskedCorners
from quasiharmonic.targets.boundary import boundary_to
from quasiharmonic.targets.chords import flattened_edges
from quasiharmonic.targets.nesting import filled


@dataclass(frozen=True, eq=False)
class Fitted:
    """A mesh, changed if need be, and the problem of mapping it.

    Attributes
    ----------
    mesh : MeshData
    problem : Problem
    held : list of int
        Boundary vertices whose place somebody has chosen.
    filled : int
        Holes of the outline that the surface does not have.
    added : int
        Vertices that stand at the end of the list, each on an edge that was split.
    """

    mesh: MeshData
    problem: Problem
    held: list[int] = field(default_factory=list)
    filled: int = 0
    added: int = 0


def opened(mesh: MeshData) -> tuple[MeshData, int]:
    """Cut a mesh open into a disk, unless it is one.

    Parameters
    ----------
    mesh : MeshData

    Returns
    -------
    mesh : MeshData
    copies : int
        Vertices along the cut, which have copies at the end of the list.

    Raises
    ------
    ValueError, ModuleNotFoundError
        As `cut_open`.
    """
    found = edges(mesh.F, len(mesh.V))
    euler = len(mesh.V) - len(found.interior) - len(found.boundary) + len(mesh.F)
    if euler == 1 and len(found.boundary) and len(trace_loops(found.boundary)) == 1:
        return mesh, 0
    cut = cut_open(mesh.V, mesh.F)
    extra = None if mesh.extra is None else mesh.extra[cut.origin]
    return replace(mesh, V=cut.V, F=cut.F, extra=extra), len(cut.V) - len(mesh.V)


def laid_along(
    mesh: MeshData,
    contours: Sequence[FloatArray],
    *,
    corners: AskedCorners | None = None,
    corner_angle: float = 20.0,
    reference: Reference | None = None,
) -> Fitted:
    """Lay a mesh's boundary along an outline, whose holes are filled for a surface that has none.

    Parameters
    ----------
    mesh : MeshData
    contours : sequence of (k, 2) float64
    corners : AskedCorners, optional
    corner_angle : float
        Both as `boundary_to` takes them.
    reference : {"equilateral", "rest", "corrected"}, optional
        As `Problem` takes it.

    Returns
    -------
    Fitted

    Raises
    ------
    ValueError
        As `boundary_to` and `Problem`; when corners are none of the boundary.
    """
    whole = filled(contours)
    holes = len(contours) - len(whole)
    try:
        fills = holes > 0 and len(boundary_loops(mesh.F, len(mesh.V))) == 1
    except ValueError:
        # What has no loops is no surface; below it is said why.
        fills = False
    chosen = None if corners is None else corners.on(mesh.V, mesh.F)
    places = boundary_to(mesh.V, mesh.F, whole if fills else list(contours), corners=chosen, corner_angle=corner_angle)
    held = [] if chosen is None or isinstance(chosen, str) else list(chosen)
    problem = Problem(mesh.V, mesh.F, *places, reference=reference)
    return Fitted(mesh, problem, held, holes if fills else 0)


def with_room(fitted: Fitted) -> Fitted:
    """Split edges that stand in the way of a map, until none is known.

    Parameters
    ----------
    fitted : Fitted
        As `laid_along` makes it, or of any mesh and problem.

    Returns
    -------
    Fitted
        On a finer mesh, with all that stood in the file.
    """
    before = fitted.problem
    # A chord along a straight side of the outline may be a rounding error off it; a diagnosis, which is exact, then
    # does not name it.
    flat = flattened_edges(before.F, before.fixed, before.target)
    roomy = _over(fitted, refine(before.V, before.F, flat))
    roomy = _over(roomy, refine_problem(roomy.problem).refined)
    return replace(roomy, added=roomy.problem.n - before.n)


def _over(fitted: Fitted, refined: Refined) -> Fitted:
    """Go over to a refined mesh."""
    if not len(refined.parents):
        return fitted
    old = fitted.problem
    # The map is still to come, and takes the place of these zeros.
    mesh, _ = refined_mesh(fitted.mesh, refined, np.zeros((old.n, 2)))
    return replace(fitted, mesh=mesh, problem=Problem(mesh.V, mesh.F, old.fixed, old.target, reference=old.reference))
