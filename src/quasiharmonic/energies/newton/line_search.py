"""Line search for all descents: backtracking with Armijo's rule, and extension beyond Newton's step."""

from __future__ import annotations

from collections.abc import Callable
from typing import Generic, NamedTuple, TypeVar

from quasiharmonic.util.progress import heartbeat

S = TypeVar("S")

# Minimum decrease of a step, as a fraction of the expected decrease (Armijo's condition).
_SUFFICIENT = 1e-4


class Taken(NamedTuple, Generic[S]):
    """An accepted step.

    Attributes
    ----------
    t : float
        Its length, in units of the direction.
    value : float
        The function's value there.
    there : S
        The state that the trial returned.
    """

    t: float
    value: float
    there: S


#: Takes a length and a bound; returns the value there, and the state if the value is below the bound and accepted.
Trial = Callable[[float, float], tuple[float, S | None]]


def _half(t: float, value: float) -> float:
    return 0.5


def backtrack(
    trial: Trial[S],
    before: float,
    expected_decrease: float,
    *,
    longest: float = 1.0,
    tries: int,
    factor: Callable[[float, float], float] = _half,
) -> Taken[S] | None:
    """Try successive step lengths until the function decreases sufficiently.

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

    Returns
    -------
    Taken or None
        The first accepted step.
    """
    t = longest
    for _ in range(tries):
        heartbeat()
        value, there = trial(t, before - _SUFFICIENT * min(t, 1.0) * expected_decrease)
        if there is not None:
            return Taken(t, value, there)
        t *= factor(t, value)
    return None


def extend(trial: Trial[S], taken: Taken[S], limit: float = float("inf"), *, longer: float = 2.0) -> Taken[S]:
    """Lengthen an accepted full step as long as the function decreases.

    Far from the minimum, barriers decrease like powers, and Newton's step is several times too short.

    Parameters
    ----------
    trial, taken
        As in `backtrack`.
    limit : float
        Maximum length.
    longer : float
        Ratio of successive lengths; above 1.
    """
    while taken.t >= 1 and longer * taken.t <= limit:
        heartbeat()
        value, there = trial(longer * taken.t, taken.value)
        if there is None:
            break
        taken = Taken(longer * taken.t, value, there)
    return taken
