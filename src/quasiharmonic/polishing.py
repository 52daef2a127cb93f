"""Less distortion without leaving the injective maps: projected Newton from a map that is injective (§10, §11).

    assemble ──▶ factor ──▶ direction ──▶ t = min(1, 0.9 × first collapse) ──▶ less energy? ──▶ injective, exactly?
       ▲                                          │ ▲            no: t/2 ◀──────────┴────────────────┘ yes
       └──────────────────────────────────────────┼─┴── t = 1 went well: 2t, 4t, … as long as the energy falls
                                                  └── next map

The second derivative of the energy is made positive definite triangle by triangle, in closed form
(`quasiharmonic.energies`). While collapsing triangles cut the steps short, negative eigenvalues enter with
their absolute values, which aims less far and gets further; afterwards they are clamped at zero, which
converges faster.
"""

from __future__ import annotations

import time
from collections.abc import Callable

import numpy as np
from numpy.typing import ArrayLike, NDArray

from quasiharmonic.certificate import certify, flipped_triangles, is_injective
from quasiharmonic.deformation_energy import DeformationEnergy, signed_areas
from quasiharmonic.energies import (
    ARAP,
    MIPS,
    AreaBarrier,
    Combination,
    Energy,
    SymmetricDirichlet,
    conformal_area_blend,
)
from quasiharmonic.linsolve import NotPositiveDefinite
from quasiharmonic.mesh.topology import named
from quasiharmonic.newton_system import NewtonSystem
from quasiharmonic.problem import Problem
from quasiharmonic.result import MapResult, Stage, Status, Step

FloatArray = NDArray[np.float64]
ComplexArray = NDArray[np.complex128]

#: What a polish can lower, by name. ARAP gets a tenth of the area barrier: alone it lets triangles collapse.
ENERGIES: dict[str, Energy] = {
    "symmetric-dirichlet": SymmetricDirichlet(),
    "mips": MIPS(),
    "blend": conformal_area_blend(),
    "arap": Combination((1.0, ARAP()), (0.1, AreaBarrier())),
}

