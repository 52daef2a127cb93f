"""Charts under a bound on stretch: covering, bijectivity, stretch by an independent formula, limits."""

from __future__ import annotations

import time

import numpy as np
import pytest

from quasiharmonic import certify, find_cuts
from quasiharmonic.apps.unwrapping import chart_search
from quasiharmonic.apps.unwrapping.chart_cuts import divide
from quasiharmonic.apps.unwrapping.chart_maps import EvenStretch, WorkingChart
from quasiharmonic.apps.unwrapping.charts import find_charts
from quasiharmonic.apps.unwrapping.triangle_moves import join_small_charts
from quasiharmonic.energies.derivatives import check_energy
from quasiharmonic.surfaces import disk, grid, starfish
from shared.closed_surfaces import torus


def sphere(rings):
    V, F = starfish(1, rings)
    return V / np.linalg.norm(V, axis=1)[:, None], F


def jacobian_stretch(V, F, uv):
    """max(σ₁, 1/σ₂) of each triangle from a singular value decomposition, without a common scale."""
    a, b, c = V[F].swapaxes(0, 1)
    x = (b - a) / np.linalg.norm(b - a, axis=1)[:, None]
    normal = np.cross(b - a, c - a)
    y = np.cross(normal / np.linalg.norm(normal, axis=1)[:, None], x)
    rest = np.stack(
        [np.stack([((p - a) * axis).sum(axis=1) for axis in (x, y)], axis=1) for p in (b, c)],
        axis=2,
    )
    image = np.stack([uv[F[:, 1]] - uv[F[:, 0]], uv[F[:, 2]] - uv[F[:, 0]]], axis=2)
    sigma = np.linalg.svd(image @ np.linalg.inv(rest), compute_uv=False)
    return np.maximum(sigma[:, 0], 1 / sigma[:, 1])


def areas(V, F):
    return 0.5 * np.linalg.norm(np.cross(V[F[:, 1]] - V[F[:, 0]], V[F[:, 2]] - V[F[:, 0]]), axis=1)


def share_over(V, F, charts, bound):
    """Share of the area whose stretch, computed independently, exceeds a bound."""
    area, stretch = areas(V, F), np.zeros(len(F))
    for chart in charts:
        stretch[chart.triangles] = jacobian_stretch(V[chart.vertices], chart.F, chart.uv)
    return area[stretch > bound].sum() / area.sum(), stretch.max()


def seams(F, charts):
    """Edges whose two triangles do not share both vertices in one chart."""
    sides = {}
    offset = 0
    for chart in charts:
        for triangle, own in zip(F[chart.triangles].tolist(), (chart.F + offset).tolist(), strict=True):
            for k in range(3):
                i, j = triangle[k], triangle[(k + 1) % 3]
                pair = own[k], own[(k + 1) % 3]
                sides.setdefault((min(i, j), max(i, j)), []).append(pair if i < j else pair[::-1])
        offset += len(chart.vertices)
    return {edge for edge, pairs in sides.items() if len(pairs) == 2 and pairs[0] != pairs[1]}


def check(V, F, charts):
    """Charts cover every triangle once, keep their corners, and are certified."""
    assert np.array_equal(np.sort(np.concatenate([chart.triangles for chart in charts])), np.arange(len(F)))
    for chart in charts:
        assert np.array_equal(chart.vertices[chart.F], F[chart.triangles])
        assert (np.diff(chart.triangles) > 0).all()
        assert certify(chart.F, chart.uv).bijective
        own = V[chart.vertices]
        measured = areas(np.c_[chart.uv, np.zeros(len(chart.uv))], chart.F).sum()
        assert measured == pytest.approx(areas(own, chart.F).sum(), rel=1e-9)
        assert chart.stretch == pytest.approx(jacobian_stretch(own, chart.F, chart.uv), rel=1e-6)


SURFACES = {
    "sphere": lambda: sphere(9),
    "torus": lambda: torus(28, 14),
    "starfish": lambda: starfish(3, 6),
}


@pytest.mark.slow
@pytest.mark.parametrize("name", SURFACES)
@pytest.mark.parametrize("bound", [1.2, 1.5])
def test_charts_keep_the_bound(name, bound):
    V, F = SURFACES[name]()
    charts = find_charts(V, F, max_stretch=bound)
    check(V, F, charts)
    share, worst = share_over(V, F, charts, bound)
    assert share <= 0.01
    assert worst <= 3
    assert all(chart.misses == 0 for chart in charts)


