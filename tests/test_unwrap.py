"""Texture coordinates for any model: `unwrap`, its result and its certificate."""

from __future__ import annotations

import json

import numpy as np
import pytest
from hypothesis import example, given
from hypothesis import strategies as st

from quasiharmonic import inverted_triangles, unwrap
from quasiharmonic.apps.unwrapping.chart_maps import WorkingChart
from quasiharmonic.apps.unwrapping.chart_verdict import certify_charts
from quasiharmonic.apps.unwrapping.layout import ChartLayout, round_positions
from quasiharmonic.apps.unwrapping.separation import separate
from quasiharmonic.surfaces import annulus, grid, random_delaunay, starfish
from shared.exact import exact_orientation
from shared.examples import examples
from shared.meshes import lift

V, F = starfish(3, 5)


@pytest.fixture(scope="module")
def result():
    return unwrap(V, F, resolution=512)


def test_iterates_as_three_arrays_that_reproduce_the_model(result):
    vmapping, indices, uvs = result
    np.testing.assert_array_equal(V[vmapping][indices], V[F])
    assert uvs.shape == (len(vmapping), 2)
    assert uvs.min() >= 0
    assert uvs.max() <= 1


@pytest.mark.slow
def test_every_triangle_is_positive(result):
    _, indices, uvs = result
    assert all(exact_orientation(*uvs[triangle].tolist()) > 0 for triangle in indices)
    assert result.success
    assert result.certificate.bijective
    assert result.certificate.bijective_charts.shape == (result.n_charts,)


def test_coordinates_are_exact_in_single_precision_in_both_conventions(result):
    u, v = result.uvs.T
    for values in (u, v, 1 - v):
        np.testing.assert_array_equal(values.astype(np.float32).astype(np.float64), values)


@pytest.mark.slow
def test_input_is_not_modified():
    points, triangles = V.copy(), F.copy()
    unwrap(points, triangles, resolution=256)
    np.testing.assert_array_equal(points, V)
    np.testing.assert_array_equal(triangles, F)


@pytest.mark.slow
def test_equal_input_gives_equal_results(result):
    for one, other in zip(result, unwrap(V, F, resolution=512), strict=True):
        np.testing.assert_array_equal(one, other)


@pytest.mark.slow
def test_single_precision_and_unsigned_indices():
    points = V.astype(np.float32)
    vmapping, indices, _ = unwrap(points, F.astype(np.uint32), resolution=256)
    np.testing.assert_array_equal(points[vmapping][indices], points[F])


def test_charts_and_seams(result):
    assert np.array_equal(np.unique(result.charts), np.arange(result.n_charts))
    sides = {}
    for triangle, rows in zip(F.tolist(), result.indices.tolist(), strict=True):
        for k in range(3):
            i, j = triangle[k], triangle[(k + 1) % 3]
            here, there = rows[k], rows[(k + 1) % 3]
            sides.setdefault((min(i, j), max(i, j)), set()).add((here, there) if i < j else (there, here))
    assert result.seams.tolist() == sorted(list(edge) for edge, rows in sides.items() if len(rows) > 1)
    assert result.seam_length > 0


def test_stretch_is_that_of_singular_values(result):
    """Against singular values by another formula, in texels."""
    edges = V[F[:, 1:]] - V[F[:, :1]]
    images = result.uvs[result.indices] * 512
    images = images[:, 1:] - images[:, :1]
    gram, image_gram = edges @ edges.swapaxes(1, 2), images @ images.swapaxes(1, 2)
    squares = np.linalg.eigvals(np.linalg.solve(gram, image_gram)).real
    area, image = (np.sqrt(np.linalg.det(g)).sum() for g in (gram, image_gram))
    squares *= area / image
    stretch = np.sqrt(np.maximum(squares.max(axis=1), 1 / squares.min(axis=1)))
    np.testing.assert_allclose(result.triangle_stretch, stretch, rtol=1e-6)
    assert result.stretch.worst == pytest.approx(stretch.max())
    assert result.stretch.median <= result.stretch.p99 <= result.stretch.worst
    assert result.texels_per_unit == pytest.approx(np.sqrt(image / area))
    assert result.utilisation == pytest.approx(image / 2 / 512**2)


