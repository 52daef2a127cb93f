"""Nodes that are in no element may be anywhere, also at NaN; all others must be finite."""

from __future__ import annotations

import numpy as np
import pytest

from quasiharmonic import MovingMesh, injective_tetrahedra, morph
from quasiharmonic.surfaces import grid
from shared.tetrahedral_meshes import box

ANYWHERE = np.array([(np.nan, np.inf, 1e300)])


@pytest.fixture(scope="module")
def block():
    """Return a block of tetrahedra, its upper vertices, and a target with a dent that inverts some at first."""
    X, T = box(4, 4, 4)
    upper = np.flatnonzero(X[:, 2] == 1)
    dented = X[upper].copy()
    dented[:, 2] -= 0.5 * (np.sin(np.pi * dented[:, 0]) * np.sin(np.pi * dented[:, 1])) ** 2
    return X, T, upper, dented


def test_tetrahedra(block):
    X, T, upper, dented = block
    more = np.concatenate([X, ANYWHERE])
    for move in (morph, injective_tetrahedra):
        plain, same = move(X, T, upper, dented), move(more, T, upper, dented)
        assert same.success
        np.testing.assert_array_equal(same.points[:-1], plain.points)
        np.testing.assert_array_equal(same.points[-1:], ANYWHERE)
        assert move(more, T, upper, dented, start=same.points).success
    moving = MovingMesh(more, T, upper)
    moving.advance(X[upper] - [0, 0, 0.02])
    np.testing.assert_array_equal(moving.points[-1:], ANYWHERE)


@pytest.mark.parametrize("name", ["points", "start", "rest"])
def test_vertices_of_tetrahedra_must_be_finite(block, name):
    X, T, upper, dented = block
    there = {"points": X, "start": X, "rest": X}
    there[name] = np.where(np.arange(len(X))[:, None] == 62, np.nan, X)
    named = "at tetrahedr" if name == "rest" else "is not finite at vertex 62"
    with pytest.raises(ValueError, match=named):
        morph(there["points"], T, upper, dented, rest=there["rest"], start=there["start"])


@pytest.mark.parametrize("slide", [False, True])
def test_triangles(slide):
    points, F = grid(6, 6)
    upper = np.flatnonzero(points[:, 1] == 1)
    more = np.concatenate([points, ANYWHERE[:, :2]])
    plain, same = (morph(places, F, upper, points[upper] - [0, 0.1], slide=slide) for places in (points, more))
    assert same.success
    np.testing.assert_array_equal(same.points[:-1], plain.points)
    assert same.drift() == plain.drift()
