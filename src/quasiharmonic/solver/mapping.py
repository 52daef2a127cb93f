"""Map a mesh: `injective_map` from arrays, `solve` for a `Problem`, `quasi_harmonic_map` for given tensors.

They check their arguments. The search itself is in `solver.search`, refinement in `solver.refinement`.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import replace
from typing import TypedDict, Unpack, get_args

from numpy.typing import ArrayLike

from quasiharmonic.energies.energies import Energy
from quasiharmonic.energies.newton.sliding_boundary import move_onto
from quasiharmonic.energies.polishing import polish_options, polish_result
from quasiharmonic.geometry.curves.boundary_curves import BoundaryCurves
from quasiharmonic.geometry.mesh.reference import Reference
from quasiharmonic.io.accepts_mesh import accepts_mesh
from quasiharmonic.io.mesh_files import ProblemArrays
from quasiharmonic.problem import Problem, check_problem
from quasiharmonic.problem.result import MapResult, Status, Step
from quasiharmonic.problem.run import Run, run_within
from quasiharmonic.solver.field.objective import Objective
from quasiharmonic.solver.field.tensor import TANH, beltrami_coefficients
from quasiharmonic.solver.search.search import search_map
from quasiharmonic.solver.search.stages import Stages
from quasiharmonic.util.arrays import (
    ComplexArray,
    FloatArray,
    check_choice,
)
from quasiharmonic.util.options import MapOptions, takes
from quasiharmonic.util.progress import reports_progress


class MapKeywords(TypedDict, total=False):
    """Types of the options of `injective_map` and `solve`."""

    strategy: str | Stages
    polish: str | Energy | None
    start: ArrayLike | None
    max_iterations: int
    linear_solver: str
    callback: Callable[[Step], object] | None
    record_every: int
    time_limit: float | None
    slide: bool | BoundaryCurves
    refine: bool


@accepts_mesh
@reports_progress
@takes(MapOptions, MapKeywords)
def injective_map(
    V: ArrayLike,
    F: ArrayLike,
    fixed: ArrayLike,
    target: ArrayLike,
    *,
    reference: Reference | None = None,
    **options: Unpack[MapKeywords],
) -> MapResult:
    """Map a triangle mesh into the plane without inverted triangles.

    Parameters
    ----------
    V : (n, 2) or (n, 3) array, or a mesh in place of ``V`` and ``F``
        Rest positions of a planar or curved mesh, a disk with or without holes.
    F : (f, 3) array of int
        Triangles, consistently oriented.
    fixed : (k,) array of int
        Fixed vertices: the whole boundary and any pinned interior vertices.
    target : (k, 2) array
        Target positions of the fixed vertices, in the same order.
    reference : {"equilateral", "rest", "corrected"}, optional
        Shape of the triangles in which gradients are taken (§9.3). It overrides the strategy's choice.
    strategy : {"speed", "paper"} or sequence of Descent
        ``"speed"`` finds a map fastest; ``"paper"`` is the pipeline of the paper, with si-log first. A sequence gives
        the stages directly.
    polish : str or Energy, optional
        Distortion energy to lower after an injective map is found; see `quasiharmonic.polish` for the names. A tenth of
        ``max_iterations`` limits the Newton steps, but at least 200 are allowed.
    start : (n, 2) array, optional
        Initial map, for instance the map of the same mesh for a similar target. The search starts from its tensors. If
        that fails, later stages start from scratch.
    max_iterations : int
        Maximum number of iterations of the search; each is one linear solve on the whole mesh. Successful repairs of
        small patches count as iterations. Failed repairs may take as long as 16 times ``max_iterations`` in total. With
        ``refine``, both limits hold for all attempts together.
    linear_solver : str
        ``"auto"`` or one of `quasiharmonic.linsolve.available`.
    callback : callable, optional
        Called with a `Step` at every iteration. During longer work, such as patch repairs or a diagnosis, it is called
        with the last `Step` again at least every half second, but not within a single factorisation. It may raise
        `KeyboardInterrupt`, for instance after a time limit, which ends the search as Ctrl-C does.
    record_every : int
        Keep every ``record_every``-th map in the result's ``path``. Default: 0, keep no maps. If edges are split, only
        maps of the given mesh are kept.
    time_limit : float, optional
        Seconds after which the call returns the best map so far with status ``TIME_LIMIT``. It is checked as often as
        the callback is called. The result then depends on the speed of the machine.
    slide : bool or BoundaryCurves
        Let boundary vertices slide along their outline during polishing, with fixed corners; see
        `quasiharmonic.polish`. If the boundary of ``target`` is off the curves by a chord, it is moved onto them first.
    refine : bool
        If a shortened search finds no injective map of the given mesh, split as few interior edges as possible. A
        search without ``refine`` may take longer and still find a map. The edges are those that the diagnosis names,
        then edges around inverted triangles, then those that a construction with a proof needs. The construction
        requires a connected surface without handles. The target's loops must be simple, disjoint, nested and wound as
        the mesh's; pins must be distinct and strictly inside. The result is then a bijective map or has status
        ``PRECISION_LIMIT``. With dozens of pins far from their mesh positions it may be ``TOO_MANY_SPLITS``.

    Returns
    -------
    MapResult
        The certified map. If no injective map was found, the result is the best map, and ``status`` gives the reason.
        The best map has the fewest inverted triangles; if the diagnosis proves that no injective map exists, it is the
        map of least area. Failure to find a map does not raise an exception. Ctrl-C ends the search and returns the
        best map so far. If edges were split, ``refined`` has the mesh of the map: old vertices keep their indices, new
        ones follow. ``refinement_attempts`` lists the attempts.

    Raises
    ------
    ValueError
        If the input is malformed; see `Problem`.

    See Also
    --------
    flatten : If the boundary may move.
    injective_maps : Many small problems, several times as fast.
    polish : Lowers the distortion of the map.
    diagnose : Why there is no map.

    Examples
    --------
    Map a square annulus onto itself with its hole turned by 90°:

    >>> import numpy as np
    >>> from quasiharmonic import boundary_loops, injective_map
    >>> from quasiharmonic.surfaces import annulus
    >>> V, F = annulus()
    >>> outer, inner = sorted(boundary_loops(F, len(V)), key=len, reverse=True)
    >>> target = np.concatenate([V[outer], V[inner] @ [[0, 1], [-1, 0]]])
    >>> result = injective_map(V, F, np.concatenate([outer, inner]), target)
    >>> result.injective, bool(result.certificate.bijective)
    (True, True)
    """
    began = time.perf_counter()
    result = solve(Problem(V, F, fixed, target, reference=reference), **options)
    return replace(result, seconds=time.perf_counter() - began)


@reports_progress
@takes(MapOptions, MapKeywords)
def solve(problem: Problem | ProblemArrays, **options: Unpack[MapKeywords]) -> MapResult:
    """Search for an injective map of a `Problem`.

    Parameters
    ----------
    problem : Problem or ProblemArrays
        A `Problem` also names the reference triangles. The call changes only its caches, which make later solves
        faster. Or the arrays that `quasiharmonic.io.read_problem` returns.
    strategy, polish, start, max_iterations, linear_solver, callback, record_every, time_limit, slide, refine
        See `injective_map`. With ``refine``, ``start`` and ``record_every`` apply to the given mesh.

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

    See Also
    --------
    injective_map : The same without a `Problem`.
    injective_maps : Many small problems.
    quasiharmonic.io.read_problem : Reads a problem from a folder.

    Examples
    --------
    >>> from quasiharmonic import Problem, boundary_loops, solve
    >>> from quasiharmonic.surfaces import disk
    >>> V, F = disk(4)
    >>> (rim,) = boundary_loops(F)
    >>> solve(Problem(V, F, rim, 2 * V[rim])).success
    True
    """
    if isinstance(problem, ProblemArrays):
        problem = Problem(*problem)
    check_problem("solve", problem, ": use injective_map for the arrays V, F, fixed and target")
    checked = MapOptions(**options)
    return run_within(checked.time_limit, lambda: solve_problem(problem, checked))


def solve_problem(problem: Problem, options: MapOptions) -> MapResult:
    """Search for an injective map and polish it; see `injective_map`."""
    began = time.perf_counter()
    polishing = None if options.polish is None else polish_options(options)
    if options.slide is not False:
        if polishing is None:
            raise ValueError("the boundary slides only while distortion is lowered: give an energy as well, by polish")
        problem = move_onto(options.slide, problem)
    if options.refine:
        # Import on demand: refinement also imports the construction and the diagnosis, which most maps do not need.
        from quasiharmonic.solver.refinement import on_refinement, search_refining

        result = search_refining(problem, options)
        problem = on_refinement(problem, result.refined)
    else:
        result = search_map(problem, options)
    if polishing is not None and result.status is Status.INJECTIVE:
        run = Run()
        with run.until_interrupted():
            result = polish_result(problem, result, polishing)
        if run.interrupted:
            result = replace(result, status=Status.INTERRUPTED)
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

    See Also
    --------
    injective_map : Searches for tensors whose map is injective.
    quasi_harmonic_derivative : The derivative of the map.

    Examples
    --------
    >>> from quasiharmonic import Problem, boundary_loops, is_injective, quasi_harmonic_map
    >>> from quasiharmonic.surfaces import disk
    >>> V, F = disk(4)
    >>> (rim,) = boundary_loops(F)
    >>> is_injective(F, quasi_harmonic_map(Problem(V, F, rim, V[rim])))
    True
    """
    check_problem("quasi_harmonic_map", problem)
    check_choice("reference", reference, get_args(Reference))
    coefficients = beltrami_coefficients(mu, len(problem.F))
    with problem.exclusive() as own:
        objective = Objective(own, reference=reference, linear_solver=linear_solver)
        return own.positions(objective.evaluate(TANH.invert(coefficients)).w)
