"""L-BFGS with optional units per triangle, whose steps never raise the objective (§9.1).

The effect of a step in ξ differs by many orders of magnitude between triangles, and plain L-BFGS needs many steps to
learn that. Each triangle's ξ may therefore be measured in given units. The objective may be infinite; steps that lead
there are shortened.
"""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass
from typing import ClassVar, NamedTuple

import numpy as np

from quasiharmonic.energies.newton.line_search import backtrack
from quasiharmonic.linsolve import NotPositiveDefinite
from quasiharmonic.solver.field.objective import Iterate, Objective
from quasiharmonic.solver.methods.base import FunctionalDescent, Iterates
from quasiharmonic.util.arrays import ComplexArray, FloatArray, work


class LbfgsTuning(NamedTuple):
    """Numbers that tune L-BFGS."""

    # Number of pairs of steps and gradient changes in memory.
    memory: int = 10
    # Maximum step of a triangle's ξ as a multiple of 1 + |ξ|. With si-log, |μ| = 0.9 is at |ξ| = 8,102.
    longest: float = 1.0
    # The same for steps along a gradient alone.
    first: float = 0.1
    # Maximum number of trial steps per direction.
    tries: int = 20
    # Number of steps whose total decrease is compared with the tolerance.
    window: int = 10


_TUNING = LbfgsTuning()


@dataclass(frozen=True, kw_only=True)
class LBFGS(FunctionalDescent):
    """Descend by limited-memory BFGS; the objective must be finite at the start.

    Attributes
    ----------
    iterations : int
        Maximum number of evaluations, including those of the line search.
    stiffness : (f,) float64, optional
        Diagonal of the initial Hessian approximation, up to a factor; positive. Default: all equal.
    tol : float
        Converged if ten steps lower the objective by less than this fraction of it.
    """

    stiffness: FloatArray | None = None
    tol: float = 0.0

    label: ClassVar[str] = "l-bfgs"

    def iterates(self, objective: Objective, start: Iterate) -> Iterates:
        """See `Descent`; values decrease strictly. Converged also if no step lowers the value."""
        stiffness = np.ones(start.xi.size) if self.stiffness is None else self.stiffness
        here, left = start, self.iterations
        pairs: deque[tuple[ComplexArray, ComplexArray, float]] = deque(maxlen=_TUNING.memory)
        values = deque([here.value], maxlen=_TUNING.window + 1)
        while left > 0:
            before = here.value
            direction = _direction(here.gradient, pairs, stiffness)
            slope = work(here.gradient, direction)
            if not slope < 0:
                if not pairs:
                    return True
                pairs.clear()
                continue

            def evaluate_step(
                t: float, bound: float, xi: ComplexArray = here.xi, along: ComplexArray = direction
            ) -> tuple[float, Iterate | None]:
                nonlocal left
                left -= 1
                try:
                    there = objective.evaluate(objective.clip_xi(xi + t * along))
                except NotPositiveDefinite:
                    return np.inf, None
                return there.value, there if there.value < bound else None

            def choose_factor(t: float, after: float, before: float = before, slope: float = slope) -> float:
                """Return the factor that leads to the minimum of the interpolating parabola, within 0.1 to 0.5."""
                if not np.isfinite(after):
                    return 0.25
                return float(np.clip(-0.5 * slope * t / (after - before - slope * t), 0.1, 0.5))

            farthest = float((np.abs(direction) / (1 + np.abs(here.xi))).max())
            longest = min(1.0, (_TUNING.longest if pairs else _TUNING.first) / farthest)
            taken = backtrack(
                evaluate_step, before, -slope, longest=longest, tries=min(_TUNING.tries, left), factor=choose_factor
            )
            if taken is None:
                if not pairs or left <= 0:
                    return left > 0
                pairs.clear()
                continue
            there = taken.state
            step, change = there.xi - here.xi, there.gradient - here.gradient
            curvature = work(step, change)
            if curvature > 1e-10 * np.sqrt(work(step, step) * work(change, change)):
                pairs.append((step, change, curvature))
            here = there
            yield here
            values.append(here.value)
            if len(values) > _TUNING.window and values[0] - values[-1] < self.tol * abs(values[-1]):
                return True
        return False


def _direction(
    gradient: ComplexArray, pairs: deque[tuple[ComplexArray, ComplexArray, float]], stiffness: FloatArray
) -> ComplexArray:
    """Apply the two-loop recursion (Nocedal and Wright 2006, algorithm 7.4) with the diagonal ``stiffness``."""
    direction = -gradient
    shares = []
    for step, change, curvature in reversed(pairs):
        share = work(step, direction) / curvature
        direction -= share * change
        shares.append(share)
    direction /= stiffness
    if pairs:
        _, change, curvature = pairs[-1]
        direction *= curvature / work(change, change / stiffness)
    for (step, change, curvature), share in zip(pairs, reversed(shares), strict=True):
        direction += (share - work(change, direction) / curvature) * step
    return direction
