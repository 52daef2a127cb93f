"""Charts of large surfaces come from a search on a coarse mesh; their promises are those of all charts."""

from __future__ import annotations

import numpy as np
import pytest

from quasiharmonic import unwrap
from quasiharmonic.apps.unwrapping.chart_search import Workers
from quasiharmonic.apps.unwrapping.coarse_search import CoarseSearch, cut_into_charts
from quasiharmonic.geometry.mesh.reference import surface_area
from quasiharmonic.geometry.mesh.splitting import split_parts
from quasiharmonic.surfaces import starfish
from quasiharmonic.targets.cuts.shortening import cut_by_levels
from shared.hinges import stretches

V, F = starfish(5, 30)  # 5,402 vertices, more than the search takes at once


def keep_all(charts, points, cost, unit):
    """Divide no chart."""
    return charts


@pytest.fixture(scope="module")
def result():
    return unwrap(V, F, jobs=1)


@pytest.mark.long
def test_charts_keep_the_promises(result):
    assert result.certificate.bijective
    assert result.stretch.p99 <= 1.5
    assert result.stretch.worst <= 3
    # The stretch of the file's coordinates, by singular values of their own.
    low, high = stretches(V, F, result)
    scale = np.sqrt(np.median(low) * np.median(high))
    assert max(high.max() / scale, scale / low.min()) < 3.5
    np.testing.assert_array_equal(result.vmapping[result.indices], F)
    # A starfish of a sixth of the vertices, which is searched as it is, has about as many charts.
    assert result.n_charts <= 2 * unwrap(*starfish(5, 12)).n_charts + 2


@pytest.mark.long
def test_the_number_of_threads_does_not_matter(result):
    again = unwrap(V, F, jobs=2)
    np.testing.assert_array_equal(result.uvs, again.uvs)
    np.testing.assert_array_equal(result.indices, again.indices)


@pytest.mark.long
def test_seams_and_charts_that_are_demanded_need_no_coarse_search(result):
    seam = F[len(F) // 2, :2]
    kept = unwrap(V, F, seams=[seam])
    assert kept.certificate.bijective
    assert (kept.seams == np.sort(seam)).all(axis=1).any()
    assert unwrap(V, F, max_charts=2).n_charts <= 2


@pytest.mark.long
def test_a_coarse_mesh_that_is_large_is_searched_on_a_coarser_one():
    W, T = starfish(5, 60)
    search, sizes = CoarseSearch(1.5, 0.1, Workers(1, None), W, keep_all), []

    def find(graph, vertices, rounds):
        sizes.append(graph.n)
        return search(graph, vertices, rounds)

    seams = cut_by_levels(W, T, None, find, 3, goal=len(W) // 3, sweeps=3)
    assert 5_000 < sizes[0] < len(W) / 2
    parts = split_parts(T, np.arange(len(T)), seams, len(W))
    assert 1 < len(parts) <= 2 * unwrap(*starfish(5, 12)).n_charts + 2
    assert sum(len(rows) for rows, _, _ in parts) == len(T)


def test_a_surface_without_interior_vertices_has_no_coarser_mesh():
    k = np.arange(3_000)
    side = np.stack([np.cos(k / 50), np.sin(k / 50), k / 500], axis=1)
    W = np.concatenate([side, side + np.array([0, 0, 0.02])])
    one, other = k[:-1], k[:-1] + len(k)
    T = np.concatenate([np.stack([one, one + 1, other], axis=1), np.stack([one + 1, other + 1, other], axis=1)])
    search = CoarseSearch(1.5, 0.1, Workers(1, None), W, keep_all)
    (chart,) = cut_into_charts(W, T, np.empty((0, 2), dtype=np.int64), np.ones(T.shape), 0.1, search)
    assert len(chart.F) == len(T)


def test_charts_are_divided_on_the_coarse_mesh():
    """The divided charts have the area of the surface in its unit, and their seams are carried to the surface."""
    W, T = 100 * V, F

    def halve(charts, points, cost, unit):
        areas.append(unit**2 * sum(chart.shape.area for chart in charts))
        return [part for chart in charts for part in chart.split(np.arange(len(chart.F)) < len(chart.F) // 2)]

    counts, areas = [], list[float]()
    for divide in (keep_all, halve):
        search = CoarseSearch(1.5, 0.1, Workers(1, None), W, divide)
        charts = cut_into_charts(W, T, np.empty((0, 2), dtype=np.int64), np.ones(T.shape), 0.1, search)
        counts.append(len(charts))
    assert counts[1] >= 2 * counts[0]
    # The coarse mesh is a little smaller than the surface.
    assert 0.9 < areas[0] / surface_area(W, T) < 1.01
