"""Ctrl-C at an inconvenient moment of a call: the result is the best map so far, and nothing that was found is lost."""

from __future__ import annotations

import time
from dataclasses import replace
from unittest.mock import DEFAULT, Mock

import numpy as np
import pytest

from quasiharmonic import (
    Problem,
    Status,
    boundary_loops,
    certify,
    harmonise,
    injective_tetrahedra,
    keep_distances,
    polish,
    solve,
    warp_by_landmarks,
)
from quasiharmonic.apps.tetrahedra.result import TetrahedraStatus
from quasiharmonic.energies.polishing import polish_map, smooth
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


def test_before_the_first_step_of_the_short_polish(monkeypatch):
    problem = star(8)
    found = solve(problem)
    monkeypatch.setattr("quasiharmonic.energies.polishing.polish_map", Mock(side_effect=KeyboardInterrupt))
    result = smooth(problem, found)
    assert result.status is Status.INTERRUPTED
    assert result.uv is found.uv


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


def once(function):
    """A function that is interrupted when it is first called."""
    return Mock(side_effect=[KeyboardInterrupt, *9 * [DEFAULT]], wraps=function)


@pytest.mark.parametrize("limit", [None, 60.0])
def test_in_the_certificate_of_a_search(monkeypatch, limit):
    monkeypatch.setattr(f"{SEARCH}.certify", once(certify))
    result = solve(star(8), polish="mips", time_limit=limit)
    assert result.injective
    assert result.status is Status.INTERRUPTED
    assert [stage.name for stage in result.stages] == [solve(star(8)).stages[0].name]


def test_before_the_first_step_of_a_polish(monkeypatch):
    monkeypatch.setattr("quasiharmonic.energies.polishing.newton_descent", Mock(side_effect=KeyboardInterrupt))
    result = solve(star(8), polish="mips")
    assert result.injective
    assert result.status is Status.INTERRUPTED


@pytest.mark.parametrize(("function", "energy"), [(polish, "mips"), (harmonise, "area")])
def test_in_the_certificate_of_a_descent(monkeypatch, function, energy):
    V, F = disk(4)
    uv = V * np.linalg.norm(V, axis=1, keepdims=True)
    whole = function(V, F, uv, energy=energy)
    monkeypatch.setattr("quasiharmonic.problem.run.certify", once(certify))
    result = function(V, F, uv, energy=energy)
    assert result.status is Status.INTERRUPTED
    assert result.injective
    np.testing.assert_array_equal(result.uv, whole.uv)


@pytest.mark.parametrize("function", [polish, harmonise, keep_distances])
def test_at_the_start_of_a_descent_the_map_is_unchanged(function):
    flat, F = disk(6)
    V = np.column_stack([flat, np.sqrt(1.1 - (flat**2).sum(axis=1))])
    stop = stop_at(0)
    result = function(V, F, 1.5 * flat, callback=stop)
    assert result.status is Status.INTERRUPTED
    assert result.injective
    assert (result.n_iterations, len(result.history), stop.call_count) == (0, 1, 1)
    if function is not keep_distances:
        np.testing.assert_array_equal(result.uv, 1.5 * flat)


def test_while_distances_are_sampled(monkeypatch):
    sample = "quasiharmonic.apps.flattening.distance_descent.sample_distances"
    monkeypatch.setattr(sample, Mock(side_effect=KeyboardInterrupt))
    V, F = disk(6)
    result = keep_distances(V, F, 1.5 * V)
    assert result.status is Status.INTERRUPTED
    assert result.certificate.bijective
    assert 0 < result.seconds < 60
    np.testing.assert_array_equal(result.uv, 1.5 * V)
    np.testing.assert_array_equal(result.V[:, :2], V)


def landmarks(**options):
    return warp_by_landmarks(np.zeros((30, 30)), [[10, 10]], [[18, 14]], resolution=8, **options)


def test_a_warp_without_a_map_is_an_interrupt(monkeypatch):
    monkeypatch.setattr(
        "quasiharmonic.solver.search.record.StageRun.record_iterate", Mock(side_effect=KeyboardInterrupt)
    )
    with pytest.raises(KeyboardInterrupt):
        landmarks()


@pytest.mark.parametrize("smoothness", [0, 4.0])
def test_a_warp_keeps_an_injective_map(monkeypatch, smoothness):
    monkeypatch.setattr(f"{SEARCH}.certify", once(certify))
    warped = landmarks(smoothness=smoothness)
    assert warped.status is Status.INTERRUPTED
    assert not warped
    assert warped.result.injective
    assert [stage.name for stage in warped.result.stages if "polish" in stage.name or stage.name == "bending"] == []


def tetrahedra(top=2.0):
    """A tetrahedron of four around an inner vertex; ``top`` moves a corner."""
    X = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1], [0.2, 0.2, 0.2]])
    target = 2.0 * X[:4]
    target[3, 2] = top
    return X, [[0, 1, 2, 4], [0, 1, 3, 4], [0, 2, 3, 4], [1, 2, 3, 4]], range(4), target


def test_in_the_certificate_of_tetrahedra(monkeypatch):
    whole = injective_tetrahedra(*tetrahedra())
    contacts = Mock(side_effect=KeyboardInterrupt)
    monkeypatch.setattr("quasiharmonic.apps.tetrahedra.certificate.find_boundary_contacts", contacts)
    result = injective_tetrahedra(*tetrahedra())
    assert contacts.call_count == 1
    assert result.status is TetrahedraStatus.INTERRUPTED
    assert result.valid
    assert result.certificate.injective is None
    assert not result.success
    np.testing.assert_array_equal(result.points, whole.points)


def test_in_the_search_for_obstructions_of_tetrahedra(monkeypatch):
    placement = "quasiharmonic.apps.tetrahedra.placement.find_obstructions"
    assert injective_tetrahedra(*tetrahedra(-1.0)).status is TetrahedraStatus.IMPOSSIBLE
    monkeypatch.setattr(placement, Mock(side_effect=KeyboardInterrupt))
    result = injective_tetrahedra(*tetrahedra(-1.0))
    assert result.status is TetrahedraStatus.INTERRUPTED
    assert not result.valid
