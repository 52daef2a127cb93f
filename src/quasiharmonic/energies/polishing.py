"""Less distortion without leaving the injective maps, from a map that is injective (§10, §11)."""

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

#: What a polish can lower, by name. ARAP gets a tenth of the area barrier: alone it lets triangles collapse.
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
    """Lower the distortion of an injective map; every step on the way is injective, certified exactly.

    Parameters
    ----------
    V : (n, 2) or (n, 3) array, or a mesh in place of ``V`` and ``F``
        Rest positions.
    F : (f, 3) array of int
        Triangles.
    uv : (n, 2) array
        An injective map of the mesh.
    fixed : (k,) array of int
        Vertices that stay where they are in ``uv``, to the last bit: the whole boundary and any pins.
    energy : str or Energy
        What is lowered, the mean over the surface's area:

        - ``"symmetric-dirichlet"``: σ₁² + σ₂² + σ₁⁻² + σ₂⁻², lengths. The safe choice.
        - ``"mips"``: σ₁/σ₂ + σ₂/σ₁, angles and nothing else; scale may vary by many orders of magnitude.
        - ``"blend"``: (1 − θ) MIPS + θ (det J + 1/det J), θ = 1/128: angles, with the scale bounded. Another θ
          with `quasiharmonic.energies.energies.conformal_area_blend`.
        - ``"arap-barrier"``: (σ₁ − 1)² + (σ₂ − 1)² and a tenth of det J + 1/det J, rigid where it can be.

        Or any `Energy` that is a barrier and has second derivatives. Lengths and areas are compared after
        scaling the map to the surface's area.
    weights : (f,) array, optional
        How much each triangle's distortion counts; positive, 1 by default.
    max_iterations : int
        Newton steps at most.
    tolerance : float
        The polish has converged when Newton's model promises a further decrease below this fraction of the
        energy (half the squared Newton decrement over the energy). Not negative. Scans of 20,000 to 40,000 triangles on
        letters end 0 to 1 % above the least energy known by the default, 0 to 2.1 % by 1e-3.
    linear_solver : str
        ``"auto"`` or one of `quasiharmonic.linsolve.available`.
    callback : callable, optional
        Called with a `Step` at the start and after every step, and with the last one again at least every half second
        in between, but not within a single factorisation; its ``energy`` is the mean energy.
    slide : bool or BoundaryCurves
        Let boundary vertices glide along the outline, in their order, its corners held: along the curves of
        `quasiharmonic.geometry.curves.BoundaryCurves`, or with True along the polygon that the boundary is in ``uv``,
        whose corners are where it turns by 20° or more. Vertices that slide are on their curve up to one rounding; a
        map that is bijective stays so. The scale is that of the start, whatever little the polygon's area changes.

    Returns
    -------
    MapResult
        With status ``POLISHED``, ``STILL_FALLING`` after the last iteration, ``EXHAUSTED`` when doubles cannot
        express a better map, or ``INTERRUPTED`` by Ctrl-C; certified in each case, with no more energy than
        ``uv``. The history holds the mean energy at every step.

    Raises
    ------
    ValueError
        When the input is malformed (see `Problem`), a rest triangle has no area, or ``uv`` is not injective;
        the message names the triangles. When the boundary is not on the curves that it is to slide along (see
        `BoundaryCurves`), or triangles are inverted once it is on them. When the energy is not known, not a barrier or
        without second derivatives, or another option has no such value. When there is no step to take as an energy of
        one's own, or a derivative of it, is NaN: the message names which, and the triangles.

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
    """Polish a map of a `Domain` at hand; the rest as `polish` has it.

    The domain's ``fixed`` vertices stay where they are in ``uv``, or slide. ``triangles`` (t, 3) are measured in place
    of its own if there are any, and stay positive, as they are in ``uv``; they may overlap, and cover all of it alike.
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
    # Overflow gives inf or NaN; every comparison with NaN is false, so such a step is never accepted.
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
    """Polish the injective map of a result, as `polish_map` does; stages and history are continued."""
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
    """Look an energy up by its name, and refuse what a polish cannot lower."""
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
    """An energy that measures maps after bringing them to the surface's area, and the exponent of their unit.

    Parameters
    ----------
    domain : Domain
    uv : (n, 2) float64
        The map whose area says by how much; a power of two of its size is the unit.
    energy : Energy
    weights : (f,) float64, optional
    triangles : (t, 3) int64, optional
        Those to measure; the domain's by default.
    """
    F = domain.F if triangles is None else triangles
    # Products of coordinates must not leave the numbers' range. A power of two costs no digits.
    exponent = int(np.frexp(np.abs(uv).max())[1])
    area = float(signed_areas(F, in_units(uv, exponent)).sum())
    return DeformationEnergy(domain.V, F, energy, area=area, weights=weights), exponent


def injective_array(domain: Domain, uv: ArrayLike, why: str) -> FloatArray:
    """A map as float64, checked to be injective; ``why`` ends the message of one that is not."""
    array = map_array("uv", uv, domain.n)
    inverted = inverted_triangles(domain.F, array)
    if inverted.size:
        raise ValueError(
            f"uv is not injective: {named('triangle', 'triangles', inverted)} inverted or degenerate; {why}"
        )
    return array
