"""Ctrl-C at an inconvenient moment of a call: the result is the best map so far, and nothing that was found is lost."""

from __future__ import annotations

import time
from dataclasses import replace
from unittest.mock import Mock

import numpy as np
import pytest

from quasiharmonic import Problem, Status, boundary_loops, solve
from quasiharmonic.energies.polishing import polish_map
from quasiharmonic.solver.methods import VectorAdam
from quasiharmonic.solver.search.stages import CoarseToFine
from quasiharmonic.surfaces import disk

SEARCH = "quasiharmonic.solver.search.search"


def stop_at(iteration):
    """A callback that interrupts at this step and after."""

    def stop(step):
        if step.iteration >= iteration:
            raise KeyboardInterrupt

    return Mock(side_effect=stop)


def star(rings):
    """A disk onto a star of six rays, which takes a few iterations."""
    V, F = disk(rings)
    (loop,) = boundary_loops(F, len(V))
    return Problem(V, F, loop, V[loop] * (1 + 0.4 * np.cos(6 * np.arctan2(*V[loop].T)))[:, None])


@pytest.mark.parametrize("refine", [False, True])
def test_before_the_first_stage(monkeypatch, refine):
    monkeypatch.setattr(f"{SEARCH}.coarse_mesh", Mock(side_effect=KeyboardInterrupt))
    result = solve(star(8), strategy=[CoarseToFine(VectorAdam())], refine=refine)
    assert result.status is Status.INTERRUPTED
    assert result.stages == []


@pytest.mark.parametrize("limit", [None, 60.0])
def test_with_the_last_step_of_a_search_no_polish_begins(limit):
    problem = star(8)
    last = solve(problem).history[-1]
    assert last.inverted == 0
    stop = stop_at(last.iteration)
    result = solve(problem, polish="mips", callback=stop, time_limit=limit)
    assert result.injective
    assert result.status is Status.INTERRUPTED
    assert result.n_iterations == last.iteration > 0
    assert stop.call_count == last.iteration + 1


def test_a_time_limit_at_the_last_step_of_a_search_ends_the_call():
    problem = star(8)
    last = solve(problem).history[-1].iteration
    result = solve(
        problem, polish="mips", time_limit=0.2, callback=lambda step: step.iteration == last and time.sleep(0.3)
    )
    assert result.injective
    assert result.status is Status.TIME_LIMIT
    assert result.n_iterations == last


@pytest.fixture(scope="module")
def large():
    """A problem that is searched on a coarse mesh."""
    return star(60)


def interrupted_polish(domain, uv, options):
    result = polish_map(domain, uv, options)
    return replace(result, status=Status.INTERRUPTED)


@pytest.mark.parametrize("polish", [interrupted_polish, Mock(side_effect=KeyboardInterrupt)])
def test_while_the_map_of_the_coarse_mesh_is_polished(large, monkeypatch, polish):
    monkeypatch.setattr(f"{SEARCH}.polish_map", polish)
    result = solve(large, polish="mips")
    assert result.status is Status.INTERRUPTED
    assert [stage.name.split(",")[0] for stage in result.stages] == ["coarse-to-fine"]
    # The map is that of the coarse mesh, not the centre of the target.
    assert len(result.certificate.inverted) < len(large.F) / 2


def test_on_the_coarse_mesh_the_callback_is_not_called_again(large):
    stop = stop_at(3)
    result = solve(large, callback=stop)
    assert result.status is Status.INTERRUPTED
    assert stop.call_count == 4
    (stage,) = result.stages
    assert (stage.n_iterations, stage.kept) == (3, True)


def test_when_the_map_of_the_coarse_mesh_is_reported(large):
    last = solve(large).history[-1]
    stop = stop_at(last.iteration)
    result = solve(large, callback=stop)
    assert last.inverted == 0
    assert result.injective
    assert result.status is Status.INTERRUPTED
    assert [stage.n_iterations for stage in result.stages] == [last.iteration]
