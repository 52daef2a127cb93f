"""One line search for every descent: Armijo's rule, and steps beyond Newton's."""

from __future__ import annotations

from collections.abc import Callable
from typing import Generic, NamedTuple, TypeVar

from quasiharmonic.util.progress import heartbeat

S = TypeVar("S")

# Fraction of the decrease that the gradient promises which a step must achieve (Armijo's condition).
_SUFFICIENT = 1e-4


class Taken(NamedTuple, Generic[S]):
    """A step that was accepted.

    Attributes
    ----------
    t : float
        Its length, in units of the direction.
    value : float
        Of the function, there.
    there : S
        What the trial has made of it.
    """

    t: float
    value: float
    there: S


#: From a length and a bound to the value there and, if that is below the bound and nothing else forbids it, the state.
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
    """Try one length after the other until the function falls as much as it should.

    Parameters
    ----------
    trial : callable
        See `Trial`.
    before : float
        The function's value at the start.
    expected_decrease : float
        The rate at which it falls along the direction, to first order; positive.
    longest : float
        The first length.
    tries : int
        Lengths at most.
    factor : callable
        From a length and the value there to what the next length is shorter by.

    Returns
    -------
    Taken or None
        The first that is accepted.
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
    """Lengthen a step that went well in full for as long as the function falls.

    Far from the minimum barriers fall by powers, and Newton's step is several times too short.

    Parameters
    ----------
    trial, taken
        As of `backtrack`.
    limit : float
        The longest length.
    longer : float
        How many times as long the next length is; above 1.
    """
    while taken.t >= 1 and longer * taken.t <= limit:
        heartbeat()
        value, there = trial(longer * taken.t, taken.value)
        if there is None:
            break
        taken = Taken(longer * taken.t, value, there)
    return taken
