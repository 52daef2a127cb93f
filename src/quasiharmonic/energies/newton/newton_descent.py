"""Projected Newton descent of an energy; the map after every step is injective (§10, §11).

::

    assemble ──▶ factor ──▶ direction ──▶ t = min(1, 0.9 × first collapse) ──▶ less energy? ──▶ injective, exactly?
       ▲                                          │ ▲            no: t/2 ◀──────────┴────────────────┘ yes
       └──────────────────────────────────────────┼─┴── t = 1 went well: 1.5t, … as long as the energy falls
                                                  └── next map

The second derivative of the energy is made positive definite triangle by triangle, in closed form
(`quasiharmonic.energies.energies`). While collapsing triangles shorten the steps, negative eigenvalues are replaced by
their absolute values, which allows longer steps. Afterwards they are clamped to zero, which converges faster.

`NewtonDescent` decides how to step. What is minimised, and along which paths a map moves, is in a `MapModel`.

In an `IteratedDescent`, conjugate gradients replace some factorisations. Far from the minimum, the error of a map that
was prolonged from a coarse mesh is mostly local. A few iterations without a factor remove it, in a tenth of the time of
a factorisation. Close to the minimum the second derivatives hardly change, so a few iterations with the last factor
suffice for the last steps. Close to an isometry, iterations with a Laplacian replace all factorisations. It has one
unknown per vertex and not two, so its factor takes an eighth of the time and a quarter of the memory.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from quasiharmonic.energies.newton.map_model import Coordinates, MapModel, NewtonObjective, NewtonState, in_units
from quasiharmonic.energies.newton.newton_system import NewtonSystem
from quasiharmonic.linsolve import NotPositiveDefinite
from quasiharmonic.problem.result import Status
from quasiharmonic.util.arrays import ComplexArray, FloatArray, IntArray, work

# Relative increases of the diagonal, tried in turn until a factorisation exists. Rounding alone changes the eigenvalues
# by about the first. They can be this small where triangle sizes span many orders of magnitude.
SHIFTS = 1e-15, 1e-12, 1e-9, 1e-6, 1e-3
# A step that lowers the energy by less than this factor times the tolerance is idle.
_IDLE_GAIN = 1e-2
# After this many successive idle steps the descent has stalled.
_MAX_IDLE = 3
# If a step with an expected decrease below the tolerance gains more than this multiple of it, the model is
# pessimistic and the map has not converged.
_PESSIMISTIC_GAIN = 4.0
# A mean energy this small is rounding error: the map is an isometry or a similarity.
_ZERO_ENERGY = 1e-12
# Above this mean energy, clamping may increase the second derivatives so much that the expected decrease is far too
# low. The error is about the energy: a factor of a thousand for a stretch of thirty.
_STRETCHED_ENERGY = 100.0


class IterationTuning(NamedTuple):
    """Numbers that tune the iterations that replace factorisations."""

    # From this number of vertices on, iterations replace factorisations below this mean energy.
    min_vertices: int = 10_000
    max_energy: float = 1.0
    # Maximum number of iterations with the factor of an earlier step, and of iterations without a factor.
    max_reused: int = 8
    max_smoothing: int = 30
    # Maximum number of iterations with a Laplacian. If they do not suffice, the descent factors from then on.
    max_near: int = 20
    # Iterations without a factor continue as long as they lower the energy to at most this fraction.
    smoothed: float = 0.5
    # Factors of earlier steps serve if the decrease of the last step differs by at most this fraction from the expected
    # one, as the second derivatives have then hardly changed.
    unexpected: float = 0.3
    # Maximum decrease that iterations leave, as a fraction of the decrease that they found.
    residual: float = 1e-2
    # Iterations of the last steps also end at this fraction of the decrease at which the descent has converged.
    negligible: float = 0.1


_ITERATION = IterationTuning()


#: See `RotationPath.inverse_near`.
InverseNear = Callable[[FloatArray], Callable[[ComplexArray], ComplexArray]]


@dataclass(frozen=True)
class StepMemory:
    """Outcome of the last steps, for the choice of the next.

    Attributes
    ----------
    shortened : bool
        Whether the last step was shortened.
    shift : int
        Index of the last shift in ``SHIFTS``.
    idle : int
        Number of successive idle steps.
    """

    shortened: bool = True
    shift: int = 0
    idle: int = 0


class NewtonDescent:
    """A Newton descent: the current state and the computation of the next.

    ``model`` has evaluated ``state``. ``first`` is the objective at the start, ``memory`` the outcome of the last
    steps.
    """

    def __init__(self, model: MapModel, state: NewtonState) -> None:
        self.model, self.state = model, state
        self.first = state.value
        self.memory = StepMemory()

    @property
    def w(self) -> ComplexArray:
        """The current map (n,) complex128, in the model's unit."""
        return self.state.w

    @property
    def value(self) -> float:
        """The current objective."""
        return self.state.value

    def restart(self, model: MapModel, state: NewtonState) -> None:
        """Continue with another model."""
        self.model, self.state, self.memory = model, state, StepMemory()

    def descend(self, steps: int, tol: float) -> Iterator[Status | None]:
        """Take at most ``steps`` steps and yield the result of `step` after each; stop at the first status."""
        outcome = None
        while outcome is None and steps > 0:
            # Overflow gives inf or NaN. Steps with either are never accepted.
            with np.errstate(all="ignore"):
                outcome = self.step(tol)
            steps -= 1
            yield outcome

    def step(self, tol: float) -> Status | None:
        """Take one step; return a status if no further step is possible."""
        tol *= self.model.slack
        state = self.state = self.model.prepare(self.state)
        if not np.isfinite(state.value):
            self.model.check_numbers(state)
        gradient = self.model.gradient(state)
        # While steps are shortened, reflect negative eigenvalues. After a full step, clamp them.
        for negative in (-1.0, 0.0) if self.memory.shortened else (0.0, -1.0):
            direction, expected_decrease, newton = self._direction(gradient, negative)
            small = newton and 0.5 * expected_decrease <= tol * (state.value + _ZERO_ENERGY)
            if small and negative < 0 and self.memory.shortened:
                continue  # the reflected model is pessimistic: only the clamped one may report convergence
            if small and negative == 0 and state.value > _STRETCHED_ENERGY:
                # The unmodified model decides, if it has a minimum within double precision.
                exact, exact_decrease, newton = self._direction(gradient, 1.0, SHIFTS[:1])
                if not newton:
                    self._search(direction, expected_decrease)
                    return Status.EXHAUSTED
                direction, expected_decrease, small = exact, exact_decrease, 0.5 * exact_decrease <= tol * state.value
            moved = self._search(direction, expected_decrease)
            gain = state.value - self.state.value
            if small and negative == 0 and not gain > _PESSIMISTIC_GAIN * tol * (state.value + _ZERO_ENERGY):
                return Status.POLISHED
            if moved:
                idle = 0 if gain > _IDLE_GAIN * tol * (state.value + _ZERO_ENERGY) else self.memory.idle + 1
                self.memory = replace(self.memory, idle=idle)
                return Status.EXHAUSTED if idle >= _MAX_IDLE else None
        self.model.check_numbers(self.state)
        return Status.EXHAUSTED

    def _direction(
        self, gradient: ComplexArray, negative: float, shifts: tuple[float, ...] = SHIFTS
    ) -> tuple[ComplexArray, float, bool]:
        """Return Newton's direction, its expected decrease (the squared Newton decrement), and True.

        If no factorisation exists, return the negative gradient divided by the diagonal, its expected decrease, and
        False.
        """
        model, state = self.model, self.state
        model.assemble(state, negative)
        # While steps are shortened, skip shifts that were too small for the previous matrix.
        skipped = self.memory.shift if self.memory.shortened and shifts is SHIFTS else 0
        found = model.system.descent(gradient, shifts[skipped:], model.solve)
        if found is not None:
            direction, expected_decrease, tried = found
            self.memory = replace(self.memory, shift=skipped + tried)
        else:
            model.check_numbers(state)
            if shifts is SHIFTS:
                self.memory = replace(self.memory, shift=len(SHIFTS) - 1)
            direction = model.system.solve_diagonal(-gradient)
            expected_decrease = -work(gradient, direction)
        return *model.restrict(state, gradient, direction, expected_decrease), found is not None

    def _search(self, direction: ComplexArray, expected_decrease: float) -> bool:
        """Take a step along a direction; return False if no step lowers the objective enough."""
        if not expected_decrease > 0:
            return False
        taken = self.model.search(self.state, direction, expected_decrease, self.memory.shortened)
        if taken is None:
            return False
        self.state, shortened = taken
        self.memory = replace(self.memory, shortened=shortened)
        return True


