"""Quasi-Newton descent near a minimum, by systems with one unknown per vertex.

A Newton system has two unknowns per vertex, so its factor takes about eight times the time of a Laplacian's. Each step
here solves with a Laplacian whose weights are the mean second derivatives of the energy on each triangle. The last
steps and the changes of the gradient correct the direction (L-BFGS with the Laplacian as metric [1]_). Near the
minimum, two or three times as many steps are needed as with Newton's method, and each takes a tenth of the time. Far
from the minimum, Newton's method is faster.

Let H₀ be the inverse of the Laplacian. The columns of S are the last displacements, those of Y the changes of the
gradient. R is the upper triangle of ``SᵀY``, and D its diagonal. The inverse second derivative is then about [2]_

::

    H = H₀ + [S  H₀Y] [R⁻ᵀ (D + YᵀH₀Y) R⁻¹   −R⁻ᵀ] [S  H₀Y]ᵀ
                      [        −R⁻¹             0  ]

The columns of H₀Y are differences of the H₀ g of successive gradients g, so each step solves once.

References
----------
.. [1] Y. Zhu, R. Bridson, D. M. Kaufman, Blended cured quasi-Newton for distortion optimization. ACM Transactions on
   Graphics 37 (2018).
.. [2] R. H. Byrd, J. Nocedal, R. B. Schnabel, Representations of quasi-Newton matrices and their use in limited memory
   methods. Mathematical Programming 63 (1994).
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from quasiharmonic.energies.deformation import DeformationEnergy
from quasiharmonic.energies.newton.line_search import backtrack, extend
from quasiharmonic.energies.newton.map_model import FRACTION, HALVINGS, NewtonState, in_units, out_of_units
from quasiharmonic.geometry.exact.certificate import is_injective
from quasiharmonic.linsolve.laplacian import FactoredLaplacian, Laplacian, weigh_edges
from quasiharmonic.util.arrays import ComplexArray, FloatArray


class MetricTuning(NamedTuple):
    """Numbers that tune the metric of a `LaplacianDescent`."""

    # Number of earlier steps that correct the direction.
    memory: int = 8
    # The Laplacian is computed again when the energy has fallen to this fraction.
    fallen: float = 0.5
    # Smallest weight of a triangle, relative to the largest.
    least_weight: float = 1e-12


_TUNING = MetricTuning()
# Factors that keep the upper triangle of a matrix.
_UPPER = np.triu(np.ones((_TUNING.memory, _TUNING.memory)))


class _Memory:
    """The last steps (k,) of a descent, which estimate its second derivatives: L-BFGS in compact form.

    Each step has the displacement, the change of the gradient, and what the metric's inverse makes of this change.
    """

    def __init__(self, size: int) -> None:
        most = _TUNING.memory
        self._steps, self._changes, self._answers = np.zeros((3, most, size))
        # Products of displacements with changes, whose upper triangle is used, and of changes with answers.
        self._curvature, self._metric = np.zeros((2, most, most))
        # Rows of the steps, the oldest first.
        self._order: list[int] = []

    def __len__(self) -> int:
        return len(self._order)

    def clear(self) -> None:
        """Drop all steps."""
        self._order.clear()

    def add(self, step: FloatArray, change: FloatArray, answer: FloatArray) -> None:
        """Remember a step; the oldest one makes room for it."""
        row = len(self) if len(self) < _TUNING.memory else self._order.pop(0)
        self._order.append(row)
        self._steps[row], self._changes[row], self._answers[row] = step, change, answer
        self._curvature[:, row] = self._steps @ change
        self._metric[row] = self._metric[:, row] = self._changes @ answer

    def correct(self, gradient: FloatArray, answer: FloatArray) -> FloatArray:
        """Return ``H g`` for the gradient g, given the answer of the metric's inverse to g."""
        order = self._order
        if not order:
            return answer
        row = np.array(order)
        own = row[:, None], row
        curvature = self._curvature[own] * _UPPER[: row.size, : row.size]
        u = np.linalg.solve(curvature, (self._steps @ gradient)[row])
        inner = curvature.diagonal() * u + self._metric[own] @ u
        v = np.linalg.solve(curvature.T, inner - (self._answers @ gradient)[row])
        by_row = np.zeros((2, _TUNING.memory))
        by_row[:, row] = v, u
        return answer + by_row[0] @ self._steps - by_row[1] @ self._answers


