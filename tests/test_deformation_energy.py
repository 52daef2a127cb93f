"""Energies on a mesh and their second derivatives in vertex positions."""

from __future__ import annotations

import numpy as np
import pytest

from quasiharmonic import Energy, distortion
from quasiharmonic.energies.deformation import DeformationEnergy, signed_areas
from quasiharmonic.energies.derivatives import derivative_error
from quasiharmonic.energies.energies import (
    ARAP,
    MIPS,
    AreaPreserving,
    Combination,
    Hardened,
    Isotropic,
    QuadraticForm,
    SymmetricDirichlet,
    UnsignedARAP,
    conformal_area_blend,
)
from quasiharmonic.energies.newton.newton_system import NewtonSystem
from quasiharmonic.energies.polishing import ENERGIES
from quasiharmonic.energies.springs import MassSpring
from quasiharmonic.linsolve import NotPositiveDefinite
from quasiharmonic.surfaces import grid, random_delaunay
from shared.meshes import bend, boundary_of, lift, surfaces


def name_of(energy):
    return type(energy).__name__


def as_complex(uv):
    return uv[:, 0] + 1j * uv[:, 1]


def bowl(n=60):
    V, F = random_delaunay(n, seed=5)
    return lift(V), F, as_complex(bend(V))


@pytest.mark.parametrize(
    "energy", [MIPS(), SymmetricDirichlet(), ARAP(), UnsignedARAP(), AreaPreserving()], ids=lambda e: type(e).__name__
)
def test_gradient_by_positions(energy):
    V, F, w = bowl()
    E = DeformationEnergy(V, F, energy, area=3.0)
    assert derivative_error(E.value, lambda w, d: np.sum(np.conj(E.gradient(w)) * d).real, w) < 1e-6


def test_gradient_of_springs():
    V, F, w = bowl()
    E = DeformationEnergy(V, F, MassSpring(V, F))
    assert derivative_error(E.value, lambda w, d: np.sum(np.conj(E.gradient(w)) * d).real, w) < 1e-6


@pytest.mark.parametrize(("name", "V", "F"), surfaces())
def test_the_mean_equals_that_of_the_measures(name, V, F):
    uv = bend(V[:, :2])
    found = distortion(V, F, uv)
    w = as_complex(uv)
    area = float(signed_areas(F, w).sum())
    for energy, measure in ((MIPS(), "mips"), (SymmetricDirichlet(), "symmetric_dirichlet"), (ARAP(), "arap")):
        assert DeformationEnergy(V, F, energy, area=area).value(w) == pytest.approx(
            found.statistics(measure).mean, rel=1e-12
        )


class Restated(Isotropic):
    """The same energy, defined by its methods alone, so that its terms are not known."""

    barrier = True

    def __init__(self, energy):
        self.energy = energy

    def density(self, d):
        return self.energy.density(d)

    def density_gradient(self, d):
        return self.energy.density_gradient(d)

    def density_hessian(self, d):
        return self.energy.density_hessian(d)


BLEND = Combination((2.0, conformal_area_blend()), (0.5, MIPS()))


@pytest.mark.parametrize(
    "energy",
    [
        *ENERGIES.values(),
        BLEND,
        Hardened(BLEND, 0.3),
        Hardened(BLEND, 0.3, 0.5),
        Combination((0.0, Hardened(MIPS(), 0)), (1.0, ARAP())),
        Combination((1.0, Hardened(MIPS(), 2.0)), (1.0, ARAP())),
    ],
)
def test_the_package_s_energies_agree_with_their_methods(energy, rng):
    V, F, w = bowl(300)
    weights = rng.uniform(0, 2, len(F))
    one, other = (DeformationEnergy(V, F, each, area=2.0, weights=weights) for each in (energy, Restated(energy)))
    d = one.deform(w)
    assert one.value_of(d) == pytest.approx(other.value_of(d), rel=1e-13)
    np.testing.assert_allclose(one.gradient_of(d, len(V)), other.gradient_of(d, len(V)), rtol=1e-9, atol=1e-12)
    for negative in (-1.0, 0.0, 1.0):
        forms = (each.curvature_of(d, negative=negative).matrices() for each in (one, other))
        np.testing.assert_allclose(*forms, rtol=1e-10, atol=1e-12)


def test_a_subclass_that_overrides_a_part_of_an_energy_is_used():
    """Unchanged methods are those of the base class, and changed ones those of the subclass."""

    class Doubled(SymmetricDirichlet):
        def density(self, d):
            return 2 * super().density(d)

    class Bent(SymmetricDirichlet):
        def density_hessian(self, d):
            return tuple(3 * bend for bend in super().density_hessian(d))

    V, F, w = bowl()
    plain, doubled, bent, both = (
        DeformationEnergy(V, F, each)
        for each in (SymmetricDirichlet(), Doubled(), Bent(), Combination((1, Doubled()), (1, MIPS())))
    )
    d = plain.deform(w)
    assert doubled.value_of(d) == pytest.approx(2 * plain.value_of(d))
    assert bent.value_of(d) == plain.value_of(d)
    assert both.value_of(d) == pytest.approx(2 * plain.value_of(d) + DeformationEnergy(V, F, MIPS()).value_of(d))
    np.testing.assert_array_equal(doubled.gradient_of(d, len(V)), plain.gradient_of(d, len(V)))
    assert (bent.curvature_of(d, negative=1.0).pp > 1.1 * plain.curvature_of(d, negative=1.0).pp).mean() > 0.5