@pytest.mark.long
def test_a_bound_that_cannot_be_kept_is_reported():
    result = unwrap(V, F, max_stretch=1.0, max_charts=2, resolution=256)
    assert result.misses
    assert all(miss.excess > 0 for miss in result.misses)
    assert result.misses[0].stretch.p99 > 1
    assert result.status.name == "STRETCHED"
    assert "misses" in result.message
    assert "beyond the bound" in result.summary()


def spoil(V, F):
    """A model with a fin, triangles that are repeated, degenerate or reversed, and a vertex without triangle."""
    fin = np.vstack([V, V[F[0, 0]] + [0, 0, 1], V[:1]])
    spoilt = F.copy()
    spoilt[20:30] = spoilt[20:30][:, ::-1]
    a, b, c = F[0]
    more = [[a, b, len(V)], F[3], F[4][::-1], [c, c, b], [a, a, a]]
    return fin, np.concatenate([spoilt[:50], more, spoilt[50:]])


@pytest.mark.slow
def test_defective_models_are_accepted():
    points, triangles = spoil(V, F)
    result = unwrap(points, triangles, resolution=512)
    vmapping, indices, uvs = result
    np.testing.assert_array_equal(points[vmapping][indices], points[triangles])
    assert result.success
    np.testing.assert_array_equal(result.cleaned.excluded, [51, 52, 53, 54])
    reversed_ = result.cleaned.triangles[result.cleaned.flipped]
    np.testing.assert_array_equal(reversed_, np.arange(20, 30))
    signs = np.array([exact_orientation(*uvs[triangle].tolist()) for triangle in indices])
    # The winding of the model stays, so reversed triangles are mirrored.
    assert (signs[reversed_] < 0).all()
    assert (np.delete(signs, [*range(20, 30), 51, 52, 53, 54]) > 0).all()
    # Excluded triangles are in charts, at positions of the triangles whose place they take.
    assert result.charts.min() == 0
    for triangle, row in zip(result.cleaned.excluded, result.cleaned.substitutes, strict=True):
        other = result.cleaned.triangles[row]
        assert result.charts[triangle] == result.charts[other]
        assert set(map(tuple, uvs[indices[triangle]])) <= set(map(tuple, uvs[indices[other]]))
    assert np.isnan(result.triangle_stretch[result.cleaned.excluded]).all()
    assert len(vmapping) < 2 * len(points)


def test_degenerate_models_are_an_error():
    with pytest.raises(ValueError, match="degenerate"):
        unwrap(V, np.array([[0, 0, 1], [2, 3, 3]]))


@pytest.mark.slow
@pytest.mark.parametrize("exponent", [-700, 700])
def test_extreme_units(exponent, result):
    other = unwrap(np.ldexp(V, exponent), F, resolution=512)
    np.testing.assert_array_equal(other.uvs, result.uvs)
    assert other.stretch == result.stretch
    assert np.ldexp(other.seam_length, -exponent) == pytest.approx(result.seam_length)
    assert np.ldexp(other.texels_per_unit, exponent) == pytest.approx(result.texels_per_unit)


def test_seams_of_existing_coordinates_are_used():
    points, triangles = grid(8, 8)
    corner_uv = points[triangles].copy()
    left = points[triangles, 0].max(axis=1) <= 0.5
    corner_uv[left] -= [3, 0]
    result = unwrap(points, triangles, uv=corner_uv, resolution=256)
    assert result.n_charts == 2
    assert len(np.unique(result.charts[left])) == 1
    assert (points[result.seams, 0] == 0.5).all()
    assert unwrap(points, triangles, uv=points, resolution=256).n_charts == 1


@pytest.mark.long
def test_edge_costs_move_seams():
    costs = np.ones(F.shape)
    upper = V[F, 2].mean(axis=1) > 0
    costs[upper] = 100
    before, after = unwrap(V, F, resolution=256), unwrap(V, F, resolution=256, edge_costs=costs)
    assert after.success

    def above(result):
        return (V[result.seams, 2] > 0).all(axis=1).sum()

    assert above(after) < above(before)