@pytest.mark.slow
def test_a_larger_bound_needs_shorter_seams():
    V, F = sphere(9)
    tight, loose = (find_charts(V, F, max_stretch=bound) for bound in (1.1, 1.6))
    assert len(seams(F, tight)) > len(seams(F, loose))
    assert len(loose) <= len(tight)


@pytest.mark.slow
def test_charts_do_not_depend_on_the_unit_or_on_the_number_of_threads():
    V, F = starfish(3, 6)
    one, two, moved = find_charts(V, F, jobs=1), find_charts(V, F, jobs=2), find_charts(V * 2.0**40, F)
    assert len(one) == len(two) == len(moved)
    for first, second, third in zip(one, two, moved, strict=True):
        assert np.array_equal(first.triangles, second.triangles)
        assert np.array_equal(first.uv, second.uv)
        assert np.array_equal(first.uv * 2.0**40, third.uv)


@pytest.mark.slow
def test_a_limit_on_charts_is_kept_and_what_it_costs_is_reported():
    V, F = sphere(9)
    charts = find_charts(V, F, max_stretch=1.02, max_charts=2)
    check(V, F, charts)
    assert len(charts) <= 2
    share, worst = share_over(V, F, charts, 1.02)
    assert share > 0.01
    assert max(chart.misses for chart in charts) > 0.01
    for chart in charts:
        order = np.argsort(chart.stretch)
        below = np.cumsum(areas(V, F)[chart.triangles][order])
        quantile = chart.stretch[order[np.searchsorted(below, 0.99 * below[-1])]]
        assert chart.misses == pytest.approx(max(quantile - 1.02, worst - 3, 0), rel=1e-6)


def test_a_division_into_three_parts_does_not_exceed_a_limit_on_charts(monkeypatch):
    def divide_twice(chart, bound):
        first, *others = divide(chart, bound)
        first.uv = None
        return [*divide(first, bound), *others]

    V, F = sphere(6)
    monkeypatch.setattr(chart_search, "divide", divide_twice)
    assert len(find_charts(V, F, max_stretch=1.02)) > 2
    assert len(find_charts(V, F, max_stretch=1.02, max_charts=2)) <= 2


@pytest.mark.long
def test_a_bound_that_no_charts_keep_is_reported():
    V, F = sphere(2)
    charts = find_charts(V, F, max_stretch=1.0)
    check(V, F, charts)
    assert max(chart.misses for chart in charts) > 0


@pytest.mark.slow
def test_planar_parts_and_single_triangles_are_isometric():
    rng = np.random.default_rng(3)
    flat, F = disk(5)
    turn, _ = np.linalg.qr(rng.normal(size=(3, 3)))
    V = np.c_[flat, np.zeros(len(flat))] @ turn + [5, 6, 7]
    alone = rng.normal(size=(300, 3))
    V, F = np.concatenate([V, alone]), np.concatenate([F, len(V) + np.arange(300).reshape(-1, 3)])
    charts = find_charts(V, F)
    assert len(charts) == 101
    check(V, F, charts)
    for chart in charts:
        sides = [
            np.linalg.norm(np.diff(x[chart.F[:, (0, 1, 2, 0)]], axis=1), axis=2) for x in (V[chart.vertices], chart.uv)
        ]
        assert sides[0] == pytest.approx(sides[1], rel=1e-9)


def test_a_planar_spiral_that_overlaps_itself_is_divided():
    t = np.linspace(0, 4 * np.pi, 121)
    inner, outer = (np.c_[r * np.cos(t), r * np.sin(t), np.zeros(t.size)] for r in (1, 2))
    V = np.concatenate([inner, outer])
    k, n = np.arange(120), 121
    F = np.concatenate([np.c_[k, k + n, k + 1], np.c_[k + 1, k + n, k + n + 1]])
    charts = find_charts(V, F)
    check(V, F, charts)
    assert 2 <= len(charts) <= 5


@pytest.mark.slow
def test_given_cuts_are_seams():
    V, F = sphere(10)
    given = find_cuts(V, F)
    far = find_cuts(V[:, [1, 2, 0]], F, min_gain=1e-2)
    assert not {tuple(edge) for edge in far.tolist()} <= {tuple(edge) for edge in given.tolist()}
    charts = find_charts(V, F, uv_cuts=far)
    check(V, F, charts)
    assert {tuple(edge) for edge in far.tolist()} <= seams(F, charts)


