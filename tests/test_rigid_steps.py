"""Almost isometric starts for rolled sheets, and Newton steps with a Laplacian's factor near an isometry."""

import numpy as np
import pytest

from quasiharmonic import boundary_loops, flatten
from quasiharmonic.apps.flattening.large_surfaces import find_almost_isometry
from quasiharmonic.apps.flattening.surface_descent import SurfaceDescent, descend
from quasiharmonic.energies.deformation import DeformationEnergy
from quasiharmonic.energies.energies import SymmetricDirichlet
from quasiharmonic.energies.measures import distortion
from quasiharmonic.energies.newton.line_search import RotationPath
from quasiharmonic.energies.newton.newton_system import NewtonSystem
from quasiharmonic.geometry.exact.certificate import is_injective
from quasiharmonic.surfaces import grid

FIXED = np.zeros(1, dtype=np.int64)


def rolled_sheet(m, seed=0, turns=1.0):
    """A rolled sheet of m² vertices, with uneven triangles and slivers."""
    rng = np.random.default_rng(seed)
    flat, F = grid(m, m)
    inner = np.flatnonzero(((flat > 0.5 / m) & (flat < 1 - 0.5 / m)).all(axis=1))
    flat[inner] += rng.uniform(-0.3, 0.3, (inner.size, 2)) / m
    thin = rng.choice(inner[inner % m < m - 2], m // 4, replace=False)
    flat[thin] = flat[thin + 1] - [1e-3 / m, 0]
    angle, height = 2 * turns * np.pi * flat[:, 0], 3 * turns * flat[:, 1]
    radius = 1 + 0.03 * angle
    return np.stack([radius * np.cos(angle), radius * np.sin(angle), height], axis=1), F


def find_almost(V, F):
    return find_almost_isometry(V, DeformationEnergy(V, F, SymmetricDirichlet()), boundary_loops(F, len(V)), "auto")


def energy_and_rotations(V, F):
    energy = DeformationEnergy(V, F, SymmetricDirichlet())
    return energy, RotationPath(F, energy.g, len(V), FIXED)


def test_turning_triangles_as_an_isometry_gives_the_isometry():
    V, F = grid(9, 7)
    w = np.exp(0.7j) * (V @ [1, 1j])
    energy, rotations = energy_and_rotations(V, F)
    p = energy.deform(w).p
    # The map before the step inverts triangles.
    start = w + np.random.default_rng(0).normal(size=(len(V), 2)) @ [1, 1j]
    turned = rotations.turn(start, energy.deform(start), p / np.abs(p))
    np.testing.assert_allclose(turned, w + start[0] - w[0], atol=1e-12)


def test_conjugate_gradients_near_an_isometry():
    V, F = rolled_sheet(80)
    found = find_almost(V, F)
    energy = DeformationEnergy(V, F, SymmetricDirichlet())
    d = energy.deform(found.uv @ [1, 1j])
    system = NewtonSystem(F, energy.g, len(V), FIXED)
    system.assemble(energy.curvature_of(d))
    load = -energy.gradient_of(d, len(V))[system.free]
    near = found.rotations.inverse_near(system.diagonal)
    direction, converged = system.iterate(load, near, 12, residual=1e-3)
    assert converged
    assert not system.iterate(load, system.solve_diagonal, 12, residual=1e-3)[1]
    system.factor()
    exact = system.solve(load)
    work = [(load.conj() * each).real.sum() for each in (direction, exact)]
    np.testing.assert_allclose(work[0], work[1], rtol=1e-2)


@pytest.mark.parametrize("seed", [0, 1])
def test_rigid_steps_flatten_a_rolled_sheet(seed):
    V, F = rolled_sheet(80, seed)
    found = find_almost(V, F)
    assert is_injective(F, found.uv)
    assert np.quantile(distortion(V, F, found.uv).isometric, 0.9) < 1.02


def test_the_last_inverted_triangles_are_relocated(monkeypatch):
    V, F = rolled_sheet(130, turns=4.0)
    module = "quasiharmonic.apps.flattening.large_surfaces"
    maps = []
    monkeypatch.setattr(f"{module}.is_injective", lambda F, uv: [maps.append(uv), is_injective(F, uv)][1])
    assert is_injective(F, find_almost(V, F).uv)
    relocated = len(maps)
    monkeypatch.setattr(f"{module}.relocate", lambda *_: None)
    find_almost(V, F)
    # Without relocation, fewer maps of the steps have no inverted triangle.
    assert relocated > len(maps) - relocated


def test_no_almost_isometry_of_a_dome():
    P, F = grid(40, 40)
    V = np.column_stack([P, 1.5 * np.exp(-8 * ((P - 0.5) ** 2).sum(axis=1))])
    assert find_almost(V, F) is None


def test_large_sheets_need_no_factor_of_the_newton_system(factored):
    V, F = rolled_sheet(130, turns=2.0)
    result = flatten(V, F)
    assert result.success
    assert max(factored) < 0.5 * len(V)
    assert np.quantile(distortion(V, F, result.uv).isometric, 0.95) < 1.01


def test_descents_far_from_an_isometry_factor(factored):
    V, F = grid(40, 40)
    bump = np.column_stack([V, 2 * np.exp(-8 * ((V - 0.5) ** 2).sum(axis=1))])
    energy, rotations = energy_and_rotations(bump, F)
    start = V * [1, 5]

    def lower(rotations):
        factored.clear()
        descent = SurfaceDescent(energy, start, "auto", rotations=rotations)
        statuses = list(descend(descent, SymmetricDirichlet(), 1e-6))
        return descent.distortion, statuses[-1], len(factored)

    exact, iterated = lower(None), lower(rotations)
    assert iterated[1] == exact[1]
    assert iterated[2] > 0
    np.testing.assert_allclose(iterated[0], exact[0], rtol=1e-5)


def test_flat_surfaces_that_overlap_are_mapped_without_overlaps(monkeypatch):
    monkeypatch.setattr("quasiharmonic.apps.flattening.flattening_run.ALMOST_FROM", 1000)
    flat, F = grid(20, 60)
    # A ring sector of 1.1 turns, wound around a cylinder.
    angle, radius = 2.2 * np.pi * flat[:, 1], 1 + 0.4 * flat[:, 0]
    plane = np.stack([radius * np.cos(angle), radius * np.sin(angle)], axis=1)
    V = np.stack([plane[:, 0], plane[:, 1], 0.5 * flat[:, 1]], axis=1)
    result = flatten(V, F)
    assert result.success
    assert result.certificate.bijective
