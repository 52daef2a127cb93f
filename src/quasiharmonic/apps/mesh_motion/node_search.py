"""The search for the positions of all nodes of a planar mesh, some of which have given positions.

A quadrilateral mesh is mapped as a mesh of triangles that halve each quadrilateral along one diagonal. So a
quadrilateral may be concave although the map of these triangles is injective. `make_convex` untangles the triangles at
all four corners, from both diagonals.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from quasiharmonic.apps.mesh_motion.midsides import centre_midsides, restore_midsides, untangle_elements
from quasiharmonic.energies.deformation import signed_areas
from quasiharmonic.energies.newton.map_model import in_units
from quasiharmonic.energies.newton.sliding_boundary import move_onto
from quasiharmonic.energies.polishing import limit_polish, polish_result
from quasiharmonic.geometry.curves.boundary_curves import BoundaryCurves
from quasiharmonic.geometry.curves.curve import Curve
from quasiharmonic.geometry.exact.certificate import certify, inverted_triangles
from quasiharmonic.geometry.exact.jacobian_signs import inverted_elements
from quasiharmonic.geometry.mesh.elements import MIDDLES, corner_triangles
from quasiharmonic.geometry.mesh.topology import boundary_loops
from quasiharmonic.problem import Problem
from quasiharmonic.problem.result import MapResult, Status
from quasiharmonic.problem.run import Run
from quasiharmonic.solver.mapping import solve
from quasiharmonic.solver.methods.untangling import untangle
from quasiharmonic.util.arrays import FloatArray, IntArray, find_exponent, to_points
from quasiharmonic.util.options import MorphOptions, PolishOptions

# Maximum number of untangling steps; successful runs need a few dozen.
_MAX_STEPS = 300


class Slide(NamedTuple):
    """How the boundary slides: along its polygon (True), not (False), or along curves; and the nodes that do not."""

    curves: bool | BoundaryCurves
    held: IntArray


@dataclass(frozen=True)
class NodeSearch:
    """The search for the positions of all nodes: a rest mesh, the nodes with given positions, and triangles.

    The triangles are sets ``nets`` to search on, in order.
    """

    F: IntArray
    rest: FloatArray
    fixed: IntArray
    nets: list[IntArray]
    options: MorphOptions

    def place(
        self, points: FloatArray, target: FloatArray, begin: FloatArray | None, slide: Slide
    ) -> tuple[FloatArray, MapResult]:
        """Place all nodes by the first set of triangles that leaves no element inverted, or by the best one.

        Nodes in no element, and mid-side nodes on a sliding boundary, are at ``points`` (n, 2). ``target`` (k, 2) has
        the positions of the fixed nodes, and ``begin`` is the initial mesh. If the boundary of six-node triangles
        slides, all nodes are first placed on the triangles between all nodes, then those inside again.
        """
        F, fixed, nets = self.F, self.fixed, self.nets
        if F.shape[1] == 6 and slide.curves is not False:
            # Mid-side nodes slide as other nodes do. They are then moved to the middle of their sides and fixed there.
            there, slid = self._search(nets[-1], points, target, begin, slide)
            has_slid = fixed[(there[fixed] != target).any(axis=1)]
            before = points.copy()
            before[fixed] = target
            there = centre_midsides(F, there, has_slid, _list_curves(slide.curves, nets[-1], before))
            after, result = self.place(points, there[fixed], there, Slide(False, fixed))
            return after, result.after(slid)
        best, least = None, np.inf
        for triangles in nets:
            after, result = self._search(triangles, points, target, begin, slide)
            if F.shape[1] == 6:
                # Mid-side nodes outside these triangles have not moved yet.
                inside = ~np.isin(F[:, MIDDLES], triangles).any()
                straight = restore_midsides(F, self.rest, after, fixed)
                after = untangle_elements(F, straight, straight if inside else after, fixed)
            left = inverted_elements(F, after).size
            if left < least:
                best, least = (after, result), left
            if not left or result.status is Status.INTERRUPTED:
                break
        assert best is not None
        return best

    def place_at_once(self, target: FloatArray) -> FloatArray:
        """Return the positions (n, 2) after one step from the rest mesh; NaN if an element is inverted."""
        whole, _ = self.place(self.rest, target, None, Slide(False, self.fixed))
        return np.full_like(whole, np.nan) if inverted_elements(self.F, whole).size else whole

    def _search(
        self, triangles: IntArray, points: FloatArray, target: FloatArray, begin: FloatArray | None, slide: Slide
    ) -> tuple[FloatArray, MapResult]:
        """Search a map of some triangles, untangle those at quadrilaterals' corners, and return the moved mesh."""
        F, fixed = self.F, self.fixed
        energy, linear_solver, callback = self.options.energy, self.options.linear_solver, self.options.callback
        used = np.unique(triangles)
        known = np.isin(fixed, used)
        own, own_fixed = np.searchsorted(used, triangles), np.searchsorted(used, fixed[known])
        # With the mesh's own reference triangles, the search starts from the harmonic extension of the displacement.
        problem = Problem(self.rest[used], own, own_fixed, target[known], reference="corrected")
        corners = np.searchsorted(used, corner_triangles(F)[0]) if F.shape[1] == 4 else None
        try:
            curves = _select_curves(slide.curves, problem, used, slide.held)
            problem = problem if curves is False else move_onto(curves, problem)
        except ValueError:
            if isinstance(slide.curves, BoundaryCurves):
                raise
            # The moved boundary touches or crosses itself, so it is no curve to slide along: search with it fixed.
            curves = False
        start, iterations = None if begin is None else begin[used], self.options.max_iterations
        result = solve(problem, start=start, max_iterations=iterations, linear_solver=linear_solver, callback=callback)
        if result.status is Status.INTERRUPTED:
            energy = None
        elif corners is not None:
            result = make_convex(problem, result, corners, linear_solver=linear_solver)
        if energy is not None and not inverted_triangles(own if corners is None else corners, result.uv).size:
            polishing = PolishOptions(
                energy=energy,
                max_iterations=limit_polish(iterations),
                tol=self.options.tol,
                linear_solver=linear_solver,
                callback=callback,
                slide=curves,
            )
            result = polish_result(problem, result, polishing, triangles=corners)
        after = points.copy()
        after[fixed] = target
        after[used] = result.uv
        return after, result