@pytest.mark.slow
def test_seams_avoid_sides_with_high_costs():
    V, F = sphere(9)
    below = V[F].mean(axis=1)[:, 2] < 0
    costs = np.where(below, 1.0, 20.0)[:, None] * np.ones(3)
    plain, directed = (find_charts(V, F, edge_costs=given) for given in (None, costs))
    check(V, F, directed)

    def share_below(charts):
        cut = np.array(sorted(seams(F, charts)))
        return (V[cut].mean(axis=1)[:, 2] < 0).mean()

    assert share_below(directed) > share_below(plain) + 0.2


@pytest.mark.long
@pytest.mark.parametrize("count", [1_000, pytest.param(10_000, marks=pytest.mark.nightly)])
def test_thousands_of_boxes_take_seconds(count):
    corners = np.array([[x, y, z] for x in (0, 1) for y in (0, 1) for z in (0, 1)], dtype=float)
    quads = np.array([[0, 1, 3, 2], [4, 6, 7, 5], [0, 4, 5, 1], [2, 3, 7, 6], [0, 2, 6, 4], [1, 5, 7, 3]])
    F = np.concatenate([quads[:, (0, 1, 2)], quads[:, (0, 2, 3)]])
    rng = np.random.default_rng(5)
    V = (corners * rng.uniform(0.5, 2, (count, 1, 3)) + rng.normal(size=(count, 1, 3)) * 100).reshape(-1, 3)
    F = (F + 8 * np.arange(count)[:, None, None]).reshape(-1, 3)
    began = time.process_time()
    charts = find_charts(V, F)
    assert time.process_time() - began < 30 * count / 10_000
    assert len(charts) == count
    check(V[: 8 * 50], F[: 12 * 50], charts[:50])
    for chart in charts[:50]:
        own = V[chart.vertices]
        sides = [np.linalg.norm(np.diff(x[chart.F[:, (0, 1, 2, 0)]], axis=1), axis=2) for x in (own, chart.uv)]
        assert sides[0] == pytest.approx(sides[1], rel=1e-9)
        # The two triangles of a face stay together.
        assert len(own) == 14


@pytest.mark.slow
def test_a_callback_reports_phases_and_stops_the_search():
    V, F = starfish(3, 6)
    heard = []
    find_charts(V, F, callback=lambda *step: heard.append(step))
    assert {phase for phase, _, _ in heard} >= {"cut", "flatten"}
    assert all(0 <= done <= total for _, done, total in heard)

    def stop(phase, done, total):
        if phase == "flatten":
            raise RuntimeError("enough")

    with pytest.raises(RuntimeError, match="enough"):
        find_charts(V, F, callback=stop, jobs=2)


@pytest.mark.parametrize("linear", [True, False])
def test_derivatives_of_the_even_stretch(linear):
    assert check_energy(EvenStretch(1.3, linear=linear)).passed


@pytest.mark.parametrize(("degrees", "expected"), [(25, 1), (55, 2)])
def test_small_charts_are_joined_unless_they_overlap(degrees, expected):
    """A fan of 330 degrees, and a further triangle at its end with or without room."""
    around = np.radians([*55 * np.arange(7), 330 + degrees])
    V = np.concatenate([[[0, 0, 0]], np.column_stack([np.cos(around), np.sin(around), 0 * around])])
    F = np.array([[0, k, k + 1] for k in range(1, 8)])
    charts = [
        WorkingChart(np.arange(6), np.arange(8), V[:8], F[:6], np.ones((6, 3))),
        WorkingChart(np.array([6]), np.array([0, 7, 8]), V[[0, 7, 8]], np.array([[0, 1, 2]]), np.ones((1, 3))),
    ]
    for chart in charts:
        chart.use(chart.V[:, :2] @ [[0, 2], [-2, 0]])
    joined = join_small_charts(charts, 1.3, 200.0, lambda: None)
    assert len(joined) == expected
    assert all(chart.bijective and chart.stretch.max() < 1 + 1e-12 for chart in joined)
    if expected == 1:
        np.testing.assert_array_equal(joined[0].vertices[joined[0].F], F)
        assert len(joined[0].vertices) == 9


@pytest.mark.slow
def test_charts_are_not_joined_across_given_seams():
    """The seams cut off a corner, which is not planar."""
    V, F = grid(20, 20)
    points = np.column_stack([V, 0.02 * np.random.default_rng(2).random(len(V))])
    near = np.abs(V[F].mean(axis=1) - V[0]).max(axis=1) < np.ptp(V[:, 0]) / 20
    sides, times = np.unique(np.sort(F[near][:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2)), axis=0, return_counts=True)
    seams = sides[(times == 1) & ~(sides == 0).any(axis=1)]
    assert len(seams) == 2
    assert len(find_charts(points, F, uv_cuts=seams)) == 1 + len(find_charts(points, F))
