"""Lower the distortion of an injective map by Newton's method, keeping every step injective (§10, §11)."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import replace

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
from quasiharmonic.energies.newton.newton_descent import NewtonDescent, in_units
from quasiharmonic.energies.newton.progressive_reference import descend
from quasiharmonic.energies.newton.sliding import SlidingDescent, lay_boundary
from quasiharmonic.geometry.curves.boundary_curves import BoundaryCurves
from quasiharmonic.geometry.exact.certificate import certify, inverted_triangles
from quasiharmonic.io.adapters.accepts_mesh import accepts_mesh
from quasiharmonic.problem import Domain, Problem
from quasiharmonic.problem.result import MapResult, Stage, Status, Step
from quasiharmonic.util.arrays import (
    FloatArray,
    IntArray,
    check_callback,
    kind_of,
    map_array,
    named,
    not_negative,
    whole_number,
)
from quasiharmonic.util.progress import reports_progress

#: Energies that `polish` can minimise, by name. ARAP alone lets triangles collapse, so it gets a tenth of the area
#: barrier.
ENERGIES: dict[str, Energy] = {
    "symmetric-dirichlet": SymmetricDirichlet(),
    "mips": MIPS(),
    "blend": conformal_area_blend(),
    "arap-barrier": Combination((1.0, ARAP()), (0.1, AreaBarrier())),
}


@accepts_mesh
@reports_progress
def polish(
    V: ArrayLike,
    F: ArrayLike,
    uv: ArrayLike,
    *,
    fixed: ArrayLike,
    energy: str | Energy = "symmetric-dirichlet",
    weights: ArrayLike | None = None,
    max_iterations: int = 200,
    tolerance: float = 1e-4,
    linear_solver: str = "auto",
    callback: Callable[[Step], object] | None = None,
    slide: bool | BoundaryCurves = False,
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
    fixed : (k,) array of int
        Fixed vertices, which keep their positions in ``uv`` exactly: the whole boundary and any pins.
    energy : str or Energy
        The energy to minimise, averaged over the surface's area:

        - ``"symmetric-dirichlet"``: σ₁² + σ₂² + σ₁⁻² + σ₂⁻², measures lengths. A good default.
        - ``"mips"``: σ₁/σ₂ + σ₂/σ₁, measures angles only; the scale may vary by many orders of magnitude.
        - ``"blend"``: (1 − θ) MIPS + θ (det J + 1/det J), θ = 1/128: measures angles, with bounded scale. For another θ
          use `quasiharmonic.energies.energies.conformal_area_blend`.
        - ``"arap-barrier"``: (σ₁ − 1)² + (σ₂ − 1)² plus a tenth of det J + 1/det J, as rigid as possible.

        Or any `Energy` that is a barrier and has second derivatives. Lengths and areas are compared after scaling the
        map to the surface's area.
    weights : (f,) array, optional
        Weight of each triangle's distortion; positive, 1 by default.
    max_iterations : int
        Maximum number of Newton steps.
    tolerance : float
        The polish has converged when half the squared Newton decrement is below this fraction of the energy. Not
        negative. On scans of 20,000 to 40,000 triangles mapped to letters, the default ends 0 to 1 % above the lowest
        known energy, 1e-3 ends 0 to 2.1 % above.
    linear_solver : str
        ``"auto"`` or one of `quasiharmonic.linsolve.available`.
    callback : callable, optional
        Called with a `Step` at the start and after every step; ``Step.energy`` is the mean energy. Between steps it is
        called with the last `Step` again at least every half second, but not during a single factorisation.
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

    Examples
    --------
    >>> import numpy as np
    >>> from quasiharmonic.surfaces import disk
    >>> V, F = disk(6)
    >>> turn = 1.0 * (1 - V[:, 0] ** 2 - V[:, 1] ** 2)
    >>> twisted = np.stack(
    ...     [V[:, 0] * np.cos(turn) - V[:, 1] * np.sin(turn), V[:, 0] * np.sin(turn) + V[:, 1] * np.cos(turn)], axis=1
    ... )
    >>> result = polish(V, F, twisted, fixed=np.arange(len(V) - 36, len(V)))
    >>> result.injective, bool(np.abs(result.uv - V).max() < 1e-3)
    (True, True)
    """
    began = time.perf_counter()
    domain = Domain(V, F, fixed)
    domain.check_boundary_fixed()
    result = polish_map(
        domain,
        uv,
        energy=energy,
        weights=weights,
        max_iterations=max_iterations,
        tolerance=tolerance,
        linear_solver=linear_solver,
        callback=callback,
        slide=slide,
    )
    return replace(result, seconds=time.perf_counter() - began)


