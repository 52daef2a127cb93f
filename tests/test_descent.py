"""The descent methods, compared with brute force and differences."""

from __future__ import annotations

from dataclasses import dataclass, replace
from itertools import islice, pairwise
from typing import ClassVar

import numpy as np
import pytest

from quasiharmonic import Descent, Problem, solve
from quasiharmonic.solver import methods as descent
from quasiharmonic.solver.field.functionals import beltrami_gradient
from quasiharmonic.solver.field.objective import Objective
from quasiharmonic.solver.field.tensor import PARAMETERISATIONS, TANH, own_tensor
from quasiharmonic.solver.methods import LBFGS, Alternating, Newton, VectorAdam
from quasiharmonic.solver.methods.base import FunctionalDescent, SearchState, Steps
from quasiharmonic.solver.methods.newton import SecondOrderModel
from shared.descent import path
from shared.meshes import random_xi
from shared.solvable_problems import star_problem, turned_ring

BOTH = list(PARAMETERISATIONS)


@pytest.mark.parametrize("name", BOTH)
class TestParameterisation:
    def test_the_parameterisation_is_inverted_exactly(self, name, rng):
        p = PARAMETERISATIONS[name]
        xi = rng.standard_normal(50) + 1j * rng.standard_normal(50)
        np.testing.assert_allclose(p.invert(p.field(xi).mu), xi, rtol=1e-11)
        assert p.invert(np.zeros(1, dtype=complex))[0] == 0
        outside = p.invert(np.array([1.0 + 0j, -3j]))
        assert np.all(np.isfinite(outside.view(float)))
        assert np.all(np.abs(outside) <= p.bound * (1 + 1e-15))

    def test_second_derivative_is_the_derivative_of_the_gradient(self, name):
        p = PARAMETERISATIONS[name]
        rho, h = np.linspace(0.1, 4, 20), 1e-5
        slope = (p.radial(rho + h)[2] - p.radial(rho - h)[2]) / (2 * h)
        np.testing.assert_allclose(p.second_derivative(rho), slope, rtol=1e-6, atol=1e-9)


@pytest.mark.parametrize("kind", [getattr(descent, name) for name in descent.__all__ if name != "Descent"])
class TestEveryMethod:
    """Properties of every method that a search relies on."""

    @staticmethod
    def posed():
        return Problem(*star_problem(depth=0.4, n=200))

    def begun(self, method):
        """An objective, and the point where the method starts after a search tried Tutte's embedding."""
        problem = self.posed()
        objective = method.objective(problem, "auto")
        tutte = objective.evaluate(np.zeros(len(problem.F), dtype=complex))
        assert tutte.inverted > 0
        return objective, method.start(objective, SearchState(None, tutte.w, tutte))

    def test_has_defaults_a_label_and_a_way_to_resume(self, kind):
        method = kind()
        assert issubclass(kind, Descent)
        assert method.label in method.name
        assert replace(method, resume=True) == kind(resume=True)
        assert replace(method, resume=True) != method
        objective, start = self.begun(kind(resume=True))
        assert start.objective.problem is objective.problem
        assert np.isfinite(start.energy)

    def test_interleaved_and_abandoned_runs(self, kind):
        """Another run on the same domain, unfinished or abandoned, changes no map of this run."""
        method = kind()
        objective, start = self.begun(method)
        alone = [at.w for at in islice(method.iterates(objective, start), 4)]
        one, other = method.iterates(objective, start), method.iterates(objective, start)
        begun = [at.w for at in islice(one, 2)]
        beside = [at.w for at in islice(other, 3)]
        other.close()
        begun += [at.w for at in islice(one, 2)]
        one.close()
        for expected, found in ((alone, begun), (alone[:3], beside)):
            assert len(found) == len(expected)
            for here, there in zip(expected, found, strict=True):
                np.testing.assert_allclose(there, here, rtol=0, atol=1e-12)

    def test_does_not_change_the_floating_point_state(self, kind):
        before = np.geterr()
        method = kind()
        iterates = method.iterates(*self.begun(method))
        for _ in islice(iterates, 3):
            assert np.geterr() == before
        iterates.close()
        assert np.geterr() == before

    def test_reports_convergence(self, kind):
        """Two iterations are too few; a method without this setting ends by itself."""
        limited = "iterations" in kind.__dataclass_fields__
        method = kind(iterations=2) if limited else kind()
        steps = Steps(method.iterates(*self.begun(method)))
        count = len(list(steps))
        assert count <= 2 or not limited
        assert steps.converged is not limited

    @pytest.mark.slow
    def test_a_solve_after_an_abandoned_one(self, kind):
        method = kind()
        objective, start = self.begun(method)
        unfinished = method.iterates(objective, start)
        next(unfinished, None)
        again, fresh = (
            solve(problem, strategy=[method], max_iterations=6) for problem in (objective.problem, self.posed())
        )
        np.testing.assert_array_equal(again.uv, fresh.uv)


