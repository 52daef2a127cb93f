"""Convex quadrilaterals: the triangles at all four corners, from both diagonals, must be positive.

A quadrilateral mesh is mapped as a mesh of triangles that halve each quadrilateral along one diagonal. So a
quadrilateral may be concave although the map of these triangles is injective. `make_convex` untangles the triangles at
all corners.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from quasiharmonic.energies.deformation import signed_areas
from quasiharmonic.energies.newton.map_model import in_units
from quasiharmonic.geometry.exact.certificate import certify, inverted_triangles
from quasiharmonic.problem import Problem
from quasiharmonic.problem.result import MapResult, Status
from quasiharmonic.problem.run import Run
from quasiharmonic.solver.methods.untangling import untangle
from quasiharmonic.util.arrays import IntArray, find_exponent, to_points

# Maximum number of untangling steps; successful runs need a few dozen.
_MAX_STEPS = 300


def make_convex(problem: Problem, result: MapResult, corners: IntArray, *, linear_solver: str) -> MapResult:
    """Continue from a map of triangles that halve quadrilaterals to one in which these are convex.

    The quadrilaterals are convex in the rest mesh, and ``corners`` (t, 3) are the triangles at all their corners. The
    result has an additional stage if steps were taken. Its status is `Status.STALLED` if corners stay inverted; the map
    then has the fewest inverted corners found.
    """
    before = inverted_triangles(corners, result.uv).size
    if not before:
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
