"""A Newton descent in which conjugate gradients replace some factorisations.

Far from the minimum, the error of a map that was prolonged from a coarse mesh is mostly local. A few iterations without
a factor remove it, in a tenth of the time of a factorisation. Close to the minimum the second derivatives hardly
change, so a few iterations with the last factor suffice for the last steps.
"""

from __future__ import annotations

import numpy as np

from quasiharmonic.energies.newton.newton_descent import SHIFTS, NewtonDescent, NewtonModel, NewtonState
from quasiharmonic.problem.result import Status
from quasiharmonic.util.arrays import ComplexArray, work

# From this number of vertices on, iterations replace factorisations below this mean energy.
_FROM, _BELOW = 10_000, 1.0
# Maximum number of iterations with the factor of an earlier step, and of iterations without a factor.
_REUSED, _SMOOTHING = 8, 30
# Iterations without a factor continue as long as they lower the energy to at most this fraction.
_SMOOTHER = 0.5
# Factors of earlier steps serve if the decrease of the last step differs by at most this fraction from the expected
# one, as the second derivatives have then hardly changed.
_UNEXPECTED = 0.3
# Maximum decrease that iterations leave, as a fraction of the decrease that they found.
_RESIDUAL = 1e-2
# Iterations of the last steps also end at this fraction of the decrease at which the descent has converged.
_NEGLIGIBLE = 0.1


class IteratedDescent(NewtonDescent):
    """A `NewtonDescent` that replaces factorisations for large surfaces, if ``iterate``.

    The model's system must depend on the state by its values alone.
    """

    def __init__(self, model: NewtonModel, state: NewtonState, *, iterate: bool) -> None:
        super().__init__(model, state)
        self._iterates = iterate and state.w.size >= _FROM
        self._smoothed, self._negligible = np.inf, 0.0
        # The objective that the last step with a factor should have led to, and the decrease that it expected.
        self._goal, self._expected = -np.inf, 0.0

    def step(self, tol: float) -> Status | None:
        """See `NewtonDescent`."""
        self._negligible = 2 * _NEGLIGIBLE * tol * self.model.slack * self.state.value
        return super().step(tol)

    def _direction(
        self, gradient: ComplexArray, negative: float, shifts: tuple[float, ...] = SHIFTS
    ) -> tuple[ComplexArray, float, bool]:
        """See `NewtonDescent`; a direction without a factor does not count as Newton's."""
        model, value = self.model, self.state.value
        iterates = self._iterates and value < _BELOW
        if iterates and value <= _SMOOTHER * self._smoothed:
            self._smoothed = value
            model.assemble(self.state, 0.0)
            direction, _ = model.system.iterate(-gradient, model.system.solve_diagonal, _SMOOTHING, residual=_RESIDUAL)
            return direction, -work(gradient, direction), False
        self._smoothed = 0.0
        if iterates and negative == 0 and shifts is SHIFTS and self._is_as_expected():
            model.assemble(self.state, 0.0)
            direction, converged = model.system.iterate(
                -gradient, model.solve, _REUSED, residual=_RESIDUAL, negligible=self._negligible
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

    def _expect(self, expected_decrease: float) -> None:
        """Record the decrease that a full step should have."""
        self._expected = 0.5 * expected_decrease
        self._goal = self.state.value - self._expected

    def _is_as_expected(self) -> bool:
        """Whether there is a factor, and the last step with it lowered the objective about as expected."""
        return self.state.value - self._goal <= _UNEXPECTED * self._expected
