"""Keep quadrilaterals convex: the triangles at all four corners, from both diagonals, must be positive."""

from __future__ import annotations

import time
from dataclasses import replace

import numpy as np

from quasiharmonic.energies.deformation import signed_areas
from quasiharmonic.energies.newton.newton_descent import in_units
from quasiharmonic.geometry.exact.certificate import certify, inverted_triangles
from quasiharmonic.problem import Problem
from quasiharmonic.problem.result import MapResult, Stage, Status
from quasiharmonic.solver.methods.untangling import untangled
from quasiharmonic.util.arrays import IntArray

# Maximum number of untangling steps; successful runs need a few dozen.
_STEPS = 300


def made_convex(problem: Problem, result: MapResult, corners: IntArray, *, linear_solver: str) -> MapResult:
    """Continue from a map of triangles that halve quadrilaterals to one in which these are convex.

    Parameters
    ----------
    problem : Problem
        The rest mesh, in which the quadrilaterals are convex, and the fixed vertices.
    result : MapResult
        A map of the triangles on either side of one diagonal.
    corners : (t, 3) int64
        The triangles at all corners.
    linear_solver : str

    Returns
    -------
    MapResult
        With an additional stage if steps were taken. The status is `Status.STALLED` if corners stay inverted; the map
        then has the fewest inverted corners found.
    """
    before = inverted_triangles(corners, result.uv).size
    if not before:
        return result
    began, steps = time.perf_counter(), 0
    exponent = int(np.frexp(np.abs(result.uv).max())[1])
    w = in_units(result.uv, exponent)
    areas = (signed_areas(problem.F, places).sum() for places in (w, in_units(problem.V, 0)))
    rest = problem.V * np.sqrt(np.divide(*areas))
    for further in untangled(corners, w, problem.fixed, rest=rest, linear_solver=linear_solver):
        w, steps = further, steps + 1
        if steps == _STEPS:
            break
    uv = np.ldexp(w.view(np.float64).reshape(-1, 2), exponent)
    uv[problem.fixed] = problem.target
    after = inverted_triangles(corners, uv).size
    seconds = time.perf_counter() - began
    stage = Stage("untangling corners", steps, seconds, (before, after), (np.inf, np.inf), kept=after < before)
    stages = [*result.stages, stage]
    if after >= before:
        return replace(result, status=Status.STALLED, stages=stages, seconds=result.seconds + seconds)
    return replace(
        result,
        uv=uv,
        status=Status.STALLED if after else Status.INJECTIVE,
        certificate=certify(problem.F, uv, loops=problem.domain.loops),
        stages=stages,
        seconds=result.seconds + seconds,
        diagnosis=None,
        mu=None,
    )
