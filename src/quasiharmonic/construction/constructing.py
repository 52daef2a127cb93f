"""A map of a refined mesh onto a simple target: constructed, certified, and rid of what it did not need."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from quasiharmonic.arrays import FloatArray
from quasiharmonic.construction.ancestry import as_refined, midpoints
from quasiharmonic.construction.cutting import Cutting
from quasiharmonic.construction.embedding import embedded
from quasiharmonic.construction.opening import thinned
from quasiharmonic.exact.certificate import Certificate, certify
from quasiharmonic.mesh.refinement import Refined
from quasiharmonic.problem import Domain, Problem


@dataclass(frozen=True, eq=False)
class Construction:
    """A map of a refined mesh.

    Attributes
    ----------
    refined : Refined
        How the mesh came from the problem's.
    uv : (n + s, 2) float64
        The map, fixed vertices exactly at their target.
    certificate : Certificate
        The exact verdict on it: bijective, or else doubles have no room where triangles are not positive.
    """

    refined: Refined
    uv: FloatArray
    certificate: Certificate


def construct(problem: Problem, guide: FloatArray | None = None, *, thin: bool = True) -> Construction:
    """Construct a map onto a simple target.

    Parameters
    ----------
    problem : Problem
        As `is_simple` asks for it.
    guide : (n, 2) array, optional
        A map, whatever it inverts, near which the mesh is to be cut.
    thin : bool
        Take out again what vertices the map can do without.

    Returns
    -------
    Construction
    """
    exponent = int(np.frexp(np.abs(problem.target).max())[1])
    unit = problem.moved(np.ldexp(problem.target, -exponent))
    near = None if guide is None else np.ldexp(guide, -exponent) @ [1, 1j]
    cutting = Cutting(unit, near)
    sheet = cutting.sheet
    triangles = np.array(sheet.vertex)[sheet.rows()]
    refined = as_refined(problem.V, problem.F, triangles, midpoints(problem.n, sheet.parents))
    fine = refined_problem(unit, refined)
    walked = np.array(sorted(cutting.places), dtype=np.int64)
    uv = np.zeros((len(refined.V), 2))
    uv[walked] = np.array([cutting.places[v] for v in walked.tolist()], dtype=np.complex128).view(float).reshape(-1, 2)
    uv[unit.fixed] = unit.target
    uv = fine.positions(embedded(fine, fine.frame.inward(uv), np.concatenate([unit.fixed, walked])))
    certificate = certify(refined.F, uv, loops=problem.domain.loops)
    if thin and certificate.bijective:
        refined, uv = thinned(unit, refined, uv)
    uv = np.ldexp(uv, exponent)
    uv[problem.fixed] = problem.target
    return Construction(refined, uv, certify(refined.F, uv, loops=problem.domain.loops))


def refined_problem(problem: Problem, refined: Refined) -> Problem:
    """A problem on a refinement of its mesh, whose triangles may be as thin as they like at rest."""
    return Problem.on(Domain(refined.V, refined.F, problem.fixed), problem.target, reference="equilateral")
