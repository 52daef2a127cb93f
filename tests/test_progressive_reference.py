"""Intermediate references between rest and a distant map, and the Newton steps that they save."""

from __future__ import annotations

import numpy as np
import pytest

from quasiharmonic import Status, is_injective, polish
from quasiharmonic.energies.deformation import DeformationEnergy
from quasiharmonic.energies.energies import MIPS, SymmetricDirichlet
from quasiharmonic.energies.newton import distant_starts as approach
from quasiharmonic.energies.newton.distant_starts import REACH, ReweightedDirichlet, reference_energy
from quasiharmonic.energies.newton.map_model import in_units
from quasiharmonic.energies.newton.newton_descent import NewtonDescent
from quasiharmonic.surfaces import disk

RINGS = 12


def shrunken(power):
    """A disk contracted at its centre, whose innermost triangles have RINGS^(2 - 2 power) of their area."""
    V, F = disk(RINGS)
    fixed = np.arange(len(V) - 6 * RINGS, len(V))
    turn = np.exp(2j * (1 - V[:, 0] ** 2 - V[:, 1] ** 2))
    z = (V[:, 0] + 1j * V[:, 1]) * np.linalg.norm(V, axis=1) ** (power - 1) * turn
    uv = np.stack([z.real, z.imag], axis=1)
    uv[fixed] = V[fixed]
    return V, F, uv, fixed


def matrices(d):
    """Jacobians (f, 2, 2) of z ↦ p z + q z̄."""
    return np.moveaxis(
        np.array([[(d.p + d.q).real, (d.q - d.p).imag], [(d.p + d.q).imag, (d.p - d.q).real]]), (0, 1), (1, 2)
    )


def afar(power=6):
    """An energy at a map far from rest, the map, and the energy relative to intermediate references."""
    V, F, uv, _ = shrunken(power)
    energy, w = DeformationEnergy(V, F, SymmetricDirichlet()), in_units(uv, 0)
    towards = reference_energy(energy, energy.deform(w))
    assert towards is not None
    return energy, w, towards


def test_singular_values_relative_to_references_are_powers():
    energy, w, towards = afar()
    before, after = matrices(energy.deform(w)), matrices(towards.deform(w))
    _, sigma, vt = np.linalg.svd(before)
    # An independent formula: build references from singular vectors and divide them out of the Jacobian.
    farthest = np.abs(np.log(sigma)).max()
    t = np.log(REACH) / farthest
    references = np.swapaxes(vt, 1, 2) @ (sigma[:, :, None] ** (1 - t) * vt)
    np.testing.assert_allclose(after, before @ np.linalg.inv(references), rtol=1e-9, atol=1e-12)
    reached = np.linalg.svd(after, compute_uv=False)
    np.testing.assert_allclose(reached, sigma**t, rtol=1e-9)
    assert np.abs(np.log(reached)).max() == pytest.approx(np.log(REACH))
    np.testing.assert_allclose(towards.deform(w).det, np.linalg.det(after), rtol=1e-9)


def test_gradient_agrees_with_differences_of_values():
    _, w, towards = afar(4)
    rng = np.random.default_rng(0)
    gradient = towards.gradient(w)
    for vertex in rng.integers(len(w), size=6):
        for way in (1, 1j):
            step = np.zeros_like(w)
            step[vertex] = way * 1e-6 * np.abs(w[vertex] - np.delete(w, vertex)).min()
            slope = (towards.value(w + step) - towards.value(w - step)) / 2
            assert slope == pytest.approx(float((gradient.conj() * step).real.sum()), rel=1e-4, abs=1e-9)


def test_no_reference_if_rest_is_close():
    V, F, uv, _ = shrunken(1.5)
    energy = DeformationEnergy(V, F, SymmetricDirichlet())
    assert reference_energy(energy, energy.deform(in_units(uv, 0))) is None


@pytest.mark.slow
def test_it_takes_a_fraction_of_newtons_steps(monkeypatch):
    V, F, uv, fixed = shrunken(8)
    seen = []
    result = polish(V, F, uv, fixed=fixed, callback=seen.append)
    monkeypatch.setattr(approach, "reference_energy", lambda energy, at: None)
    straight = polish(V, F, uv, fixed=fixed)
    assert result.status is straight.status is Status.POLISHED
    assert len(result.history) < 0.6 * len(straight.history)
    assert result.history[-1].energy == pytest.approx(straight.history[-1].energy, rel=0.01)
    assert np.all(np.diff([step.energy for step in seen]) <= 0)
    np.testing.assert_array_equal(result.uv[fixed], uv[fixed])


def test_every_intermediate_map_is_injective(monkeypatch):
    V, F, uv, fixed = shrunken(8)
    maps = []
    restart = NewtonDescent.restart

    def noted(self, model, state):
        maps.append(model.positions(state.w))
        restart(self, model, state)

    monkeypatch.setattr(NewtonDescent, "restart", noted)
    polish(V, F, uv, fixed=fixed)
    assert len(maps) > 4
    assert all(is_injective(F, here) for here in maps)


def test_max_iterations_counts_steps_of_either_kind():
    V, F, uv, fixed = shrunken(8)
    for most in (0, 1, 2, 9):
        assert len(polish(V, F, uv, fixed=fixed, max_iterations=most).history) == most + 1


def test_other_energies_do_not_use_references(monkeypatch):
    V, F, uv, fixed = shrunken(8)
    monkeypatch.setattr(approach, "reference_energy", None)
    assert polish(V, F, uv, fixed=fixed, energy=MIPS()).injective


@pytest.mark.parametrize("worse", [False, True])
def test_an_interrupted_or_failed_step_leaves_the_map_unchanged(monkeypatch, worse):
    V, F, uv, fixed = shrunken(8)

    def step(self, tolerance):
        assert isinstance(self.model.energy.energy, ReweightedDirichlet)
        self.state = self.state._replace(w=self.w * 0.999 if worse else self.w.copy())
        raise KeyboardInterrupt

    monkeypatch.setattr(NewtonDescent, "step", step)
    result = polish(V, F, uv, fixed=fixed)
    start = polish(V, F, uv, fixed=fixed, max_iterations=0)
    assert result.status is Status.INTERRUPTED
    np.testing.assert_array_equal(result.uv, uv)
    assert result.stages[0].energy == start.stages[0].energy
