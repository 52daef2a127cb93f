"""Strips of quadrilaterals as rectangles: `unwrap` with ``straighten=True``."""

from __future__ import annotations

import json

import numpy as np
import pytest

from quasiharmonic import unwrap
from quasiharmonic.results import UnwrapStatus
from quasiharmonic.surfaces import disk
from quasiharmonic.util.progress import heartbeat
from shared.closed_surfaces import torus

AROUND, ALONG = 12, 9


def tube(place, around=AROUND, along=ALONG, closed=True, turned=None):
    """Quadrilaterals on a surface given by a map from angle and height; ``turned`` ones have the other diagonal."""
    angle, height = np.meshgrid(2 * np.pi * np.arange(around + 1 - closed) / around, np.arange(along + 1) / along)
    V = np.stack(place(angle.ravel(), height.ravel()), axis=1)
    columns = angle.shape[1]
    i, j = (k.ravel() for k in np.meshgrid(np.arange(around), np.arange(along)))
    a, b = j * columns + i, j * columns + (i + 1) % columns
    c, d = b + columns, a + columns
    turned = np.zeros(i.size, dtype=bool) if turned is None else turned
    one = np.where(turned[:, None], np.stack([a, b, d], 1), np.stack([a, b, c], 1))
    other = np.where(turned[:, None], np.stack([b, c, d], 1), np.stack([a, c, d], 1))
    return V, np.stack([one, other], 1).reshape(-1, 3)


def bent(angle, height, radius=0.25):
    """A quarter of a torus."""
    far, turn = 1 + radius * np.cos(angle), height * np.pi / 2
    return far * np.cos(turn), far * np.sin(turn), radius * np.sin(angle)


def frustum(angle, height):
    radius = 1 - 0.3 * height
    return radius * np.cos(angle), radius * np.sin(angle), 3 * height


def shares_on_axes(result, rows=slice(None)):
    """Outline's edges along an axis, and all edges of the outline; `rows` are triangles."""
    T = result.indices[rows]
    side = np.concatenate([T[:, [0, 1]], T[:, [1, 2]], T[:, [2, 0]]])
    _, first, times = np.unique(np.sort(side, axis=1), axis=0, return_index=True, return_counts=True)
    step = np.diff(result.uvs[side[first[times == 1]]], axis=1)[:, 0]
    return (np.abs(step).min(axis=1) <= 2.0**-23).mean()


@pytest.mark.parametrize("shape", [bent, frustum])
@pytest.mark.parametrize("seed", [None, 0])
def test_a_tube_of_quadrilaterals_becomes_a_rectangle(shape, seed):
    turned = None if seed is None else np.random.default_rng(seed).random(AROUND * ALONG) < 0.5
    V, F = tube(shape, turned=turned)
    before, result = (unwrap(V, F, resolution=512, straighten=on) for on in (False, True))
    assert result.success
    assert result.n_charts == 1
    assert shares_on_axes(result) == 1
    assert shares_on_axes(before) < 0.9
    low, high = result.uvs.min(axis=0), result.uvs.max(axis=0)
    np.testing.assert_allclose(result.utilisation, np.prod(high - low), rtol=1e-6)
    (strip,) = result.strips
    assert (strip.triangle, strip.columns, strip.rows, strip.straightened) == (0, AROUND, ALONG, True)
    assert 1 < strip.stretch <= 1.5
    np.testing.assert_allclose(result.stretch.worst, strip.stretch, rtol=1e-4)
    # The cut runs along one column, from boundary to boundary.
    assert len(result.seams) == ALONG
    assert before.strips == ()


def test_a_tube_is_cut_where_its_columns_are_shortest():
    V, F = tube(bent)
    result = unwrap(V, F, resolution=512, straighten=True)
    # The inner side of the bend.
    np.testing.assert_allclose(np.hypot(*V[result.seams, :2].T), 0.75, rtol=1e-12)


def test_rows_and_columns_keep_their_mean_lengths():
    V, F = tube(frustum, closed=False)
    result = unwrap(V, F, resolution=512, straighten=True)
    size = np.ptp(result.uvs, axis=0) * 512 / result.texels_per_unit
    slope, rim = np.hypot(3, 0.3 * np.cos(np.pi / AROUND)), 2 * AROUND * np.sin(np.pi / AROUND) * 0.85
    np.testing.assert_allclose(np.sort(size), np.sort([slope, rim]), rtol=0.02)


