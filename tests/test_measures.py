"""Distortion per triangle, and its summaries."""

from __future__ import annotations

import json

import numpy as np
import pytest

from quasiharmonic import distortion, inverted_triangles
from quasiharmonic.energies.measures import MEASURES
from quasiharmonic.surfaces import grid, random_delaunay
from shared.meshes import bend, lift, surfaces


def jacobians(V, F, uv):
    """Return (f, 2, 2) Jacobians from orthonormal frames of the triangles' planes."""
    V = np.column_stack([V, np.zeros((len(V), 3 - V.shape[1]))])
    found = []
    for i, j, k in F:
        x = (V[j] - V[i]) / np.linalg.norm(V[j] - V[i])
        y = V[k] - V[i] - x * np.dot(x, V[k] - V[i])
        y /= np.linalg.norm(y)
        rest = np.array([[np.dot(e, V[j] - V[i]), np.dot(e, V[k] - V[i])] for e in (x, y)])
        found.append(np.stack([uv[j] - uv[i], uv[k] - uv[i]], axis=1) @ np.linalg.inv(rest))
    return np.array(found)


@pytest.mark.parametrize(("name", "V", "F"), surfaces())
def test_singular_values_are_those_of_the_jacobian(name, V, F):
    uv = bend(V[:, :2])
    found = distortion(V, F, uv)
    J = jacobians(V, F, uv)
    s = np.linalg.svd(J, compute_uv=False)
    np.testing.assert_allclose(found.sigma1, s[:, 0], rtol=1e-12)
    np.testing.assert_allclose(found.sigma2, s[:, 1], rtol=1e-10)
    np.testing.assert_allclose(found.conformal, s[:, 0] / s[:, 1], rtol=1e-10)
    np.testing.assert_allclose(found.mips, s[:, 0] / s[:, 1] + s[:, 1] / s[:, 0] - 2, rtol=1e-8, atol=1e-12)
    # μ = q/p from the Jacobian's entries.
    p = 0.5 * (J[:, 0, 0] + J[:, 1, 1] + 1j * (J[:, 1, 0] - J[:, 0, 1]))
    q = 0.5 * (J[:, 0, 0] - J[:, 1, 1] + 1j * (J[:, 1, 0] + J[:, 0, 1]))
    np.testing.assert_allclose(found.beltrami, q / p, rtol=1e-9, atol=1e-12)
    np.testing.assert_allclose(found.shear, np.abs(q / p), rtol=1e-9, atol=1e-12)
    t = found.scale * s
    np.testing.assert_allclose(found.isometric, np.maximum(t[:, 0], 1 / t[:, 1]), rtol=1e-10)
    np.testing.assert_allclose(found.symmetric_dirichlet, (t**2 + t**-2.0).sum(axis=1) - 4, rtol=1e-9, atol=1e-12)
    np.testing.assert_allclose(found.arap, ((t - 1) ** 2).sum(axis=1), rtol=1e-9, atol=1e-12)
    np.testing.assert_allclose(found.area_ratio, t.prod(axis=1), rtol=1e-10)
    assert np.sum(found.share * found.area_ratio) == pytest.approx(1)
    assert found.share.sum() == pytest.approx(1)
    assert not found.flat.size
    assert not found.inverted.size


def test_similarities_distort_nothing():
    V, F = random_delaunay(50)
    uv = 7 * V @ np.array([[0.6, 0.8], [-0.8, 0.6]]) + [3, -2]
    found = distortion(V, F, uv)
    assert found.scale == pytest.approx(1 / 7)
    np.testing.assert_allclose(found.sigma1, 7)
    np.testing.assert_allclose(found.sigma2, 7)
    for name in ("conformal", "isometric", "area_ratio"):
        np.testing.assert_allclose(getattr(found, name), 1, rtol=1e-12)
    for name in ("mips", "symmetric_dirichlet", "arap", "shear"):
        np.testing.assert_allclose(getattr(found, name), 0, atol=1e-12)


@pytest.mark.parametrize(("of_surface", "of_map"), [(1e6, 1e-6), (1e-160, 1e150), (1e150, 1e-160), (1e300, 1e300)])
def test_scaled_measures_do_not_depend_on_scale(of_surface, of_map):
    V, F = random_delaunay(40)
    V, uv = lift(V), bend(V)
    expected, found = distortion(V, F, uv), distortion(of_surface * V, F, of_map * uv)
    for name in MEASURES[2:]:
        np.testing.assert_allclose(getattr(found, name), getattr(expected, name), rtol=1e-9, atol=1e-12)


