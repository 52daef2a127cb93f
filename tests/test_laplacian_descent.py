"""Quasi-Newton descents with a Laplacian as metric, and the thin triangles that they leave stretched."""

from __future__ import annotations

import numpy as np
import pytest

from quasiharmonic.apps.flattening.piece import Piece
from quasiharmonic.apps.flattening.surface_descent import SurfaceDescent
from quasiharmonic.apps.unwrapping.chart_maps import WorkingChart, flatten_chart, relax_thin
from quasiharmonic.energies.energies import MIPS, Hardened, SymmetricDirichlet
from quasiharmonic.energies.newton.laplacian_descent import LaplacianDescent
from quasiharmonic.geometry.exact.certificate import is_injective
from quasiharmonic.linsolve import NotPositiveDefinite
from shared.meshes import irregular_disk, lift


def bowl(n=300, seed=3):
    """A piece of a curved surface, and an injective map of it with moderate distortion."""
    V, F = irregular_disk(n, seed)
    return Piece(lift(V), F), V * [1.2, 0.9]


def minimum(energy, uv):
    """Lowest energy by Newton's method."""
    descent = SurfaceDescent(energy, uv, "auto")
    for _ in descent.descend(100, 1e-10):
        pass
    return descent.distortion


@pytest.mark.parametrize("density", [SymmetricDirichlet(), Hardened(SymmetricDirichlet(), 0.5), MIPS()])
def test_the_minimum_is_newton_s(density):
    piece, uv = bowl()
    energy = piece.energy(density, None)
    descent = LaplacianDescent(energy, piece.fit_scale(uv))
    before = descent.value
    # Steepest descent in the metric alone takes hundreds of steps.
    for _ in range(100):
        value = descent.value
        if not descent.step():
            break
        assert descent.value < value
        assert is_injective(piece.F, descent.uv)
    lowest = minimum(energy, piece.fit_scale(uv))
    assert descent.value == pytest.approx(lowest, rel=1e-5, abs=1e-9)
    assert before > 1.2 * lowest


def two_loops(inverse, steps, changes, gradient):
    """L-BFGS's direction by its usual recursion, with the inverse metric as a matrix."""
    r, factors = gradient.copy(), []
    for s, y in zip(reversed(steps), reversed(changes), strict=True):
        factors.append(s @ r / (s @ y))
        r -= factors[-1] * y
    z = inverse @ r
    for s, y, factor in zip(steps, changes, reversed(factors), strict=True):
        z += (factor - y @ z / (s @ y)) * s
    return -z


def test_directions_are_those_of_the_recursion():
    piece, uv = bowl(120)
    energy = piece.energy(Hardened(SymmetricDirichlet(), 0.5), None)
    near = LaplacianDescent(energy, piece.fit_scale(uv))
    for _ in range(20):
        near.step()
    # So near that the energy does not halve, which would change the metric.
    descent = LaplacianDescent(energy, 0.8 * near.uv + 0.2 * piece.fit_scale(uv))
    w = descent.uv @ [1, 1j]
    n, first = len(w), descent.value
    form = energy.curvature_of(energy.deform(w))
    weight = 0.5 * (form.pp + form.qq)
    stiffness = np.zeros((n, n))
    for k in range(3):
        i, j = piece.F[:, k], piece.F[:, (k + 1) % 3]
        entry = 2 * weight * (energy.g[k] * energy.g[(k + 1) % 3].conj()).real
        np.add.at(stiffness, (i, j), entry)
        np.add.at(stiffness, (j, i), entry)
    stiffness -= np.diag(stiffness.sum(axis=1))
    inverse = np.zeros((n, n))
    inverse[1:, 1:] = np.linalg.inv(stiffness[1:, 1:])
    inverse = np.kron(inverse, np.eye(2))
    steps, changes, gradient = [], [], energy.gradient(w).view(np.float64)
    while descent.step() and descent.value > 0.5 * first and len(steps) < 12:
        there = descent.uv @ [1, 1j]
        step, new = (there - w).view(np.float64), energy.gradient(there).view(np.float64)
        expected = two_loops(inverse, steps[-8:], changes[-8:], gradient)
        np.testing.assert_allclose(
            step / np.linalg.norm(step), expected / np.linalg.norm(expected), atol=1e-7 * np.sqrt(n)
        )
        steps.append(step)
        changes.append(new - gradient)
        w, gradient = there, new
    # The first steps are no longer remembered at the end.
    assert len(steps) > 8


def test_rotations_of_the_start_do_not_matter():
    piece, uv = bowl()
    energy = piece.energy(SymmetricDirichlet(), None)
    uv = piece.fit_scale(uv)
    turned = uv @ np.array([[0.6, 0.8], [-0.8, 0.6]])
    found = []
    for start in (uv, turned):
        descent = LaplacianDescent(energy, start)
        for _ in range(5):
            descent.step()
        found.append(descent.value)
    assert found[0] == pytest.approx(found[1], rel=1e-6)


def chart_with_sliver(height):
    """A disk; a vertex very close to an edge makes a thin triangle, which the map stretches along the edge."""
    V, F = irregular_disk(200, 5)
    inner = F[np.argmin(np.abs(V[F].mean(axis=1)).sum(axis=1))]
    a, b, c = V[inner]
    near = a + 0.5 * (b - a) + height * (c - a)
    k = len(V)
    i, j, m = inner.tolist()
    others = F[(inner != F).any(axis=1)]
    T = np.concatenate([others, [[i, j, k], [j, m, k], [m, i, k]]])
    P = np.concatenate([V, [near]])
    chart = WorkingChart(np.arange(len(T)), np.arange(k + 1), np.pad(P, [(0, 0), (0, 1)]), T, np.ones(T.shape))
    moved = P.copy()
    # Twenty times as high as it should be.
    moved[k] = a + 0.5 * (b - a) + 20 * height * (c - a)
    chart.use(moved)
    return chart, len(T) - 3


def test_thin_triangles_do_not_stay_stretched():
    chart, thin = chart_with_sliver(2e-3)
    before = chart.stretch.copy()
    assert before[thin] > 10
    assert not chart.too_long[thin]
    relax_thin(chart, 1.5)
    assert chart.stretch[thin] < 2
    assert chart.bijective
    assert chart.share_over(1.5) <= (chart.area * (before > 1.5)).sum()


def test_a_chart_without_stretched_triangles_keeps_its_map():
    chart, _ = chart_with_sliver(0.2)
    chart.use(np.delete(chart.V, 2, axis=1))
    before = chart.uv.copy()
    assert chart.stretch.max() < 3
    relax_thin(chart, 1.5)
    np.testing.assert_array_equal(chart.uv, before)


def test_newton_s_method_takes_over_where_the_laplacian_has_no_factor(monkeypatch):
    def fail(self):
        raise NotPositiveDefinite("the matrix is not positive definite")

    V, F = irregular_disk(200, 5)
    chart = WorkingChart(np.arange(len(F)), np.arange(len(V)), 3 * lift(V), F, np.ones(F.shape))
    flatten_chart(chart, 1.3, lambda: None)
    expected = chart.stretch
    monkeypatch.setattr(LaplacianDescent, "step", fail)
    chart.uv = None
    flatten_chart(chart, 1.3, lambda: None)
    assert is_injective(F, chart.uv)
    assert np.quantile(chart.stretch, 0.99) < 1.1 * np.quantile(expected, 0.99)
