"""Lower the distortion of an injective map by Newton's method, keeping every step injective (§10, §11)."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import replace
from typing import TypedDict, Unpack

import numpy as np
from numpy.typing import ArrayLike

from quasiharmonic.energies.deformation import DeformationEnergy, positive_weights, signed_areas
from quasiharmonic.energies.energies import (
    ARAP,
    MIPS,
    AreaBarrier,
    Combination,
    Energy,
    SymmetricDirichlet,
    conformal_area_blend,
)
from quasiharmonic.energies.newton.distant_starts import descend
from quasiharmonic.energies.newton.map_model import MapModel, in_units
from quasiharmonic.energies.newton.newton_descent import NewtonDescent, newton_descent
from quasiharmonic.energies.newton.sliding_boundary import SlidingModel, move_boundary
from quasiharmonic.geometry.curves.boundary_curves import BoundaryCurves
from quasiharmonic.geometry.exact.certificate import inverted_triangles
from quasiharmonic.geometry.mesh.reference import rest_shapes
from quasiharmonic.io.accepts_mesh import accepts_mesh
from quasiharmonic.problem import Domain, Problem
from quasiharmonic.problem.result import MapResult, Status, Step
from quasiharmonic.problem.run import Run, run_within
from quasiharmonic.util.arrays import FloatArray, IntArray, describe, find_exponent, map_array, reject
from quasiharmonic.util.hints import suggest
from quasiharmonic.util.options import MapOptions, PolishOptions, takes
from quasiharmonic.util.progress import reports_progress

#: Polishing steps of `smooth`. On about 10,000 triangles they take a few times as long as the first map and go nearly
#: as far as convergence: they lower the MIPS energy to a fifth and the worst stretch to a hundredth.
SMOOTHING_STEPS = 20
#: Largest number of triangles that `smooth` accepts; on larger meshes the time of the steps is noticeable.
LARGEST_SMOOTHED = 100_000
#: Energies that `polish` can minimise, by name. ARAP alone lets triangles collapse, so it gets a tenth of the area
#: barrier.
ENERGIES: dict[str, Energy] = {
    "symmetric-dirichlet": SymmetricDirichlet(),
    "mips": MIPS(),
    "blend": conformal_area_blend(),
    "arap-barrier": Combination((1.0, ARAP()), (0.1, AreaBarrier())),
}


class PolishKeywords(TypedDict, total=False):
    """Types of the options of `polish`."""

    energy: str | Energy
    weights: ArrayLike | None
    max_iterations: int
    tol: float
    linear_solver: str
    callback: Callable[[Step], object] | None
    record_every: int
    time_limit: float | None
    slide: bool | BoundaryCurves


@accepts_mesh
@reports_progress
@takes(PolishOptions, PolishKeywords)
def polish(
    V: ArrayLike, F: ArrayLike, uv: ArrayLike, *, fixed: ArrayLike | None = None, **options: Unpack[PolishKeywords]
) -> MapResult:
    """Lower the distortion of an injective map; every step is injective, certified exactly.

    Parameters
    ----------
    V : (n, 2) or (n, 3) array, or a mesh in place of ``V`` and ``F``
        Rest positions.
    F : (f, 3) array of int
        Triangles.
    uv : (n, 2) array
        An injective map of the mesh.
    fixed : (k,) array of int, optional
        Fixed vertices, which keep their positions in ``uv`` exactly: the whole boundary and any pins. Default: the
        boundary.
    energy : str or Energy
        The energy to minimise, averaged over the surface's area:

        - ``"symmetric-dirichlet"``: σ₁² + σ₂² + σ₁⁻² + σ₂⁻² − 4, measures lengths. A good default.
        - ``"mips"``: σ₁/σ₂ + σ₂/σ₁ − 2, measures angles only; the scale may vary by many orders of magnitude.
        - ``"blend"``: (1 − θ) MIPS + θ (det J + 1/det J − 2), θ = 1/128: measures angles, with bounded scale. For
          another θ use `quasiharmonic.energies.energies.conformal_area_blend`.
        - ``"arap-barrier"``: (σ₁ − 1)² + (σ₂ − 1)² plus a tenth of det J + 1/det J − 2, as rigid as possible.

        Or any `Energy` that is a barrier and has second derivatives. Lengths and areas are compared after scaling the
        map to the surface's area.
    weights : (f,) array, optional
        Weight of each triangle's distortion; positive, 1 by default.
    max_iterations : int
        Maximum number of Newton steps.
    tol : float
        The polish has converged when half the squared Newton decrement is below this fraction of the energy. Not
        negative. On scans of 20,000 to 40,000 triangles mapped to letters, the default ends 0 to 1 % above the lowest
        known energy, 1e-3 ends 0 to 2.1 % above.
    linear_solver : str
        ``"auto"`` or one of `quasiharmonic.linsolve.available`.
    callback : callable, optional
        Called with a `Step` at the start and after every step; ``Step.energy`` is the mean energy. Between steps it is
        called with the last `Step` again at least every half second, but not during a single factorisation.
    record_every : int
        Keep every ``record_every``-th map in the result's ``path``. Default: 0, keep no maps.
    time_limit : float, optional
        Seconds after which the call returns the best map so far with status ``TIME_LIMIT``. It is checked as often as
        the callback is called. The result then depends on the speed of the machine.
    slide : bool or BoundaryCurves
        Let boundary vertices slide along the outline, in their order, with fixed corners. With True, they slide along
        the boundary polygon of ``uv``, whose corners turn by 20° or more. With
        `quasiharmonic.geometry.curves.BoundaryCurves`, they slide along these curves. Sliding vertices are on their
        curve up to one rounding. A bijective map stays bijective. The scale of the start is kept, although the area of
        the polygon may change slightly.

    Returns
    -------
    MapResult
        With status ``POLISHED`` on convergence, ``STILL_FALLING`` after the last iteration, ``EXHAUSTED`` when double
        precision cannot express a better map, or ``INTERRUPTED`` by Ctrl-C. In each case the map is certified and its
        energy is at most that of ``uv``. The history has the mean energy at every step.

    Raises
    ------
    ValueError
        - When the input is malformed (see `Problem`), a rest triangle has no area, or ``uv`` is not injective; the
          message lists the triangles.
        - When the boundary is not on the curves it should slide along (see `BoundaryCurves`), or moving it onto them
          inverts triangles.
        - When the energy is unknown, is not a barrier or has no second derivatives, or when another option is invalid.
        - When a user-defined energy or one of its derivatives is NaN or infinite, so that no step is possible; the
          message lists which, and the triangles.
    TimeoutError
        If the time limit is over before the first step.

    See Also
    --------
    harmonise : Lowers energies that are no barriers.
    flatten : Lowers the distortion with a free boundary.
    distortion : Measures it.
    quasiharmonic.atlas.polish : Every island of a mesh with seams.

    Examples
    --------
    >>> import numpy as np
    >>> from quasiharmonic.surfaces import disk
    >>> V, F = disk(6)
    >>> turn = 1.0 * (1 - V[:, 0] ** 2 - V[:, 1] ** 2)
    >>> twisted = np.stack(
    ...     [V[:, 0] * np.cos(turn) - V[:, 1] * np.sin(turn), V[:, 0] * np.sin(turn) + V[:, 1] * np.cos(turn)], axis=1
    ... )
    >>> result = polish(V, F, twisted)
    >>> result.injective, bool(np.abs(result.uv - V).max() < 1e-3)
    (True, True)
    """
    began = time.perf_counter()
    domain = Domain(V, F, fixed)
    domain.check_boundary_fixed()
    return replace(polish_map(domain, uv, PolishOptions(**options)), seconds=time.perf_counter() - began)


def polish_map(
    domain: Domain, uv: ArrayLike, options: PolishOptions, *, triangles: IntArray | None = None
) -> MapResult:
    """Polish a map of an existing `Domain`; results and errors as in `polish`.

    The domain's ``fixed`` vertices keep their positions in ``uv``, or slide. If ``triangles`` (t, 3) are given, they
    are measured in place of the domain's triangles. They must be positive in ``uv`` and stay so. They may overlap, but
    must cover the surface evenly.
    """
    return run_within(options.time_limit, lambda: _polish(domain, uv, options, triangles))


def _polish(domain: Domain, uv: ArrayLike, options: PolishOptions, triangles: IntArray | None) -> MapResult:
    """Polish a map; see `polish_map`."""
    chosen, linear_solver = find_energy(options.energy), options.linear_solver
    run = Run(options.callback, options.record_every)
    start = check_injective(domain, uv, "polish needs an injective map: repair it first (repair; qhm repair)")
    track = None if options.slide is False else move_boundary(options.slide, domain, start)
    if track is not None:
        start = track.uv
    weights = options.weights
    if weights is not None:
        weights = positive_weights(weights, len(domain.F if triangles is None else triangles))
    # Overflow gives inf or NaN. Comparisons with NaN are false, so these steps are never accepted.
    with np.errstate(all="ignore"):
        deformation, exponent = scale_energy(domain, start, chosen, weights, triangles)
        model: MapModel | SlidingModel
        if track is None:
            descent, model = newton_descent(deformation, start, domain.fixed, exponent, linear_solver)
            outcomes = descend(descent, model, options.max_iterations, options.tol)
        else:
            model = SlidingModel(deformation, track, domain.fixed, domain.loops, exponent, linear_solver)
            descent = NewtonDescent(model, model.start())
            outcomes = descent.descend(options.max_iterations, options.tol)
    name = options.energy if isinstance(options.energy, str) else type(chosen).__name__
    status = Status.INTERRUPTED
    with run.until_interrupted():
        status = run.descend(
            f"polish, {name}",
            outcomes,
            lambda: model.mean_energy(descent.state),
            lambda: model.positions(descent.w),
        )
    run.judge_last_stage(kept=descent.value < descent.first)
    uv = model.positions(descent.w)
    solver = model.system.solver.name
    return run.result(uv, domain.F, status, loops=domain.loops, linear_solver=solver, V=domain.V)


def polish_result(
    problem: Problem, result: MapResult, options: PolishOptions, *, triangles: IntArray | None = None
) -> MapResult:
    """Polish the injective map of a result with `polish_map`, appending to its stages, history and path.

    If edges were split, the path has only maps of the given mesh.
    """
    options = replace(options, record_every=0) if result.refined is not None else options
    further = polish_map(problem.domain, result.uv, options, triangles=triangles).after(result)
    return replace(further, refined=result.refined, refinement_attempts=result.refinement_attempts)


def limit_polish(max_iterations: int) -> int:
    """Return the maximum number of steps of the polish that follows a search with at most ``max_iterations``."""
    return max(200, max_iterations // 10)


def polish_options(options: MapOptions) -> PolishOptions:
    """Return the options of the polish that follows a search, with the energy that they name."""
    return PolishOptions(
        energy=find_energy(options.polish, "polish"),
        max_iterations=limit_polish(options.max_iterations),
        linear_solver=options.linear_solver,
        callback=options.callback,
        record_every=options.record_every,
        slide=options.slide,
    )


def find_energy(energy: str | Energy, option: str = "energy") -> Energy:
    """Look up the energy of an option by its name and reject energies that `polish` cannot minimise."""
    if isinstance(energy, str):
        if energy not in ENERGIES:
            raise ValueError(
                f"{option} must be one of {', '.join(ENERGIES)}, or an Energy, not {energy!r}: use harmonise "
                f"for energies without a barrier, which let triangles collapse{suggest(energy, ENERGIES)}"
            )
        return ENERGIES[energy]
    if not isinstance(energy, Energy):
        raise ValueError(f"{option} must be one of {', '.join(ENERGIES)}, or an Energy, not {describe(energy)}")
    if not energy.barrier:
        raise ValueError(
            f"{type(energy).__name__} is not a barrier energy, so triangles would collapse; "
            "combine it with a barrier energy, such as AreaBarrier"
        )
    if type(energy).curvature is Energy.curvature:
        raise ValueError(
            f"{type(energy).__name__} has no second derivatives, and Newton's method needs them: "
            "implement its curvature, or use `harmonise`, which needs only first derivatives"
        )
    return energy


def scale_energy(
    domain: Domain,
    uv: FloatArray,
    energy: Energy,
    weights: FloatArray | None = None,
    triangles: IntArray | None = None,
) -> tuple[DeformationEnergy, int]:
    """Return an energy that scales maps to the surface's area, and the binary exponent of the length unit.

    The area of ``uv`` (n, 2) determines the scale. The unit is a power of two of about its size. The energy measures
    the domain's triangles unless others (t, 3) are given.
    """
    F = domain.F if triangles is None else triangles
    exponent = find_exponent(uv)
    area = float(signed_areas(F, in_units(uv, exponent)).sum())
    return DeformationEnergy(domain.V, F, energy, area=area, weights=weights), exponent


def check_injective(domain: Domain, uv: ArrayLike, why: str) -> FloatArray:
    """Return a map as float64 and check that it is injective; ``why`` ends the error message."""
    array = map_array("uv", uv, domain.n)
    message = f"uv is not injective: {{}} inverted or degenerate; {why}"
    reject(inverted_triangles(domain.F, array), "triangle", "triangles", message)
    return array


def is_smoothable(V: FloatArray, F: IntArray, *, slide: bool = False) -> bool:
    """Return whether `smooth` changes maps of a surface."""
    return (slide or len(F) <= LARGEST_SMOOTHED) and not rest_shapes(V, F).flat.size


def smooth(
    problem: Problem,
    result: MapResult,
    *,
    linear_solver: str = "auto",
    callback: Callable[[Step], object] | None = None,
    slide: bool | BoundaryCurves = False,
) -> MapResult:
    """Lower the distortion of an injective map by a few polishing steps, if the mesh is of moderate size.

    Return the unchanged result if the mesh has more than `LARGEST_SMOOTHED` triangles and does not slide, or if a rest
    triangle has no area. With ``slide``, maps of any size are smoothed, because only polishing slides the boundary. See
    `polish` for the options. If it is interrupted, the result is the best map so far with status ``INTERRUPTED``.
    """
    if not is_smoothable(problem.V, problem.F, slide=slide is not False):
        return result
    options = PolishOptions(
        energy="blend", max_iterations=SMOOTHING_STEPS, linear_solver=linear_solver, callback=callback, slide=slide
    )
    run = Run()
    with run.until_interrupted():
        result = polish_result(problem, result, options)
    # Convergence is not the goal here, so the status does not report its absence.
    interrupted = run.interrupted or result.status is Status.INTERRUPTED
    return replace(result, status=Status.INTERRUPTED if interrupted else Status.INJECTIVE)
