"""A time limit of a map, a polish or a flattening: the best certified map so far, soon after the limit."""

from __future__ import annotations

import time

import numpy as np
import pytest

from quasiharmonic import Status, atlas, boundary_loops, flatten, injective_map, polish, solve, surfaces
from quasiharmonic.problem import Problem


def folded():
    """A disk onto an outline that no search maps: two boundary vertices at one place, whose repairs take long."""
    V, F = surfaces.disk(20)
    (loop,) = boundary_loops(F, len(V))
    return V, F, loop, V[loop] * (1 + 0.9 * np.cos(9 * np.arctan2(*V[loop].T)))[:, None]


def dome():
    flat, F = surfaces.disk(40)
    return np.column_stack([flat, 2 * np.sqrt(1.05 - (flat**2).sum(axis=1))]), F


def test_a_search_ends_with_its_best_map():
    V, F, loop, target = folded()
    began = time.process_time()
    result = injective_map(V, F, loop, target, time_limit=0.02, strategy="paper")
    assert time.process_time() - began < 2
    assert result.status is Status.TIME_LIMIT
    assert not result.injective
    assert not result
    assert len(result.uv) == len(V)


def test_a_polish_within_a_search_counts():
    V, F = surfaces.disk(30)
    (loop,) = boundary_loops(F, len(V))
    problem = Problem(V, F, loop, V[loop] * (1 + 0.3 * np.cos(5 * np.arctan2(*V[loop].T)))[:, None])
    whole = solve(problem, polish="mips")
    steps = []

    def wait(step):
        steps.append(step)
        if len(steps) > 2:
            time.sleep(0.3)

    result = solve(problem, polish="mips", time_limit=0.25, callback=wait)
    assert whole.status is Status.POLISHED
    assert result.status is Status.TIME_LIMIT
    assert result.n_iterations < whole.n_iterations


@pytest.mark.parametrize("energy", ["symmetric-dirichlet", "mips"])
def test_a_polish_ends_with_an_injective_map(energy):
    V, F = surfaces.disk(30)
    turn = 2.5 * (1 - V[:, 0] ** 2 - V[:, 1] ** 2)
    twisted = np.stack(
        [V[:, 0] * np.cos(turn) - V[:, 1] * np.sin(turn), V[:, 0] * np.sin(turn) + V[:, 1] * np.cos(turn)], axis=1
    )
    result = polish(V, F, twisted, energy=energy, time_limit=0.3, callback=lambda step: time.sleep(0.2))
    assert result.status is Status.TIME_LIMIT
    assert result.injective
    assert result.success
    assert not result.converged
    with pytest.raises(TimeoutError, match="no map was computed within the time limit of 1e-09 s"):
        polish(V, F, twisted, time_limit=1e-9)


def test_a_flattening_ends_with_a_bijective_map_or_an_error():
    V, F = dome()
    with pytest.raises(TimeoutError, match=r"no map was computed within the time limit of 1e-09 s"):
        flatten(V, F, time_limit=1e-9)

    def wait(step):
        time.sleep(0.2)

    result = flatten(V, F, time_limit=1.0, callback=wait, max_iterations=50)
    assert result.status in (Status.TIME_LIMIT, Status.POLISHED)
    assert result.certificate.bijective


def test_ctrl_c_within_the_limit_is_an_interrupt():
    V, F, loop, target = folded()

    def stop(step):
        raise KeyboardInterrupt

    assert injective_map(V, F, loop, target, time_limit=60, callback=stop).status is Status.INTERRUPTED


def test_a_generous_limit_changes_nothing():
    V, F = surfaces.disk(6)
    (loop,) = boundary_loops(F, len(V))
    one, other = (injective_map(V, F, loop, V[loop] * [2, 1], time_limit=limit) for limit in (None, 600.0))
    np.testing.assert_array_equal(one.uv, other.uv)
    assert one.status is other.status


@pytest.mark.parametrize("limit", [0, -1.0, np.nan, "soon"])
def test_a_wrong_limit_is_an_error(limit):
    V, F = surfaces.disk(3)
    with pytest.raises(ValueError, match="time_limit"):
        polish(V, F, V, time_limit=limit)


def test_islands_have_the_limit_each():
    V, F = surfaces.disk(20)
    mesh = atlas.SeamedMesh(V, F, F, np.stack([V[:, 0], V[:, 1] * (1 + 0.9 * V[:, 0])], axis=1))
    found = atlas.polish(mesh, time_limit=0.2, callback=lambda step: time.sleep(0.15))
    assert found.status is Status.TIME_LIMIT
    assert found.injective
