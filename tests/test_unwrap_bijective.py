"""All charts of `unwrap` are bijective: at tight bounds, with slivers, and with parts below the stored precision."""

from __future__ import annotations

import numpy as np
import pytest

import hostile_models
from hostile_models import blocks, find_fault, split_edges
from quasiharmonic import unwrap
from quasiharmonic.apps.unwrapping.chart_fitting import divide_fragile, mend_charts
from quasiharmonic.apps.unwrapping.chart_maps import WorkingChart
from quasiharmonic.apps.unwrapping.chart_search import close_slits
from quasiharmonic.apps.unwrapping.charts import Chart, find_charts
from quasiharmonic.apps.unwrapping.layout import ChartLayout, grid_unit, round_positions
from quasiharmonic.apps.unwrapping.separation import separate
from quasiharmonic.geometry.exact.certificate import certify
from quasiharmonic.results import UnwrapStatus
from quasiharmonic.surfaces import disk, grid
from shared.meshes import boundary_of, lift


def sphere(n):
    """A sphere as NumPy users make it: sin(π) is 1.2e-16, so one pole has n almost coincident vertices."""
    u, v = np.meshgrid(np.arange(n) * 2 * np.pi / n, np.linspace(0, np.pi, n // 2 + 1), indexing="ij")
    m = n // 2 + 1
    a = (np.arange(n)[:, None] * m + np.arange(m - 1)).ravel()
    b = (a + m) % (n * m)
    V = np.stack([np.sin(v) * np.cos(u), np.sin(v) * np.sin(u), np.cos(v)], axis=-1).reshape(-1, 3)
    return V, np.concatenate([np.stack([a, a + 1, b + 1], axis=1), np.stack([a, b + 1, b], axis=1)])


@pytest.mark.slow
@pytest.mark.parametrize("n", [16, 32])
def test_spheres_with_a_pole_of_almost_coincident_vertices(n):
    V, F = sphere(n)
    result = unwrap(V, F, resolution=1024)
    assert result.certificate.bijective
    assert result.status is UnwrapStatus.UNWRAPPED
    # The slivers at the pole are no reason for further charts.
    assert result.n_charts <= 4


@pytest.mark.slow
def test_a_sphere_in_single_precision():
    V, F = sphere(32)
    result = unwrap(V.astype(np.float32), F, resolution=1024)
    assert result.certificate.bijective
    assert result.n_charts <= 4


@pytest.mark.slow
@pytest.mark.parametrize(
    "family", ["voxels", "profile", "box", "scales", "almost_flat", "almost_symmetric", "long_strip", "twisted"]
)
@pytest.mark.parametrize("bound", [1.1, 1.2])
def test_hostile_models_at_tight_bounds(family, bound):
    # Of each family the first models of at most 500 triangles.
    models = (getattr(hostile_models, family)(np.random.default_rng(k)) for k in range(12))
    small = [(V, F) for V, F in models if len(F) <= 500][:3]
    assert small
    assert [find_fault(V, F, bound) for V, F in small] == [""] * len(small)


@pytest.mark.nightly
@pytest.mark.parametrize("family", hostile_models.FAMILIES)
def test_hostile_models(family):
    for k in range(30):
        V, F = family(np.random.default_rng(1000 + k))
        assert find_fault(V, F, hostile_models.BOUNDS[k % 5]) == ""


def test_a_flat_plate_with_holes_is_one_chart_with_holes():
    V, F = split_edges(*blocks(np.ones((5, 5, 1), dtype=bool)), 1)
    top = (V[F][:, :, 2] == 1).all(axis=1)
    centre = V[F].mean(axis=1)
    holes = (np.abs(centre[:, :2] - [1.5, 1.5]) < 0.5).all(axis=1) | (np.abs(centre[:, :2] - [3.5, 2.5]) < 0.5).all(
        axis=1
    )
    result = unwrap(V, F[top & ~holes], resolution=256)
    assert result.n_charts == 1
    assert not len(result.seams)
    assert result.stretch.worst == pytest.approx(1, abs=1e-6)


def slit_plate():
    """A flat plate, opened along a straight cut from the middle of a side to the centre."""
    V, F = grid(6, 6)
    V = np.pad(V, [(0, 0), (0, 1)])
    centre = V[F].mean(axis=1)
    middle = np.flatnonzero((V[:, 1] == np.median(V[:, 1])) & (V[:, 0] < np.median(V[:, 0])))
    copy = np.arange(len(V))
    copy[middle] = len(V) + np.arange(middle.size)
    above = centre[:, 1] > np.median(V[:, 1])
    own = np.where(above[:, None], copy[F], F)
    origin = np.concatenate([np.arange(len(V)), middle])
    return V, F, own, origin


def test_slits_are_closed():
    V, F, own, origin = slit_plate()
    chart = WorkingChart(np.arange(len(F)), origin, V[origin], own, np.ones(F.shape))
    chart.use(V[origin, :2])
    assert not chart.bijective
    closed = close_slits(chart)
    assert closed is not None
    assert closed.bijective
    assert len(closed.V) == len(V)
    assert len(boundary_of(closed.F)) == len(boundary_of(F))
    np.testing.assert_allclose(np.ptp(closed.V[closed.F], axis=1), np.ptp(V[F], axis=1))
    assert close_slits(closed) is None


def test_an_open_slit_stays():
    V, F, own, origin = slit_plate()
    chart = WorkingChart(np.arange(len(F)), origin, V[origin], own, np.ones(F.shape))
    uv = V[origin, :2].copy()
    # Copies with triangles above move up.
    moved = np.arange(len(origin)) >= len(V)
    uv[moved, 1] += 0.1 * np.ptp(V[:, 1]) / 4
    chart.use(uv)
    assert chart.bijective
    assert close_slits(chart) is None


def place(chart, uv):
    """A layout of one chart in the texture."""
    k = len(chart.F)
    return ChartLayout(chart.F, round_positions(chart.F, uv), np.zeros(k, dtype=int), np.zeros(k, dtype=bool))


def single_chart(V, F):
    return Chart(np.arange(len(F)), F, np.arange(len(V)), V[:, :2], np.ones(len(F)), 0.0)


def all_bijective(charts, scale):
    """Whether all charts are bijective after they are scaled and rounded."""
    verdicts = []
    for chart in charts:
        uv = scale * (chart.uv - chart.uv.min(axis=0))
        verdicts.append(certify(chart.F, round_positions(chart.F, uv)).bijective)
    return all(verdicts)


def test_charts_below_the_precision_are_enlarged():
    V, F = disk(6)
    V = np.pad(V, [(0, 0), (0, 1)])
    scale = 2.0**-24
    chart = single_chart(V, F)
    (mended,) = mend_charts(
        [chart], place(chart, scale * chart.uv), np.array([0]), scale=scale, V=V, cost=np.ones(F.shape), bound=1.5
    )
    assert all_bijective([mended], scale)
    factor = np.ptp(mended.uv) / np.ptp(chart.uv)
    np.testing.assert_allclose(mended.uv, factor * chart.uv)
    # The stretch is more than three, so the bound is missed.
    assert mended.misses == pytest.approx(factor - 3)


def test_a_thin_triangle_is_thickened():
    V, F = np.array([[0, 0, 0], [1, 0, 0], [0.5, 1e-12, 0]]), np.array([[0, 1, 2]])
    chart = single_chart(V, F)
    (mended,) = mend_charts(
        [chart], place(chart, 0.5 * chart.uv), np.array([0]), scale=0.5, V=V, cost=np.ones((1, 3)), bound=1.5
    )
    assert all_bijective([mended], 0.5)
    assert np.abs(mended.uv - chart.uv).max() < 1e-5
    assert mended.misses == 0


def test_charts_with_thin_triangles_are_divided_into_few():
    V, F = grid(12, 12)
    V = np.pad(V / np.ptp(V), [(0, 0), (0, 1)])
    # One column of squares is far thinner than the stored precision.
    x = np.unique(V[:, 0])
    V[V[:, 0] > x[5], 0] -= (1 - 1e-10) * (x[6] - x[5])
    charts, scale = [single_chart(V, F)], 0.5
    for _ in range(8):
        verdicts = [all_bijective([chart], scale) for chart in charts]
        if all(verdicts):
            break
        at = verdicts.index(False)
        rest = charts[:at] + charts[at + 1 :]
        one = single_chart(V, F) if len(charts[at].F) == len(F) else charts[at]
        charts = rest + mend_charts(
            [Chart(np.arange(len(one.F)), one.F, one.vertices, one.uv, one.stretch, 0.0)],
            place(one, scale * (one.uv - one.uv.min(axis=0))),
            np.array([0]),
            scale=scale,
            V=V,
            cost=np.ones(F.shape),
            bound=1.5,
        )
    assert all_bijective(charts, scale)
    assert sum(len(chart.F) for chart in charts) == len(F)


def test_a_chart_that_is_hardly_too_small_is_divided():
    V, F = grid(4, 4)
    V = np.pad(V, [(0, 0), (0, 1)])
    chart = single_chart(V, F)
    layout = place(chart, chart.uv)
    # The triangles are hardly lower than the aim of the enlargement, which rounding would repeat forever.
    height = np.ptp(chart.uv[:, 0]) / 4 / np.sqrt(2)
    scale = 7.999 * grid_unit(layout.uv) / height
    mended = mend_charts([chart], layout, np.array([0]), scale=scale, V=V, cost=np.ones(F.shape), bound=1.5)
    assert len(mended) > 1
    assert sum(len(one.F) for one in mended) == len(F)


@pytest.mark.parametrize(("gap", "divided"), [(1e-3, False), (1e-9, True)])
def test_a_chart_whose_ends_almost_touch_is_divided_before_it_is_packed(gap, divided):
    V, F = grid(80, 4)
    angle, radius = (2 * np.pi - gap) * V[:, 0] / V[:, 0].max(), 1 + V[:, 1] / V[:, 1].max()
    V = np.stack([-radius * np.cos(angle), radius * np.sin(angle), np.zeros(len(V))], axis=1)
    chart = single_chart(V, F)
    assert certify(F, chart.uv).bijective
    parts = divide_fragile([chart], V, np.ones(F.shape), bound=1.5)
    assert (len(parts) > 1) == divided
    assert all_bijective(parts, 0.2)
    assert sum(len(part.F) for part in parts) == len(F)
    if not divided:
        assert parts == [chart]


@pytest.mark.slow
def test_the_search_returns_charts_that_keep_away_from_themselves():
    V, F = split_edges(*blocks(np.ones((3, 2, 1), dtype=bool)), 2)
    for chart in find_charts(V, F, max_stretch=1.05):
        # Rounded to a millionth of the chart's size, the boundary still does not touch itself.
        unit = 2.0**-20 * np.sqrt(len(chart.F) / 32)
        assert certify(chart.F, np.rint(chart.uv / unit) * unit).bijective


def test_long_charts_that_look_alike_in_large_cells_are_placed():
    rng = np.random.default_rng(0)
    blades = []
    for _ in range(120):
        width, height, angle = 0.01 * rng.uniform(0.7, 1.3), rng.uniform(0.6, 1.2), rng.uniform(0, 2 * np.pi)
        across, up = width * np.array([np.cos(angle), np.sin(angle), 0]), np.array([0, 0, height])
        root = np.array([*rng.uniform(0, 5, 2), 0])
        blades.append(root + np.array([-across, across, up + across / 2, up - across / 2]))
    F = (np.array([[0, 1, 2], [0, 2, 3]]) + 4 * np.arange(len(blades))[:, None, None]).reshape(-1, 3)
    result = unwrap(np.concatenate(blades), F, resolution=512)
    assert result.certificate.bijective
    assert result.n_charts == len(blades)


@pytest.mark.parametrize("height", [1e30, 1e38, -6e21])
def test_a_vertex_without_data(height):
    V, F = disk(3)
    V = np.pad(V, [(0, 0), (0, 1)])
    V[-1, 2] = height
    assert unwrap(V, F).certificate.bijective


def test_a_large_chart_without_crossings_is_separated_without_an_error():
    points, triangles = disk(20)
    assert len(points) > 1000
    rows, vertices = np.arange(len(triangles)), np.arange(len(points))
    chart = WorkingChart(rows, vertices, lift(points), triangles, np.ones(triangles.shape))
    chart.use(points)
    assert not chart.crossings.size
    assert separate(chart, 1.5, lambda: None)
