"""Islands that lie exactly on their mirror images, and verdicts on defective maps of many vertices."""

from __future__ import annotations

import tracemalloc

import numpy as np

from quasiharmonic import io, unwrap
from quasiharmonic.apps.unwrapping.chart_verdict import certify_defective
from quasiharmonic.atlas import SeamedMesh, certify, polish
from quasiharmonic.surfaces import disk, grid
from quasiharmonic.ui.cli.written_map import certify_map


def folded(n):
    """A sheet that is symmetric in x, and a map of it that folds one half onto the other."""
    V, F = grid(n, n)
    other = np.where(V[:, 0] == 0, np.arange(len(V)), np.arange(len(V)) + len(V))
    both = np.concatenate([V, V * [-1, 1]])
    F = np.concatenate([F, other[F][:, ::-1]])
    used, F = np.unique(F, return_inverse=True)
    return both[used], F.reshape(-1, 3), np.abs(both[used])


def test_a_part_folded_onto_its_image_is_two_islands():
    V, F, uv = folded(4)
    verdict = certify(SeamedMesh(V, F, F, uv))
    assert [island.mirrored for island in verdict.islands] == [False, True]
    assert verdict.bijective
    assert verdict.overlapping.tolist() == [[0, 1]]


def test_the_image_may_differ_by_rounding():
    V, F, uv = folded(4)
    rng = np.random.default_rng(0)
    uv[V[:, 0] < 0] += 1e-9 * rng.normal(size=(np.count_nonzero(V[:, 0] < 0), 2))
    assert len(SeamedMesh(V, F, F, uv).islands) == 2


def test_polished_halves_stay_apart():
    V, F, uv = folded(5)
    uv[:, 0] **= 1.5
    result = polish(SeamedMesh(V, F, F, uv))
    assert [island.bijective for island in certify(result.mesh).islands] == [True, True]


def test_a_single_fold_is_a_defect():
    V, F = disk(4)
    uv = V.copy()
    one, other = F[0], next(T for T in F[1:] if len(np.intersect1d(F[0], T)) == 2)
    (apex,), (opposite,) = np.setdiff1d(one, other), np.setdiff1d(other, one)
    uv[apex] = uv[opposite]
    verdict = certify(SeamedMesh(V, F, F, uv))
    assert len(verdict.islands) == 1
    assert not verdict.injective


def test_a_vertex_far_away_makes_no_folds():
    V, F = disk(4)
    uv = V.copy()
    uv[0] = 1e67
    assert len(SeamedMesh(V, F, F, uv).islands) == 1


def test_unknown_and_equal_positions_are_no_folds():
    V, F = disk(3)
    for uv in (np.full((len(V), 2), np.nan), np.zeros((len(V), 2))):
        assert len(SeamedMesh(V, F, F, uv).islands) == 1


def test_stacked_charts_of_a_file_are_kept():
    V, F, uv = folded(4)
    V = np.column_stack([V, 0.3 * V[:, 0] ** 2 + 0.2 * V[:, 1] ** 2])
    result = unwrap(V, F, uv=uv, resolution=256)
    assert result.n_charts == 2


def test_defective_maps_take_memory_in_proportion_to_their_size():
    V, F = grid(70, 70)
    uv = V.copy()
    uv[len(V) // 2] += 3 / 70
    tracemalloc.start()
    certify_defective(np.pad(V, [(0, 0), (0, 1)]), F, uv[F], np.arange(len(F)))
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    # All pairs of vertices would take 200 MB.
    assert peak < 50e6


def test_overlapping_positive_triangles_of_mixed_winding_are_not_set_apart():
    V = np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0], [1, 1, 1]])
    found = certify_map(io.MeshData(V, np.array([[0, 1, 2], [0, 1, 3]])).with_map(V[:, :2]))
    assert (found.injective, found.bijective, found.set_apart) == (True, False, None)
