"""Deformation energies: formulas, derivatives, projections, invariances."""

from __future__ import annotations

import numpy as np
import pytest

from quasiharmonic import Energy
from quasiharmonic.energies.derivatives import check_energy, derivative_error, random_deformation
from quasiharmonic.energies.energies import (
    ARAP,
    MIPS,
    AreaBarrier,
    AreaPreserving,
    Combination,
    Deformation,
    Hardened,
    SymmetricDirichlet,
    conformal_area_blend,
)
from quasiharmonic.energies.springs import MassSpring
from quasiharmonic.geometry.mesh.reference import rest_shapes
from quasiharmonic.geometry.mesh.topology import edges
from quasiharmonic.surfaces import random_delaunay
from shared.meshes import lift

ISOTROPIC = [
    MIPS(),
    SymmetricDirichlet(),
    ARAP(),
    AreaPreserving(),
    AreaBarrier(),
    conformal_area_blend(0.2),
    Combination((1.0, ARAP()), (0.1, AreaBarrier())),
    Hardened(SymmetricDirichlet(), 0.5),
    Hardened(SymmetricDirichlet(), 0.5, 0.8),
]
INVERTIBLE = [ARAP(), AreaPreserving()]


def name_of(energy):
    return type(energy).__name__


def inverted_deformation(f=100):
    d = random_deformation(f, seed=4)
    return Deformation.of(d.q, d.p)


def springs():
    V, F = random_delaunay(40, seed=1)
    V = lift(V)
    d = random_deformation(len(F), seed=2)
    return MassSpring(V, F), d, V, F


@pytest.mark.parametrize("energy", ISOTROPIC, ids=name_of)
def test_derivatives_agree_with_differences(energy):
    found = check_energy(energy)
    assert found.passed
    assert np.isfinite(found.curvature)


def test_a_function_that_is_nowhere_finite_has_no_derivative():
    assert derivative_error(lambda x: np.nan * x, lambda x, d: d, np.ones(2)) == np.inf


@pytest.mark.parametrize("energy", INVERTIBLE, ids=name_of)
def test_derivatives_of_inverted_triangles(energy):
    assert check_energy(energy, inverted_deformation()).passed


def test_derivatives_of_springs():
    energy, d, _, _ = springs()
    assert check_energy(energy, d).passed
    assert check_energy(energy, inverted_deformation(d.p.size)).passed


@pytest.mark.parametrize(
    ("energy", "formula"),
    [
        (MIPS(), lambda s, t: s / t + t / s - 2),
        (SymmetricDirichlet(), lambda s, t: s**2 + t**2 + s**-2 + t**-2 - 4),
        (ARAP(), lambda s, t: (s - 1) ** 2 + (t - 1) ** 2),
        (AreaPreserving(), lambda s, t: (s * t - 1) ** 2),
        (AreaBarrier(), lambda s, t: s * t + 1 / (s * t) - 2),
        (conformal_area_blend(0.25), lambda s, t: 0.75 * (s / t + t / s - 2) + 0.25 * (s * t + 1 / (s * t) - 2)),
    ],
    ids=lambda x: name_of(x) if isinstance(x, Energy) else "",
)
def test_density_in_singular_values(energy, formula):
    d = random_deformation(50)
    s, t = np.abs(d.p) + np.abs(d.q), np.abs(d.p) - np.abs(d.q)
    np.testing.assert_allclose(energy.density(d), formula(s, t), rtol=1e-10, atol=1e-12)


def test_spring_energy_is_a_sum_over_edges():
    energy, _, V, F = springs()
    shapes = rest_shapes(V, F)
    # The lengths of edges in an actual map, from its own Jacobians.
    w = (V[:, 0] + 0.3 * V[:, 1] ** 2) + 1j * (0.8 * V[:, 1] + 0.1 * V[:, 0])
    g = shapes.half_gradients() / shapes.unit
    p, q = np.sum(w[F.T] * g.conj(), axis=0), np.sum(w[F.T] * g, axis=0)
    total = np.sum(energy.density(Deformation.of(p, q)) * shapes.m * shapes.unit**2)
    found = edges(F, len(V))
    i, j = np.concatenate([found.interior, found.boundary]).T
    expected = np.sum((np.abs(w[i] - w[j]) - np.linalg.norm(V[i] - V[j], axis=1)) ** 2)
    assert total == pytest.approx(expected, rel=1e-12)


@pytest.mark.parametrize("energy", ISOTROPIC, ids=name_of)
@pytest.mark.parametrize("negative", [0.0, -1.0, 1.0])
def test_curvature_is_filtered_like_by_an_eigensolver(energy, negative):
    d = random_deformation(200, seed=7)
    eigenvalues, vectors = np.linalg.eigh(energy.curvature(d, negative=1.0).matrices())
    kept = np.where(eigenvalues < 0, negative * eigenvalues, eigenvalues)
    expected = np.einsum("fij,fj,fkj->fik", vectors, kept, vectors)
    found = energy.curvature(d, negative=negative).matrices()
    size = np.abs(expected).max(axis=(1, 2), keepdims=True)
    assert np.all(np.abs(found - expected) <= 1e-12 * size)


@pytest.mark.parametrize("energy", ISOTROPIC, ids=name_of)
def test_rotations_of_image_or_triangle_change_nothing(energy, rng):
    d = random_deformation(30)
    image, triangle = np.exp(1j * rng.uniform(0, 6, (2, 30)))
    turned = Deformation.of(d.p * image * triangle, d.q * image / triangle)
    np.testing.assert_allclose(energy.density(turned), energy.density(d), rtol=1e-10, atol=1e-12)


