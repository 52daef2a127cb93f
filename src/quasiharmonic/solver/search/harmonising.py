"""Lower any distortion energy within the injective maps by quasi-harmonisation (§11).

The energy may be finite for inverted triangles.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import get_args

import numpy as np
from numpy.typing import ArrayLike

from quasiharmonic.energies.deformation import DeformationEnergy, signed_areas
from quasiharmonic.energies.energies import ARAP, MIPS, AreaPreserving, Energy, SymmetricDirichlet, UnsignedARAP
from quasiharmonic.energies.springs import MassSpring
from quasiharmonic.geometry.exact.certificate import certify, inverted_triangles
from quasiharmonic.geometry.mesh.reference import Reference
from quasiharmonic.io.adapters.accepts_mesh import accepts_mesh
from quasiharmonic.problem import Domain, Problem
from quasiharmonic.problem.diagnosis import diagnose
from quasiharmonic.problem.result import MapResult, Status, Step
from quasiharmonic.solver.field.objective import Objective
from quasiharmonic.solver.field.regularisers import Conformal
from quasiharmonic.solver.search.harmonic_descent import HarmonicDescent
from quasiharmonic.solver.search.harmonised import Harmonised
from quasiharmonic.util.arrays import (
    FloatArray,
    IntArray,
    check_callback,
    check_choice,
    kind_of,
    map_array,
    named,
    not_negative,
    real_array,
    true_or_false,
    whole_number,
)
from quasiharmonic.util.progress import reports_progress

#: Energies by name: each entry makes its energy from the rest mesh.
ENERGIES: dict[str, Callable[[FloatArray, IntArray], Energy]] = {
    "arap": lambda V, F: ARAP(),
    "arap-unsigned": lambda V, F: UnsignedARAP(),
    "area": lambda V, F: AreaPreserving(),
    "springs": MassSpring,
    "mips": lambda V, F: MIPS(),
    "symmetric-dirichlet": lambda V, F: SymmetricDirichlet(),
}
#: η of each round. Barriers keep the map injective by themselves; for other energies V₃ must dominate at the end.
BARRIER_ETA = (0.1, 1.0, 1.0, 1.0)
ETA = (0.1, 0.1, 0.01, 0.001)


@accepts_mesh
@reports_progress
def harmonise(
    V: ArrayLike,
    F: ArrayLike,
    uv: ArrayLike,
    *,
    fixed: ArrayLike,
    energy: str | Energy | None = "arap",
    eta: float | Sequence[float] | None = None,
    conformal: float = 1e-3,
    weights: ArrayLike | None = None,
    scaled: bool = True,
    max_iterations: int = 40,
    tolerance: float = 1e-3,
    reference: Reference = "rest",
    linear_solver: str = "auto",
    callback: Callable[[Step], object] | None = None,
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
    fixed : (k,) array of int
        Fixed vertices, which keep exactly their positions in ``uv``: the whole boundary and any pins.
    energy : str, Energy or None
        E, the mean over the surface's area:

        - ``"arap"``: (σ₁ − 1)² + (σ₂ − 1)², as rigid as possible, with σ₂ < 0 for inverted triangles;
        - ``"arap-unsigned"``: the same with σ₂ ≥ 0 as in the paper; inversion has no cost;
        - ``"area"``: (σ₁σ₂ − 1)², areas only;
        - ``"springs"``: (l − l⁰)² summed over the mesh's edges;
        - ``"mips"``: σ₁/σ₂ + σ₂/σ₁ − 2, angles only;
        - ``"symmetric-dirichlet"``: σ₁² + σ₂² + σ₁⁻² + σ₂⁻² − 4, lengths.

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
    tolerance : float
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

    Examples
    --------
    Equalise the areas of a disk whose triangles are crowded at the centre:

    >>> import numpy as np
    >>> from quasiharmonic import distortion
    >>> from quasiharmonic.surfaces import disk
    >>> V, F = disk(6)
    >>> crowded = V * np.linalg.norm(V, axis=1, keepdims=True)
    >>> result = harmonise(V, F, crowded, fixed=np.arange(len(V) - 36, len(V)), energy="area")
    >>> result.injective, bool(distortion(V, F, result.uv).area_ratio.std() < 0.1)
    (True, True)
    """
    began = time.perf_counter()
    domain = Domain(V, F, fixed)
    domain.check_boundary_fixed()
    if energy is None and reference == "rest":
        domain.check_areas()
    result = harmonise_map(
        domain,
        uv,
        energy=energy,
        eta=eta,
        conformal=conformal,
        weights=weights,
        scaled=scaled,
        max_iterations=max_iterations,
        tolerance=tolerance,
        reference=reference,
        linear_solver=linear_solver,
        callback=callback,
    )
    return replace(result, seconds=time.perf_counter() - began)