class TestAlternating:
    def test_the_frozen_tensor_is_optimal(self, rng):
        """No other tensor has a lower energy for the map, on positive and on inverted triangles."""
        problem = Problem(*star_problem(n=80))
        mesh = problem.domain.mesh("equilateral")
        w = rng.standard_normal(problem.n) + 1j * rng.standard_normal(problem.n)
        dw = mesh.derivatives(w)
        best = beltrami_gradient(mesh, TANH.field(TANH.invert(own_tensor(dw.p, dw.q))), dw)[0]
        inverted = -dw.area[dw.area < 0].sum()
        assert inverted > 0
        assert best == pytest.approx(2 * inverted, rel=1e-6)
        for seed in range(20):
            other = TANH.field(TANH.invert(own_tensor(dw.p, dw.q)) + random_xi(problem.F, 0.05, seed))
            assert beltrami_gradient(mesh, other, dw)[0] > best

    def test_lowers_the_energy(self):
        seen = path(Alternating(iterations=10), Objective(Problem(*star_problem())))
        assert np.all(np.diff([i.dirichlet for i in seen]) <= 1e-12)
        assert len(seen) == 11


@pytest.mark.parametrize("name", BOTH)
@pytest.mark.parametrize("reference", ["equilateral", "rest"])
class TestNewton:
    def test_second_derivatives_against_differences(self, name, reference):
        """dᵀ(K − Bᵀ H⁻¹ B)d is the second derivative of V₃(ξ), the map following."""
        objective = Objective(Problem(*star_problem(n=80)), parameterisation=name, reference=reference)
        xi = random_xi(objective.problem.F)
        h = 1e-4
        for seed in range(3):
            d = random_xi(objective.problem.F, 1.0, seed + 10)
            ahead, behind = objective.evaluate(xi + h * d), objective.evaluate(xi - h * d)
            here = objective.evaluate(xi)
            second = (ahead.dirichlet - 2 * here.dirichlet + behind.dirichlet) / h**2
            model = SecondOrderModel(here)
            alpha, beta = (model.unit.conj() * d).real, (model.unit.conj() * d).imag
            bent = model.K[0] * alpha**2 + 2 * model.K[1] * alpha * beta + model.K[2] * beta**2
            along, across = model.B
            load = model.gather(along[0] * alpha + across[0] * beta, along[1] * alpha + across[1] * beta)
            load[objective.problem.fixed] = 0
            follow = np.vdot(load, here.operator.respond(load)).real
            assert bent.sum() - follow == pytest.approx(second, rel=1e-4)
            slope = (ahead.dirichlet - behind.dirichlet) / (2 * h)
            assert model.g[0] @ alpha + model.g[1] @ beta == pytest.approx(slope, rel=1e-6)
            assert np.vdot(here.gradient, d).real == pytest.approx(slope, rel=1e-6)

    def test_descends(self, name, reference):
        objective = Objective(Problem(*star_problem(depth=0.3)), parameterisation=name, reference=reference)
        values = [i.dirichlet for i in path(Newton(iterations=15), objective)]
        assert np.all(np.diff(values) < 0)
        assert values[-1] < 0.05 * values[0]

    def test_starts_from_zero_where_polar_coordinates_fail(self, name, reference):
        objective = Objective(Problem(*star_problem(n=80)), parameterisation=name, reference=reference)
        model = SecondOrderModel(objective.evaluate(np.zeros(len(objective.problem.F), dtype=complex)))
        for part in (*model.K, *model.g, *model.B[0], *model.B[1]):
            assert np.all(np.isfinite(part))