def test_a_constant_derivative():
    class Stretch(Energy):
        def density(self, d):
            return d.a + d.q.real

        def gradient(self, d):
            return 2 * d.p, 1.0

    V, F, w = bowl()
    E = DeformationEnergy(V, F, Stretch())
    assert derivative_error(E.value, lambda w, d: np.sum(np.conj(E.gradient(w)) * d).real, w) < 1e-6


def test_scale_does_not_matter_with_normalisation():
    V, F, w = bowl()
    area = float(signed_areas(F, w).sum())
    values = [
        DeformationEnergy(a * V, F, SymmetricDirichlet(), area=b**2 * area).value(b * w)
        for a, b in ((1, 1), (1e5, 1), (1, 1e-6), (1e150, 1e-120), (1e-170, 1e140))
    ]
    assert values == pytest.approx([values[0]] * 5, rel=1e-12)


def test_without_an_area_the_energy_is_not_normalised():
    V, F = grid(3, 3)
    w = as_complex(V)
    E = DeformationEnergy(100 * V, F, AreaPreserving())
    assert E.value(100 * w) == pytest.approx(0, abs=1e-20)
    assert E.value(200 * w) == pytest.approx(9)


def test_weights(rng):
    V, F, w = bowl()
    weights = rng.random(len(F))
    E = DeformationEnergy(V, F, MIPS(), weights=weights)
    found = distortion(V, F, np.stack([w.real, w.imag], axis=1))
    assert E.value(w) == pytest.approx(np.sum(weights * found.share * found.mips))
    assert derivative_error(E.value, lambda w, d: np.sum(np.conj(E.gradient(w)) * d).real, w) < 1e-6


def test_a_clockwise_planar_mesh_is_a_surface_seen_from_behind():
    V, F = grid(4, 4)
    mirrored = V * [-1, 1]
    assert DeformationEnergy(mirrored, F, ARAP()).value(as_complex(V)) == pytest.approx(0, abs=1e-20)


def test_unsigned_arap_agrees_with_singular_values(rng):
    """§11.1.1 by NumPy's singular values. For inverted triangles `ARAP` is larger; otherwise both are equal."""
    V, F = random_delaunay(60, seed=5)
    w = as_complex(V) + 0.15 * (rng.standard_normal((len(V), 2)) @ (1, 1j))
    uv = np.stack([w.real, w.imag], axis=1)
    rest, image = ((x[F[:, 1:]] - x[F[:, :1]]).transpose(0, 2, 1) for x in (V, uv))
    J = image @ np.linalg.inv(rest)
    s = np.linalg.svd(J, compute_uv=False)
    inverted = np.linalg.det(J) < 0
    assert 10 < inverted.sum() < len(F) - 10
    share = np.linalg.det(rest) / np.linalg.det(rest).sum()
    mean = np.sum(share * ((s - 1) ** 2).sum(axis=1))
    assert DeformationEnergy(V, F, UnsignedARAP()).value(w) == pytest.approx(mean, rel=1e-12)
    s[inverted, 1] *= -1
    assert DeformationEnergy(V, F, ARAP()).value(w) == pytest.approx(np.sum(share * ((s - 1) ** 2).sum(axis=1)))
    E = DeformationEnergy(V, F, UnsignedARAP())
    assert derivative_error(E.value, lambda w, d: np.sum(np.conj(E.gradient(w)) * d).real, w) < 1e-6
    assert E.value(np.conj(as_complex(V))) == pytest.approx(0, abs=1e-20)


def test_inverted_triangles():
    V, F, w = bowl()
    mirrored = np.conj(w)
    assert DeformationEnergy(V, F, MIPS()).value(mirrored) == np.inf
    assert np.isfinite(DeformationEnergy(V, F, ARAP()).value(mirrored))


def test_malformed_input():
    V, F = grid(2, 2)
    flat = V.copy()
    flat[:, 1] = 0
    with pytest.raises(ValueError, match=r"triangles 0, 1, 2, 3, 4, … \(8 in all\) of zero area in the rest mesh"):
        DeformationEnergy(flat, F, MIPS())
    for area in (0.0, -1.0, np.nan, np.inf):
        with pytest.raises(ValueError, match="area of the map must be positive"):
            DeformationEnergy(V, F, MIPS(), area=area)
    with pytest.raises(ValueError, match=r"weights must have shape \(8,\)"):
        DeformationEnergy(V, F, MIPS(), weights=np.ones(3))
    with pytest.raises(ValueError, match="negative or not finite at triangle 2"):
        DeformationEnergy(V, F, MIPS(), weights=[1, 1, -1, 1, 1, 1, 1, 1])
    with pytest.raises(ValueError, match="V must have shape"):
        DeformationEnergy(V[:, :1], F, MIPS())


