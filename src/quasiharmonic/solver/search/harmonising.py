"""Lower any distortion energy within the injective maps by quasi-harmonisation (§11).

The energy may be finite for inverted triangles.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import TypedDict, Unpack, cast

import numpy as np
from numpy.typing import ArrayLike

from quasiharmonic.energies import polishing
from quasiharmonic.energies.deformation import DeformationEnergy, signed_areas
from quasiharmonic.energies.energies import ARAP, AreaPreserving, Energy, UnsignedARAP
from quasiharmonic.energies.springs import MassSpring
from quasiharmonic.geometry.exact.certificate import inverted_triangles
from quasiharmonic.geometry.mesh.reference import Reference
from quasiharmonic.io.accepts_mesh import accepts_mesh
from quasiharmonic.problem import Domain, Problem
from quasiharmonic.problem.diagnosis import diagnose
from quasiharmonic.problem.result import MapResult, Status, Step
from quasiharmonic.problem.run import Run
from quasiharmonic.solver.field.objective import Objective
from quasiharmonic.solver.search.harmonic_descent import Conformal, HarmonicDescent, Harmonised
from quasiharmonic.util.arrays import (
    FloatArray,
    IntArray,
    describe,
    map_array,
    names_of,
    real_array,
)
from quasiharmonic.util.hints import suggest
from quasiharmonic.util.options import HarmoniseOptions, takes
from quasiharmonic.util.progress import reports_progress


def _without_mesh(energy: Energy) -> Callable[[FloatArray, IntArray], Energy]:
    """Return a function of the rest mesh that returns an energy which does not depend on it."""
    return lambda V, F: energy


#: Energies by name, those of `polish` included: each entry makes its energy from the rest mesh.
ENERGIES: dict[str, Callable[[FloatArray, IntArray], Energy]] = {
    "arap": lambda V, F: ARAP(),
    "arap-unsigned": lambda V, F: UnsignedARAP(),
    "area": lambda V, F: AreaPreserving(),
    "springs": MassSpring,
    **{name: _without_mesh(energy) for name, energy in polishing.ENERGIES.items()},
}
#: η of each round. Barriers keep the map injective by themselves; for other energies V₃ must dominate at the end.
BARRIER_ETA = (0.1, 1.0, 1.0, 1.0)
ETA = (0.1, 0.1, 0.01, 0.001)


class HarmoniseKeywords(TypedDict, total=False):
    """Types of the options of `harmonise`."""

    energy: str | Energy | None
    eta: float | Sequence[float] | None
    conformal: float
    weights: ArrayLike | None
    scaled: bool
    max_iterations: int
    tol: float
    reference: Reference
    linear_solver: str
    callback: Callable[[Step], object] | None


@accepts_mesh
@reports_progress
@takes(HarmoniseOptions, HarmoniseKeywords)
def harmonise(
    V: ArrayLike, F: ArrayLike, uv: ArrayLike, *, fixed: ArrayLike | None = None, **options: Unpack[HarmoniseKeywords]
) -> MapResult:
    """Lower any distortion energy within the injective maps, by quasi-harmonisation (§11).

    Use it for energies that are finite for inverted triangles and for energies without second derivatives. For barriers
    with second derivatives `quasiharmonic.polish` is faster.

    Parameters
    ----------
    V : (n, 2) or (n, 3) array, or a mesh in place of ``V`` and ``F``
        Rest positions.
    F : (f, 3) array of int
        Triangles.
    uv : (n, 2) array
        Initial map, for instance from `quasiharmonic.injective_map`. It must be injective only if the energy is a
        barrier.
    fixed : (k,) array of int, optional
        Fixed vertices, which keep exactly their positions in ``uv``: the whole boundary and any pins. Default: the
        boundary.
    energy : str, Energy or None
        E, the mean over the surface's area:

        - ``"arap"``: (σ₁ − 1)² + (σ₂ − 1)², as rigid as possible, with σ₂ < 0 for inverted triangles;
        - ``"arap-unsigned"``: the same with σ₂ ≥ 0 as in the paper; inversion has no cost;
        - ``"area"``: (σ₁σ₂ − 1)², areas only;
        - ``"springs"``: (l − l⁰)² summed over the mesh's edges;
        - the barriers ``"symmetric-dirichlet"``, ``"mips"``, ``"blend"`` and ``"arap-barrier"`` of `polish`.

        Or any `Energy`. None lowers R₁ alone: MIPS for injective maps, but finite for other maps.
    eta : float or sequence of float, optional
        η in ``V₃/|Ω| + η (E + κ R₁)``, one value per round. Default: four rounds that end at 1 for barriers and at
        0.001 for other energies. (The paper uses 1e-4 throughout.)
    conformal : float
        κ, the weight of the regulariser R₁ (eq. 35). A small value keeps triangles from collapsing.
    weights : (f,) array, optional
        Weight of each triangle's distortion in E; not negative, default 1. R₁ is not weighted, so it keeps triangles of
        weight 0 from collapsing.
    scaled : bool
        If True, compare lengths and areas after scaling the map to the surface's area. If False, compare them unscaled,
        so that weighted triangles can keep their size while the others fill the remaining area.
    max_iterations : int
        Maximum number of linear solves per round.
    tol : float
        A round has converged if ten steps lower its objective by less than this fraction. Not negative.
    reference : {"equilateral", "rest", "corrected"}
        Reference triangles of V₃ and R₁. R₁ measures the surface's angles only with ``"rest"``.
    linear_solver : str
        ``"auto"`` or one of `quasiharmonic.linsolve.available`.
    callback : callable, optional
        Called with a `Step` at every map, whose ``energy`` is E + κR₁. It is called with the last `Step` again at least
        every half second in between, but not within a single factorisation.

    Returns
    -------
    MapResult
        The certified injective map of least E + κR₁ found, ``uv`` included. The status is ``POLISHED`` if the last
        round converged and ``STILL_FALLING`` if not. It is ``UNIMPROVED`` if no injective map was better than ``uv``
        and ``INTERRUPTED`` after Ctrl-C. If no map was injective, the result is the map with the fewest inverted
        triangles. Its status is ``IMPOSSIBLE`` if the ``diagnosis`` forbids an injective map, and otherwise
        ``STALLED``. The history holds E + κR₁ of every map.

    Raises
    ------
    ValueError
        If the input is malformed (see `Problem`), an option is invalid, or a rest triangle has no area. If the energy
        is a barrier and ``uv`` is not injective. If a user-defined energy or its first derivative is NaN or infinite
        at the start of a round. The message names the triangles.

    See Also
    --------
    polish : Faster for barriers with second derivatives.
    distortion : Measures the distortion.
    quasiharmonic.atlas.harmonise : Every island of a mesh with seams.

    Examples
    --------
    Equalise the areas of a disk whose triangles are crowded at the centre:

    >>> import numpy as np
    >>> from quasiharmonic import distortion
    >>> from quasiharmonic.surfaces import disk
    >>> V, F = disk(6)
    >>> crowded = V * np.linalg.norm(V, axis=1, keepdims=True)
    >>> result = harmonise(V, F, crowded, energy="area")
    >>> result.injective, bool(distortion(V, F, result.uv).area_ratio.std() < 0.1)
    (True, True)
    """
    began = time.perf_counter()
    domain = Domain(V, F, fixed)
    domain.check_boundary_fixed()
    checked = HarmoniseOptions(**options)
    if checked.energy is None and checked.reference == "rest":
        domain.check_areas()
    return replace(harmonise_map(domain, uv, checked), seconds=time.perf_counter() - began)


def harmonise_map(domain: Domain, uv: ArrayLike, options: HarmoniseOptions) -> MapResult:
    """Quasi-harmonise a map of a `Domain`; results and errors as in `harmonise`.

    The domain's ``fixed`` vertices keep their positions in ``uv``.
    """
    run = Run(options.callback)
    chosen = _find_energy(options.energy, domain)
    barrier = chosen is not None and chosen.barrier
    reference = cast("Reference", options.reference)
    schedule = _eta_schedule(options.eta, barrier)
    if chosen is None and options.conformal == 0:
        raise ValueError("conformal must be positive if energy is None, not 0")
    if options.weights is not None and chosen is None:
        raise ValueError("weights belong to the energy, but energy is None")
    start = map_array("uv", uv, domain.n)
    inverted = inverted_triangles(domain.F, start)
    if barrier and inverted.size:
        raise ValueError(
            f"uv is not injective: {names_of('triangle', 'triangles', inverted)} inverted or degenerate, where "
            "this energy is infinite; repair the map first (repair; qhm repair), or use an energy without a barrier"
        )
    name = options.energy if isinstance(options.energy, str) else "R₁" if chosen is None else type(chosen).__name__
    problem = Problem.on(domain, start[domain.fixed])
    with problem.exclusive() as own, np.errstate(all="ignore"):
        area = float(signed_areas(own.F, own.frame.inward(start)).sum())
        if not area > 0:
            raise ValueError(
                "the boundary encloses no area in uv, or has the wrong orientation: reflect uv, or map the boundary "
                "again"
            )
        deformation = None
        if chosen is not None:
            # The map is in the frame's unit. Scale the surface accordingly so that both compare as in the caller's
            # units.
            V, scaled_to = (own.V, area) if options.scaled else (own.frame.lengths(own.V), None)
            deformation = DeformationEnergy(V, own.F, chosen, area=scaled_to, weights=options.weights)
        objective = Objective(own, "dirichlet", "tanh", reference, options.linear_solver)
        regulariser = Conformal(objective.mesh.m / objective.mesh.m.sum())

        def descend(eta: float) -> Harmonised:
            return Harmonised(own, objective.mesh, area, deformation, regulariser, eta=eta, conformal=options.conformal)

        descent = HarmonicDescent(objective, descend, start, run)
        first, status = descent.best, Status.STILL_FALLING
        with run.until_interrupted():
            run.record(*first)
            for values in (schedule, len(schedule) * schedule[-1:]):
                for value in values:
                    stage = f"harmonise, {name}, η = {value:g}"
                    at_minimum = descent.run(stage, value, options.max_iterations, options.tol)
                    status = Status.POLISHED if at_minimum else Status.STILL_FALLING
                done = descent.untangle() and (descent.best < first or status is Status.POLISHED)
                if done or values == len(schedule) * schedule[-1:]:
                    break
                # The schedule's long steps left inverted triangles that could not be untangled, or the result is worse
                # than the initial map. Restart from the best map with the last η alone.
                descent.return_to_best()
    result = run.result(descent.uv, domain.F, status, linear_solver=objective.laplacian.solver.name, V=domain.V)
    with run.until_interrupted():
        converged = status is Status.POLISHED and run.history[-1].inverted == 0
        if not result.injective and not run.interrupted:
            diagnosis = diagnose(problem)
            status = Status.IMPOSSIBLE if diagnosis.forbids_injective else Status.STALLED
            result = replace(result, diagnosis=diagnosis)
        elif not (descent.best < first or converged):
            status = Status.UNIMPROVED
    return replace(result, status=Status.INTERRUPTED if run.interrupted else status, seconds=run.seconds)


def _find_energy(energy: str | Energy | None, domain: Domain) -> Energy | None:
    """Return the named energy for this mesh, or the given energy itself."""
    if energy is None or isinstance(energy, Energy):
        return energy
    if not isinstance(energy, str) or energy not in ENERGIES:
        near = suggest(energy, ENERGIES)
        raise ValueError(
            f"energy must be one of {', '.join(ENERGIES)}, an Energy or None, not {describe(energy)}{near}"
        )
    return ENERGIES[energy](domain.V, domain.F)


def _eta_schedule(eta: float | Sequence[float] | None, barrier: bool) -> tuple[float, ...]:
    if eta is None:
        return BARRIER_ETA if barrier else ETA
    schedule = np.atleast_1d(real_array("eta", eta))
    if schedule.ndim != 1 or not schedule.size or not np.all((schedule > 0) & (schedule < np.inf)):
        raise ValueError(f"eta must be a positive number, or one for each round, not {eta!r}")
    return tuple(float(value) for value in schedule)