def test_newton_converges_fast_near_a_solution():
    """It converges to 1e-10 of the area within a few steps, where first-order methods are slow."""
    problem = Problem(*star_problem(depth=0.4))
    objective = Objective(problem)
    start = path(VectorAdam(iterations=40, schedule=((0, 0.2),)), objective)[-1]
    energies = [i.energy for i in path(Newton(iterations=40), objective, start)]
    assert min(energies) < 1e-10


@pytest.mark.parametrize("functional", ["neumann", "sobolev", "dirichlet"])
def test_lbfgs_descends(functional):
    objective = Objective(Problem(*star_problem()), functional)
    values = [i.value for i in path(LBFGS(iterations=30), objective)]
    assert min(values) < 0.1 * values[0]


def test_lbfgs_stays_within_the_bound():
    objective = Objective(Problem(*turned_ring(180)))
    start = objective.evaluate(TANH.bound * np.exp(1j * np.arange(len(objective.problem.F))))
    iterates = list(path(LBFGS(iterations=10), objective, start))
    assert len(iterates) > 3
    for iterate in iterates:
        assert np.abs(iterate.xi).max() <= TANH.bound * (1 + 1e-12)


def test_vector_adam_steps_have_the_length_of_the_schedule():
    """The first step of every triangle with a non-zero gradient has exactly that length."""
    objective = Objective(Problem(*star_problem()))
    first = path(VectorAdam(iterations=1, schedule=((0, 0.37),)), objective)[1]
    np.testing.assert_allclose(np.abs(first.xi), 0.37, rtol=1e-9)


@pytest.mark.parametrize("momenta", [(0.9, 0.999), (0.0, 0.5), (0.6, 0.9)])
def test_vector_adam_is_adam_with_the_moduli_of_complex_numbers(momenta):
    """Compare with Kingma and Ba's formulas, step by step."""
    objective = Objective(Problem(*star_problem()))
    maps = path(VectorAdam(iterations=6, schedule=((0, 0.1),), momenta=momenta), objective)
    first, second = momenta
    mean, square, xi = 0, 0, maps[0].xi
    for k, (here, after) in enumerate(pairwise(maps), start=1):
        mean = first * mean + (1 - first) * here.gradient
        square = second * square + (1 - second) * np.abs(here.gradient) ** 2
        xi = xi - 0.1 * (mean / (1 - first**k)) / np.sqrt(square / (1 - second**k))
        np.testing.assert_allclose(after.xi, xi, rtol=1e-8)


class TestPatience:
    """A stage ends when its own functional no longer decreases, whatever V₃ does."""

    @dataclass(frozen=True, kw_only=True)
    class Roughening(FunctionalDescent):
        """Tensors that become rougher: V₄ falls below zero and V₃ grows."""

        label: ClassVar[str] = "roughening"
        patience = 5, 1e-3

        def iterates(self, objective, start):
            for k in range(1, self.iterations + 1):
                yield objective.evaluate(start.xi + 0.02 * k * random_xi(objective.problem.F))
            return False

    @pytest.mark.parametrize(("functional", "most"), [("poisson", 40), ("dirichlet", 12)])
    def test_patience_uses_the_descended_functional(self, functional, most):
        V, F, fixed, target = star_problem()
        result = solve(Problem(V, F, fixed, target), strategy=[self.Roughening(functional=functional, iterations=40)])
        assert not result.injective
        assert result.history[-1].energy > result.history[0].energy
        assert (result.stages[0].n_iterations == 40) == (most == 40)
        assert result.stages[0].n_iterations <= most


def test_vector_adam_ignores_the_frames():
    """A rotation of the triangles' corners rotates ξ and changes nothing else."""
    V, F, fixed, target = star_problem()
    turned = np.where((np.arange(len(F)) % 2)[:, None], np.roll(F, -1, axis=1), F)
    a, b = (solve(Problem(V, G, fixed, target)) for G in (F, turned))
    np.testing.assert_allclose(a.uv, b.uv, atol=1e-9)