@pytest.mark.parametrize("energy", ISOTROPIC, ids=name_of)
def test_isometries_are_minima(energy, rng):
    turn = np.exp(1j * rng.uniform(0, 6, 20))
    d = Deformation.of(turn, np.zeros(20, dtype=complex))
    assert np.all(energy.density(d) < 1e-24)
    assert all(np.abs(part).max() < 1e-12 for part in energy.gradient(d))
    # If q is zero it has no direction, and none is needed.
    assert np.linalg.eigvalsh(energy.curvature(d, negative=1.0).matrices()).min() > -1e-12


def test_mips_does_not_depend_on_scale():
    d = random_deformation(30)
    scaled = Deformation.of(1e-7 * d.p, 1e-7 * d.q)
    np.testing.assert_allclose(MIPS().density(scaled), MIPS().density(d), rtol=1e-10)


@pytest.mark.parametrize("energy", ISOTROPIC, ids=name_of)
def test_properties_at_collapse_are_true(energy):
    inverted = energy.density(inverted_deformation(10))
    assert np.all(np.isposinf(inverted)) if energy.barrier else np.all(np.isfinite(inverted))
    thin = Deformation.of(np.full(1, 1 + 0j), np.full(1, 1 - 1e-9 + 0j))
    assert (energy.density(thin)[0] > 1e6) == energy.barrier


def test_arap_at_its_kink():
    d = Deformation.of(np.zeros(1, dtype=complex), np.full(1, 0.5 + 0j))
    assert ARAP().density(d)[0] == pytest.approx(2.5)
    assert all(np.isfinite(part).all() for part in ARAP().gradient(d))
    assert np.isfinite(ARAP().curvature(d).matrices()).all()


def test_spring_of_zero_length():
    energy, _, _, F = springs()
    nothing = Deformation.of(np.zeros(len(F), dtype=complex), np.zeros(len(F), dtype=complex))
    assert all(np.all(part == 0) for part in energy.gradient(nothing))
    assert np.isfinite(energy.curvature(nothing).matrices()).all()


def test_a_form_and_its_matrix_agree():
    d = random_deformation(10)
    form = MIPS().curvature(d, negative=1.0)
    along_p, along_q = form.apply(d.q, d.p)
    x = np.stack([d.q.real, d.q.imag, d.p.real, d.p.imag], axis=1)
    expected = np.einsum("fij,fj->fi", form.matrices(), x)
    np.testing.assert_allclose(np.stack([along_p.real, along_p.imag, along_q.real, along_q.imag], axis=1), expected)


def test_an_energy_with_first_derivatives_only():
    class Dirichlet(Energy):
        def density(self, d):
            return d.a + d.b

        def gradient(self, d):
            return 2 * d.p, 2 * d.q

    found = check_energy(Dirichlet())
    assert found.passed
    assert np.isnan(found.curvature)
    with pytest.raises(NotImplementedError, match="Dirichlet has no second derivatives"):
        Dirichlet().curvature(random_deformation(3))


def test_wrong_derivatives_are_detected():
    class Wrong(MIPS):
        def density_gradient(self, d):
            a, b = super().density_gradient(d)
            return a, 1.01 * b

    assert not check_energy(Wrong()).passed

    class Bent(MIPS):
        def density_hessian(self, d):
            aa, ab, bb = super().density_hessian(d)
            return aa, -ab, bb

    found = check_energy(Bent())
    assert found.gradient < 1e-6 < found.curvature
    assert not found.passed


def test_derivative_error_of_complex_variables(rng):
    w = rng.standard_normal(5) + 1j * rng.standard_normal(5)

    def along(w, d):
        return np.sum(np.conj(4 * np.abs(w) ** 2 * w) * d).real

    assert derivative_error(lambda w: np.sum(np.abs(w) ** 4), along, w) < 1e-8
    assert derivative_error(lambda w: np.sum(np.abs(w) ** 4), lambda w, d: 1.001 * along(w, d), w) > 1e-4


@pytest.mark.parametrize("theta", [-0.1, 1.5, np.nan])
def test_a_blend_is_one_energy(theta):
    with pytest.raises(ValueError, match="theta must be between 0 and 1"):
        conformal_area_blend(theta)


def test_springs_reject_flat_triangles():
    with pytest.raises(ValueError, match="triangle 0 of zero area"):
        MassSpring([[0, 0], [1, 0], [2, 0]], np.array([[0, 1, 2]]))


def test_a_function_that_is_never_a_number_has_a_wrong_derivative():
    assert derivative_error(lambda x: np.nan * x.sum(), lambda x, d: d.sum(), np.ones(3)) == np.inf


def test_a_hardened_energy_continues_by_its_tangent():
    """The continuation is linear in E and lies below E + k E³; both agree up to the value where it begins."""
    base, d = SymmetricDirichlet(), random_deformation(400, seed=2)
    e, k, limit = base.density(d), 0.5, 0.8
    hardened, continued = Hardened(base, k).density(d), Hardened(base, k, limit).density(d)
    beyond = e > limit
    assert 50 < np.count_nonzero(beyond) < 350
    np.testing.assert_array_equal(continued[~beyond], hardened[~beyond])
    assert (continued[beyond] < hardened[beyond]).all()
    slope = 1 + 3 * k * limit**2
    np.testing.assert_allclose(continued[beyond], limit + k * limit**3 + slope * (e[beyond] - limit), rtol=1e-12)


def test_second_derivatives_of_a_linear_continuation_are_finite_near_collapse():
    """The square of the slope overflows there, but has no share in them."""
    det = 10.0 ** -np.arange(40, 75, 5)
    d = Deformation(np.ones(det.size, dtype=complex), 1 - det + 0j, det)
    for part in Hardened(SymmetricDirichlet(), 2, 1.0).density_hessian(d):
        assert np.isfinite(part).all()