@reports_progress
def harmonise_map(
    domain: Domain,
    uv: ArrayLike,
    *,
    energy: str | Energy | None = "arap",
    eta: float | Sequence[float] | None = None,
    conformal: float = 1e-3,
    weights: ArrayLike | None = None,
    scaled: bool = True,
    max_iterations: int = 40,
    tolerance: float = 1e-3,
    reference: Reference = "rest",
    linear_solver: str = "auto",
    callback: Callable[[Step], object] | None = None,
) -> MapResult:
    """Quasi-harmonise a map of a `Domain`; see `harmonise` for the options.

    The domain's ``fixed`` vertices keep their positions in ``uv``.
    """
    began = time.perf_counter()
    chosen = _energy(energy, domain)
    barrier = chosen is not None and chosen.barrier
    schedule = _schedule(eta, barrier)
    not_negative("conformal", conformal)
    if chosen is None and conformal == 0:
        raise ValueError("conformal must be positive if energy is None, not 0")
    if weights is not None and chosen is None:
        raise ValueError("weights belong to the energy, but energy is None")
    check_choice("reference", reference, get_args(Reference))
    whole_number("max_iterations", max_iterations, least=1)
    not_negative("tolerance", tolerance)
    true_or_false("scaled", scaled)
    check_callback(callback)
    start = map_array("uv", uv, domain.n)
    inverted = inverted_triangles(domain.F, start)
    if barrier and inverted.size:
        raise ValueError(
            f"uv is not injective: {named('triangle', 'triangles', inverted)} inverted or degenerate, where "
            "this energy is infinite; start from an injective map, or lower R₁ (energy=None)"
        )
    name = energy if isinstance(energy, str) else "R₁" if energy is None else type(energy).__name__
    problem = Problem.on(domain, start[domain.fixed])
    with problem.exclusive() as own, np.errstate(all="ignore"):
        area = float(signed_areas(own.F, own.frame.inward(start)).sum())
        if not area > 0:
            raise ValueError("the boundary encloses no area in uv, or has the wrong orientation")
        deformation = None
        if chosen is not None:
            # The map is in the frame's unit. Scale the surface accordingly so that both compare as in the caller's
            # units.
            V, asked = (own.V, area) if scaled else (own.frame.lengths(own.V), None)
            deformation = DeformationEnergy(V, own.F, chosen, area=asked, weights=weights)
        objective = Objective(own, "dirichlet", "tanh", reference, linear_solver)
        regulariser = Conformal(objective.mesh.m / objective.mesh.m.sum())

        def descended(eta: float) -> Harmonised:
            return Harmonised(own, objective.mesh, area, deformation, regulariser, eta=eta, conformal=conformal)

        descent = HarmonicDescent(objective, descended, start, callback)
        first, status = descent.best, Status.STILL_FALLING
        try:
            for values in (schedule, len(schedule) * schedule[-1:]):
                for value in values:
                    rest = descent.run(f"harmonise, {name}, η = {value:g}", value, max_iterations, tolerance)
                    status = Status.POLISHED if rest else Status.STILL_FALLING
                done = descent.right() and (descent.best < first or status is Status.POLISHED)
                if done or values == len(schedule) * schedule[-1:]:
                    break
                # The schedule's long steps left inverted triangles that could not be untangled, or the result is worse
                # than the initial map. Restart from the best map with the last η alone.
                descent.back()
        except KeyboardInterrupt:
            status = Status.INTERRUPTED
    certificate = certify(domain.F, descent.uv)
    diagnosis = None
    if status is not Status.INTERRUPTED:
        converged = status is Status.POLISHED and descent.history[-1].inverted == 0
        if not certificate.injective:
            try:
                diagnosis = diagnose(problem)
                status = Status.IMPOSSIBLE if diagnosis.forbids_injective else Status.STALLED
            except KeyboardInterrupt:
                status = Status.INTERRUPTED
        elif not (descent.best < first or converged):
            status = Status.UNIMPROVED
    return MapResult(
        uv=descent.uv,
        status=status,
        certificate=certificate,
        stages=descent.stages,
        history=descent.history,
        diagnosis=diagnosis,
        linear_solver=objective.laplacian.solver.name,
        seconds=time.perf_counter() - began,
        V=domain.V,
    )


def _energy(energy: str | Energy | None, domain: Domain) -> Energy | None:
    """Return the named energy for this mesh, or the given energy itself."""
    if energy is None or isinstance(energy, Energy):
        return energy
    if energy not in ENERGIES:
        raise ValueError(f"energy must be one of {', '.join(ENERGIES)}, an Energy or None, not {kind_of(energy)}")
    return ENERGIES[energy](domain.V, domain.F)


def _schedule(eta: float | Sequence[float] | None, barrier: bool) -> tuple[float, ...]:
    if eta is None:
        return BARRIER_ETA if barrier else ETA
    schedule = np.atleast_1d(real_array("eta", eta))
    if schedule.ndim != 1 or not schedule.size or not np.all((schedule > 0) & (schedule < np.inf)):
        raise ValueError(f"eta must be a positive number, or one for each round, not {eta!r}")
    return tuple(float(value) for value in schedule)
