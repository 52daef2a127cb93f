"""The record of a call: steps, stages, recorded maps, time limit and interrupts."""

from __future__ import annotations

import ast
from pathlib import Path
from unittest.mock import Mock

import numpy as np
import pytest

from quasiharmonic import polish
from quasiharmonic.problem.result import MapResult, Status
from quasiharmonic.problem.run import Run
from quasiharmonic.surfaces import disk
from quasiharmonic.util.progress import heartbeat, time_limit

SOURCE = Path(__file__).parent.parent / "src/quasiharmonic"


def falling(values, statuses):
    """A descent whose energy takes these values; ``state`` has the current one."""
    state = [values[0]]

    def steps():
        for value, status in zip(values[1:], statuses, strict=True):
            state[0] = value
            yield status

    return state, steps()


def test_a_descent_records_its_start_and_every_step():
    told = []
    run = Run(told.append, 2)
    state, steps = falling([4.0, 2.0, 1.0], [None, Status.POLISHED])
    status = run.descend("descent", steps, lambda: state[0], lambda: np.full((3, 2), state[0]))
    assert status is Status.POLISHED
    assert [(step.iteration, step.inverted, step.energy) for step in run.history] == [
        (0, 0, 4.0),
        (1, 0, 2.0),
        (2, 0, 1.0),
    ]
    assert told == run.history
    assert [(shot.iteration, shot.uv[0, 0]) for shot in run.path] == [(0, 4.0), (2, 1.0)]
    (stage,) = run.stages
    assert (stage.name, stage.n_iterations, stage.energy, stage.kept) == ("descent", 2, (4.0, 1.0), True)


def test_a_descent_without_a_status_was_still_falling():
    run = Run()
    state, steps = falling([4.0, 2.0], [None])
    assert run.descend("descent", steps, lambda: state[0]) is Status.STILL_FALLING
    assert run.path == []


def test_an_interrupt_keeps_the_stage_and_the_work_so_far():
    def stop(step):
        if step.iteration == 1:
            raise KeyboardInterrupt

    run = Run(stop)
    state, steps = falling([4.0, 2.0, 1.0], [None, None])
    status = Status.INTERRUPTED
    with run.until_interrupted():
        status = run.descend("descent", steps, lambda: state[0])
    assert run.interrupted
    assert status is Status.INTERRUPTED
    assert [stage.n_iterations for stage in run.stages] == [1]
    assert run.stages[0].energy == (4.0, 2.0)


def test_an_exception_of_a_step_is_not_hidden():
    def steps():
        yield None
        state.clear()
        raise ZeroDivisionError

    run, state = Run(), [4.0]
    with pytest.raises(ZeroDivisionError) as caught:
        run.descend("descent", steps(), lambda: state[0])
    assert caught.value.__context__ is None
    assert [(stage.n_iterations, stage.energy) for stage in run.stages] == [(1, (4.0, 4.0))]


def test_without_a_stage_there_is_nothing_to_judge():
    run = Run()
    with run.until_interrupted():
        run.descend("descent", [], Mock(side_effect=KeyboardInterrupt))
    run.judge_last_stage(kept=False)
    assert run.stages == []


def test_a_result_does_not_change_when_the_run_goes_on():
    V, F = disk(3)
    run = Run(record_every=1)
    results = []
    for _ in range(2):
        run.descend("descent", [None], lambda: 1.0, lambda: V)
        results.append(run.result(V, F, Status.STILL_FALLING))
    assert [(len(one.stages), len(one.history), len(one.path)) for one in results] == [(1, 2, 2), (2, 4, 4)]


def test_other_exceptions_are_not_interrupts():
    run = Run()
    with pytest.raises(ZeroDivisionError), run.until_interrupted():
        1 / 0  # noqa: B018
    assert not run.interrupted


def test_a_time_limit_ends_the_run_like_an_interrupt():
    run = Run()
    with time_limit(0.0) as limit, run.until_interrupted():
        run.record(0, 1.0)
        run.record(0, 0.5)
    assert limit.reached
    assert run.interrupted
    assert len(run.history) == 1
    # Outside the block, and within a block after its limit, work continues.
    run.record(0, 0.5)
    with time_limit(0.0), run.until_interrupted():
        with run.until_interrupted():
            heartbeat()
        heartbeat()
        run.record(0, 0.25)
    assert len(run.history) == 3


def test_the_first_of_two_time_limits_counts():
    run = Run()
    with time_limit(0.0) as outer, time_limit(60.0) as inner, run.until_interrupted():
        heartbeat()
    assert (outer.reached, inner.reached, run.interrupted) == (True, False, True)


def test_stages_follow_one_another_without_a_gap():
    run = Run()
    run.add_stage("first", energy=(2.0, 1.0))
    run.add_stage("second", energy=(1.0, 1.0))
    run.judge_last_stage(kept=False)
    assert [stage.kept for stage in run.stages] == [True, False]
    assert sum(stage.seconds for stage in run.stages) <= run.seconds


@pytest.mark.parametrize(
    ("statuses", "together"),
    [
        ([Status.POLISHED, Status.STILL_FALLING], Status.STILL_FALLING),
        ([Status.EXHAUSTED, Status.POLISHED], Status.EXHAUSTED),
        ([Status.POLISHED, Status.COLLAPSED], Status.COLLAPSED),
        ([Status.COLLAPSED, Status.STALLED], Status.STALLED),
        ([Status.STALLED, Status.IMPOSSIBLE], Status.IMPOSSIBLE),
        ([Status.IMPOSSIBLE, Status.INTERRUPTED], Status.INTERRUPTED),
        ([Status.INJECTIVE, Status.STALLED], Status.STALLED),
    ],
)
def test_the_status_of_several_maps_is_that_of_the_least_progress(statuses, together):
    assert Status.most_severe(statuses) is together
    assert Status.most_severe(reversed(statuses)) is together


def test_every_status_has_a_rank():
    assert [Status.most_severe([status, status]) for status in Status] == [*Status]


def test_results_follow_one_another():
    V, F = disk(3)
    first = polish(V, F, V * [2, 1], max_iterations=1)
    second = polish(V, F, first.uv)
    both = second.after(first)
    assert both.stages == first.stages + second.stages
    assert both.n_iterations == first.n_iterations + second.n_iterations
    assert both.history == first.history + second.history
    assert both.seconds == first.seconds + second.seconds
    assert both.uv is second.uv


def test_a_combined_result_has_the_worst_status_and_all_stages():
    V, F = disk(3)
    results = [polish(V, F, V * [2, 1], max_iterations=count) for count in (0, 100)]
    both = MapResult.combine(results, V, results[0].certificate)
    assert both.status is Status.STILL_FALLING
    assert both.stages == results[0].stages + results[1].stages


def test_interrupts_are_caught_in_one_place():
    """Outside `Run`, only the command and the page catch Ctrl-C; a batch does so in the process of a worker."""
    found = {
        path.relative_to(SOURCE).as_posix()
        for path in SOURCE.rglob("*.py")
        # Parsing all files takes seconds.
        if "KeyboardInterrupt" in (text := path.read_text(encoding="utf-8"))
        for node in ast.walk(ast.parse(text))
        if isinstance(node, ast.ExceptHandler)
        and node.type is not None
        and "KeyboardInterrupt" in ast.unparse(node.type)
    }
    assert {name for name in found if not name.startswith("ui/")} == {"__main__.py", "problem/run.py"}
