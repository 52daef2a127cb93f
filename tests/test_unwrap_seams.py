"""The seams of `unwrap`: edges of the model, and those of existing texture coordinates."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from quasiharmonic import unwrap
from quasiharmonic.surfaces import annulus, grid, starfish
from shared.closed_surfaces import torus
from shared.examples import examples


def ellipsoid(n):
    """A sphere with the vertices of a subdivided cube, stretched; its charts are too long for the texture."""
    square, triangles = grid(n, n)
    sides = []
    for k in range(3):
        for sign in (1, -1):
            face = np.column_stack([2 * square - 1, np.full(len(square), float(sign))])
            face[:, 0] *= sign
            sides.append(np.roll(face, k, axis=1))
    points, number = np.unique(np.round(np.concatenate(sides), 9), axis=0, return_inverse=True)
    rows = np.concatenate([triangles + k * len(square) for k in range(6)])
    return points / np.linalg.norm(points, axis=1, keepdims=True) * [3, 1, 0.5], number.ravel()[rows]


MODELS = {"ellipsoid": ellipsoid(10), "torus": torus(24, 10, 1.5), "starfish": starfish(3, 6)}


@pytest.mark.long
@pytest.mark.parametrize("name", MODELS)
@pytest.mark.parametrize("bound", [1.1, 1.5])
def test_seams_of_own_output_are_kept(name, bound):
    V, F = MODELS[name]
    first = unwrap(V, F, resolution=256, max_stretch=bound)
    again = unwrap(V, F, resolution=256, max_stretch=bound, uv=first.uvs[first.indices])
    assert (first.status.name, again.status.name) == ("UNWRAPPED", "UNWRAPPED")
    np.testing.assert_array_equal(again.seams, first.seams)
    assert again.stretch.p99 <= bound


def bowl():
    square, F = grid(20, 20)
    return np.column_stack([square, 1.2 * ((square - 0.5) ** 2).sum(axis=1)]), F, square


def strip():
    square, F = grid(60, 3)
    x, y = square.T
    return np.column_stack([20 * x, y, 0.4 * np.sin(8 * x) * (1 + 0.3 * y)]), F, square


def plate_with_a_hole():
    flat, F = annulus(8)
    return np.column_stack([flat, 0.3 * (flat**2).sum(axis=1)]), F, flat


@pytest.mark.slow
@pytest.mark.parametrize("model", [bowl, strip, plate_with_a_hole])
def test_coordinates_without_seams_get_none_if_the_bound_is_kept(model):
    V, F, uv = model()
    assert unwrap(V, F, resolution=256).n_charts > 1
    result = unwrap(V, F, resolution=256, uv=uv)
    assert result.status.name == "UNWRAPPED"
    assert (result.n_charts, len(result.seams)) == (1, 0)


@pytest.mark.slow
@pytest.mark.parametrize("scale", [(-1, 1), (1e-200, 1e-200), (1e200, -1e200), (0, 1)])
def test_mirrored_coordinates_and_coordinates_of_any_size_are_accepted(scale):
    V, F, uv = strip()
    result = unwrap(V, F, resolution=256, uv=uv * scale)
    assert result.success
    assert result.n_charts == 1


@pytest.mark.slow
def test_coordinates_that_overlap_themselves_are_replaced():
    V, F, uv = strip()
    result = unwrap(V, F, resolution=256, uv=np.abs(uv - 0.5))
    assert result.success
    assert result.n_charts == 1


@pytest.mark.slow
def test_unknown_coordinates_are_none():
    V, F = starfish(3, 8)
    result, plain = unwrap(V, F, uv=np.full((len(V), 2), np.nan)), unwrap(V, F)
    assert np.array_equal(result.uvs, plain.uvs)


def test_closed_parts_without_coordinates_are_cut():
    V, F, uv = strip()
    more, triangles = torus(12, 6)
    corner_uv = np.concatenate([uv[F], np.full((len(triangles), 3, 2), np.nan)])
    result = unwrap(np.concatenate([V, more]), np.concatenate([F, triangles + len(V)]), uv=corner_uv, resolution=256)
    assert result.status.name == "UNWRAPPED"
    assert len(np.unique(result.charts[: len(F)])) == 1
    assert result.seams.min() >= len(V)


@pytest.mark.slow
def test_a_bound_that_given_seams_do_not_keep_requires_more():
    V, F, uv = bowl()
    result = unwrap(V * [1, 1, 3], F, resolution=256, uv=uv)
    assert result.status.name == "UNWRAPPED"
    assert len(result.seams)


def test_seams_are_edges_of_the_model_where_vertices_are_split():
    V, F = starfish(3, 5)
    apart, own = V[F].reshape(-1, 3), np.arange(F.size).reshape(-1, 3)
    split, joined = (unwrap(*mesh, resolution=256) for mesh in ((apart, own), (V, F)))
    sides = {tuple(sorted((a, b))) for row in own.tolist() for a, b in zip(row, row[1:] + row[:1], strict=True)}
    assert {tuple(edge) for edge in split.seams.tolist()} <= sides
    assert split.seam_length == pytest.approx(joined.seam_length)


def test_an_edge_of_three_triangles_is_named_by_vertices_of_the_model():
    points = np.array([[0, 0, 0], [1, 0, 0], [0.5, 1, 0], [0.5, -1, 0], [0.5, 0, 1], [0, 0, 0], [1, 0, 0]])
    result = unwrap(points, [[0, 6, 2], [6, 0, 3], [5, 6, 4]], resolution=64)
    assert result.seams.tolist() in ([[0, 6]], [[5, 6]])


@pytest.mark.long
@given(st.integers(0, 2**31), st.floats(0, 1))
@examples(20)
def test_each_seam_is_named_once_by_an_edge_of_the_model(seed, share):
    """Also at edges of several triangles, with random vertices split."""
    rng = np.random.default_rng(seed)
    points = np.round(rng.normal(size=(8, 3)), 1)
    triangles = np.stack([rng.choice(8, 3, replace=False) for _ in range(12)])
    split = rng.random(triangles.shape) < share
    points = np.concatenate([points, points[triangles[split]]])
    triangles[split] = np.arange(8, len(points))
    seams = unwrap(points, triangles, resolution=64).seams
    sides = np.sort(np.stack([triangles, triangles[:, (1, 2, 0)]], axis=2).reshape(-1, 2), axis=1)
    assert {tuple(edge) for edge in seams.tolist()} <= {tuple(side) for side in sides.tolist()}
    places = {frozenset(map(tuple, ends)) for ends in points[seams].tolist()}
    assert len(places) == len(seams)
