"""Morphing of planar meshes: compute a valid interior after the boundary has moved."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from quasiharmonic.apps.mesh_motion.midsides import carried, centred, followed, settled, sides
from quasiharmonic.apps.mesh_motion.morphed import MorphResult, forbidden_elements
from quasiharmonic.apps.mesh_motion.quadrilaterals import made_convex
from quasiharmonic.apps.mesh_motion.quality import element_quality
from quasiharmonic.energies.energies import Energy
from quasiharmonic.energies.newton.sliding import moved_onto
from quasiharmonic.energies.polishing import energy_named, polished
from quasiharmonic.geometry.curves.boundary_curves import BoundaryCurves
from quasiharmonic.geometry.curves.curve import Curve
from quasiharmonic.geometry.exact.certificate import inverted_triangles
from quasiharmonic.geometry.exact.jacobian_signs import inverted_elements
from quasiharmonic.geometry.exact.predicates import orientation
from quasiharmonic.geometry.mesh.elements import (
    MIDDLES,
    check_spread,
    corner_triangles,
    covering_triangles,
    element_array,
    name_elements,
    nets_of,
    turned_over,
)
from quasiharmonic.geometry.mesh.topology import boundary_edges, boundary_loops
from quasiharmonic.io.adapters.accepts_mesh import accepts_planar_mesh
from quasiharmonic.problem import Problem
from quasiharmonic.problem.result import MapResult, Status, Step
from quasiharmonic.solver.search.solving import solve
from quasiharmonic.util.arrays import FloatArray, IntArray, check_finite, check_range, index_array, map_array, named
from quasiharmonic.util.progress import reports_progress


@accepts_planar_mesh
@reports_progress
def morph(
    points: ArrayLike,
    F: ArrayLike,
    moved_vertices: ArrayLike,
    positions: ArrayLike,
    *,
    energy: str | Energy | None = "symmetric-dirichlet",
    max_iterations: int = 2000,
    linear_solver: str = "auto",
    callback: Callable[[Step], object] | None = None,
    slide: bool | BoundaryCurves = False,
    rest: ArrayLike | None = None,
    start: ArrayLike | None = None,
    tolerance: float = 1e-8,
) -> MorphResult:
    """Move some nodes of a planar mesh and place the others so that no element is inverted.

    Parameters
    ----------
    points : (n, 2) array, or a mesh in the plane in place of ``points`` and ``F``
        The current mesh.
    F : (f, 3), (f, 4) or (f, 6) array of int
        Triangles, quadrilaterals or six-node triangles, clockwise or counterclockwise, corners first (see
        `quasiharmonic.geometry.mesh.elements`). A quadrilateral whose last two nodes are equal is a triangle.
    moved_vertices : (k,) array of int
        Nodes to move, on the boundary or inside. Other boundary nodes are fixed, except mid-side nodes, which follow
        their side.
    positions : (k, 2) array
        Target positions of the moved nodes.
    energy : str, Energy or None
        Energy that the placement minimises; see `quasiharmonic.polish`. The default preserves shapes and sizes of the
        triangles, so a graded mesh stays graded. None returns the first valid mesh.
    max_iterations : int
        Maximum number of linear solves to find a valid mesh.
    linear_solver : str
        ``"auto"`` or one of `quasiharmonic.linsolve.available`.
    callback : callable, optional
        Called with a `Step` at every iteration, and with the last one again at least every half second in between, but
        not within a single factorisation.
    slide : bool or BoundaryCurves
        Let the boundary vertices that are not moved slide along their outline, with fixed corners, like nodes on the
        walls of a channel. With `quasiharmonic.geometry.curves.BoundaryCurves` they slide along these curves, with True
        along the boundary polygon. Moved vertices slide only if ``BoundaryCurves`` assigns them a curve.
    rest : (n, 2) array, optional
        The mesh against which distortion is measured; default ``points``. In a chain of steps use the first mesh, so
        that the chain does not drift (`MorphResult.drift`).
    start : (n, 2) array, optional
        Initial mesh, close to the result. Default: ``points`` if ``rest`` is given, otherwise the harmonic extension of
        the displacement.
    tolerance : float
        The mesh has converged if a further step is predicted to lower the energy by less than this fraction; see
        `quasiharmonic.polish`. A larger value is faster, and the result depends more on the initial mesh.

    Returns
    -------
    MorphResult
        If no valid mesh was found, ``result.status`` has the reason, or ``inverted`` has the inverted elements.

    Raises
    ------
    ValueError
        If the input is malformed (see `Problem`), a moved node is in no element, or the rest mesh overlaps itself. If
        an element at rest has no area, or a quadrilateral at rest is not convex. The message names the elements.

    Notes
    -----
    Triangles are searched as any map. For quadrilaterals the search uses the triangles on either side of a diagonal;
    then the triangles at all four corners are untangled and their energy is lowered.

    For six-node triangles the search uses the triangles between corners. Interior mid-side nodes keep their relative
    position on their sides at rest; straight sides stay straight. If a curved side would invert an element, nodes move
    aside as little as possible, if necessary corners too. If this fails, the search is repeated on the four triangles
    between the nodes of each element. With ``slide``, the boundary and its mid-side nodes first slide on these four
    triangles.

    Examples
    --------
    Push the middle of the upper side of a square halfway down:

    >>> import numpy as np
    >>> from quasiharmonic import morph
    >>> from quasiharmonic.surfaces import grid
    >>> points, F = grid(12, 12)
    >>> upper = np.flatnonzero(points[:, 1] == 1)
    >>> x = points[upper, 0]
    >>> morphed = morph(points, F, upper, np.stack([x, 1 - 0.5 * np.sin(np.pi * x) ** 4], axis=1))
    >>> morphed.valid, bool(morphed.quality_after.min() > 0.25)
    (True, True)
    """
    points = map_array("points", points, finite=False)
    F = element_array(F, len(points))
    used = np.unique(F)
    _check_used("points", points, used)
    first = points if rest is None else _like("rest", rest, points, used)
    begin = (None if rest is None else points) if start is None else _like("start", start, points, used)
    F = _counterclockwise(F, first)
    check_spread(F, len(points))
    fixed, target = _placed(points, F, moved_vertices, positions)
    question = _Question(F, first, fixed, nets_of(F))
    settings = _Settings(energy, max_iterations, linear_solver, callback, tolerance)
    after, result = _answered(question, points, target, begin, (slide, np.asarray(moved_vertices)), settings)

    def one_step() -> FloatArray:
        # Fix the boundary at the positions to which it has slid.
        alone = settings._replace(callback=None)
        whole, _ = _answered(question, first, after[fixed], None, (False, fixed), alone)
        return np.full_like(whole, np.nan) if inverted_elements(F, whole).size else whole

    inverted = inverted_elements(F, after)
    forbidden = np.intersect1d(inverted, forbidden_elements(F, after, fixed))
    before, now = element_quality(F, points), element_quality(F, after)
    return MorphResult(after, F, inverted, forbidden, result, before, now, one_step)


class _Question(NamedTuple):
    """A rest mesh, the nodes with given positions, and sets of triangles to search on, in order."""

    F: IntArray
    rest: FloatArray
    fixed: IntArray
    nets: list[IntArray]


class _Settings(NamedTuple):
    """Search options; see `morph`."""

    energy: str | Energy | None
    max_iterations: int
    linear_solver: str
    callback: Callable[[Step], object] | None
    tolerance: float


def _answered(
    question: _Question,
    points: FloatArray,
    target: FloatArray,
    begin: FloatArray | None,
    slide: tuple[bool | BoundaryCurves, IntArray],
    settings: _Settings,
) -> tuple[FloatArray, MapResult]:
    """Place all nodes by the first set of triangles that leaves no element inverted, or by the best one.

    Parameters
    ----------
    question : _Question
    points : (n, 2) float64
        Positions of nodes in no element, and of mid-side nodes on a sliding boundary.
    target : (k, 2) float64
        Target positions of the given nodes.
    begin : (n, 2) float64 or None
        Initial mesh.
    slide : (bool or BoundaryCurves, (l,) int64)
        The curves of the boundary, and the nodes that do not slide.
    settings : _Settings
    """
    F, rest, fixed, nets = question
    if F.shape[1] == 6 and slide[0] is not False:
        # Mid-side nodes slide as other nodes do. They are then moved to the middle of their sides and fixed there.
        there, slid = _searched(question, nets[-1], points, target, begin, slide, settings)
        has_slid = fixed[(there[fixed] != target).any(axis=1)]
        before = points.copy()
        before[fixed] = target
        there = centred(F, there, has_slid, _curves(slide[0], nets[-1], before))
        after, result = _answered(question, points, there[fixed], there, (False, fixed), settings)
        return after, replace(
            result,
            stages=slid.stages + result.stages,
            history=slid.history + result.history,
            seconds=slid.seconds + result.seconds,
        )
    best, least = None, np.inf
    for triangles in nets:
        after, result = _searched(question, triangles, points, target, begin, slide, settings)
        if F.shape[1] == 6:
            # Mid-side nodes outside these triangles have not moved yet.
            inside = ~np.isin(F[:, MIDDLES], triangles).any()
            straight = followed(F, rest, after, fixed)
            after = settled(F, straight, straight if inside else after, fixed)
        left = inverted_elements(F, after).size
        if left < least:
            best, least = (after, result), left
        if not left:
            break
    assert best is not None
    return best


def _searched(
    question: _Question,
    triangles: IntArray,
    points: FloatArray,
    target: FloatArray,
    begin: FloatArray | None,
    slide: tuple[bool | BoundaryCurves, IntArray],
    settings: _Settings,
) -> tuple[FloatArray, MapResult]:
    """Search a map of some triangles, untangle those at quadrilaterals' corners, and return the moved mesh."""
    F, rest, fixed, _ = question
    energy, max_iterations, linear_solver, callback, tolerance = settings
    used = np.unique(triangles)
    known = np.isin(fixed, used)
    own, held = np.searchsorted(used, triangles), np.searchsorted(used, fixed[known])
    # With the mesh's own reference triangles, the search starts from the harmonic extension of the displacement.
    problem = Problem(rest[used], own, held, target[known], reference="corrected")
    rails = _rails(slide[0], problem, used, slide[1])
    corners = np.searchsorted(used, corner_triangles(F)[0]) if F.shape[1] == 4 else None
    if energy is not None:
        energy_named(energy)
    elif rails is not False:
        raise ValueError("the boundary slides only while distortion is lowered: give an energy as well")
    if rails is not False:
        problem = moved_onto(rails, problem)
    result = solve(
        problem,
        start=None if begin is None else begin[used],
        max_iterations=max_iterations,
        linear_solver=linear_solver,
        callback=callback,
    )
    if corners is not None and result.status is not Status.INTERRUPTED:
        result = made_convex(problem, result, corners, linear_solver=linear_solver)
    if energy is not None and not inverted_triangles(own if corners is None else corners, result.uv).size:
        result = polished(
            problem,
            result,
            energy=energy,
            tolerance=tolerance,
            linear_solver=linear_solver,
            callback=callback,
            slide=rails,
            triangles=corners,
        )
    after = points.copy()
    after[fixed] = target
    after[used] = result.uv
    return after, result


