"""Distances along surfaces: known values, their errors in maps, and the descent that reduces these."""

from __future__ import annotations

import json
import re

import numpy as np
import pytest
from scipy.optimize import minimize_scalar

from quasiharmonic import distortion, surfaces
from quasiharmonic.energies.distances import surface_distances
from quasiharmonic.geometry.mesh.geodesics import straight_segments
from shared.distances import rolled, spherical, turned

# --- along the surface


def test_straight_segments_of_a_plane_are_exact(flat):
    V, F = flat
    for crossings in range(4):
        found = straight_segments(V, F, crossings).tocoo()
        away = np.linalg.norm(V[found.row] - V[found.col], axis=1)
        assert np.allclose(found.data, away, rtol=1e-13)
    assert abs(straight_segments(V, F, 3) - straight_segments(V, F, 3).T).max() < 1e-14


def test_segments_cross_at_most_the_given_number_of_edges():
    V, F = surfaces.grid(3, 3)
    squares = [set((9 * straight_segments(V, F, k).data ** 2).round(6).tolist()) for k in range(3)]
    assert squares[0] == {1, 2}
    # Across one edge: the other diagonal of a square, and its detour over two edges; through a vertex, by rounding.
    assert {1, 2, 5} <= squares[1] <= {1, 2, 4, 5}
    assert squares[1] <= squares[2] <= {1, 2, 4, 5, 8, 10}


@pytest.mark.slow
@pytest.mark.parametrize("lift", [lambda V: V, lambda V: rolled(V, 0.4)], ids=["plane", "cylinder"])
def test_distances_on_developable_surfaces(flat, lift):
    V, F = flat
    lifted = lift(V)
    # A fine mesh of a cylinder is not a cylinder; its edges show the difference.
    chord = 0.0 if lifted.shape[1] == 2 else 1e-2
    last = np.inf
    for crossings, most in ((1, 3e-2), (3, 1e-2), (5, 5e-3)):
        found = surface_distances(lifted, F, rings=10, sources=60, crossings=crossings)
        ratio = found.length / np.linalg.norm(V[found.source] - V[found.target], axis=1)
        assert ratio.min() > 1 - 1e-12 - chord
        assert ratio.mean() - 1 < most
        assert ratio.mean() < last
        last = ratio.mean()
    if not chord:
        every = surface_distances(V, F, rings=10, sources=60, crossings=30)
        assert np.allclose(every.length, np.linalg.norm(V[every.source] - V[every.target], axis=1), rtol=1e-12)


def test_distances_on_a_sphere():
    V, F = surfaces.disk(20)
    radius = 0.7
    on_sphere = spherical(V, radius)
    found = surface_distances(on_sphere, F, rings=8, sources=80, crossings=5)
    cosine = (on_sphere[found.source] * on_sphere[found.target]).sum(axis=1) / radius**2
    ratio = found.length / (radius * np.arccos(np.clip(cosine, -1, 1)))
    assert abs(ratio.mean() - 1) < 3e-3
    assert ratio.max() < 1.03
    assert ratio.min() > 0.99


def test_no_path_crosses_a_cut():
    V, F = surfaces.grid(12, 12)
    # A slit from the left side to the centre: its upper side has its own vertices.
    middle = np.flatnonzero((np.abs(V[:, 1] - 0.5) < 1e-9) & (V[:, 0] < 0.5 - 1e-9))
    above = (V[F].mean(axis=1)[:, 1] > 0.5)[:, None] & np.isin(F, middle)
    copies = np.full(len(V), -1)
    copies[middle] = len(V) + np.arange(middle.size)
    slit, cut = np.concatenate([V, V[middle]]), np.where(above, copies[F], F)
    found = surface_distances(slit, cut, rings=20, sources=1000, crossings=12)
    corner, copy = middle[np.argmin(V[middle, 0])], copies[middle[np.argmin(V[middle, 0])]]
    between = (found.source == corner) & (found.target == copy)
    assert found.length[between] == pytest.approx(1.0, rel=1e-9)


def test_scale_of_coordinates_does_not_matter(dome):
    V, F = dome
    wanted = surface_distances(V, F, rings=4, sources=30)
    for exponent in (-500, 500):
        found = surface_distances(np.ldexp(V, exponent), F, rings=4, sources=30)
        assert np.array_equal(found.length, np.ldexp(wanted.length, exponent))
        assert found.error(np.ldexp(V[:, :2], exponent)).mean == wanted.error(V[:, :2]).mean


