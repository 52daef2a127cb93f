"""An iterate answers for its own tensors, whatever has been factored since."""

from __future__ import annotations

import numpy as np
import pytest
from quasiharmonic.field.regularisers import Conformal

from quasiharmonic import Problem
from quasiharmonic.energy.deformation import DeformationEnergy
from quasiharmonic.energy.energies import MIPS
from quasiharmonic.field.functionals import FUNCTIONALS
from quasiharmonic.field.objective import Objective
from quasiharmonic.mesh.topology import boundary_edges
from quasiharmonic.search.harmonised import Harmonised
from shared.meshes import bend, lift, random_annulus, random_xi


def posed():
    """A curved annulus with a pin."""
    V, F = random_annulus()
    fixed = np.unique(boundary_edges(F, len(V)))
    fixed = np.append(fixed, np.setdiff1d(np.arange(len(V)), fixed)[:1])
    return Problem(lift(V), F, fixed, bend(V[fixed]))


def harmonised(problem):
    """Q of the harmonised MIPS energy."""
    objective = Objective(problem, reference="rest")
    energy = DeformationEnergy(problem.V, problem.F, MIPS(), area=2.0)
    regulariser = Conformal(objective.mesh.m / objective.mesh.m.sum())
    return objective.descending(Harmonised(problem, objective.mesh, 2.0, energy, regulariser, eta=0.3, conformal=0.2))


MAKERS = {name: lambda problem, name=name: Objective(problem, name) for name in FUNCTIONALS} | {
    "harmonised": harmonised
}


def asked(iterate):
    return iterate.value, iterate.gradient


@pytest.mark.parametrize("name", MAKERS)
@pytest.mark.parametrize("other", [None, *MAKERS])
def test_asked_after_another_evaluation(name, other):
    """Evaluate at ξ₁, then at ξ₂ (by another objective of the same problem), then ask the first."""
    xi1, xi2 = (random_xi(posed().F, 0.1, seed) for seed in (1, 2))
    value, gradient = asked(MAKERS[name](posed()).evaluate(xi1))
    assert np.isfinite(value)
    problem = posed()
    objective = MAKERS[name](problem)
    second = objective if other is None else MAKERS[other](problem)
    first, later = objective.evaluate(xi1), second.evaluate(xi2)
    later_value, later_gradient = asked(MAKERS[other or name](posed()).evaluate(xi2))
    for _ in range(2):
        assert first.value == pytest.approx(value, rel=1e-12)
        np.testing.assert_allclose(first.gradient, gradient, rtol=1e-9, atol=1e-12 * np.abs(gradient).max())
        assert later.value == pytest.approx(later_value, rel=1e-12)
        np.testing.assert_allclose(later.gradient, later_gradient, rtol=1e-9, atol=1e-12 * np.abs(later_gradient).max())


def test_operators_in_turn():
    """Each gives its own answers, however often the other has refactored in between."""
    problem = posed()
    objective = Objective(problem)
    one, two = (objective.evaluate(random_xi(problem.F, 0.3, seed)).operator for seed in (3, 4))
    load = random_xi(np.zeros(problem.n), 1.0, 5)
    answers = [operator.respond(load) for operator in (one, two, one, two)]
    np.testing.assert_array_equal(answers[0], answers[2])
    np.testing.assert_array_equal(answers[1], answers[3])
    assert np.abs(answers[0] - answers[1]).max() > 1e-3


def test_a_map_at_its_own_tensors_is_what_they_give_back():
    problem = posed()
    inside = problem.frame.inward(bend(problem.V[:, :2]))
    for functional in FUNCTIONALS:
        objective = Objective(problem, functional)
        at = objective.of_map(inside)
        np.testing.assert_allclose(objective.evaluate(at.xi).w, inside, atol=1e-10)
        assert at.value == pytest.approx(objective.evaluate(at.xi).value, abs=1e-9)