def test_inverted_and_collapsed_images():
    V = [[0, 0], [1, 0], [0, 1]]
    for image, sigma2, arap in (([[0, 0], [1, 0], [0, -1]], -1, 4), ([[0, 0], [1, 0], [0, 0]], 0, None)):
        found = distortion(V, [[0, 1, 2]], image)
        assert found.sigma1 == pytest.approx(1)
        assert found.sigma2 == pytest.approx(sigma2)
        assert found.inverted.tolist() == [0]
        for name in ("mips", "conformal", "isometric", "symmetric_dirichlet"):
            assert np.isposinf(getattr(found, name)).all()
        assert found.area_ratio == pytest.approx(sigma2)
        if arap is not None:
            assert found.arap == pytest.approx(arap)
    assert distortion(V, [[0, 1, 2]], [[0, 0], [1, 0], [0, 0]]).shear == pytest.approx(1)
    # A mirror image preserves angles and has p = 0.
    assert np.isinf(distortion(V, [[0, 1, 2]], [[0, 0], [1, 0], [0, -1]]).shear).all()
    point = distortion(V, [[0, 1, 2]], np.ones((3, 2)))
    assert point.scale == 1
    assert point.sigma1 == 0 == point.sigma2
    assert np.isnan(point.shear).all()


def test_the_sign_is_that_of_the_certificate(rng):
    V, F = random_delaunay(80)
    # Almost collapsed images, whose orientation floating point cannot decide.
    x = rng.random(len(V))
    uv = np.stack([x, 0.1 * x], axis=1)
    found = distortion(V, F, uv)
    assert np.array_equal(found.inverted, inverted_triangles(F, uv))
    assert np.array_equal(np.flatnonzero(found.sigma2 <= 0), found.inverted)
    assert 0 < found.inverted.size < len(F)


def test_flat_rest_triangles_are_undefined_and_skipped():
    V = np.array([[0, 0], [1, 0], [0, 1], [2, 0]])
    uv = np.array([[0, 0], [1, 0], [0, 1], [2, 0.5]])
    found = distortion(V, [[0, 1, 2], [0, 1, 3]], uv)
    assert found.flat.tolist() == [1]
    assert found.inverted.size == 0
    for name, values in found.per_triangle().items():
        assert np.isnan(values).tolist() == [False, True], name
    assert np.isnan(found.beltrami[1])
    assert found.statistics("conformal").maximum == pytest.approx(1)
    with pytest.raises(ValueError, match="mips is defined on no triangle"):
        distortion(V, [[0, 1, 3]], uv).statistics("mips")
    assert distortion(V, [[0, 1, 3]], uv).to_dict()["mips"] is None


def test_summaries_are_weighted_by_area():
    # The halves of two unit squares; the second square is stretched to double height.
    V = np.array([[0, 0], [3, 0], [3, 1], [0, 1], [4, 0], [4, 1]])
    F = np.array([[0, 1, 2], [0, 2, 3], [1, 4, 5], [1, 5, 2]])
    uv = V * [1.0, 1.0]
    uv[[4]] = [5, 0]
    uv[[5]] = [5, 1]
    found = distortion(V, F, uv)
    summary = found.statistics("conformal")
    assert summary.mean == pytest.approx((3 * 1 + 1 * 2) / 4)
    assert summary.median == pytest.approx(1)
    assert summary.p95 == pytest.approx(2)
    assert (summary.minimum, summary.maximum) == pytest.approx((1, 2))
    assert summary.lowest in (0, 1)
    assert summary.highest in (2, 3)
    with pytest.raises(ValueError, match="measure must be one of sigma1, "):
        found.statistics("beauty")


def test_reports_are_valid_json_for_every_map():
    V, F = grid(3, 3)
    for uv in (V, V * [1, -1], V * 0):
        report = distortion(V, F, uv).to_dict()
        assert json.loads(json.dumps(report, allow_nan=False)) == report
        assert set(MEASURES) < set(report)
    assert report["mips"]["maximum"] is None
    assert report["inverted"] == len(F)


def test_any_dtype():
    V, F = grid(2, 2)
    expected = distortion(V, F, V + 0.1 * V**2)
    found = distortion(V.tolist(), F.astype(np.uint8), (V + 0.1 * V**2).astype(np.longdouble))
    np.testing.assert_array_equal(found.mips, expected.mips)


def test_input_is_not_changed():
    V, F = grid(3, 3)
    uv = bend(V)
    before = [x.copy() for x in (V, F, uv)]
    for x in (V, F, uv):
        x.flags.writeable = False
    distortion(V, F, uv)
    for x, y in zip((V, F, uv), before, strict=True):
        np.testing.assert_array_equal(x, y)


def test_malformed_input():
    V, F = grid(2, 2)
    with pytest.raises(ValueError, match="the mesh has no triangles"):
        distortion(V, F[:0], V)
    with pytest.raises(ValueError, match="V must have shape"):
        distortion(V[:, 0], F, V)
    with pytest.raises(ValueError, match=r"uv must have shape \(9, 2\)"):
        distortion(V, F, V[:-1])
    with pytest.raises(ValueError, match=r"F must have shape \(f, 3\)"):
        distortion(V, F[:, :2], V)
    with pytest.raises(ValueError, match="F must contain integer"):
        distortion(V, F * 1.0, V)
    with pytest.raises(ValueError, match="F refers to vertex 9, but there are only vertices 0 … 8"):
        distortion(V, F + 1, V)
    broken = V.copy()
    broken[4, 1] = np.nan
    with pytest.raises(ValueError, match="uv is not finite at vertex 4"):
        distortion(V, F, broken)
    with pytest.raises(ValueError, match="V is not finite at vertex 4"):
        distortion(broken, F, V)