@reports_progress
def polish_map(
    domain: Domain,
    uv: ArrayLike,
    *,
    energy: str | Energy = "symmetric-dirichlet",
    weights: ArrayLike | None = None,
    max_iterations: int = 200,
    tolerance: float = 1e-4,
    linear_solver: str = "auto",
    callback: Callable[[Step], object] | None = None,
    slide: bool | BoundaryCurves = False,
    triangles: IntArray | None = None,
) -> MapResult:
    """Polish a map of an existing `Domain`; parameters, results and errors as in `polish`.

    The domain's ``fixed`` vertices keep their positions in ``uv``, or slide. If ``triangles`` (t, 3) are given, they
    are measured in place of the domain's triangles. They must be positive in ``uv`` and stay so. They may overlap, but
    must cover the surface evenly.
    """
    began = time.perf_counter()
    chosen = energy_named(energy)
    whole_number("max_iterations", max_iterations, least=0)
    not_negative("tolerance", tolerance)
    check_callback(callback)
    start = injective_array(domain, uv, "polish needs an injective map")
    track = lay_boundary(slide, domain, start) if slide is not False else None
    if track is not None:
        start = track.uv
    if weights is not None:
        weights = positive_weights(weights, len(domain.F if triangles is None else triangles))
    # Overflow gives inf or NaN. Comparisons with NaN are false, so these steps are never accepted.
    with np.errstate(all="ignore"):
        deformation, exponent = at_own_scale(domain, start, chosen, weights, triangles)
        descent: NewtonDescent
        if track is None:
            descent = NewtonDescent(deformation, start, domain.fixed, exponent, linear_solver)
            outcomes = descend(descent, max_iterations, tolerance)
        else:
            descent = SlidingDescent(deformation, track, domain.fixed, domain.loops, exponent, linear_solver)
            outcomes = descent.descend(max_iterations, tolerance)
    history: list[Step] = []

    def report() -> None:
        history.append(Step(len(history), 0, descent.energies[1]))
        if callback is not None:
            callback(history[-1])

    status = Status.STILL_FALLING
    try:
        report()
        for outcome in outcomes:
            report()
            status = outcome or status
    except KeyboardInterrupt:
        status = Status.INTERRUPTED
    uv = descent.positions(descent.w)
    certificate = certify(domain.F, uv, loops=domain.loops)
    seconds = time.perf_counter() - began
    name = energy if isinstance(energy, str) else type(energy).__name__
    stage = Stage(
        name=f"polish, {name}",
        iterations=max(len(history) - 1, 0),
        seconds=seconds,
        inverted=(0, 0),
        energy=descent.energies,
        kept=descent.value < descent.first,
    )
    return MapResult(
        uv=uv,
        status=status,
        certificate=certificate,
        stages=[stage],
        history=history,
        linear_solver=descent.system.solver.name,
        seconds=seconds,
        V=domain.V,
    )


def polished(
    problem: Problem,
    result: MapResult,
    *,
    energy: str | Energy,
    max_iterations: int = 200,
    tolerance: float = 1e-4,
    linear_solver: str = "auto",
    callback: Callable[[Step], object] | None = None,
    slide: bool | BoundaryCurves = False,
    triangles: IntArray | None = None,
) -> MapResult:
    """Polish the injective map of a result with `polish_map`, appending to its stages and history."""
    further = polish_map(
        problem.domain,
        result.uv,
        energy=energy,
        max_iterations=max_iterations,
        tolerance=tolerance,
        linear_solver=linear_solver,
        callback=callback,
        slide=slide,
        triangles=triangles,
    )
    return replace(
        further,
        stages=result.stages + further.stages,
        history=result.history + further.history,
        path=result.path,
        refined=result.refined,
        refinement_attempts=result.refinement_attempts,
        seconds=result.seconds + further.seconds,
    )


def energy_named(energy: str | Energy) -> Energy:
    """Look up an energy by its name and reject energies that `polish` cannot minimise."""
    if isinstance(energy, str):
        if energy not in ENERGIES:
            raise ValueError(f"energy must be one of {', '.join(ENERGIES)}, or an Energy, not {energy!r}")
        return ENERGIES[energy]
    if not isinstance(energy, Energy):
        raise ValueError(f"energy must be one of {', '.join(ENERGIES)}, or an Energy, not {kind_of(energy)}")
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


def at_own_scale(
    domain: Domain,
    uv: FloatArray,
    energy: Energy,
    weights: FloatArray | None = None,
    triangles: IntArray | None = None,
) -> tuple[DeformationEnergy, int]:
    """Return an energy that scales maps to the surface's area, and the binary exponent of the length unit.

    Parameters
    ----------
    domain : Domain
    uv : (n, 2) float64
        The map whose area determines the scale. The unit is a power of two of about its size.
    energy : Energy
    weights : (f,) float64, optional
    triangles : (t, 3) int64, optional
        Triangles to measure; by default those of the domain.
    """
    F = domain.F if triangles is None else triangles
    # Scale so that products of coordinates neither overflow nor underflow. A power of two causes no rounding.
    exponent = int(np.frexp(np.abs(uv).max())[1])
    area = float(signed_areas(F, in_units(uv, exponent)).sum())
    return DeformationEnergy(domain.V, F, energy, area=area, weights=weights), exponent


def injective_array(domain: Domain, uv: ArrayLike, why: str) -> FloatArray:
    """Return a map as float64 and check that it is injective; ``why`` ends the error message."""
    array = map_array("uv", uv, domain.n)
    inverted = inverted_triangles(domain.F, array)
    if inverted.size:
        raise ValueError(
            f"uv is not injective: {named('triangle', 'triangles', inverted)} inverted or degenerate; {why}"
        )
    return array
