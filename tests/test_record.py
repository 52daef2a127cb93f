"""The recorded path: the maps of every k-th iteration, and none by default."""

from __future__ import annotations

import numpy as np
import pytest

from quasiharmonic import Problem, injective_map, polish, solve
from quasiharmonic.solver.methods import Newton, VectorAdam
from quasiharmonic.surfaces import annulus, grid
from quasiharmonic.targets import boundary_to
from shared.meshes import boundary_of, signed_areas
from shared.solvable_problems import turned_ring as solvable_ring


def turned_ring(rows=8):
    V, F = annulus(rows)
    fixed = boundary_of(F)
    target = V[fixed].copy()
    target[np.abs(target).max(axis=1) < 0.75] *= -1
    return V, F, fixed, target


@pytest.mark.long
@pytest.mark.parametrize(("k", "rows"), [(1, 12), (3, 8), pytest.param(7, 12, marks=pytest.mark.nightly)])
def test_every_kth_map_is_recorded(k, rows):
    V, F, fixed, target = turned_ring(rows)
    result = injective_map(V, F, fixed, target, record_every=k)
    assert result.n_iterations > 20
    assert [s.iteration for s in result.path] == list(range(0, result.n_iterations + 1, k))
    for snapshot in result.path:
        step = result.history[snapshot.iteration]
        assert step.iteration == snapshot.iteration
        assert np.count_nonzero(signed_areas(F, snapshot.uv) <= 0) == step.inverted
        np.testing.assert_array_equal(snapshot.uv[fixed], target)
    if k == 1:
        np.testing.assert_array_equal(result.path[-1].uv, result.uv)
    # Each map has its own array.
    assert len({s.uv.ctypes.data for s in result.path}) == len(result.path)


@pytest.mark.long
def test_recording_changes_nothing_and_is_off_by_default():
    problem = Problem(*turned_ring())
    plain, recorded = solve(problem), solve(problem, record_every=2)
    assert plain.path == []
    np.testing.assert_array_equal(plain.uv, recorded.uv)
    assert plain.history == recorded.history


@pytest.mark.slow
def test_counting_continues_through_the_stages():
    stages = [VectorAdam(iterations=4), Newton(iterations=6, resume=True)]
    result = solve(Problem(*turned_ring()), strategy=stages, record_every=1)
    assert [s.iteration for s in result.path] == [s.iteration for s in result.history]


def test_the_path_continues_through_the_polish():
    V, F = annulus(6)
    fixed = boundary_of(F)
    result = injective_map(V, F, fixed, V[fixed] * [2, 1], polish="mips", record_every=1)
    assert result.stages[-1].n_iterations > 2
    assert [s.iteration for s in result.path] == list(range(len(result.history)))
    np.testing.assert_array_equal(result.path[-1].uv, result.uv)
    alone = polish(V, F, V * (1 + 0.2 * V[:, :1] ** 2), energy="mips", record_every=2)
    assert [s.iteration for s in alone.path] == list(range(0, alone.n_iterations + 1, 2))


@pytest.mark.slow
def test_maps_of_the_given_mesh_are_kept_with_refinement():
    V, F = grid(8, 8)
    split = solve(Problem(V, F, *boundary_to(V, F, "letter:E")), refine=True, polish="mips", record_every=1)
    assert split.added
    # Two attempts on the given mesh.
    stages = [VectorAdam(iterations=2), Newton(iterations=2), Newton(iterations=50)]
    twice = solve(Problem(*solvable_ring(135)), refine=True, record_every=1, strategy=stages)
    assert [attempt.added for attempt in twice.refinement_attempts] == [0, 0]
    for result, polishing, given in ((split, split.stages[-1].n_iterations + 1, F), (twice, 0, twice.F)):
        assert [s.iteration for s in result.path] == list(range(len(result.history) - polishing))
        for snapshot in result.path:
            step = result.history[snapshot.iteration]
            assert np.count_nonzero(signed_areas(given, snapshot.uv) <= 0) == step.inverted


def test_a_negative_interval_is_rejected():
    with pytest.raises(ValueError, match="record"):
        solve(Problem(*turned_ring()), record_every=-1)