class IteratedDescent(NewtonDescent):
    """A `NewtonDescent` that replaces factorisations for large surfaces, if ``iterate``.

    The model's system must depend on the state by its values alone. ``inverse_near`` is a `RotationPath.inverse_near`
    if the map is close to an isometry.
    """

    def __init__(
        self, model: MapModel, state: NewtonState, *, iterate: bool, inverse_near: InverseNear | None = None
    ) -> None:
        super().__init__(model, state)
        self._inverse_near = inverse_near
        self._iterates = iterate and state.w.size >= _ITERATION.min_vertices
        self._smoothed, self._negligible = np.inf, 0.0
        # The objective that the last step with a factor should have led to, and the decrease that it expected.
        self._goal, self._expected = -np.inf, 0.0

    def step(self, tol: float) -> Status | None:
        """See `NewtonDescent`."""
        self._negligible = 2 * _ITERATION.negligible * tol * self.model.slack * self.state.value
        return super().step(tol)

    def _direction(
        self, gradient: ComplexArray, negative: float, shifts: tuple[float, ...] = SHIFTS
    ) -> tuple[ComplexArray, float, bool]:
        """See `NewtonDescent`; a direction without a factor does not count as Newton's."""
        if self._inverse_near is not None and negative <= 0:
            direction = self._iterate_near(gradient, negative, self._inverse_near)
            if direction is not None:
                return direction, -work(gradient, direction), True
            self._inverse_near = None
        model, value = self.model, self.state.value
        iterates = self._iterates and value < _ITERATION.max_energy
        if iterates and value <= _ITERATION.smoothed * self._smoothed:
            self._smoothed = value
            model.assemble(self.state, 0.0)
            direction, _ = model.system.iterate(
                -gradient, model.system.solve_diagonal, _ITERATION.max_smoothing, residual=_ITERATION.residual
            )
            return direction, -work(gradient, direction), False
        self._smoothed = 0.0
        if iterates and negative == 0 and shifts is SHIFTS and self._is_as_expected():
            model.assemble(self.state, 0.0)
            direction, converged = model.system.iterate(
                -gradient, model.solve, _ITERATION.max_reused, residual=_ITERATION.residual, negligible=self._negligible
            )
            if converged:
                expected_decrease = -work(gradient, direction)
                self._expect(expected_decrease)
                return direction, expected_decrease, True
        direction, expected_decrease, newton = super()._direction(gradient, negative, shifts)
        if newton and not self.memory.shift:
            self._expect(expected_decrease)
        else:
            self._goal = -np.inf
        return direction, expected_decrease, newton

    def _iterate_near(self, gradient: ComplexArray, negative: float, inverse_near: InverseNear) -> ComplexArray | None:
        """Return Newton's direction near an isometry; None if the iterations do not converge."""
        system = self.model.system
        self.model.assemble(self.state, negative)
        try:
            direction, converged = system.iterate(
                -gradient,
                inverse_near(system.diagonal),
                _ITERATION.max_near,
                residual=_ITERATION.residual,
                negligible=self._negligible,
            )
        except NotPositiveDefinite:
            return None
        return direction if converged else None

    def _expect(self, expected_decrease: float) -> None:
        """Record the decrease that a full step should have."""
        self._expected = 0.5 * expected_decrease
        self._goal = self.state.value - self._expected

    def _is_as_expected(self) -> bool:
        """Whether there is a factor, and the last step with it lowered the objective about as expected."""
        return self.state.value - self._goal <= _ITERATION.unexpected * self._expected


def newton_descent(
    energy: NewtonObjective, uv: FloatArray, fixed: IntArray, exponent: int, linear_solver: str
) -> tuple[NewtonDescent, MapModel]:
    """Return a descent of an energy from an injective map (n, 2), and its model.

    The energy takes maps in units of ``2 ** exponent``. The fixed vertices keep their positions in ``uv`` exactly.
    """
    model = MapModel(
        energy, Coordinates.of(uv, fixed, exponent), NewtonSystem(energy.F, energy.g, len(uv), fixed, linear_solver)
    )
    return NewtonDescent(model, model.evaluate(in_units(uv, exponent))), model