def _like(name: str, mesh: ArrayLike, points: FloatArray, used: IntArray) -> FloatArray:
    """Check other positions of a mesh's nodes; nodes in no element may be anywhere."""
    array = map_array(name, mesh, len(points), finite=False)
    _check_used(name, array, used)
    return array


def _check_used(name: str, points: FloatArray, used: IntArray) -> None:
    mine = np.zeros_like(points)
    mine[used] = points[used]
    check_finite(name, "vertex", "vertices", mine)


def _counterclockwise(F: IntArray, rest: FloatArray) -> IntArray:
    """Return the elements with counterclockwise winding; raise ValueError if the distortion of one is undefined."""
    quadrilaterals = F.shape[1] == 4
    triangles, of = corner_triangles(F) if quadrilaterals else covering_triangles(F)
    sign = orientation(*(rest[triangles[:, k]] for k in range(3)))
    if quadrilaterals:
        turning = np.bincount(of, sign, len(F))
        bad = np.flatnonzero(np.abs(turning) != np.bincount(of, minlength=len(F)))
        if bad.size:
            raise ValueError(
                f"{name_elements(F, bad)} not convex: all four corners of a quadrilateral must turn the same way. "
                "Move their nodes, or split them into triangles"
            )
    else:
        flat = np.unique(of[sign == 0])
        if flat.size:
            raise ValueError(f"{name_elements(F, flat)} degenerate: repair the mesh first")
        turning = orientation(*(rest[F[:, k]] for k in range(3))).astype(np.float64)
    return np.where((turning < 0)[:, None], turned_over(F), F)


