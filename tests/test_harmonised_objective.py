"""The objective of `harmonise`: its gradient through the solve, and L-BFGS on it."""

from __future__ import annotations

import numpy as np
import pytest

from quasiharmonic import (
    distortion,
)
from quasiharmonic.energies import polishing
from quasiharmonic.energies.derivatives import derivative_error
from quasiharmonic.energies.energies import MIPS
from quasiharmonic.solver.methods import LBFGS
from quasiharmonic.solver.methods.base import Steps
from quasiharmonic.solver.search.harmonising import ENERGIES
from shared.harmonising import bowl, objective_of
from shared.meshes import random_xi

BARRIERS = set(polishing.ENERGIES)


class TestObjective:
    @pytest.mark.parametrize("name", [*ENERGIES, None])
    @pytest.mark.parametrize("reference", ["rest", "equilateral"])
    @pytest.mark.parametrize("sigmoid", ["tanh", "si-log"])
    def test_gradient_is_that_of_the_value(self, name, reference, sigmoid):
        V, F, uv, fixed = bowl()
        energy = None if name is None else ENERGIES[name](V, F)
        weights = None if name is None else np.random.default_rng(1).uniform(0, 3, len(F))
        objective = objective_of(V, F, uv, fixed, energy, weights=weights, reference=reference, sigmoid=sigmoid)
        xi = objective.near_map(objective.problem.frame.inward(uv)).xi + random_xi(F, 0.02)
        assert np.isfinite(objective.evaluate(xi).value)

        def along(x, d):
            return np.sum(np.conj(objective.evaluate(x).gradient) * d).real

        assert derivative_error(lambda x: objective.evaluate(x).value, along, xi) < 1e-7

    @pytest.mark.parametrize("name", sorted(set(ENERGIES) - BARRIERS))
    def test_gradient_where_triangles_are_inverted(self, name):
        V, F, uv, fixed = bowl()
        objective = objective_of(V, F, uv, fixed, ENERGIES[name](V, F))
        xi = random_xi(F, 1.0)
        assert objective.evaluate(xi).inverted > 3

        def along(x, d):
            return np.sum(np.conj(objective.evaluate(x).gradient) * d).real

        assert derivative_error(lambda x: objective.evaluate(x).value, along, xi) < 1e-6

    def test_terms_add_up(self):
        V, F, uv, fixed = bowl()
        xi = random_xi(F, 0.05)
        at = objective_of(V, F, uv, fixed, MIPS(), eta=0.3, conformal=0.2).evaluate(xi)
        area = at.objective.functional.area
        assert area == pytest.approx(at.dw.area.sum())
        measured = distortion(V, F, at.objective.problem.positions(at.w))
        regulariser = np.sum(measured.share * 4 * np.sinh(np.abs(xi)) ** 2)
        expected = at.dirichlet / area + 0.3 * (measured.statistics("mips").mean + 0.2 * regulariser)
        assert at.value == pytest.approx(expected, rel=1e-12)

    def test_does_not_depend_on_scales(self):
        V, F, uv, fixed = bowl()
        xi = random_xi(F, 0.05)
        for name in ENERGIES:
            one, other = (
                objective_of(a * V, F, b * uv, fixed, ENERGIES[name](a * V, F)).evaluate(xi).value
                for a, b in ((1, 1), (64, 0.25))
            )
            assert other == pytest.approx(one, rel=1e-12)

    def test_at_the_maps_own_tensors(self):
        """There V₃ is zero, and R₁ is MIPS, which is the purpose of eq. 35."""
        V, F, uv, fixed = bowl()
        objective = objective_of(V, F, uv, fixed, None, eta=1.0, conformal=1.0)
        at = objective.near_map(objective.problem.frame.inward(uv))
        np.testing.assert_allclose(objective.problem.positions(at.w), uv, atol=1e-12)
        mips = distortion(V, F, uv).statistics("mips").mean
        assert at.value == pytest.approx(mips, rel=1e-10)
        assert objective.functional.distortion_of_map(at) == pytest.approx(mips, rel=1e-10)

    def test_regulariser_of_a_map_with_inverted_triangles(self):
        V, F, uv, fixed = bowl()
        objective = objective_of(V, F, uv, fixed, None)
        at = objective.evaluate(random_xi(F, 1.0))
        assert np.isfinite(objective.functional.distortion(at))
        assert objective.functional.distortion_of_map(at) == np.inf


class TestLBFGS:
    @pytest.mark.parametrize("name", [*ENERGIES, None])
    def test_decreases_at_every_step(self, name):
        V, F, uv, fixed = bowl()
        energy = None if name is None else ENERGIES[name](V, F)
        objective = objective_of(V, F, uv, fixed, energy, conformal=1e-2)
        start = objective.near_map(objective.problem.frame.inward(uv))
        stiffness = np.abs(start.gradient) + 1e-3 * np.abs(start.gradient).mean()
        with np.errstate(all="ignore"):
            values = [at.value for at in LBFGS(iterations=100, stiffness=stiffness).iterates(objective, start)]
        assert len(values) > 30
        assert np.all(np.diff([start.value, *values]) < 0)

    def test_converges_to_a_minimum(self):
        V, F, uv, fixed = bowl(40)
        objective = objective_of(V, F, uv, fixed, MIPS(), conformal=1e-2)
        start = objective.evaluate(np.zeros(len(F), dtype=complex))
        assert np.isfinite(start.value)
        with np.errstate(all="ignore"):
            steps = Steps(LBFGS(iterations=5000, tol=1e-13).iterates(objective, start))
            last = list(steps)
        assert steps.converged
        assert len(last) < 4000
        assert np.abs(last[-1].gradient).max() < 1e-5 * np.abs(start.gradient).max()

    def test_stops_after_the_given_number_of_evaluations(self):
        V, F, uv, fixed = bowl()
        objective = objective_of(V, F, uv, fixed, MIPS())
        calls = []
        evaluate = objective.evaluate
        objective.evaluate = lambda xi: (calls.append(xi), evaluate(xi))[1]
        start = evaluate(np.zeros(len(F), dtype=complex))
        steps = Steps(LBFGS(iterations=7).iterates(objective, start))
        assert list(steps)
        assert not steps.converged
        assert len(calls) == 7
