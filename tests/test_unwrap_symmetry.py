"""Symmetric models: mirrored seams and charts, verified by positions; what is reported otherwise."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

import hard_models as models
from quasiharmonic import unwrap
from quasiharmonic.apps.unwrapping.symmetry import find_mirror
from shared.examples import examples
from shared.hinges import edges_of


def parts(axis, *, curved=False):
    """A symmetric model of parts on both sides of a plane; ``curved`` adds two rough balls."""
    some = [models.moved(models.channel(), [1, 0.3, 0.1]), models.moved(models.tube(12, caps=True), [5, 0, 0])]
    if curved:
        some.append(models.moved(models.golf_ball(np.random.default_rng(0), 2), [8, 0, 0]))
    V, F = models.mirrored(models.together(*some))
    return np.roll(V, axis, axis=1), F


MODELS = {
    "robot": (models.robot(), "x"),
    "parts": (parts(0), "x"),
    "parts in y": (parts(1), "y"),
    "parts in z": (parts(2), "z"),
    "curved parts": (parts(0, curved=True), "x"),
    "open cone": (models.cone(16, height=1, cap=False), "x"),
}


def images(V, axis):
    """Return the mirror image (n,) of each vertex, by its position."""
    k = "xyz".index(axis)
    twice = V[:, k].min() + V[:, k].max()
    mirrored = V.copy()
    mirrored[:, k] = twice - V[:, k]
    place = {tuple(point): number for number, point in enumerate(np.round(V, 6).tolist())}
    return np.array([place[tuple(point)] for point in (np.round(mirrored, 6) + 0.0).tolist()])


def seams_of(V, F, result):
    edges = edges_of(V, F, result.indices)
    return {tuple(ends) for ends in edges.ends[edges.seam].tolist()}


@pytest.mark.slow
@pytest.mark.parametrize("name", MODELS)
@pytest.mark.parametrize("asked", [True, False])
def test_seams_and_triangles_are_mirrored(name, asked):
    (V, F), axis = MODELS[name]
    V = np.round(V, 9) + 0.0
    result = unwrap(V, F, resolution=1024, symmetry=axis if asked else "auto")
    assert (result.symmetry.axis, result.symmetry.share, result.symmetry.applied) == (axis, 1, True)
    assert "mirrored" in result.summary()
    image = images(V, axis)
    seams = seams_of(V, F, result)
    assert {tuple(sorted(image[list(ends)].tolist())) for ends in seams} == seams
    number = {tuple(sorted(triangle)): t for t, triangle in enumerate(F.tolist())}
    other = [number[tuple(sorted(triangle))] for triangle in image[F].tolist()]
    corners = result.uvs[result.indices]
    lengths = np.sort(np.linalg.norm(corners - np.roll(corners, 1, axis=1), axis=2), axis=1)
    np.testing.assert_allclose(lengths, lengths[other], atol=1e-6)


@pytest.mark.slow
def test_symmetry_can_be_turned_off():
    V, F = models.robot()
    result = unwrap(V, F, resolution=512, symmetry=None)
    assert result.success
    assert (result.symmetry.axis, result.symmetry.applied) == (None, False)
    assert "mirror" not in result.summary()


@pytest.mark.slow
@pytest.mark.parametrize("symmetry", ["auto", "x"])
def test_almost_symmetric_models_are_reported(symmetry):
    V, F = models.robot()
    V[F[-1, 0]] += 1e-4 * np.linalg.norm(np.ptp(V, axis=0)) * np.array([0.3, 0.5, 0.4])
    result = unwrap(V, F, resolution=512, symmetry=symmetry)
    assert (result.symmetry.axis, result.symmetry.applied) == ("x", False)
    # The moved vertex and its former image have none.
    assert result.symmetry.share == pytest.approx(1 - 2 / len(V))
    assert "not every vertex has a mirror image" in result.summary()


@pytest.mark.parametrize("symmetry", ["auto", "y"])
def test_a_model_without_symmetry_is_reported_if_an_axis_was_chosen(symmetry):
    V, F = models.box()
    result = unwrap(V * (1 + 0.1 * np.random.default_rng(0).random(V.shape)), F, resolution=256, symmetry=symmetry)
    assert result.symmetry.share < 0.9
    assert not result.symmetry.applied
    assert ("not mirrored" in result.summary()) == (symmetry == "y") == bool(result.symmetry.reason)


@pytest.mark.slow
def test_differences_below_the_tolerance_are_not_seen():
    """The tolerance is 1e-6 of the diagonal."""
    V, F = models.robot()
    noise = np.random.default_rng(1).uniform(-1, 1, V.shape)
    result = unwrap(V + 1e-7 * np.linalg.norm(np.ptp(V, axis=0)) * noise, F, resolution=512)
    assert result.symmetry.applied


def test_an_unknown_axis_is_an_error():
    with pytest.raises(ValueError, match="symmetry"):
        unwrap(*models.box(), symmetry="w")


@given(st.integers(0, 2**31), st.integers(0, 2))
@examples(20)
def test_the_mirror_of_random_triangles(seed, axis):
    random = np.random.default_rng(seed)
    half = 0.1 + np.abs(random.normal(size=(12, 3)))
    half[random.random(12) < 0.4, 0] = 0
    triangles = np.array([random.permutation(12)[:3] for _ in range(8)])
    V, F = models.mirrored((half, triangles[(half[triangles][:, :, 0] > 0).any(axis=1)]))
    V = np.roll(V, axis, axis=1)
    mirror, found = find_mirror(V, F, "xyz"[axis])
    assert found == ("xyz"[axis], 1, True, "")
    reflected = V.copy()
    reflected[:, axis] *= -1
    np.testing.assert_allclose(V[mirror.vertex], reflected, atol=1e-12)
    np.testing.assert_array_equal(np.sort(F[mirror.triangle]), np.sort(mirror.vertex[F]))
    np.testing.assert_array_equal(mirror.triangle[mirror.triangle], np.arange(len(F)))
    np.testing.assert_array_equal(mirror.positive, (V[F][:, :, axis] >= 0).all(axis=1))


def test_mirrored_vertices_without_mirrored_triangles():
    V = np.array([[-1, 0, 0], [1, 0, 0], [-1, 1, 0], [1, 1, 0], [0, 2, 0.0]])
    mirror, found = find_mirror(V, np.array([[0, 1, 2], [1, 3, 2]]), "x")
    assert mirror is None
    assert (found.share, found.applied) == (1, False)
    assert found.reason == "not every triangle has a mirror image"