@pytest.mark.slow
def test_identical_components_are_stacked():
    points, triangles = annulus(6)
    points = lift(points)
    model = np.vstack([points, points + 5, points * [-1, 1, 1] - 5])
    faces = np.concatenate([triangles, triangles + len(points), triangles[:, ::-1] + 2 * len(points)])
    apart, stacked = (unwrap(model, faces, resolution=256, max_stretch=1.5, stack=stack) for stack in (False, True))
    alone = unwrap(points, triangles, resolution=256, max_stretch=1.5)
    assert apart.success
    assert stacked.success
    assert stacked.n_charts == 3 * alone.n_charts
    assert stacked.texels_per_unit > 1.1 * apart.texels_per_unit


@pytest.mark.slow
def test_planar_meshes():
    points, triangles = annulus(8)
    result = unwrap(points, triangles, resolution=256)
    assert result.success
    assert result.stretch.worst == pytest.approx(1, abs=0.01)


@pytest.mark.slow
def test_mesh_objects_and_trimesh():
    trimesh = pytest.importorskip("trimesh")
    result = unwrap(trimesh.Trimesh(V, F, process=False), resolution=256)
    for one, other in zip(result, unwrap(V, F, resolution=256), strict=True):
        np.testing.assert_array_equal(one, other)
    made = result.to_trimesh()
    np.testing.assert_array_equal(made.vertices[made.faces], V[F])
    np.testing.assert_array_equal(made.visual.uv, result.uvs)


@pytest.mark.slow
def test_progress_by_phase_and_exceptions_of_the_callback():
    steps = []
    unwrap(V, F, resolution=256, callback=steps.append)
    phases = list(dict.fromkeys(step.phase for step in steps))
    assert phases[0] == "clean"
    assert "flatten" in phases
    assert phases[-2:] == ["pack", "certify"]
    assert all(0 <= step.done <= step.total for step in steps)

    def stop(step):
        if step.phase == "pack":
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        unwrap(V, F, resolution=256, callback=stop)


@pytest.mark.parametrize(
    ("arguments", "options", "words"),
    [
        ((np.empty((0, 3)), np.empty((0, 3), dtype=int)), {}, "no triangles"),
        ((V, np.empty((0, 3), dtype=int)), {}, "no triangles"),
        ((np.where(np.arange(len(V))[:, None] == 5, np.nan, V), F), {}, "vertex 5"),
        ((V, np.where(np.arange(len(F))[:, None] == 7, len(V), F)), {}, f"vertex {len(V)}"),
        ((V, F), {"max_stretch": 0.9}, "max_stretch"),
        ((V, F), {"max_stretch": np.nan}, "max_stretch"),
        ((V, F), {"max_charts": 0}, "max_charts"),
        ((V, F), {"resolution": 0}, "resolution"),
        ((V, F), {"resolution": (1, 2, 3)}, "resolution"),
        ((V, F), {"padding": -1}, "padding"),
        ((V, F), {"texels_per_unit": 0}, "texels_per_unit"),
        ((V, F), {"tiles": 0}, "tiles"),
        ((V, F), {"rotate": 1}, "rotate"),
        ((V, F), {"stack": "yes"}, "stack"),
        ((V, F), {"outward": None}, "outward"),
        ((V, F), {"seed": -1}, "seed"),
        ((V, F), {"jobs": 0}, "jobs"),
        ((V, F), {"uv": np.zeros((3, 2))}, "uv"),
        ((V, F), {"uv": np.where(np.arange(len(V))[:, None] == 7, np.inf, V[:, :2])}, r"infinite .* index \(7, 0\)"),
        ((V, F), {"callback": 1}, "callback"),
    ],
)
def test_bad_input_is_named(arguments, options, words):
    with pytest.raises((ValueError, TypeError), match=words):
        unwrap(*arguments, **options)


def layout(*squares, mirrored=()):
    """Charts of two triangles each, squares given by their lower left corner and side."""
    corners = np.array([[0.0, 0], [1, 0], [1, 1], [0, 1]])
    uv = np.concatenate([[x, y] + side * corners for x, y, side in squares])
    count = len(squares)
    rows = (np.array([[0, 1, 2], [0, 2, 3]]) + 4 * np.arange(count)[:, None, None]).reshape(-1, 3)
    turned = np.isin(np.repeat(np.arange(count), 2), mirrored)
    return ChartLayout(rows, uv, np.repeat(np.arange(count), 2), turned)


