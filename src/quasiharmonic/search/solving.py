"""From a problem to a map without inverted triangles: the strategy (§9.2).

``injective_map`` is the one-shot call and ``solve`` the same for a `Problem` at hand. The search stops at
the first map whose every triangle is strictly positive, decided exactly on the coordinates that are
handed back.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import replace
from typing import get_args

from numpy.typing import ArrayLike

from quasiharmonic.arrays import ComplexArray, FloatArray, check_callback, check_choice, map_array, whole_number
from quasiharmonic.curves.rails import Rails
from quasiharmonic.energy.energies import Energy
from quasiharmonic.energy.polishing import energy_named, polished
from quasiharmonic.energy.sliding import moved_onto
from quasiharmonic.exact.certificate import certify
from quasiharmonic.field.objective import Objective
from quasiharmonic.field.tensor import TANH, beltrami_coefficients
from quasiharmonic.given.taking import takes_mesh
from quasiharmonic.hearing import heard
from quasiharmonic.mesh.reference import Reference
from quasiharmonic.problem import Frame, Problem
from quasiharmonic.result import MapResult, Status, Step
from quasiharmonic.search.stages import Search, Stages
from quasiharmonic.search.strategy import stages_of


@takes_mesh
@heard
def injective_map(
    V: ArrayLike,
    F: ArrayLike,
    fixed: ArrayLike,
    target: ArrayLike,
    *,
    reference: Reference | None = None,
    strategy: str | Stages = "speed",
    polish: str | Energy | None = None,
    start: ArrayLike | None = None,
    max_iterations: int = 2000,
    linear_solver: str = "auto",
    callback: Callable[[Step], object] | None = None,
    record: int = 0,
    slide: bool | Rails = False,
) -> MapResult:
    """Map a triangle mesh into the plane with no triangle inverted.

    Parameters
    ----------
    V : (n, 2) or (n, 3) array, or a mesh in place of ``V`` and ``F``
        Rest positions of a planar or curved mesh, disk-like or with holes.
    F : (f, 3) array of int
        Triangles, consistently oriented.
    fixed : (k,) array of int
        Vertices with given positions: the whole boundary and any pinned interior vertices.
    target : (k, 2) array
        Where they go.
    reference : {"equilateral", "rest", "corrected"}, optional
        Shape of the triangles in which gradients are taken (§9.3), whatever the strategy would choose.
    strategy : {"speed", "paper"} or sequence of Descent
        ``"speed"`` finds a map soonest; ``"paper"`` is the paper's own pipeline, si-log first; or stages of one's own.
    polish : str or Energy, optional
        Once injective, lower this distortion energy; see `quasiharmonic.polish` for the names.
    start : (n, 2) array, optional
        A map to begin with, for instance that of the same mesh for a target near this one: the search starts at
        its tensors, and afresh where that leads nowhere.
    max_iterations : int
        Iterations to spend at most on finding the map: one linear solve each on the whole mesh. Tries at repairing a
        small patch are counted where they succeed.
    linear_solver : str
        ``"auto"`` or one of `quasiharmonic.linsolve.available`.
    callback : callable, optional
        Called with a `Step` at every iteration, and with the last one again at least every half second in between:
        while patches are tried, say, or a diagnosis is made, but not within a single factorisation. It may raise
        `KeyboardInterrupt`, on a clock of its own for instance, which ends the search as Ctrl-C does.
    record : int
        Keep the map of every ``record``-th iteration in the result's ``path``; none of them by default.
    slide : bool or Rails
        While polishing let boundary vertices glide along their outline, its corners held; see `quasiharmonic.polish`.
        The boundary of ``target`` is put onto the curves first, if it is off them by a chord.

    Returns
    -------
    MapResult
        With the certified map, or with the best map found and a status that says why it is not injective: of the
        maps met, the one with the fewest inverted triangles; where the diagnosis proves that none is injective,
        the one of least area. Failure to find a map is not an exception. Ctrl-C ends the search and returns the
        best map so far.

    Raises
    ------
    ValueError
        When the input is malformed; see `Problem`.

    Examples
    --------
    A square annulus whose hole is turned by a quarter:

    >>> import numpy as np
    >>> from quasiharmonic import injective_map
    >>> from quasiharmonic.surfaces import annulus
    >>> from quasiharmonic.mesh.topology import boundary_loops
    >>> V, F = annulus()
    >>> outer, inner = sorted(boundary_loops(F, len(V)), key=len, reverse=True)
    >>> target = np.concatenate([V[outer], V[inner] @ [[0, 1], [-1, 0]]])
    >>> result = injective_map(V, F, np.concatenate([outer, inner]), target)
    >>> result.injective, bool(result.certificate.bijective)
    (True, True)
    """
    began = time.perf_counter()
    problem = Problem(V, F, fixed, target, reference=reference)
    result = solve(
        problem,
        strategy=strategy,
        polish=polish,
        start=start,
        max_iterations=max_iterations,
        linear_solver=linear_solver,
        callback=callback,
        record=record,
        slide=slide,
    )
    return replace(result, seconds=time.perf_counter() - began)


@heard
def solve(
    problem: Problem,
    *,
    strategy: str | Stages = "speed",
    polish: str | Energy | None = None,
    start: ArrayLike | None = None,
    max_iterations: int = 2000,
    linear_solver: str = "auto",
    callback: Callable[[Step], object] | None = None,
    record: int = 0,
    slide: bool | Rails = False,
) -> MapResult:
    """Solve a problem at hand.

    Parameters
    ----------
    problem : Problem
        It has the kind of reference triangles too, and is not changed but for what it keeps to be solved again sooner.
    strategy, polish, start, max_iterations, linear_solver, callback, record, slide
        As of `injective_map`.

    Returns
    -------
    MapResult
        As of `injective_map`.

    Raises
    ------
    ValueError
        When an option is none that there is, or ``start`` has another shape than (n, 2) or a place that is not finite.
    ImportError
        When the linear solver named is not installed.
    """
    began = time.perf_counter()
    whole_number("max_iterations", max_iterations, least=1)
    whole_number("record", record, least=0)
    check_callback(callback)
    lower = None if polish is None else energy_named(polish)
    first = None if start is None else _first_map(problem, start)
    if slide is not False:
        if lower is None:
            raise ValueError("the boundary slides while distortion is lowered: name an energy for that too")
        problem = moved_onto(slide, problem)
    with problem.exclusive() as own:
        search = Search(own, linear_solver, callback, max_iterations, record, first)
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
    """The quasi-harmonic map of a tensor field, or Tutte's embedding where no field is given (equation 12).

    Parameters
    ----------
    problem : Problem
    mu : (f,) complex128, optional
        Beltrami coefficients of the tensors, below 1 in modulus; zero by default.
    reference : {"equilateral", "rest", "corrected"}
        The triangles in whose frames they are expressed, unless the problem itself names others.
    linear_solver : str
        ``"auto"`` or one of `quasiharmonic.linsolve.available`.

    Returns
    -------
    (n, 2) float64
        Positions, the fixed vertices exactly at their target. Injective only where the target is convex
        or μ is right.

    Raises
    ------
    ValueError
        When μ has another shape or is not below 1 in modulus; the message names the triangles.
    quasiharmonic.linsolve.NotPositiveDefinite
        When rounding leaves no positive definite Laplacian.
    """
    check_choice("reference", reference, get_args(Reference))
    coefficients = beltrami_coefficients(mu, len(problem.F))
    with problem.exclusive() as own:
        objective = Objective(own, reference=reference, linear_solver=linear_solver)
        return own.positions(objective.evaluate(TANH.invert(coefficients)).w)


def _first_map(problem: Problem, start: ArrayLike) -> ComplexArray:
    """The caller's first map, checked, as complex numbers in a frame of its own: only its tensors count."""
    uv = map_array("start", start, problem.n)
    return Frame(uv).inward(uv)
