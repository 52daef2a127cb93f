"""Solve one problem: search for a map without inverted triangles (§9.2).

The search stops at the first map in which every triangle is strictly positive. Exact arithmetic verifies this on the
returned coordinates.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import replace
from typing import get_args

from numpy.typing import ArrayLike

from quasiharmonic.energies.energies import Energy
from quasiharmonic.energies.newton.sliding import moved_onto
from quasiharmonic.energies.polishing import energy_named, polished
from quasiharmonic.geometry.curves.boundary_curves import BoundaryCurves
from quasiharmonic.geometry.exact.certificate import certify
from quasiharmonic.geometry.mesh.reference import Reference
from quasiharmonic.problem import Frame, Problem
from quasiharmonic.problem.result import MapResult, Status, Step
from quasiharmonic.solver.field.objective import Objective
from quasiharmonic.solver.field.tensor import TANH, beltrami_coefficients
from quasiharmonic.solver.search.stages import Search, Stages
from quasiharmonic.solver.search.strategy import stages_of
from quasiharmonic.util.arrays import (
    ComplexArray,
    FloatArray,
    check_callback,
    check_choice,
    kind_of,
    map_array,
    whole_number,
)
from quasiharmonic.util.progress import reports_progress


@reports_progress
def solve(
    problem: Problem,
    *,
    strategy: str | Stages = "speed",
    polish: str | Energy | None = None,
    start: ArrayLike | None = None,
    max_iterations: int = 2000,
    linear_solver: str = "auto",
    callback: Callable[[Step], object] | None = None,
    record_every: int = 0,
    slide: bool | BoundaryCurves = False,
) -> MapResult:
    """Search for an injective map of a `Problem`.

    Parameters
    ----------
    problem : Problem
        It also names the reference triangles. The call changes only its caches, which make later solves faster.
    strategy, polish, start, max_iterations, linear_solver, callback, record_every, slide
        See `injective_map`.

    Returns
    -------
    MapResult
        See `injective_map`.

    Raises
    ------
    ValueError
        If an option is unknown or invalid, or ``start`` does not have shape (n, 2) or contains a non-finite position.
    ImportError
        If the named linear solver is not installed.
    """
    began = time.perf_counter()
    whole_number("max_iterations", max_iterations, least=1)
    whole_number("record_every", record_every, least=0)
    check_callback(callback)
    lower = None if polish is None else energy_named(polish)
    if not isinstance(problem, Problem):
        raise TypeError(
            f"solve takes a Problem, not {kind_of(problem)}: use injective_map for the arrays V, F, fixed and target"
        )
    first = None if start is None else _first_map(problem, start)
    if slide is not False:
        if lower is None:
            raise ValueError("the boundary slides only while distortion is lowered: give an energy as well")
        problem = moved_onto(slide, problem)
    with problem.exclusive() as own:
        search = Search(own, linear_solver, callback, max_iterations, record_every, first)
        status = search.run(stages_of(strategy, own))
    uv = problem.positions(search.best_map)
    certificate = certify(problem.F, uv, loops=problem.domain.loops)
    field = search.best_field
    result = MapResult(
        uv=uv,
        status=Status.INJECTIVE if certificate.injective else status,
        certificate=certificate,
        stages=search.stages,
        history=search.history,
        path=search.path,
        diagnosis=search.diagnosis,
        linear_solver=search.linear_solver,
        mu=None if field is None else field.mu,
        reference=search.best_reference,
        V=problem.V,
    )
    if lower is not None and status is Status.INJECTIVE:
        result = polished(problem, result, energy=lower, linear_solver=linear_solver, callback=callback, slide=slide)
    return replace(result, seconds=time.perf_counter() - began)


def quasi_harmonic_map(
    problem: Problem,
    mu: ComplexArray | None = None,
    *,
    reference: Reference = "equilateral",
    linear_solver: str = "auto",
) -> FloatArray:
    """Compute the quasi-harmonic map of a tensor field, or Tutte's embedding without a field (equation 12).

    Parameters
    ----------
    problem : Problem
    mu : (f,) complex128, optional
        Beltrami coefficients of the tensors, with modulus below 1. Default: zero.
    reference : {"equilateral", "rest", "corrected"}
            Reference triangles in whose frames the coefficients are expressed. A reference set in ``problem`` takes
            precedence.
    linear_solver : str
        ``"auto"`` or one of `quasiharmonic.linsolve.available`.

    Returns
    -------
    (n, 2) float64
        Positions; fixed vertices are exactly at their target positions. The map is injective if the target is convex or
        ``mu`` is the field of an injective map; otherwise it may not be.

    Raises
    ------
    ValueError
        If ``mu`` has the wrong shape or a modulus of 1 or more; the message names the triangles.
    quasiharmonic.linsolve.NotPositiveDefinite
        If the Laplacian is not positive definite after rounding.
    """
    check_choice("reference", reference, get_args(Reference))
    coefficients = beltrami_coefficients(mu, len(problem.F))
    with problem.exclusive() as own:
        objective = Objective(own, reference=reference, linear_solver=linear_solver)
        return own.positions(objective.evaluate(TANH.invert(coefficients)).w)


def _first_map(problem: Problem, start: ArrayLike) -> ComplexArray:
    """Check the initial map and return it as complex numbers in its own frame, because only its tensors are used."""
    uv = map_array("start", start, problem.n)
    return Frame(uv).inward(uv)