def _list_curves(slide: bool | BoundaryCurves, triangles: IntArray, positions: FloatArray) -> list[Curve]:
    """Return the curves along which the boundary of some triangles slides."""
    if isinstance(slide, BoundaryCurves):
        return slide.curves
    return [Curve.polygon(positions[loop]) for loop in boundary_loops(triangles, len(positions))]


def _select_curves(
    slide: bool | BoundaryCurves, problem: Problem, used: IntArray, moved: IntArray
) -> bool | BoundaryCurves:
    """Return the boundary curves in the indices of the triangles' vertices, with moved vertices fixed."""
    own_fixed = np.searchsorted(used, moved)
    if isinstance(slide, BoundaryCurves):
        return slide.restrict(used).with_fixed_unless_on(own_fixed)
    if slide is not True:
        return slide
    positions = np.zeros((problem.n, 2))
    positions[problem.fixed] = problem.target
    return BoundaryCurves.around(problem.domain.loops, positions, fixed=own_fixed)


def make_convex(problem: Problem, result: MapResult, corners: IntArray, *, linear_solver: str) -> MapResult:
    """Continue from a map of triangles that halve quadrilaterals to one in which these are convex.

    The quadrilaterals are convex in the rest mesh, and ``corners`` (t, 3) are the triangles at all their corners. The
    result has an additional stage if steps were taken. Its status is `Status.STALLED` if corners stay inverted; the map
    then has the fewest inverted corners found. A result with `Status.IMPOSSIBLE` is returned unchanged.
    """
    before = inverted_triangles(corners, result.uv).size
    if not before or result.status is Status.IMPOSSIBLE:
        return result
    run, steps = Run(), 0
    exponent = find_exponent(result.uv)
    w = in_units(result.uv, exponent)
    areas = (signed_areas(problem.F, places).sum() for places in (w, in_units(problem.V, 0)))
    rest = problem.V * np.sqrt(np.divide(*areas))
    for further in untangle(corners, w, problem.fixed, rest=rest, linear_solver=linear_solver):
        w, steps = further, steps + 1
        if steps == _MAX_STEPS:
            break
    uv = np.ldexp(to_points(w), exponent)
    uv[problem.fixed] = problem.target
    after = inverted_triangles(corners, uv).size
    name, inverted, energy = "untangling corners", (before, after), (np.inf, np.inf)
    run.add_stage(name, n_iterations=steps, inverted=inverted, energy=energy, kept=after < before)
    result = replace(result, stages=result.stages + run.stages, seconds=result.seconds + run.seconds)
    if after >= before:
        return replace(result, status=Status.STALLED)
    certificate = certify(problem.F, uv, loops=problem.domain.loops)
    status = Status.STALLED if after else Status.INJECTIVE
    return replace(result, uv=uv, status=status, certificate=certificate, diagnosis=None, mu=None)
