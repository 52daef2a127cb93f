"""Parts of a line search: backtracking with Armijo's rule, and extension beyond Newton's step.

`map_model` combines them to the line search of Newton's method on positions, and sets its constants. `sliding_boundary`
and `surface_descent` do so for their paths. Gradient methods on tensors (`solver.methods`) do not use this module.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Generic, NamedTuple, TypeVar

from quasiharmonic.util.arrays import FloatArray
from quasiharmonic.util.progress import heartbeat

S = TypeVar("S")

# Minimum decrease of a step, as a fraction of the expected decrease (Armijo's condition).
_SUFFICIENT = 1e-4


class AcceptedStep(NamedTuple, Generic[S]):
    """An accepted step: its length in units of the direction, and the function's value and the trial's state there."""

    t: float
    value: float
    state: S


#: Takes a length and a bound; returns the value there, and the state if the value is below the bound and accepted.
Trial = Callable[[float, float], tuple[float, S | None]]


def _halve(t: float, value: float) -> float:
    return 0.5


def backtrack(
    trial: Trial[S],
    before: float,
    expected_decrease: float,
    *,
    longest: float = 1.0,
    tries: int,
    factor: Callable[[float, float], float] = _halve,
) -> AcceptedStep[S] | None:
    """Try successive step lengths until the function decreases sufficiently; return the first accepted step or None.

    Parameters
    ----------
    trial : callable
        See `Trial`.
    before : float
        The function's value at the start.
    expected_decrease : float
        Rate of decrease along the direction, to first order; positive.
    longest : float
        The first length.
    tries : int
        Maximum number of lengths.
    factor : callable
        Takes a length and the value there; returns the factor for the next length.
    """
    t = longest
    for _ in range(tries):
        heartbeat()
        value, there = trial(t, before - _SUFFICIENT * min(t, 1.0) * expected_decrease)
        if there is not None:
            return AcceptedStep(t, value, there)
        t *= factor(t, value)
    return None


def backtrack_each(
    values: Callable[[FloatArray], FloatArray],
    before: FloatArray,
    expected_decrease: FloatArray,
    longest: FloatArray,
    *,
    tries: int,
) -> tuple[FloatArray, FloatArray]:
    """Backtrack along one direction with a length for each of many independent functions.

    ``values`` takes lengths (k,) and returns the functions' values (k,). A function with ``longest`` 0 stays. See
    `backtrack` for the others. Return the accepted lengths (k,), 0 where none was accepted, and the values there.
    """
    t, moving = longest.copy(), longest > 0
    for _ in range(tries):
        heartbeat()
        value = values(t)
        too_far = moving & ~(value <= before - _SUFFICIENT * t * expected_decrease)
        if not too_far.any():
            return t, value
        t[too_far] *= 0.5
    t[too_far] = 0
    return t, values(t)


def extend(
    trial: Trial[S], taken: AcceptedStep[S], limit: float = float("inf"), *, longer: float = 2.0
) -> AcceptedStep[S]:
    """Lengthen an accepted full step by factors ``longer``, up to ``limit``, as long as the function decreases.

    Far from the minimum, barriers decrease like powers, and Newton's step is several times too short.
    """
    while taken.t >= 1 and longer * taken.t <= limit:
        heartbeat()
        value, there = trial(longer * taken.t, taken.value)
        if there is None:
            break
        taken = AcceptedStep(longer * taken.t, value, there)
    return taken