class TestCertificate:
    def certify(self, charts, *, stacked=False):
        triangles = 10 * np.arange(len(charts.rows))
        return certify_charts(charts, triangles, size=(64, 64), padding=4, stacked=stacked)

    def test_disjoint_charts(self):
        found = self.certify(layout((0, 0, 0.25), (0.25 + 5 / 64, 0, 0.25), (0.75, 0.75, 0.125)))
        assert found.bijective
        assert found.clearance == pytest.approx(5)
        assert "no overlaps" in found.summary()

    def test_distant_charts_have_no_clearance(self):
        assert self.certify(layout((0, 0, 0.25), (0.5, 0, 0.25))).clearance == np.inf

    @pytest.mark.parametrize("other", [(0.125, 0.125, 0.25), (0.0625, 0.0625, 0.125), (0.25, 0, 0.25), (0, 0, 0.25)])
    def test_charts_that_overlap_or_touch(self, other):
        found = self.certify(layout((0.6, 0.6, 0.125), (0, 0, 0.25), other))
        assert not found.bijective
        assert found.overlapping.tolist() == [[1, 2]]
        assert found.bijective_charts.all()

    def test_a_chart_inside_the_hole_of_another_is_apart(self):
        uv, F = annulus(8)
        inner = layout((-0.25, -0.25, 0.5))
        rows = np.concatenate([F, inner.rows + len(uv)])
        chart = np.repeat([0, 1], [len(F), 2])
        found = self.certify(ChartLayout(rows, np.vstack([uv, inner.uv]), chart, np.zeros(len(rows), dtype=bool)))
        assert found.bijective

    def test_triangles_that_are_not_positive_are_named_by_the_input(self):
        charts = layout((0, 0, 0.25), (0.5, 0, 0.25))
        charts.uv[6] = charts.uv[4]
        found = self.certify(charts)
        assert found.degenerate.tolist() == [20, 30]
        assert found.bijective_charts.tolist() == [True, False]
        assert not found.bijective
        assert found.disjoint

    def test_mirrored_and_stacked_charts(self):
        charts = layout((0, 0, 0.25), (0.5, 0, 0.25), (0, 0, 0.25), mirrored=[2])
        charts.uv[8:] = charts.uv[[9, 8, 11, 10]]
        assert not self.certify(charts).disjoint
        assert self.certify(charts, stacked=True).bijective
        charts.uv[8:] += 0.03125
        assert not self.certify(charts, stacked=True).disjoint


@pytest.mark.slow
def test_rounding_keeps_triangles_positive_where_it_can():
    points, triangles = random_delaunay(3000, seed=2)
    uv = 0.5 + 3e-6 * points
    plain = np.rint(uv * 2**24) / 2**24
    rounded = round_positions(triangles, uv)
    assert len(inverted_triangles(triangles, plain)) > 20
    assert len(inverted_triangles(triangles, rounded)) < 5
    assert np.abs(rounded - uv).max() < 4 * 2.0**-24
    np.testing.assert_array_equal(rounded * 2**24, np.rint(rounded * 2**24))


def quads(columns, rows):
    """A sheet of quads as triangles, and a mask (f, 3) of the sides inside quads."""
    flat, triangles = grid(columns, rows)
    tail, head = flat[triangles], flat[np.roll(triangles, -1, axis=1)]
    return flat, triangles, np.all(np.abs(head - tail) > 1e-9, axis=2)


