"""``benchmarks/future_work.py``: formulas against differences, and steps against the hyperbolic distance."""

from __future__ import annotations

import numpy as np
import pytest

import determinants
import hyperbolic
import positive_weights
from quasiharmonic import Problem, boundary_loops, certify, solve
from quasiharmonic.energies.deformation import signed_areas
from quasiharmonic.solver.field.tensor import TANH
from quasiharmonic.surfaces import disk
from shared.meshes import random_xi

WIDTH = 1e-6


@pytest.fixture
def problem():
    V, F = disk(5)
    (loop,) = boundary_loops(F, len(V))
    return Problem(V, F, loop, V[loop] * (1 + 0.6 * V[loop, :1]))


def slope(function):
    return (function(WIDTH) - function(-WIDTH)) / (2 * WIDTH)


def test_determinants(problem):
    """V₃ where s = 0, and its gradients in ξ and s."""
    random, f = np.random.default_rng(1), len(problem.F)
    scaled = determinants.Scaled(problem)
    xi, s = random_xi(problem.F, seed=1), random.normal(size=f)
    _, by_xi, by_s, _ = scaled.evaluate(xi, s)
    along, change = random_xi(problem.F, seed=2), random.normal(size=f)
    by = slope(lambda t: scaled.evaluate(xi + t * along, s)[0])
    assert np.vdot(by_xi, along).real == pytest.approx(by, rel=1e-6)
    assert by_s @ change == pytest.approx(slope(lambda t: scaled.evaluate(xi, s + t * change)[0]), rel=1e-6)
    assert scaled.evaluate(xi, 0 * s)[0] == pytest.approx(scaled.objective.evaluate(xi).dirichlet, rel=1e-12)


def test_geodesics(problem):
    xi, step = random_xi(problem.F, seed=3), random_xi(problem.F, seed=4)
    mu = TANH.field(xi).mu
    there = hyperbolic.exponential(mu, step)
    np.testing.assert_allclose(np.arctanh(np.abs((there - mu) / (1 - np.conj(mu) * there))), np.abs(step), rtol=1e-9)
    half = hyperbolic.exponential(mu, step / 2)
    carried = hyperbolic.transport(mu, half) * step / 2
    np.testing.assert_allclose(hyperbolic.exponential(half, carried), there, atol=1e-12)
    objective = determinants.Scaled(problem).objective
    gradient = hyperbolic.riemannian(objective.evaluate(xi).gradient, xi)
    by = slope(lambda t: objective.evaluate(TANH.invert(hyperbolic.exponential(mu, t * step))).value)
    assert np.vdot(gradient, step).real == pytest.approx(by, rel=1e-6)
    assert solve(problem, strategy=[hyperbolic.HyperbolicAdam(iterations=100)]).injective


@pytest.mark.parametrize("symmetric", [False, True])
def test_positive_weights(problem, symmetric):
    random = np.random.default_rng(3)
    means = positive_weights.Means(problem, symmetric)
    theta, change = random.normal(size=(2, means.count))
    w, by_theta = means.evaluate(theta, 0.3)
    width = 0.3 * np.abs(signed_areas(problem.F, w)).mean()

    def smooth(t):
        area = signed_areas(problem.F, means.evaluate(theta + t * change, 0.3)[0])
        return float((np.sqrt(area**2 + width**2) - area).sum() / 2)

    assert by_theta @ change == pytest.approx(slope(smooth), rel=1e-5)
    assert means.descend().flips == 0


def test_maps_with_one_and_two_weights_per_edge(problem):
    """Every injective map has two positive weights per edge; Tutte's embedding also has one weight per edge."""
    assert positive_weights.mean_values(problem, solve(problem).uv) < 1e-12
    V, F = disk(5)
    (loop,) = boundary_loops(F, len(V))
    round_ = Problem(V, F, loop, V[loop])
    assert positive_weights.has_symmetric(round_, solve(round_).uv)
    # A triangle in a triangle, joined by edges that all lean one way: no convex function has these edges as its
    # creases.
    corners = np.exp(2j * np.pi * np.arange(3) / 3)
    w = np.concatenate([4 * corners, corners])
    ring = [(i, (i + 1) % 3, 3 + i) for i in range(3)] + [((i + 1) % 3, 3 + (i + 1) % 3, 3 + i) for i in range(3)]
    F, V = np.array([(3, 4, 5), *ring]), np.stack([w.real, w.imag], axis=1)
    nested = Problem(V, F, np.arange(3), V[:3])
    assert certify(F, V).injective
    assert not positive_weights.has_symmetric(nested, V)
