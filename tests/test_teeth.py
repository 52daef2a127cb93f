"""Teeth in the outlines of charts: triangles that move across a seam, which becomes shorter."""

from __future__ import annotations

import itertools

import numpy as np
import pytest

from quasiharmonic.apps.unwrapping.chart_maps import WorkingChart
from quasiharmonic.apps.unwrapping.hinges import DEMANDED_COST, UNDIVIDED_COST
from quasiharmonic.apps.unwrapping.triangle_moves import move_teeth
from quasiharmonic.geometry.mesh.splitting import fans, renumber
from quasiharmonic.surfaces import grid

V, F = grid(8, 8)
V = np.pad(8 * V, [(0, 0), (0, 1)])
# Seams run along the diagonal. The triangle above the diagonal of one square is a tooth of the lower chart.
ABOVE = np.diff(V[F].mean(axis=1)[:, :2])[:, 0] > 0
(TOOTH,) = np.flatnonzero(np.linalg.norm(V[F].mean(axis=1) - [4 + 1 / 3, 4 + 2 / 3, 0], axis=1) < 1e-9)


def make_chart(rows, cost, cut=None):
    split = fans(F[rows], cut)[0]
    own, corner = renumber(split, F[rows])
    origin = F[rows].ravel()[corner]
    return WorkingChart(rows, origin, V[origin], own, cost[rows])


def make_charts(cost=None, upper=(1, 1)):
    """Two charts with a tooth; the upper one is stretched."""
    below = ~ABOVE
    below[TOOTH] = True
    cost = np.ones(F.shape) if cost is None else cost
    lower, above = (make_chart(np.flatnonzero(rows), cost) for rows in (below, ~below))
    lower.use(lower.V[:, :2])
    above.use(above.V[:, :2] * upper + [0, 9])
    return [lower, above]


def find_base():
    """Side of the tooth on the diagonal."""
    ends = V[F[TOOTH]], V[np.roll(F[TOOTH], -1)]
    return int(np.argmax(np.linalg.norm(ends[0] - ends[1], axis=1)))


@pytest.mark.parametrize("upper", [(1, 1), (1.2, 1)])
def test_a_tooth_moves_into_its_notch(upper):
    charts = make_charts(upper=upper)
    moved = move_teeth(charts, 1.3)
    for before, chart, rows in zip(charts, moved, (~ABOVE, ABOVE), strict=True):
        np.testing.assert_array_equal(chart.triangles, np.flatnonzero(rows))
        np.testing.assert_array_equal(chart.vertices[chart.F], F[rows])
        assert chart.bijective
        (loop,), (longer,) = chart.piece.loops, before.piece.loops
        assert len(loop) == len(longer) - 1
    assert moved[1].stretch.max() < 1.1
    # The charts that were given stay as they were.
    assert TOOTH in charts[0].triangles


@pytest.mark.parametrize("factor", [DEMANDED_COST, UNDIVIDED_COST])
def test_demanded_seams_and_polygons_stay(factor):
    cost = np.ones(F.shape)
    cost[TOOTH, find_base() - 1] = factor
    charts = make_charts(cost)
    assert move_teeth(charts, 1.3) == charts


def test_seams_stay_where_the_third_side_costs_more():
    cost = np.ones(F.shape)
    keys = np.sort(np.stack([F, np.roll(F, -1, axis=1)], axis=2), axis=2)
    base = keys[TOOTH, find_base()]
    cost[(keys == base).all(axis=2)] = 2
    charts = make_charts(cost)
    assert move_teeth(charts, 1.3) == charts


def test_teeth_that_would_be_stretched_stay():
    charts = make_charts(upper=(2, 1))
    assert move_teeth(charts, 1.3) == charts
    assert TOOTH in move_teeth(charts, 1.5)[1].triangles


def test_teeth_stay_if_something_lies_in_the_notch():
    charts = make_charts()
    uv, far = charts[1].uv, int(np.flatnonzero((charts[1].V[:, :2] == [0, 8]).all(axis=1))[0])
    notch = [int(np.flatnonzero(charts[1].vertices == vertex)[0]) for vertex in F[TOOTH]]
    uv[far] = uv[notch].mean(axis=0)
    assert move_teeth(charts, 1.3) == charts


def test_teeth_of_slits_move_to_the_other_side():
    tail, head = F.ravel(), np.roll(F, -1, axis=1).ravel()
    place = V[:, :2]
    path = np.array([[2, 2], [3, 3], [4, 4], [4, 5], [5, 5], [6, 6]])
    numbers = [int(np.flatnonzero((place == point).all(axis=1))[0]) for point in path]
    slit = {frozenset(pair) for pair in itertools.pairwise(numbers)}
    cut = np.array([frozenset(pair) in slit for pair in zip(tail.tolist(), head.tolist(), strict=True)])
    chart = make_chart(np.arange(len(F)), np.ones(F.shape), cut.reshape(-1, 3))
    above = ABOVE.copy()
    above[TOOTH] = False
    uv = chart.V[:, :2].copy()
    upper = np.setdiff1d(chart.F[above], chart.F[~above])
    opened = upper[np.isin(chart.vertices[upper], numbers)]
    uv[opened] += [-0.15, 0.15]
    chart.use(uv)
    assert chart.bijective
    (moved,) = move_teeth([chart], 1.5)
    assert moved.bijective
    assert sorted(map(len, moved.piece.loops)) == [8, 32]
    assert sorted(map(len, chart.piece.loops)) == [10, 32]
    np.testing.assert_array_equal(moved.vertices[moved.F], F)


def test_no_charts():
    assert move_teeth([], 1.3) == []
