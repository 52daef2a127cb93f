"""Inverses of unwrapped models."""

from __future__ import annotations

import pickle

import numpy as np
import pytest

from quasiharmonic import unwrap
from quasiharmonic.surfaces import starfish


def damaged_starfish():
    """A closed model with reversed, repeated and degenerate triangles, and a second, stackable copy of it."""
    V, F = starfish(3, 12)
    F = np.vstack([F, F[5], [F[7, 0], F[7, 0], F[7, 1]], F[9, ::-1]])
    F[::3] = F[::3, ::-1]
    return np.vstack([V, V + np.array([5, 0, 0])]), np.vstack([F, F + len(V)])


@pytest.mark.slow
@pytest.mark.parametrize("stack", [False, True])
def test_the_inverse_of_an_unwrapped_model_with_defects(stack):
    V, F = damaged_starfish()
    result = unwrap(V, F, stack=stack)
    inverse = result.inverse()
    assert np.array_equal(inverse.F, F)
    # Centres of the triangles that have texture coordinates of their own.
    own = np.setdiff1d(np.arange(len(F)), result.cleaned.excluded)
    centre = result.uvs[result.indices[own]].mean(axis=1)
    at = inverse.locate(centre)
    assert at.found.all()
    assert np.allclose(inverse.plane(at), centre, atol=1e-6)
    if stack:
        # Copies are located in the first one.
        assert (at.triangle < len(F) // 2).all()
        return
    assert np.array_equal(at.triangle, own)
    first = at.triangle
    assert np.allclose(inverse.surface(at), V[F[first]].mean(axis=1), atol=1e-4)
    corners = np.random.default_rng(0).random((len(F), 3, 2))
    assert np.allclose(inverse.values(at, corners, per="corner"), corners[first].mean(axis=1), atol=1e-3)
    a, b, c = V[F[first]].swapaxes(0, 1)
    assert ((inverse.normals(at) * np.cross(b - a, c - a)).sum(axis=1) > 0).all()
    outside = inverse.nearest([[-1.0, -1.0], [2.0, 0.5]])
    assert outside.found.all()
    beside = result.uvs[result.indices[outside.triangle]]
    assert np.allclose(np.einsum("kc,kcd->kd", outside.barycentric, beside), inverse.plane(outside))
    distance = np.linalg.norm(result.uvs[:, None] - [[-1.0, -1.0], [2.0, 0.5]], axis=2).min(axis=0)
    assert (np.linalg.norm(inverse.plane(outside) - [[-1.0, -1.0], [2.0, 0.5]], axis=1) <= distance + 1e-12).all()


def test_the_inverse_of_an_unwrapped_model_owns_its_rows():
    result = unwrap(*starfish(3, 4))
    inverse = result.inverse()
    at, before = inverse.vertices(), inverse.FT.copy()
    places = inverse.plane(at)
    result.indices[:] = 0
    assert np.array_equal(inverse.FT, before)
    np.testing.assert_array_equal(inverse.plane(at), places)
    assert not pickle.loads(pickle.dumps(inverse)).FT.flags.writeable
