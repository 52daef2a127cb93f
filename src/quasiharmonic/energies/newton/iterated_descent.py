"""A Newton descent in which conjugate gradients replace some factorisations.

Far from the minimum, the error of a map that was prolonged from a coarse mesh is mostly local. A few iterations without
a factor remove it, in a tenth of the time of a factorisation. Close to the minimum the second derivatives hardly
change, so a few iterations with the last factor suffice for the last step.
"""

from __future__ import annotations

import numpy as np

from quasiharmonic.energies.newton.newton_descent import SHIFTS, NewtonDescent, NewtonModel, NewtonState
from quasiharmonic.util.arrays import ComplexArray, work

# From this number of vertices on, iterations replace factorisations below this mean energy.
_FROM, _BELOW = 10_000, 1.0
# Maximum number of iterations with the factor of an earlier step, and of iterations without a factor.
_REUSED, _SMOOTHING = 5, 30
# Iterations without a factor continue as long as they lower the energy to at most this fraction.
_SMOOTHER = 0.5
# Factors of earlier steps serve if the last step was expected to lower the energy by at most this fraction.
_LAST_DECREASE = 0.2
# Maximum decrease that iterations leave, as a fraction of the decrease that they found.
_RESIDUAL = 1e-3


class IteratedDescent(NewtonDescent):
    """A `NewtonDescent` that replaces factorisations for large surfaces, if ``iterate``.

    The model's system must depend on the state by its values alone.
    """

    def __init__(self, model: NewtonModel, state: NewtonState, *, iterate: bool) -> None:
        super().__init__(model, state)
        self._iterates = iterate and state.w.size >= _FROM
        self._factored, self._smoothed, self._decrease = False, np.inf, np.inf

    def _direction(
        self, gradient: ComplexArray, negative: float, shifts: tuple[float, ...] = SHIFTS
    ) -> tuple[ComplexArray, float, bool]:
        """See `NewtonDescent`; a direction without a factor does not count as Newton's."""
        model, value = self.model, self.state.value
        iterates = self._iterates and value < _BELOW
        if iterates and value <= _SMOOTHER * self._smoothed:
            self._smoothed = value
            model.assemble(self.state, 0.0)
            direction, _ = model.system.iterate(-gradient, model.system.solve_diagonal, _SMOOTHING, _RESIDUAL)
            return direction, -work(gradient, direction), False
        self._smoothed = 0.0
        near = iterates and self._decrease <= _LAST_DECREASE * value
        if near and self._factored and negative == 0 and shifts is SHIFTS:
            model.assemble(self.state, 0.0)
            direction, converged = model.system.iterate(-gradient, model.solve, _REUSED, _RESIDUAL)
            if converged:
                return direction, -work(gradient, direction), True
        found = super()._direction(gradient, negative, shifts)
        self._factored, self._decrease = found[2] and not self.memory.shift, found[1]
        return found
