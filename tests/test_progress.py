"""Progress callbacks are also called while there is no new step."""

from __future__ import annotations

import time

import numpy as np
import pytest

import problems
from quasiharmonic import Problem, boundary_loops, flatten, injective_map, polish, solve
from quasiharmonic.surfaces import cat
from quasiharmonic.targets import arc_length, letter
from quasiharmonic.util import progress as hearing
from quasiharmonic.util.progress import heartbeat, reports_progress
from shared.distinct_steps import DistinctSteps
from shared.solvable_problems import star_problem


@reports_progress
def working(told, *, callback=None):
    """Report some steps, each followed by work in two parts."""
    for step in told:
        if callback is not None:
            callback(step)
        heartbeat()
        heartbeat()
    return told


@pytest.fixture
def impatient(monkeypatch):
    monkeypatch.setattr(hearing, "INTERVAL", 0.0)


def test_the_last_step_is_reported_again(impatient):
    seen = []
    assert working([1, 2], callback=seen.append) == [1, 2]
    assert seen == [1, 1, 1, 2, 2, 2]
    assert working([3]) == [3]
    heartbeat()
    assert seen[-1] == 2


def test_only_if_the_last_call_is_long_ago():
    seen = []
    working([1, 2, 3], callback=seen.append)
    assert seen == [1, 2, 3]


def test_exceptions_of_a_callback_are_raised(impatient):
    seen = []

    def stop(step):
        seen.append(step)
        if len(seen) == 2:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        working([1, 2], callback=stop)
    assert seen == [1, 1]
    heartbeat()
    assert seen == [1, 1]


def test_a_callback_that_stopped_the_search_is_not_called_again(impatient):
    seen = []

    def stop(step):
        seen.append(step)
        if len(seen) == 2:
            raise KeyboardInterrupt

    @reports_progress
    def interrupted(*, callback):
        try:
            callback(1)
            heartbeat()
        except KeyboardInterrupt:
            heartbeat()
            return "the best so far"

    assert interrupted(callback=stop) == "the best so far"
    assert seen == [1, 1]


def test_objects_that_are_not_callable_are_rejected():
    V, F, fixed, target = star_problem(n=60)
    with pytest.raises((TypeError, ValueError), match="callback"):
        injective_map(V, F, fixed, target, callback=5)


def test_a_callback_may_use_the_library(impatient):
    seen, states = [], []

    def nested(step):
        seen.append(step)
        states.append(np.geterr())
        working([10, 20])

    with np.errstate(all="raise"):
        working([1], callback=nested)
    assert seen == [1, 1, 1]
    assert states[0]["over"] == "raise"

    inner = []
    working([1], callback=lambda step: working([step], callback=inner.append))
    assert inner == 9 * [1]


def test_repeated_reports_are_not_steps(impatient):
    V, F, fixed, target = star_problem(n=60)
    seen, once = [], DistinctSteps()

    def note(step):
        seen.append(step)
        once.append(step)

    result = injective_map(V, F, fixed, target, callback=note, polish="mips")
    assert len(seen) > len(result.history)
    assert once == result.history
    plain = injective_map(V, F, fixed, target, polish="mips")
    np.testing.assert_array_equal(plain.uv, result.uv)
    assert plain.history == result.history


def test_interrupted_between_steps(impatient):
    V, F, fixed, target = star_problem()
    start = injective_map(V, F, fixed, target).uv
    for solved in (
        lambda stop: solve(Problem(V, F, fixed, target), strategy="paper", callback=stop),
        lambda stop: polish(V, F, start, fixed=fixed, callback=stop),
    ):
        seen = []

        def stop(step, seen=seen):
            if seen and step is seen[-1]:
                raise KeyboardInterrupt
            seen.append(step)

        assert solved(stop).status.name == "INTERRUPTED"
        assert len(seen) == 1


def longest(run, seconds):
    """Return the longest CPU time between two callbacks of a search that is stopped after some seconds."""
    calls = []

    def note(step):
        calls.append(time.process_time())
        if calls[-1] - calls[0] > seconds:
            raise KeyboardInterrupt

    run(note)
    return max(np.diff(calls))


def stuck():
    """A problem that local repair tries for minutes without success."""
    return problems.make("jam", 282, 0.786)


def crossing():
    """A target that crosses itself a thousand times."""
    V, F = cat(60)
    (loop,) = boundary_loops(F, len(V))
    target = arc_length(V[loop], letter("R")[0])
    return V, F, loop, target + 0.3 * np.random.default_rng(0).standard_normal(target.shape)


@pytest.mark.long
@pytest.mark.parametrize("seconds", [1.5, pytest.param(12, marks=pytest.mark.nightly)])
@pytest.mark.parametrize(
    "run",
    [
        lambda note: injective_map(*stuck()[:4], callback=note),
        lambda note: injective_map(*crossing(), callback=note),
        lambda note: flatten(*cat(40), energy="distances", callback=note),
    ],
    ids=["repair", "diagnosis", "distances"],
)
def test_every_half_second(run, seconds):
    # No factorisation here takes long. CPU time, since the machine may be busy.
    assert longest(run, seconds) < 0.5
