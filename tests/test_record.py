"""The recorded path: the maps of every k-th iteration, and none by default."""

from __future__ import annotations

import numpy as np
import pytest

from quasiharmonic import Problem, injective_map, solve
from quasiharmonic.solver.methods import Newton, VectorAdam
from quasiharmonic.surfaces import annulus
from shared.meshes import boundary_of, signed_areas


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


def test_a_negative_interval_is_rejected():
    with pytest.raises(ValueError, match="record"):
        solve(Problem(*turned_ring()), record_every=-1)
