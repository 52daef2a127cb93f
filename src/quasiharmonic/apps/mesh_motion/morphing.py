"""Morphing of planar meshes: the boundary has moved, give me a valid interior."""

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
    """Move some nodes of a planar mesh and place the others such that no element is inverted.

    Parameters
    ----------
    points : (n, 2) array, or a mesh in the plane in place of ``points`` and ``F``
        The mesh as it is.
    F : (f, 3), (f, 4) or (f, 6) array of int
        Triangles, quadrilaterals, or triangles of six nodes, wound either way, corners first (see
        `quasiharmonic.geometry.mesh.elements`). A quadrilateral whose last two nodes are one is a triangle.
    moved_vertices : (k,) array of int
        Nodes that go somewhere else: of the boundary, or inside. Boundary nodes not among them stay, but for mid-side
        nodes, which go along with the side that they are on.
    positions : (k, 2) array
        Where they go.
    energy : str, Energy or None
        What the placement minimises; see `quasiharmonic.polish`. The default keeps shapes and sizes of the
        triangles, so that a graded mesh stays graded. None takes the first valid mesh.
    max_iterations : int
        Linear solves to spend at most on finding a valid mesh.
    linear_solver : str
        ``"auto"`` or one of `quasiharmonic.linsolve.available`.
    callback : callable, optional
        Called with a `Step` at every iteration, and with the last one again at least every half second in between, but
        not within a single factorisation.
    slide : bool or BoundaryCurves
        Let the boundary vertices that are not moved glide along their outline, its corners held, as nodes on the walls
        of a channel do: along the curves of `quasiharmonic.geometry.curves.BoundaryCurves`, or with True along the
        polygon that the boundary is. Moved ones slide only where ``BoundaryCurves`` tell them a curve of their own.
    rest : (n, 2) array, optional
        The mesh against which distortion is measured, ``points`` by default. In a chain of steps it is the first one,
        so that the chain does not drift (`MorphResult.drift`).
    start : (n, 2) array, optional
        A mesh near to the one sought, to begin from. By default that is ``points`` where ``rest`` is another, and else
        the harmonic extension of the displacement.
    tolerance : float
        What a further step could lower the energy by, as a part of it, when the mesh counts as at rest; see
        `quasiharmonic.polish`. The larger, the sooner, and the more it shows from where it came there.

    Returns
    -------
    MorphResult
        When no valid mesh was found, ``result.status`` says why, or ``inverted`` which elements are to blame.

    Raises
    ------
    ValueError
        When the input is malformed (see `Problem`), a node to move is in no element, or at rest an element has no area
        or a quadrilateral is not convex, or the mesh is folded over; names the elements.

    Notes
    -----
    Triangles are searched for as every map is. Of quadrilaterals the triangles on either side of a diagonal are, and
    then those at all four corners are righted and their energy lowered. Of six-node triangles those between their
    corners are, and mid-side nodes inside go where they are on their sides at rest, straight if they were, or aside by
    as little as it takes where a curved side would invert an element; if that does not do, corners near by move too,
    and the search is made once more on the four triangles between the nodes of each. On these the boundary slides, with
    its mid-side nodes, before all that.

    Examples
    --------
    The upper side of a square pushed halfway down in its middle:

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
        # Where the boundary has slid to, it is held.
        alone = settings._replace(callback=None)
        whole, _ = _answered(question, first, after[fixed], None, (False, fixed), alone)
        return np.full_like(whole, np.nan) if inverted_elements(F, whole).size else whole

    inverted = inverted_elements(F, after)
    forbidden = np.intersect1d(inverted, forbidden_elements(F, after, fixed))
    before, now = element_quality(F, points), element_quality(F, after)
    return MorphResult(after, F, inverted, forbidden, result, before, now, one_step)


class _Question(NamedTuple):
    """A mesh at rest, the nodes whose places are given, and the triangles to search on, one set after the other."""

    F: IntArray
    rest: FloatArray
    fixed: IntArray
    nets: list[IntArray]


class _Settings(NamedTuple):
    """How to search, as of `morph`."""

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
    """Places of all nodes by the first set of triangles that leaves no element inverted, or the best one.

    Parameters
    ----------
    question : _Question
    points : (n, 2) float64
        Where nodes are that belong to no element, and mid-side nodes on a boundary that slides.
    target : (k, 2) float64
        Where the given nodes go.
    begin : (n, 2) float64 or None
        What to begin with.
    slide : (bool or BoundaryCurves, (l,) int64)
        What the boundary slides along, and which nodes do not.
    settings : _Settings
    """
    F, rest, fixed, nets = question
    if F.shape[1] == 6 and slide[0] is not False:
        # Mid-side nodes slide as others do, and then stay in the middle of where their sides have come to.
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
            # Mid-side nodes that the triangles leave out have not been anywhere.
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
    """A map of some triangles, those at quadrilaterals' corners positive, and the mesh with its nodes there."""
    F, rest, fixed, _ = question
    energy, max_iterations, linear_solver, callback, tolerance = settings
    used = np.unique(triangles)
    known = np.isin(fixed, used)
    own, held = np.searchsorted(used, triangles), np.searchsorted(used, fixed[known])
    # On the mesh's own triangles the search starts from the harmonic extension of the displacement.
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
    """Other places of the nodes of a mesh; those in no element may be anywhere."""
    array = map_array(name, mesh, len(points), finite=False)
    _check_used(name, array, used)
    return array


def _check_used(name: str, points: FloatArray, used: IntArray) -> None:
    mine = np.zeros_like(points)
    mine[used] = points[used]
    check_finite(name, "vertex", "vertices", mine)


def _counterclockwise(F: IntArray, rest: FloatArray) -> IntArray:
    """The elements, all in one direction around; a ValueError that names those of which distortion is not defined."""
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
    """Return the nodes that are given, those moved and the rest of the boundary, and where they go."""
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
    """What the boundary of some triangles slides along."""
    if isinstance(slide, BoundaryCurves):
        return slide.curves
    return [Curve.polygon(places[loop]) for loop in boundary_loops(triangles, len(places))]


def _rails(slide: bool | BoundaryCurves, problem: Problem, used: IntArray, moved: IntArray) -> bool | BoundaryCurves:
    """What the boundary slides along, in the numbers of the vertices that triangles use; those moved are held."""
    held = np.searchsorted(used, moved)
    if isinstance(slide, BoundaryCurves):
        return slide.among(used).holding(held)
    if slide is not True:
        return slide
    places = np.zeros((problem.n, 2))
    places[problem.fixed] = problem.target
    return BoundaryCurves.around(problem.domain.loops, places, fixed=held)