# Of the step at which the first triangle would collapse.
_FRACTION = 0.9
# Of the decrease that the gradient promises (Armijo's condition).
_SUFFICIENT = 1e-4
# The step is halved, and then doubled, this often before the direction is given up.
_HALVINGS = 30
# Raised diagonals, one after the other until a factorisation exists. Rounding alone moves the eigenvalues
# by the first, and where triangles span many orders of magnitude they are as small as that.
_SHIFTS = 1e-15, 1e-12, 1e-9, 1e-6, 1e-3
# A step that lowers the energy by less than this part of the tolerance is idle; after so many in a row the
# map has come to rest short of convergence.
_IDLE, _PATIENCE = 1e-2, 3
# A mean energy this small is rounding: the map is an isometry, or a similarity.
_NOTHING = 1e-12


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
) -> MapResult:
    """Lower the distortion of an injective map; every step on the way is injective, certified exactly.

    Parameters
    ----------
    V : (n, 2) or (n, 3) array
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
          with `quasiharmonic.energies.conformal_area_blend`.
        - ``"arap"``: (σ₁ − 1)² + (σ₂ − 1)² and a tenth of det J + 1/det J, rigid where it can be.

        Or any `Energy` that is a barrier and has second derivatives. Lengths and areas are compared after
        scaling the map to the surface's area.
    weights : (f,) array, optional
        How much each triangle's distortion counts; positive, 1 by default.
    max_iterations : int
        Newton steps at most.
    tolerance : float
        The polish has converged when Newton's model promises a further decrease below this fraction of the
        energy (half the squared Newton decrement over the energy).
    linear_solver : str
        ``"auto"`` or one of `quasiharmonic.linsolve.available`.
    callback : callable, optional
        Called with a `Step` at the start and after every step; its ``energy`` is the mean energy.

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
        the message names the triangles. When the energy is not known or not a barrier.

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
    # Where the fixed vertices are does not matter to the checks; where they are is where ``uv`` has them.
    problem = Problem(V, F, fixed, np.zeros((np.size(fixed), 2)), reference="equilateral")
    return polish_map(
        problem,
        uv,
        energy=energy,
        weights=weights,
        max_iterations=max_iterations,
        tolerance=tolerance,
        linear_solver=linear_solver,
        callback=callback,
        _began=began,
    )


def polish_map(
    problem: Problem,
    uv: ArrayLike,
    *,
    energy: str | Energy = "symmetric-dirichlet",
    weights: ArrayLike | None = None,
    max_iterations: int = 200,
    tolerance: float = 1e-4,
    linear_solver: str = "auto",
    callback: Callable[[Step], object] | None = None,
    _began: float | None = None,
) -> MapResult:
    """Polish a map of a `Problem` at hand; the rest as `polish` has it.

    The problem's ``fixed`` vertices stay where they are in ``uv``; its ``target`` is not looked at.
    """
    began = time.perf_counter() if _began is None else _began
    chosen = energy_named(energy)
    start = _start(problem, uv)
    if weights is not None and not np.all(np.asarray(weights) > 0):
        bad = np.flatnonzero(~(np.asarray(weights) > 0))
        raise ValueError(f"the weight is not positive at {named('triangle', 'triangles', bad)}")
    # What leaves the numbers' range is met by comparisons: it is never below anything.
    with np.errstate(all="ignore"):
        descent = _Descent(problem, start, chosen, weights, linear_solver)
    history: list[Step] = []

    def report() -> None:
        history.append(Step(len(history), 0, descent.value))
        if callback is not None:
            callback(history[-1])

    status = Status.STILL_FALLING
    try:
        report()
        for _ in range(max_iterations):
            with np.errstate(all="ignore"):
                outcome = descent.step(tolerance)
            report()
            if outcome is not None:
                status = outcome
                break
    except KeyboardInterrupt:
        status = Status.INTERRUPTED
    uv = descent.positions(descent.w)
    certificate = certify(problem.F, uv)
    seconds = time.perf_counter() - began
    name = energy if isinstance(energy, str) else type(energy).__name__
    stage = Stage(
        name=f"polish, {name}",
        iterations=max(len(history) - 1, 0),
        seconds=seconds,
        flipped=(0, 0),
        energy=(descent.first, descent.value),
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
    )


def energy_named(energy: str | Energy) -> Energy:
    """Look an energy up by its name, and refuse what a polish cannot lower."""
    if isinstance(energy, str):
        if energy not in ENERGIES:
            raise ValueError(f"energy must be one of {', '.join(ENERGIES)}, or an Energy, not {energy!r}")
        return ENERGIES[energy]
    if not isinstance(energy, Energy):
        raise ValueError(f"energy must be one of {', '.join(ENERGIES)}, or an Energy, not {energy!r}")
    if not energy.barrier:
        raise ValueError(
            f"{type(energy).__name__} is no barrier: it would let the first triangles collapse and stop there; "
            "combine it with an energy that is one, such as AreaBarrier"
        )
    return energy


def _start(problem: Problem, uv: ArrayLike) -> FloatArray:
    """The start as float64, checked."""
    start = np.array(uv, dtype=np.float64)
    if start.shape != (problem.n, 2):
        raise ValueError(f"uv must have shape ({problem.n}, 2), a position for every vertex, not {start.shape}")
    broken = np.flatnonzero(~np.isfinite(start).all(axis=1))
    if broken.size:
        raise ValueError(f"uv is not finite at {named('vertex', 'vertices', broken)}")
    flipped = flipped_triangles(problem.F, start)
    if flipped.size:
        raise ValueError(
            f"uv is not injective: {named('triangle', 'triangles', flipped)} inverted or without area; "
            "a polish starts from an injective map"
        )
    return start


class _Descent:
    """The map at hand and how to get to the next."""

    def __init__(
        self, problem: Problem, uv: FloatArray, energy: Energy, weights: ArrayLike | None, linear_solver: str
    ) -> None:
        self._F = problem.F
        self._fixed, self._pinned = problem.fixed, uv[problem.fixed]
        # Products of coordinates must not leave the numbers' range. A power of two costs no digits.
        self._exponent = int(np.frexp(np.abs(uv).max())[1])
        self.w: ComplexArray = np.ldexp(uv, -self._exponent).view(np.complex128).ravel()
        self.energy = DeformationEnergy(
            problem.V, problem.F, energy, area=float(signed_areas(problem.F, self.w).sum()), weights=weights
        )
        self.system = NewtonSystem(problem.F, self.energy.g, problem.n, problem.fixed, linear_solver)
        self._deformation = self.energy.deform(self.w)
        self.value = self.first = self.energy.value_of(self._deformation)
        self._cut = True
        self._idle = 0

    def positions(self, w: ComplexArray) -> FloatArray:
        """A map as the caller gets it, the fixed vertices to the last bit."""
        uv = np.ldexp(w.view(np.float64).reshape(-1, 2), self._exponent)
        uv[self._fixed] = self._pinned
        return uv

    def step(self, tolerance: float) -> Status | None:
        """Take one step; a status where there is no other to take."""
        gradient = self.energy.gradient_of(self._deformation, self.w.size)[self.system.free]
        # While steps are cut short, reflect negative eigenvalues; a step in full says that clamping will do.
        for negative in (-1.0, 0.0) if self._cut else (0.0, -1.0):
            direction, promise, newton = self._direction(gradient, negative)
            small = newton and 0.5 * promise <= tolerance * (self.value + _NOTHING)
            if small and negative < 0 and self._cut:
                continue  # the reflected model is pessimistic: only the clamped one may declare an end
            before = self.value
            moved = self._search(direction, promise)
            if small and negative == 0:
                return Status.POLISHED
            if moved:
                self._idle = 0 if before - self.value > _IDLE * tolerance * before else self._idle + 1
                return Status.EXHAUSTED if self._idle >= _PATIENCE else None
        return Status.EXHAUSTED

    def _direction(self, gradient: ComplexArray, negative: float) -> tuple[ComplexArray, float, bool]:
        """Newton's direction, the rate at which the energy falls along it (the squared decrement), and True;
        or, where no factorisation exists, the gradient over the diagonal, its rate, and False.
        """
        self.system.assemble(self.energy.curvature_of(self._deformation, negative=negative))
        for shift in _SHIFTS:
            try:
                self.system.factor(shift)
                direction = self.system.solve(-gradient)
            except NotPositiveDefinite:
                continue
            promise = -_dot(gradient, direction)
            if promise >= 0:
                return direction, promise, True
        direction = self.system.solve_diagonal(-gradient)
        return direction, -_dot(gradient, direction), False

    def _search(self, direction: ComplexArray, promise: float) -> bool:
        """Move along a direction, as far as is good; False where no step lowers the energy enough."""
        if not promise > 0:
            return False
        full = np.zeros_like(self.w)
        full[self.system.free] = direction
        limit = _FRACTION * float(self.energy.steps_to_collapse(self.w, full).min())
        start, before = self.w, self.value
        longest = min(1.0, limit)
        halved = longest * 0.5 ** np.arange(_HALVINGS)
        # Where a triangle's area is all rounding, Newton's step is shorter than the spacing of the numbers.
        doubled = 2.0 ** np.arange(1, _HALVINGS)
        for t in (*halved, *doubled[doubled <= limit]):
            if self._accept(start + t * full, before - _SUFFICIENT * min(t, 1.0) * promise):
                break
        else:
            return False
        self._cut = t < 1
        # Far from the minimum, barriers fall by powers and Newton's step is several times too short.
        while t >= 1 and 2 * t <= limit and self._accept(start + 2 * t * full, self.value):
            t *= 2
        return True

    def _accept(self, w: ComplexArray, bound: float) -> bool:
        """Go there if the energy is below a bound and every triangle, exactly, positive."""
        deformation = self.energy.deform(w)
        value = self.energy.value_of(deformation)
        if not (value < bound and is_injective(self._F, self.positions(w))):
            return False
        self.w, self._deformation, self.value = w, deformation, value
        return True


def _dot(a: ComplexArray, b: ComplexArray) -> float:
    return float(np.sum(a.real * b.real + a.imag * b.imag))