@pytest.mark.slow
@pytest.mark.parametrize("shape", ["hills", "strip", "closed"])
def test_sides_with_large_costs_are_not_cut(shape):
    if shape == "hills":
        flat, triangles, inside = quads(6, 6)
        points = np.column_stack([flat, 0.5 * np.sin(9 * flat[:, 0]) * np.cos(8 * flat[:, 1])])
    elif shape == "strip":
        # Its chart is too long for the texture, so it is divided.
        flat, triangles, inside = quads(3, 2)
        points = flat * [20.0, 1.0]
    else:
        # A closed box with strongly bent faces, which is unfolded.
        points = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)], dtype=float)
        points[[0, 3, 5, 6]] *= 0.2
        faces = np.array([[0, 1, 3, 2], [4, 6, 7, 5], [0, 4, 5, 1], [2, 3, 7, 6], [0, 2, 6, 4], [1, 5, 7, 3]])
        triangles = np.concatenate([faces[:, [0, 1, 2]], faces[:, [0, 2, 3]]])
        inside = np.zeros(triangles.shape, dtype=bool)
        inside[:6, 2] = inside[6:, 0] = True
    found = unwrap(points, triangles, max_stretch=1.2, resolution=512, edge_costs=np.where(inside, 1000.0, 1.0))
    sides = np.sort(np.stack([triangles, np.roll(triangles, -1, axis=1)], axis=2), axis=2)
    spared = {tuple(side) for side in sides[inside].tolist()}
    assert len(found.seams)
    assert spared.isdisjoint(map(tuple, found.seams.tolist()))
    assert found.success


def test_a_single_long_polygon_is_not_divided():
    points, triangles = np.array([[0.0, 0.0], [20.0, 0.0], [20.0, 1.0], [0.0, 1.0]]), np.array([[0, 1, 2], [0, 2, 3]])
    inside = np.array([[False, False, True], [True, False, False]])
    # A flat face stays whole, unless the texture is to be used better.
    assert unwrap(points, triangles, resolution=512).n_charts == 1
    assert unwrap(points, triangles, resolution=512, divide_for_packing=True).n_charts == 2
    kept = np.where(inside, 1000.0, 1.0)
    assert unwrap(points, triangles, resolution=512, divide_for_packing=True, edge_costs=kept).n_charts == 1


@pytest.mark.long
def test_separation_of_a_large_chart_moves_only_vertices_close_to_the_overlap():
    """A strip around a circle whose ends overlap a little in the plane."""
    V, F = grid(100, 220)
    radius, angle = 1 + 0.3 * V[:, 0], (2 * np.pi + 0.002) * V[:, 1]
    uv = radius[:, None] * np.stack([np.cos(angle), np.sin(angle)], axis=1)
    V = np.column_stack([uv, 0.01 * angle])
    chart = WorkingChart(np.arange(len(F)), np.arange(len(V)), V, F, np.ones(F.shape), uv.copy())
    chart.use(uv)
    before = chart.uv
    assert len(chart.crossings) > 0
    assert not chart.bijective
    assert separate(chart, 1.5, lambda: None)
    assert chart.bijective
    far = np.argsort(uv[:, 0])[:1000]
    scale = np.ptp(chart.uv[far], axis=0) / np.ptp(before[far], axis=0)
    moved = (chart.uv - chart.uv[far].mean(axis=0)) / scale - (before - before[far].mean(axis=0))
    assert np.abs(moved[far]).max() < 1e-12 < 1e-6 < np.abs(moved).max()


@pytest.mark.parametrize("height", [1e-8, 1e-15])
def test_a_model_of_thin_triangles_alone_has_no_measured_stretch(height):
    points = [[0, 0, 0], [1, 0, 0], [0.5, height, 0]]
    result = unwrap(points, [[0, 1, 2]], resolution=64)
    assert result.certificate.bijective
    assert np.isnan(result.stretch).all()
    assert "not measured" in result.summary()
    assert result.to_dict()["stretch"] == {"median": None, "p99": None, "worst": None}


@pytest.mark.long
@given(st.integers(3, 8), st.integers(1, 8), st.integers(0, 2**31), st.integers(-16, -7), st.sampled_from([1.0, 1.5]))
@examples(30)
@example(4, 5, 604, -8, 1.0)  # two charts that would close
def test_models_of_thin_triangles_have_a_report_and_no_stretched_charts(n, f, seed, exponent, bound):
    rng = np.random.default_rng(seed)
    points = rng.normal(size=(n, 3)) * [1, 10.0**exponent, 10.0**exponent]
    result = unwrap(points, [rng.choice(n, 3, replace=False) for _ in range(f)], max_stretch=bound, resolution=64)
    assert result.success
    assert result.summary()
    json.dumps(result.to_dict(), allow_nan=False)
    # The stretch of thin triangles is not measured, so no chart of them exceeds the bound.
    assert not any(np.isnan(miss.stretch.worst) for miss in result.misses)
    assert result.misses or result.status.name == "UNWRAPPED"
