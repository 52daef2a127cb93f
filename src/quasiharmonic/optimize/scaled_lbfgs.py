"""L-BFGS in units of one's own for every triangle, with steps that never raise the objective (§9.1).

What a step of ξ does differs by many orders of magnitude between triangles, and plain L-BFGS spends itself on finding
that out. Here each triangle's ξ is measured in given units, and an objective may be infinite: steps that lead there
are shortened.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from quasiharmonic.functionals import work
from quasiharmonic.linsolve import NotPositiveDefinite
from quasiharmonic.objective import Iterate, Objective

FloatArray = NDArray[np.float64]
ComplexArray = NDArray[np.complex128]

# Pairs of steps and changes of gradient that are remembered.
_MEMORY = 10
# Of the decrease that the gradient promises (Armijo's condition).
_SUFFICIENT = 1e-4
# No triangle's ξ moves farther in a step, and in the first step from a gradient alone.
_LONGEST, _FIRST = 1.0, 0.1
# A step is shortened this often before the direction is given up.
_TRIES = 20
# The descent is at rest when so many steps together have lowered the objective by less than the tolerance.
_WINDOW = 10


def scaled_lbfgs(
    objective: Objective,
    start: Iterate,
    visit: Callable[[Iterate], None],
    *,
    iterations: int,
    stiffness: FloatArray,
    tolerance: float = 0.0,
) -> bool:
    """Descend by limited-memory BFGS.

    Parameters
    ----------
    objective : Objective
    start : Iterate
        Of finite value.
    visit : callable
        Called with every accepted iterate, whose value is below the one before; raises `Stop` to end.
    iterations : int
        Evaluations at most, those of the line search included.
    stiffness : (f,) float64
        The diagonal that stands for the second derivative until something better is known, up to a factor; positive.
    tolerance : float
        Ten steps that lower the objective by less than this fraction of it are the end.

    Returns
    -------
    bool
        Whether it came to rest, in that sense or because no step lowers the objective any more.
    """
    here = start
    pairs: deque[tuple[ComplexArray, ComplexArray, float]] = deque(maxlen=_MEMORY)
    values = deque([here.value], maxlen=_WINDOW + 1)
    left = iterations
    while left > 0:
        direction = _direction(here.gradient, pairs, stiffness)
        slope = work(here.gradient, direction)
        longest = float(np.abs(direction).max(initial=0))
        if not slope < 0:
            if not pairs:
                return True
            pairs.clear()
            continue
        t = min(1.0, (_LONGEST if pairs else _FIRST) / longest)
        there = None
        for _ in range(min(_TRIES, left)):
            left -= 1
            there = _evaluated(objective, here.xi + t * direction)
            if there is not None and there.value < here.value + _SUFFICIENT * t * slope:
                break
            t *= _shorter(t, slope, here.value, np.inf if there is None else there.value)
            there = None
        if there is None:
            if not pairs or left <= 0:
                return left > 0
            pairs.clear()
            continue
        step, change = there.xi - here.xi, there.gradient - here.gradient
        curvature = work(step, change)
        if curvature > 1e-10 * np.sqrt(work(step, step) * work(change, change)):
            pairs.append((step, change, curvature))
        here = there
        visit(here)
        values.append(here.value)
        if len(values) > _WINDOW and values[0] - values[-1] < tolerance * abs(values[-1]):
            return True
    return False


def _evaluated(objective: Objective, xi: ComplexArray) -> Iterate | None:
    """The iterate at ``xi``, None where there is none of finite value."""
    try:
        found = objective.evaluate(objective.bounded(xi))
    except NotPositiveDefinite:
        return None
    return found if np.isfinite(found.value) else None


def _shorter(t: float, slope: float, before: float, after: float) -> float:
    """By how much to shorten a step: to the minimum of the parabola through what is known, within reason."""
    if not np.isfinite(after):
        return 0.25
    return float(np.clip(-0.5 * slope * t / (after - before - slope * t), 0.1, 0.5))


def _direction(
    gradient: ComplexArray, pairs: deque[tuple[ComplexArray, ComplexArray, float]], stiffness: FloatArray
) -> ComplexArray:
    """The two-loop recursion (Nocedal and Wright 2006, algorithm 7.4) from the diagonal ``stiffness``."""
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