def test_strips_end_at_creases():
    V, F = tube(frustum)
    n = len(V)
    first = np.arange(AROUND)
    V = np.append(V, [[0, 0, 0]], axis=0)
    F = np.concatenate([F, np.stack([np.full(AROUND, n), (first + 1) % AROUND, first], 1)])
    result = unwrap(V, F, resolution=512, straighten=True)
    (strip,) = result.strips
    assert (strip.columns, strip.rows, strip.straightened) == (AROUND, ALONG, True)
    assert result.n_charts == 2
    assert shares_on_axes(result, slice(0, 2 * AROUND * ALONG)) == 1
    assert result.success


@pytest.mark.parametrize("options", [{"max_stretch": 1.1}, {"max_charts": 1}])
def test_strips_that_exceed_a_bound_stay_as_they_are(options):
    V, F = tube(frustum)
    if "max_charts" in options:
        n = len(V)
        lid = np.stack([np.full(AROUND, n), (np.arange(AROUND) + 1) % AROUND, np.arange(AROUND)], 1)
        V, F = np.append(V, [[0, 0, 0]], axis=0), np.concatenate([F, lid])
    before, result = (unwrap(V, F, resolution=512, straighten=on, **options) for on in (False, True))
    np.testing.assert_array_equal(result.uvs, before.uvs)
    (strip,) = result.strips
    assert not strip.straightened
    assert "0 of 1 strip straightened" in result.summary()
    assert json.loads(json.dumps(result.to_dict()))["strips"][0]["straightened"] is False


def almost(V, F):
    """Without its last triangle."""
    return V, F[:-1]


@pytest.mark.parametrize("model", [disk(4), torus(12, 8), almost(*tube(bent, 16)), tube(frustum, 5, 1)])
def test_what_is_no_grid_stays_as_it_is(model):
    V, F = model
    before, result = (unwrap(V, F, resolution=256, straighten=on) for on in (False, True))
    np.testing.assert_array_equal(result.uvs, before.uvs)
    assert result.strips == ()


def test_straight_developable_strips_are_unrolled_without_stretch():
    V, F = tube(lambda angle, height: (np.cos(angle), np.sin(angle), 4 * height))
    result = unwrap(V, F, resolution=256, straighten=True)
    assert result.strips == ()
    assert result.stretch.worst < 1.001


def test_polygons_decide_how_triangles_are_paired():
    # Triangles with almost equal sides could be paired in three directions.
    V, F = tube(lambda angle, height: (angle + 2.4 * height, np.cos(angle), 4 * height), closed=False)
    inside = F[::2][:, [0, 2]]
    keys = set(map(tuple, np.sort(inside, axis=1).tolist()))
    costs = np.array([[1e3 if tuple(sorted((t[k], t[k - 2]))) in keys else 1 for k in range(3)] for t in F.tolist()])
    result = unwrap(V, F, resolution=256, straighten=True, edge_costs=costs, max_stretch=3)
    assert [(strip.columns, strip.rows) for strip in result.strips] == [(AROUND, ALONG)]


def test_demanded_seams_divide_strips_and_given_seams_are_kept():
    V, F = tube(bent)
    first = unwrap(V, F, resolution=256)
    result = unwrap(V, F, resolution=256, straighten=True, uv=first.uvs[first.indices])
    assert {*map(tuple, first.seams.tolist())} <= {*map(tuple, result.seams.tolist())}
    across = np.stack([np.arange(AROUND), (np.arange(AROUND) + 1) % AROUND], 1) + 3 * AROUND
    uv = np.zeros((len(F), 3, 2))
    uv[6 * AROUND :] = 1
    result = unwrap(V, F, resolution=256, straighten=True, uv=uv)
    assert [(strip.columns, strip.rows) for strip in result.strips] == [(AROUND, 3), (AROUND, ALONG - 3)]
    assert {*map(tuple, np.sort(across, axis=1).tolist())} <= {*map(tuple, result.seams.tolist())}
    assert shares_on_axes(result) == 1


def test_strips_are_listed_after_a_time_limit(monkeypatch):
    V, F = tube(bent)
    other = disk(3)
    points, triangles = np.concatenate([V, np.pad(other[0], [(0, 0), (0, 1)]) + 9]), [F, other[1] + len(V)]

    def search(*arguments, **options):
        while True:
            heartbeat()

    monkeypatch.setattr("quasiharmonic.apps.unwrapping.stages.find_charts", search)
    result = unwrap(points, np.concatenate(triangles), resolution=512, straighten=True, time_limit=2)
    assert result.status is UnwrapStatus.TIME_LIMIT
    assert [strip.straightened for strip in result.strips] == [True]
    assert shares_on_axes(result, slice(len(F))) == 1