def test_steps_to_collapse_are_the_first_zeros_of_the_areas(rng):
    V, F, w = bowl(200)
    E = DeformationEnergy(V, F, MIPS())
    # Steps have very different sizes, so that all branches of the formula occur.
    step = (rng.standard_normal(w.size) + 1j * rng.standard_normal(w.size)) * 10.0 ** rng.integers(-9, 2, w.size)
    found = E.steps_to_collapse(w, step)
    for t, face in zip(found, F, strict=True):
        (a, b, c), (da, db, dc) = w[face], step[face]
        d, e, dd, de = b - a, c - a, db - da, dc - da
        cross = lambda x, y: (np.conj(x) * y).imag  # noqa: E731
        roots = np.roots([cross(dd, de), cross(d, de) + cross(dd, e), cross(d, e)])
        ahead = [r.real for r in roots if abs(r.imag) < 1e-12 * abs(r) and r.real > 0]
        assert t == pytest.approx(min(ahead, default=np.inf), rel=1e-6)
    assert np.isinf(found).any()
    assert np.isfinite(found).any()


def test_collapse_of_shapes_that_grow_or_do_not_change():
    V, F = grid(2, 2)
    w = as_complex(V)
    E = DeformationEnergy(V, F, MIPS())
    assert np.all(np.isinf(E.steps_to_collapse(w, np.zeros_like(w))))
    assert np.all(np.isinf(E.steps_to_collapse(w, w)))
    np.testing.assert_allclose(E.steps_to_collapse(w, -w), 1, rtol=1e-7)


@pytest.mark.parametrize("energy", [MIPS(), SymmetricDirichlet(), ARAP(), UnsignedARAP()], ids=name_of)
def test_the_system_matrix_is_the_second_derivative(energy):
    V, F, w = bowl()
    fixed = boundary_of(F)
    E = DeformationEnergy(V, F, energy, area=2.0)
    system = NewtonSystem(F, E.g, len(V), fixed)
    assert set(system.free) == set(range(len(V))) - set(fixed)
    system.assemble(E.curvature_of(E.deform(w), negative=1.0))
    H = system.matrix().toarray()
    np.testing.assert_array_equal(H, H.T)

    def gradient(x):
        moved = w.copy()
        moved[system.free] += x.view(np.complex128)
        return E.gradient(moved)[system.free].view(np.float64)

    # Differences are relative to the size of the mesh, since the displacement is zero.
    h = 1e-6
    differences = np.array([(gradient(h * e) - gradient(-h * e)) / (2 * h) for e in np.eye(2 * system.free.size)])
    assert np.abs(differences - H).max() < 1e-6 * np.abs(H).max()


def test_projected_systems_are_semidefinite_and_solved():
    V, F, w = bowl()
    E = DeformationEnergy(V, F, MIPS(), area=2.0)
    system = NewtonSystem(F, E.g, len(V), boundary_of(F))
    for negative in (0.0, -1.0):
        system.assemble(E.curvature_of(E.deform(w), negative=negative))
        H = system.matrix().toarray()
        assert np.linalg.eigvalsh(H).min() > 0
        load = E.gradient(w)[system.free]
        for shift in (0.0, 1e-3):
            system.factor(shift)
            raised = H + shift * np.diag(np.diag(H))
            np.testing.assert_allclose(raised @ system.solve(load).view(np.float64), load.view(np.float64), atol=1e-12)
        np.testing.assert_allclose(system.solve_diagonal(load).view(np.float64), load.view(np.float64) / np.diag(H))


def test_indefinite_and_empty_systems():
    V, F, w = bowl()
    E = DeformationEnergy(V, F, MIPS())
    system = NewtonSystem(F, E.g, len(V), boundary_of(F))
    form = E.curvature_of(E.deform(w)).scaled(np.full(len(F), -1.0))
    system.assemble(form)
    # Vertices whose diagonal entry is not positive count as vertices without curvature.
    with pytest.raises(NotPositiveDefinite):
        system.factor()
    nothing = np.zeros(len(F))
    none = np.zeros(len(F), dtype=complex)
    system.assemble(QuadraticForm(nothing, nothing, none, none, none, none))
    system.factor()
    load = E.gradient(w)[system.free]
    np.testing.assert_array_equal(system.solve(load), load)
    np.testing.assert_array_equal(system.solve_diagonal(load), load)

    rigid = NewtonSystem(F, E.g, len(V), np.arange(len(V)))
    rigid.assemble(form)
    rigid.factor()
    assert rigid.solve(load[:0]).size == 0
