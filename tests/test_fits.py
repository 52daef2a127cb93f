"""Fits of a chart's map to targets of its triangles."""

from __future__ import annotations

import numpy as np
import pytest

from quasiharmonic.apps.flattening.piece import Piece
from quasiharmonic.apps.unwrapping.chart_maps import FREE_SHARE, WorkingChart, flatten_chart
from quasiharmonic.apps.unwrapping.fits import Fits, direction, limit_stretch, singular_values
from quasiharmonic.energies.energies import SymmetricDirichlet
from quasiharmonic.energies.measures import distortion
from quasiharmonic.geometry.exact.certificate import is_injective
from shared.meshes import disk, lift


@pytest.fixture
def surface():
    """A curved disk: its vertices in the unit of its piece, triangles, gradients, and positions in the plane."""
    points, F = disk(6)
    piece = Piece(lift(points), F)
    return piece.V, F, piece.energy(SymmetricDirichlet(), None).g, points @ [1, 1j]


def test_derivatives_have_the_singular_values_of_the_map(surface):
    V, F, g, w = surface
    w = w + 0.1 * w**2
    measured = distortion(V, F, np.stack([w.real, w.imag], axis=1))
    fits = Fits(F, g)
    larger, smaller = singular_values(*fits.derivatives(w))
    # Distortion is measured after scaling the map to the surface's area.
    scale = np.sqrt(fits.area.sum() / (fits.area * larger * smaller).sum())
    assert np.maximum(scale * larger, 1 / (scale * smaller)) == pytest.approx(measured.isometric)


def test_a_map_is_found_from_its_derivatives(surface):
    _, F, g, w = surface
    fits = Fits(F, g)
    assert fits.place(*fits.derivatives(w)) == pytest.approx(w - w[0])


def test_a_fit_is_the_nearest_map(surface):
    """No other map is closer to the targets: the sum of squares grows in every direction, and has slope zero."""
    _, F, g, w = surface
    fits, rng = Fits(F, g), np.random.default_rng(0)
    targets = rng.normal(size=(2, len(F))) + 1j * rng.normal(size=(2, len(F)))
    best = fits.place(*targets)

    def distance(w):
        return sum((fits.area * np.abs(d - t) ** 2).sum() for d, t in zip(fits.derivatives(w), targets, strict=True))

    for _ in range(5):
        step = 1e-3 * (rng.normal(size=len(w)) + 1j * rng.normal(size=len(w)))
        up, down = distance(best + step), distance(best - step)
        assert min(up, down) > distance(best)
        assert up - down == pytest.approx(0, abs=1e-6 * (up + down - 2 * distance(best)))


def test_limited_stretch():
    rng = np.random.default_rng(1)
    p, q = rng.normal(size=(2, 50)) + 1j * rng.normal(size=(2, 50))
    larger, smaller = singular_values(*limit_stretch(p, q, 1.2))
    assert larger.max() == pytest.approx(1.2)
    assert smaller.min() == pytest.approx(1 / 1.2)
    rotation, nothing = limit_stretch(p, q, 1.0)
    assert rotation == pytest.approx(direction(p))
    assert not np.abs(nothing).any()
    inside = 1 + 0.05 * p / np.abs(p), 0.02 * q / np.abs(q)
    assert np.concatenate(limit_stretch(*inside, 1.2)) == pytest.approx(np.concatenate(inside))


def test_share_over_the_aim_counts_inverted_triangles(surface):
    _, F, g, w = surface
    fits = Fits(F, g)
    assert fits.share_over(*fits.derivatives(w), 100.0) == 0
    middle = int(F[0, 0])
    w[middle] += 10
    assert fits.share_over(*fits.derivatives(w), 100.0) > 0
    assert fits.share_over(*fits.derivatives(w.conj()), 100.0) == 1


@pytest.mark.parametrize("height", [0.3, 0.8])
def test_a_chart_keeps_its_bound(height):
    points, F = disk(8)
    V = np.c_[points, height * np.cos(2 * points).prod(axis=1)]
    chart = WorkingChart(np.arange(len(F)), np.arange(len(V)), V, F, np.ones(F.shape))
    flatten_chart(chart, 1.3, lambda: None)
    assert chart.bijective
    assert is_injective(F, chart.uv)
    assert chart.share_over(1.3) <= FREE_SHARE
