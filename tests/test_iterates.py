"""An iterate evaluates at its own tensors, although the domain was factored for others since."""

from __future__ import annotations

import copy
import pickle
import sys
from concurrent.futures import ThreadPoolExecutor
from functools import cache

import numpy as np
import pytest

from quasiharmonic import Problem, solve
from quasiharmonic.energies.deformation import DeformationEnergy
from quasiharmonic.energies.energies import MIPS
from quasiharmonic.geometry.mesh.topology import boundary_edges
from quasiharmonic.solver.field.functionals import FUNCTIONALS
from quasiharmonic.solver.field.objective import Objective
from quasiharmonic.solver.search.harmonic_descent import Conformal, Harmonised
from shared.meshes import bend, lift, random_annulus, random_xi


def posed():
    """A curved annulus with a pin."""
    V, F = random_annulus(90)
    fixed = np.unique(boundary_edges(F, len(V)))
    fixed = np.append(fixed, np.setdiff1d(np.arange(len(V)), fixed)[:1])
    return Problem(lift(V), F, fixed, bend(V[fixed]))


def harmonised(problem):
    """Q of the harmonised MIPS energy."""
    objective = Objective(problem, reference="rest")
    energy = DeformationEnergy(problem.V, problem.F, MIPS(), area=2.0)
    regulariser = Conformal(objective.mesh.m / objective.mesh.m.sum())
    return objective.with_functional(
        Harmonised(problem, objective.mesh, 2.0, energy, regulariser, eta=0.3, conformal=0.2)
    )


MAKERS = {name: lambda problem, name=name: Objective(problem, name) for name in FUNCTIONALS} | {
    "harmonised": harmonised
}


def asked(iterate):
    return iterate.value, iterate.gradient


@cache
def alone(name, seed):
    """Random tensors, and the results at them of an objective whose problem nothing else uses."""
    problem = posed()
    xi = random_xi(problem.F, 0.1, seed)
    value, gradient = asked(MAKERS[name](problem).evaluate(xi))
    gradient.setflags(write=False)
    return xi, value, gradient


@pytest.mark.parametrize("name", MAKERS)
@pytest.mark.parametrize("other", [None, *MAKERS])
def test_used_after_another_evaluation(name, other):
    """Evaluate at ξ₁, then at ξ₂ (with another objective of the same problem), then use the first iterate."""
    xi1, value, gradient = alone(name, 1)
    xi2, later_value, later_gradient = alone(other or name, 2)
    assert np.isfinite(value)
    problem = posed()
    objective = MAKERS[name](problem)
    second = objective if other is None else MAKERS[other](problem)
    first, later = objective.evaluate(xi1), second.evaluate(xi2)
    for _ in range(2):
        assert first.value == pytest.approx(value, rel=1e-12)
        np.testing.assert_allclose(first.gradient, gradient, rtol=1e-9, atol=1e-12 * np.abs(gradient).max())
        assert later.value == pytest.approx(later_value, rel=1e-12)
        np.testing.assert_allclose(later.gradient, later_gradient, rtol=1e-9, atol=1e-12 * np.abs(later_gradient).max())


def test_operators_in_turn():
    """Each one gives its own results, although the other refactors in between."""
    problem = posed()
    objective = Objective(problem)
    one, two = (objective.evaluate(random_xi(problem.F, 0.3, seed)).operator for seed in (3, 4))
    load = random_xi(np.zeros(problem.n), 1.0, 5)
    answers = [operator.respond(load) for operator in (one, two, one, two)]
    np.testing.assert_array_equal(answers[0], answers[2])
    np.testing.assert_array_equal(answers[1], answers[3])
    assert np.abs(answers[0] - answers[1]).max() > 1e-3


@pytest.fixture
def hasty():
    """Make threads switch as often as possible."""
    interval = sys.getswitchinterval()
    sys.setswitchinterval(1e-6)
    yield
    sys.setswitchinterval(interval)


SHARED = {
    "one objective": lambda make, problem, one: one,
    "two objectives of one problem": lambda make, problem, one: make(problem),
    "a moved problem": lambda make, problem, one: make(problem.with_target(problem.target)),
}


@pytest.mark.usefixtures("hasty")
@pytest.mark.parametrize("shared", SHARED)
@pytest.mark.parametrize("name", MAKERS)
def test_threads_share_a_domain(name, shared):
    """Other threads evaluate on the same domain; each one gets the result that it would get alone."""
    make = MAKERS[name]
    expected = [alone(name, seed) for seed in range(4)]
    problem = posed()
    one = make(problem)

    def wrong(thread):
        mine, bad = SHARED[shared](make, problem, one), 0
        for turn in range(10):
            xi, value, gradient = expected[(thread + turn) % 4]
            at = mine.evaluate(xi)
            bad += not np.isclose(at.value, value, rtol=1e-9, atol=0)
            bad += not np.allclose(at.gradient, gradient, rtol=0, atol=1e-9 * np.abs(gradient).max())
        return bad

    with ThreadPoolExecutor(4) as threads:
        assert sum(threads.map(wrong, range(4))) == 0


@pytest.mark.usefixtures("hasty")
def test_a_solve_beside_another_thread():
    """An objective of the same problem in another thread does not disturb a search."""
    alone, problem = solve(posed()), posed()
    objective, xi, done = Objective(problem), random_xi(problem.F, 0.3), []

    def spin():
        while not done:
            objective.evaluate(xi)

    with ThreadPoolExecutor(1) as threads:
        spinning = threads.submit(spin)
        try:
            for _ in range(4):
                beside = solve(problem)
                np.testing.assert_array_equal(beside.uv, alone.uv)
                assert beside.n_iterations == alone.n_iterations
        finally:
            done.append(True)
        spinning.result()


def test_a_domain_with_factors_is_pickled_and_copied():
    problem = posed()
    xi = random_xi(problem.F, 0.3)
    value = Objective(problem).evaluate(xi).value
    for other in (pickle.loads(pickle.dumps(problem)), copy.deepcopy(problem)):
        assert Objective(other).evaluate(xi).value == value


def test_a_map_at_its_own_tensors_is_reproduced():
    problem = posed()
    inside = problem.frame.inward(bend(problem.V[:, :2]))
    for functional in FUNCTIONALS:
        objective = Objective(problem, functional)
        at = objective.of_map(inside)
        np.testing.assert_allclose(objective.evaluate(at.xi).w, inside, atol=1e-10)
        assert at.value == pytest.approx(objective.evaluate(at.xi).value, abs=1e-9)