def test_sample_has_the_requested_pairs(dome):
    V, F = dome
    F = np.concatenate([F, F[:1] * 0 + len(V) + [[1, 2, 3]]])  # vertex len(V) is isolated
    V = np.concatenate([V, [[9, 9, 9], [3, 0, 0], [4, 0, 0], [3, 1, 0]]])
    every = surface_distances(V, F, rings=2, sources=10_000)
    assert np.array_equal(np.unique(every.source), np.unique(F))
    both = set(zip(every.source.tolist(), every.target.tolist(), strict=True))
    assert both == {(j, i) for i, j in both}
    assert all(i != j for i, j in both)
    ring = {(int(i), int(j)) for i, j in zip(F.ravel(), np.roll(F, -1, axis=1).ravel(), strict=True)}
    ring |= {(j, i) for i, j in ring}
    around = {j: {k for i, k in ring if i == j} for j in np.unique(F).tolist()}
    assert both == ring | {(i, k) for i, j in ring for k in around[j] if i != k}
    some = surface_distances(V, F, rings=2, sources=50, targets=7)
    assert np.unique(some.source, return_counts=True)[1].max() == 7
    assert np.unique(some.source).size == 50
    assert set(zip(some.source.tolist(), some.target.tolist(), strict=True)) <= both
    again = surface_distances(V, F, rings=2, sources=50, targets=7)
    assert np.array_equal(some.target, again.target)
    other = surface_distances(V, F, rings=2, sources=50, targets=7, seed=1)
    assert not np.array_equal(some.source, other.source)


# --- in the plane


def test_the_scale_is_optimal(dome):
    V, F = dome
    rng = np.random.default_rng(0)
    uv = V[:, :2] * [3, 1] + rng.normal(0, 0.02, (len(V), 2))
    sample = surface_distances(V, F, rings=6, sources=100)
    found = sample.error(uv)
    plane = np.linalg.norm(uv[sample.source] - uv[sample.target], axis=1)

    def mean(scale):
        return np.abs(scale * plane / sample.length - 1).mean()

    best = minimize_scalar(mean, bounds=(0, 3), method="bounded", options={"xatol": 1e-10})
    assert found.mean == pytest.approx(mean(found.scale), rel=1e-12)
    assert found.mean <= best.fun * (1 + 1e-12)
    assert found.scale == pytest.approx(best.x, rel=1e-4)
    assert found.rms == pytest.approx(np.sqrt(np.mean((found.scale * plane / sample.length - 1) ** 2)))
    assert found.median <= found.mean <= found.rms
    assert sample.error(7 * turned(uv, 1.0)).mean == pytest.approx(found.mean, rel=1e-12)


@pytest.mark.slow
def test_isometries_have_no_error_and_a_point_has_the_whole_error(flat):
    V, F = flat
    assert surface_distances(rolled(V, 50.0), F, rings=5, crossings=20).error(turned(V, 0.3)).mean < 1e-5
    point = distortion(V, F, np.zeros_like(V), rings=5).distances
    assert (point.mean, point.scale) == (1.0, 1.0)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"rings": 0}, "rings must be an integer of at least 1, not 0"),
        ({"sources": 2.5}, "sources must be an integer"),
        ({"crossings": -1}, "crossings must be an integer of at least 0"),
        ({"uv": np.zeros((3, 2))}, "a pair refers to vertex 3, but there are only vertices 0 … 2"),
        ({"uv": np.full((4, 2), np.nan)}, "uv is not finite at vertices 0, 1, 2, 3"),
        ({"V": np.zeros((4, 4))}, "V must have shape"),
        ({"V": [[0, 0], [1, 0], [2, 0], [0, 1]]}, "triangle 0 of zero area"),
        ({"F": [[0, 1, 9]]}, "F refers to vertex 9"),
        ({"F": np.zeros((0, 3), dtype=int)}, "at least one triangle"),
    ],
)
def test_invalid_input_is_named(options, message):
    given = {"V": [[0, 0], [1, 0], [1, 1], [0, 1]], "F": [[0, 1, 2], [0, 2, 3]], "uv": np.eye(4)[:, :2], **options}
    uv = given.pop("uv")

    def measured():
        return surface_distances(**given).error(uv)

    with pytest.raises(ValueError, match=re.escape(message)):
        measured()


def test_statistics_name_their_sampling(dome):
    V, F = dome
    found = surface_distances(V, F, rings=3, sources=25, crossings=2).error(V[:, :2])
    told = found.to_dict()
    assert (told["rings"], told["sources"], told["targets"], told["crossings"]) == (3, 25, None, 2)
    assert told["pairs"] == found.relative.size
    assert (told["mean"], told["rms"], told["scale"]) == (found.mean, found.rms, found.scale)
    assert "25 vertices with all others at most 3 edges away" in told["sampling"]
    assert "cross at most 2 edges each" in found.summary()
    json.dumps(told, allow_nan=False)
