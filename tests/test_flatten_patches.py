"""Flattening of surfaces with slivers: patches around the worst triangles, iterations without a factorisation."""

import numpy as np
import pytest

from quasiharmonic import flatten
from quasiharmonic.apps.flattening.surface_descent import SurfaceDescent, descend
from quasiharmonic.energies.deformation import DeformationEnergy
from quasiharmonic.energies.energies import SymmetricDirichlet
from quasiharmonic.energies.newton.newton_system import NewtonSystem
from quasiharmonic.surfaces import grid


def nearly_coincident(seed):
    """A bent sheet with 80 vertices at 1e-9 from a neighbour."""
    rng = np.random.default_rng(seed)
    flat, F = grid(89, 119)
    column, row = np.round(flat * [89, 119]).T
    V = np.stack([40 * np.sin(row / 40), column, 40 * np.cos(row / 40)], axis=1)
    inner = np.flatnonzero((row > 1) & (row < 117) & (column > 1) & (column < 87))
    moved = rng.choice(inner, 60, replace=False)
    V[moved], V[moved[:20] + 90] = V[moved + 1], V[moved[:20] + 1]
    V[moved] += 1e-9 * rng.normal(size=(60, 3))
    V[moved[:20] + 90] += 1e-9 * rng.normal(size=(20, 3))
    return V, F


def test_nearly_coincident_vertices_take_few_steps():
    result = flatten(*nearly_coincident(2))
    # Without patches, 48 steps.
    assert result.success
    assert len(result.stages) == 2
    assert result.n_iterations <= 32
    assert result.history[-1].energy < 1e-5


def test_iterations_lead_to_the_same_minimum(factored):
    V, F = grid(110, 110)
    bump = np.column_stack([V, 0.3 * np.exp(-8 * ((V - 0.5) ** 2).sum(axis=1))])
    energy = DeformationEnergy(bump, F, SymmetricDirichlet())

    def lower(iterate):
        factored.clear()
        descent = SurfaceDescent(energy, V, "auto", iterate=iterate)
        statuses = list(descend(descent, SymmetricDirichlet(), 1e-6))
        return descent.distortion, statuses[-1], len(factored)

    exact, iterated = lower(False), lower(True)
    assert iterated[1] == exact[1]
    assert iterated[2] < exact[2]
    np.testing.assert_allclose(iterated[0], exact[0], rtol=1e-5)


@pytest.mark.parametrize(("steps", "enough"), [(3, False), (200, True)])
def test_conjugate_gradients(steps, enough):
    V, F = grid(8, 8)
    energy = DeformationEnergy(V, F, SymmetricDirichlet())
    system = NewtonSystem(F, energy.g, len(V), np.array([0, 5]))
    system.assemble(energy.curvature_of(energy.deform(V[:, 0] + 1j * V[:, 1])))
    load = np.random.default_rng(0).normal(size=(system.free.size, 2)) @ [1, 1j]
    system.factor()
    exact = system.solve(load)
    found, converged = system.iterate(load, system.solve_diagonal, steps, residual=1e-14)
    assert converged is enough
    assert np.allclose(found, exact, rtol=1e-5, atol=1e-6 * np.abs(exact).max()) is enough


def test_conjugate_gradients_end_where_little_is_left():
    V, F = grid(8, 8)
    energy = DeformationEnergy(V, F, SymmetricDirichlet())
    system = NewtonSystem(F, energy.g, len(V), np.array([0, 5]))
    system.assemble(energy.curvature_of(energy.deform(V[:, 0] + 1j * V[:, 1])))
    load = np.ones(system.free.size, dtype=np.complex128)
    left = float((load.real @ system.solve_diagonal(load).real) * 2)
    at_once, converged = system.iterate(load, system.solve_diagonal, 5, residual=0, negligible=2 * left)
    assert converged
    assert not at_once.any()
    _, converged = system.iterate(load, system.solve_diagonal, 5, residual=0, negligible=1e-3 * left)
    assert not converged
