"""ξ → μ → 𝒜 against eq. 33, and its derivatives against differences."""

from __future__ import annotations

from fractions import Fraction

import numpy as np
import pytest

from quasiharmonic.solver.field.tensor import (
    PARAMETERISATIONS,
    SI_LOG,
    TANH,
    beltrami_coefficients,
    own_tensor,
    parameterisation_of,
)

BOTH = list(PARAMETERISATIONS.values())


def paper_tensor(mu):
    """Eq. 33, by matrices."""
    one = 1 - np.abs(mu) ** 2
    return np.array([np.abs(1 - mu) ** 2, -2 * mu.imag, np.abs(1 + mu) ** 2]) / one


@pytest.mark.parametrize("parameterisation", BOTH, ids=lambda p: p.name)
class TestField:
    def test_is_eq_33_of_the_sigmoid(self, parameterisation, rng):
        xi = rng.standard_normal(50) + 1j * rng.standard_normal(50)
        rho = np.abs(xi)
        r = np.tanh(rho) if parameterisation is TANH else 1 - 1 / (1 + np.log(1 + rho))
        field = parameterisation.field(xi)
        np.testing.assert_allclose(field.mu, r * xi / rho, rtol=1e-14)
        np.testing.assert_allclose(field.entries(), paper_tensor(field.mu), rtol=1e-11)

    def test_has_unit_determinant_and_is_positive(self, parameterisation, rng):
        xi = 2 * (rng.standard_normal(500) + 1j * rng.standard_normal(500))
        a11, a12, a22 = parameterisation.field(xi).entries()
        scale = (a11 + a22) ** 2
        assert np.all(np.abs(a11 * a22 - a12**2 - 1) <= 1e-14 * scale)
        assert np.all(a11 > 0)
        assert np.all(a22 > 0)

    def test_is_the_identity_at_zero(self, parameterisation):
        field = parameterisation.field(np.zeros(3, dtype=complex))
        np.testing.assert_array_equal(field.entries(), [[1] * 3, [0] * 3, [1] * 3])
        assert np.all(np.isfinite(field.pull(np.ones(3, dtype=complex))))

    def test_stays_positive_definite_up_to_its_bound(self, parameterisation, rng):
        xi = parameterisation.bound * np.exp(2j * np.pi * rng.random(2000))
        for a11, a12, a22 in parameterisation.field(xi).entries().T:
            assert Fraction(a11) * Fraction(a22) > Fraction(a12) ** 2
            assert a11 > 0

    @pytest.mark.parametrize("scale", [1.0, 1e-9, 0.0])
    def test_pull_is_the_transpose_of_the_differential(self, parameterisation, rng, scale):
        xi = scale * (rng.standard_normal(40) + 1j * rng.standard_normal(40))
        weights = rng.standard_normal(40) + 1j * rng.standard_normal(40)
        gradient = parameterisation.field(xi).pull(weights)
        h = 1e-6
        for direction in (1, 1j):
            ahead, behind = parameterisation.field(xi + h * direction).mu, parameterisation.field(xi - h * direction).mu
            slope = (np.conj(weights) * (ahead - behind)).real / (2 * h)
            found = (np.conj(gradient) * direction).real
            # si-log is C¹ only at 0: a central difference is off by O(h) there.
            np.testing.assert_allclose(found, slope, rtol=1e-6, atol=1e-5 if scale < 1 else 1e-8)

    def test_pull_twist_is_the_transpose_of_the_tensor(self, parameterisation, rng):
        xi = rng.standard_normal(40) + 1j * rng.standard_normal(40)
        by_c, by_w = rng.standard_normal(40), rng.standard_normal(40) + 1j * rng.standard_normal(40)

        def value(mu):
            a11, a12, a22 = paper_tensor(mu)
            c, w = (a11 + a22) / 2, (a22 - a11) / 2 - 1j * a12
            return by_c * c + (np.conj(by_w) * w).real

        field = parameterisation.field(xi)
        gradient = field.pull_twist(by_c, by_w)
        h = 1e-7
        for direction in (1, 1j):
            slope = (value(field.mu + h * direction) - value(field.mu - h * direction)) / (2 * h)
            np.testing.assert_allclose((np.conj(gradient) * direction).real, slope, rtol=1e-4, atol=1e-5)


def test_rotating_xi_rotates_the_gradient_field(rng):
    """All directions are equal: a frame rotated by φ rotates ξ by 2φ and leaves the tensor unchanged."""
    xi = rng.standard_normal(30) + 1j * rng.standard_normal(30)
    for parameterisation in BOTH:
        turned = parameterisation.field(xi * np.exp(0.8j))
        np.testing.assert_allclose(turned.mu, parameterisation.field(xi).mu * np.exp(0.8j), rtol=1e-13)
        np.testing.assert_allclose(turned.defect, parameterisation.field(xi).defect, rtol=1e-12)


def test_determinant_defect_keeps_its_digits_where_mu_rounds_to_one():
    field = TANH.field(np.array([9.0 + 0j]))
    assert field.defect[0] == pytest.approx(1 / np.cosh(9.0) ** 2, rel=1e-13)
    assert SI_LOG.field(np.array([1e90 + 0j])).defect[0] > 0
    assert TANH.field(np.array([1e3 + 0j])).defect[0] == 0


def test_an_almost_zero_derivative_causes_no_division_by_zero():
    p, q = np.array([[5e-324, 1e-310j, 1e-300, 2.0, 0], [5e-324, 1e-309, 5e-301, 1j, 0]], dtype=complex)
    np.testing.assert_allclose(own_tensor(p, q), [0, 0, 0.5, 0.5j, 0])
    # The smallest normal number is large enough.
    assert own_tensor(np.array([2.0**-1022 + 0j]), np.array([2.0**-1023 + 0j])) == [0.5]


def test_a_part_of_a_field():
    xi = np.arange(6) + 1j
    for parameterisation in BOTH:
        field = parameterisation.field(xi)
        np.testing.assert_array_equal(field[2:5].mu, field.mu[2:5])
        assert parameterisation_of(parameterisation.number) is parameterisation


def test_beltrami_coefficients_are_converted():
    for given, expected in ((None, [0, 0]), ([0, 0.5], [0, 0.5]), (np.array([0.3j, -0.9]), [0.3j, -0.9])):
        found = beltrami_coefficients(given, 2)
        assert found.dtype == np.complex128
        assert found.tolist() == expected


@pytest.mark.parametrize(
    ("mu", "words"),
    [
        ([0.5], "mu must contain 2 numbers, one for each triangle, not an array of \\(1,\\)"),
        ([[0.5, 0]], "mu must contain 2 numbers"),
        (["a", "b"], "mu must contain 2 numbers"),
        ([True, False], "mu must contain 2 numbers"),
        ([0.5, 1j], "mu is not below 1 in modulus at triangle 1$"),
        ([np.nan, -1], "mu is not below 1 in modulus at triangles 0, 1$"),
    ],
)
def test_wrong_beltrami_coefficients_are_named(mu, words):
    with pytest.raises(ValueError, match=words):
        beltrami_coefficients(mu, 2)