def _placed(
    points: FloatArray, F: IntArray, moved_vertices: ArrayLike, positions: ArrayLike
) -> tuple[IntArray, FloatArray]:
    """Return the fixed nodes (moved nodes and the rest of the boundary) and their target positions."""
    given = index_array("moved_vertices", moved_vertices)
    if given.ndim != 1:
        raise ValueError(f"moved_vertices must have shape (k,), not {given.shape}")
    check_range("moved_vertices", given, len(points))
    target = map_array("positions", positions, len(given), finite=False)
    check_finite("positions", "row", "rows", target)
    idle = given[~np.isin(given, F)]
    if idle.size:
        raise ValueError(f"moved_vertices refers to {named('vertex', 'vertices', idle)}, but no triangle uses them")
    left = np.setdiff1d(boundary_edges(covering_triangles(F)[0], len(points)), given)
    there = points.copy()
    there[given] = target
    if F.shape[1] == 6:
        middle, ends = sides(F)
        follows = np.isin(middle, left)
        there[middle[follows]] = carried(points, there, middle[follows], ends[follows])
    return np.concatenate([given, left]), np.concatenate([target, there[left]])


def _curves(slide: bool | BoundaryCurves, triangles: IntArray, places: FloatArray) -> list[Curve]:
    """Return the curves along which the boundary of some triangles slides."""
    if isinstance(slide, BoundaryCurves):
        return slide.curves
    return [Curve.polygon(places[loop]) for loop in boundary_loops(triangles, len(places))]


def _rails(slide: bool | BoundaryCurves, problem: Problem, used: IntArray, moved: IntArray) -> bool | BoundaryCurves:
    """Return the boundary curves in the indices of the triangles' vertices, with moved vertices fixed."""
    held = np.searchsorted(used, moved)
    if isinstance(slide, BoundaryCurves):
        return slide.among(used).holding(held)
    if slide is not True:
        return slide
    places = np.zeros((problem.n, 2))
    places[problem.fixed] = problem.target
    return BoundaryCurves.around(problem.domain.loops, places, fixed=held)