class LaplacianDescent:
    """Steps that lower an energy from an injective map ``uv`` (n, 2) of about unit size; every map is injective.

    The boundary is free. Vertex 0 is fixed to prevent drift.

    Raises
    ------
    NotPositiveDefinite
        Also from `step`: if the Laplacian is not positive definite because of rounding.
    """

    def __init__(self, energy: DeformationEnergy, uv: FloatArray, linear_solver: str = "auto") -> None:
        self.energy = energy
        self._laplacian = Laplacian(energy.F, len(uv), np.array([0]), linear_solver)
        w = in_units(uv, 0)
        self._state = self._evaluate(w)
        self._gradient = energy.gradient_of(self._state.derivatives, w.size)
        self._memory = _Memory(2 * w.size)
        self._measured_at = np.inf
        self._metric: FactoredLaplacian | None = None
        self._answer = np.empty(0)

    @property
    def uv(self) -> FloatArray:
        """The current map; (n, 2) float64."""
        return out_of_units(self._state.w, 0)

    @property
    def value(self) -> float:
        """The current energy."""
        return self._state.value

    def step(self) -> bool:
        """Take one step; return False if no step lowers the energy."""
        state, energy = self._state, self.energy
        if self._metric is None or state.value < _TUNING.fallen * self._measured_at:
            self._measure()
        gradient = self._gradient.view(np.float64)
        direction = -self._memory.correct(gradient, self._answer)
        slope = float(direction @ gradient)
        if not slope < 0:
            self._memory.clear()
            direction = -self._answer
            slope = float(direction @ gradient)
            if not slope < 0:
                return False
        full = direction.view(np.complex128)

        def trial(t: float, bound: float) -> tuple[float, NewtonState | None]:
            there = self._evaluate(state.w + t * full)
            accepted = there.value < bound and is_injective(energy.F, out_of_units(there.w, 0))
            return there.value, there if accepted else None

        limit = FRACTION * float(energy.steps_to_collapse(state.w, full).min())
        taken = backtrack(trial, state.value, -slope, longest=min(1.0, limit), tries=HALVINGS)
        if taken is None:
            return False
        if not len(self._memory):
            taken = extend(trial, taken, limit)
        self._move(taken.state)
        return True

    def _evaluate(self, w: ComplexArray) -> NewtonState:
        derivatives = self.energy.deform(w)
        return NewtonState(w, derivatives, self.energy.value_of(derivatives))

    def _measure(self) -> None:
        """Factor the Laplacian at the current map, and drop the earlier steps."""
        form = self.energy.curvature_of(self._state.derivatives)
        weight = 0.5 * (form.pp + form.qq)
        weight = np.maximum(weight, _TUNING.least_weight * weight.max())
        self._metric = self._laplacian.factor(weigh_edges(self.energy.g, weight))
        self._measured_at = self._state.value
        self._memory.clear()
        self._answer = self._metric.respond(self._gradient).view(np.float64)

    def _move(self, there: NewtonState) -> None:
        """Continue from a state, and remember the step to it."""
        assert self._metric is not None
        gradient = self.energy.gradient_of(there.derivatives, there.w.size)
        answer = self._metric.respond(gradient).view(np.float64)
        step, change = (there.w - self._state.w).view(np.float64), (gradient - self._gradient).view(np.float64)
        if step @ change > 0:
            self._memory.add(step, change, answer - self._answer)
        self._state, self._gradient, self._answer = there, gradient, answer
