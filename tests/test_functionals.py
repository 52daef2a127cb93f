"""V₁ … V₄ against the paper's matrices, differences and theorems."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.optimize import brentq

from quasiharmonic import Problem, certify, solve
from quasiharmonic.geometry.mesh.reference import operators
from quasiharmonic.geometry.mesh.topology import boundary_loops
from quasiharmonic.solver.field.functionals import beltrami_gradient, neumann_target
from quasiharmonic.solver.field.objective import Objective
from quasiharmonic.solver.field.tensor import TANH
from quasiharmonic.solver.methods import LBFGS, Newton
from quasiharmonic.surfaces import disk, random_delaunay
from shared.functionals import MESHES, NAMES, SIGHTED, matrices, posed
from shared.meshes import bend, random_xi, signed_areas

IDS = [name for name, _, _ in MESHES]


# V₁ … V₄ by the paper's dense matrices, from the map w, its residual, L, its pseudo-inverse, D and the Neumann data g.
PAPER = {
    "neumann": lambda w, residual, L, pinv, D, g: np.vdot(residual, residual).real / 2,
    "sobolev": lambda w, residual, L, pinv, D, g: (residual.conj() @ pinv @ residual).real / 2,
    "dirichlet": lambda w, residual, L, pinv, D, g: (w.conj() @ L @ w).real / 2 - w.real @ D @ w.imag,
    "poisson": lambda w, residual, L, pinv, D, g: (g.conj() @ pinv @ g).real / 2 - w.real @ D @ w.imag,
}


def inverse_field(mesh, w):
    """Return the μ of eq. 39 for an injective map: 𝒜 = det J (JᵀJ)⁻¹ is the tensor whose μ is q/p."""
    p, q, _ = mesh.derivatives(w)
    return q / p


@pytest.mark.parametrize(("name", "V", "F"), MESHES, ids=IDS)
class TestValues:
    def test_agree_with_the_papers_formulas(self, name, V, F):
        problem, xi = posed(V, F, noise=0.05), random_xi(F)
        L, D, pinv = matrices(problem, Objective(problem).evaluate(xi))
        for functional, formula in PAPER.items():
            iterate = Objective(problem, functional).evaluate(xi)
            w = iterate.w
            g = -1j * (D @ w)
            np.testing.assert_allclose(neumann_target(problem, w), g, atol=1e-14)
            residual = L @ w - g
            on_boundary = np.zeros(len(V), dtype=complex)
            on_boundary[problem.fixed] = residual[problem.fixed]
            assert iterate.value == pytest.approx(formula(w, residual, L, pinv, D, g), rel=1e-8)
            if functional != "poisson":
                assert iterate.value > 0

    def test_v2_is_v3_plus_v4(self, name, V, F):
        problem = posed(V, F, noise=0.05)
        xi = random_xi(F)
        v2, v3, v4 = (Objective(problem, n).evaluate(xi) for n in ("sobolev", "dirichlet", "poisson"))
        assert v2.value == pytest.approx(v3.value + v4.value, rel=1e-10)
        np.testing.assert_allclose(v2.gradient, v3.gradient + v4.gradient, rtol=1e-8, atol=1e-10)
        assert v4.value >= -v3.value

    def test_dirichlet_to_neumann_and_back(self, name, V, F):
        """Eq. 13, 14, 28: the flux of the map is S(A) b.

        S(A)† is RᵀL†R on data without constants, and V₃ is its weak form.
        """
        problem = posed(V, F, noise=0.05)
        at = Objective(problem).evaluate(random_xi(F))
        L, D, pinv = matrices(problem, at)
        op = operators(V, F, "equilateral")
        R, S = op.R.toarray(), op.S.toarray()
        dtn = R.T @ L @ R - R.T @ L @ S @ np.linalg.solve(S.T @ L @ S, S.T @ L @ R)
        b = R.T @ at.w
        np.testing.assert_allclose(R.T @ at.operator.flux(at.w), dtn @ b, atol=1e-10)
        area = at.w.real @ D @ at.w.imag
        assert at.value == pytest.approx((b.conj() @ dtn @ b).real / 2 - area, rel=1e-10)
        # The pseudo-inverses differ by constants only.
        k = len(b)
        no_constant = np.eye(k) - np.full((k, k), 1 / k)
        ntd = R.T @ pinv @ R
        np.testing.assert_allclose(
            no_constant @ ntd @ no_constant, np.linalg.pinv(dtn, hermitian=True), atol=1e-9 * np.abs(ntd).max()
        )
        g = R.T @ neumann_target(problem, at.w)
        v4 = Objective(problem, "poisson").evaluate(at.xi).value
        assert v4 == pytest.approx((g.conj() @ np.linalg.pinv(dtn, hermitian=True) @ g).real / 2 - area, rel=1e-8)

    def test_sandwich_at_determinants_above_one(self, name, V, F):
        """Proposition C.3, eq. 42, for tensors of determinants 1 to 4; below 1 it need not hold."""
        problem = posed(V, F, noise=0.2)
        op = operators(V, F, "equilateral")
        rng = np.random.default_rng(2)
        w = problem.frame.inward(bend(V[:, :2]) + 0.1 * rng.standard_normal((len(V), 2)))
        areas = problem.domain.mesh("equilateral").derivatives(w).area
        signed, unsigned = areas.sum(), np.abs(areas).sum()
        assert unsigned > signed

        def energy(a):
            return (w.conj() @ op.laplacian(a.T) @ w).real / 2

        scale = 1 + rng.random(len(F))
        unit = TANH.field(random_xi(F, 0.3)).entries()
        for a in (unit, scale * unit):
            assert np.linalg.det(np.array([[a[0], a[1]], [a[1], a[2]]]).T).min() > 1 - 1e-9
            assert energy(a) >= unsigned >= signed
        assert energy(scale * unit) > energy(unit)
        # The smallest tensors for this map, for which the bound is tight: those of the map with mirrored inverted
        # triangles.
        p, q, _ = problem.domain.mesh("equilateral").derivatives(w)
        mu = np.where(np.abs(q) < np.abs(p), q / p, np.conj(p / q))
        least = TANH.field(TANH.invert(mu)).entries()
        assert energy(least) == pytest.approx(unsigned, rel=1e-9)
        assert energy(0.9 * least) < unsigned

    def test_equal_areas_characterise_injective_maps(self, name, V, F):
        """Proposition C.4: signed and unsigned area are equal without degeneracy iff all triangles are positive."""
        straight = bend(V[:, :2])
        disturbed = straight + 0.2 * np.random.default_rng(3).standard_normal(straight.shape)
        collapsed = straight.copy()
        collapsed[F[0, 0]] = collapsed[F[0, 1]]
        for uv, same, degenerate in ((straight, True, False), (disturbed, False, False), (collapsed, None, True)):
            doubled = signed_areas(F, uv)
            equal = np.abs(doubled).sum() == pytest.approx(doubled.sum(), rel=1e-12)
            assert (doubled == 0).any() == degenerate
            if same is not None:
                assert equal == same
            certificate = certify(F, uv)
            assert certificate.injective == (equal and not degenerate)
            assert bool(certificate.degenerate.size) == degenerate

    def test_sandwich(self, name, V, F):
        """Eq. 42: Dirichlet energy ≥ unsigned area ≥ signed area."""
        problem = posed(V, F, noise=0.2)
        iterate = Objective(problem).evaluate(random_xi(F, 2.0))
        signed = iterate.dw.area.sum()
        unsigned = np.abs(iterate.dw.area).sum()
        assert iterate.value + signed >= unsigned >= signed
        assert iterate.inverted > 0

    def test_are_frame_and_similarity_invariant(self, name, V, F):
        """If a triangle's corners rotate, its ξ rotates by twice the angle, and nothing else changes."""
        problem = posed(V, F, noise=0.05)
        turned = Problem(V, np.roll(F, -1, axis=1), problem.fixed, problem.target)
        # Scaling by a power of two and half a turn are exact, so the solver's frame is the same one mirrored.
        moved = Problem(V, F, problem.fixed, -4 * problem.target)
        xi = random_xi(F)
        for functional in NAMES:
            a = Objective(problem, functional).evaluate(xi)
            # In an equilateral triangle, the next side is rotated by 120°.
            b = Objective(turned, functional).evaluate(xi * np.exp(-2j * np.deg2rad(120)))
            c = Objective(moved, functional).evaluate(xi)
            assert b.value == pytest.approx(a.value, rel=1e-10)
            assert c.value == pytest.approx(a.value, rel=1e-10)
            np.testing.assert_allclose(np.abs(b.gradient), np.abs(a.gradient), rtol=1e-7, atol=1e-10)
            np.testing.assert_allclose(c.gradient, a.gradient, rtol=1e-7, atol=1e-10)


@pytest.mark.parametrize("functional", NAMES)
@pytest.mark.parametrize("parameterisation", ["tanh", "si-log"])
@pytest.mark.parametrize("reference", ["equilateral", "rest"])
@pytest.mark.parametrize("pins", [0, 4])
@pytest.mark.parametrize("mesh", [1, 2], ids=["bowl", "annulus"])
def test_gradients_against_differences(functional, parameterisation, reference, pins, mesh):
    _, V, F = MESHES[mesh]
    objective = Objective(posed(V, F, pins, noise=0.05), functional, parameterisation, reference)
    xi = random_xi(F)
    rng = np.random.default_rng(1)
    h = 1e-5
    gradient = objective.evaluate(xi).gradient
    for _ in range(2):
        direction = rng.standard_normal(len(F)) + 1j * rng.standard_normal(len(F))
        slope = (objective.evaluate(xi + h * direction).value - objective.evaluate(xi - h * direction).value) / (2 * h)
        assert np.vdot(gradient, direction).real == pytest.approx(slope, rel=1e-6)


@pytest.mark.parametrize(("name", "V", "F"), MESHES, ids=IDS)
class TestTheorems:
    @pytest.mark.parametrize("pins", [0, 5])
    def test_completeness(self, name, V, F, pins):
        """Theorem 6.4, Proposition B.2: every injective map is reproduced from its own A, where V₁ … V₄ are zero."""
        problem = posed(V, F, pins)
        uv = bend(V[:, :2])
        assert signed_areas(F, uv).min() > 0
        w = problem.frame.inward(uv)
        # Every interior position is already arbitrary, so no random injective map is needed.
        inner = np.setdiff1d(np.arange(len(V)), problem.fixed)
        w[inner] += 0.02 * np.random.default_rng(4).standard_normal((inner.size, 2)).view(complex).ravel() * 0.2
        assert signed_areas(F, problem.frame.outward(w)).min() > 0
        mu = inverse_field(problem.domain.mesh("equilateral"), w)
        xi = np.arctanh(np.abs(mu)) * np.exp(1j * np.angle(mu))
        for functional in NAMES:
            iterate = Objective(problem, functional).evaluate(xi)
            np.testing.assert_allclose(iterate.w, w, atol=1e-9)
            assert abs(iterate.value) < 1e-12
            assert np.abs(iterate.gradient).max() < 1e-6

    def test_positive_semidefinite(self, name, V, F):
        """Proposition A.1: GᵀAG + iD ⪰ 0 for determinants of at least 1; the A of an injective map is tight."""
        op = operators(V, F, "equilateral")
        problem = posed(V, F)
        mu = inverse_field(problem.domain.mesh("equilateral"), problem.frame.inward(bend(V[:, :2])))
        tight = np.arctanh(np.abs(mu)) * np.exp(1j * np.angle(mu))
        for xi, factor, holds in ((random_xi(F), 1, True), (tight, 1.3, True), (tight, 1, True), (tight, 0.9, False)):
            a = TANH.field(xi).entries()
            H = factor * op.laplacian(a.T).toarray() + 1j * op.D.toarray()
            lowest = np.linalg.eigvalsh(H).min()
            assert (lowest > -1e-12) if holds else (lowest < -1e-3)

    @pytest.mark.parametrize("functional", SIGHTED)
    def test_a_vanishing_functional_means_an_injective_map(self, name, V, F, functional):
        """Converse of Theorem 6.4, by descent: as V → 0 the last inverted triangle becomes positive, for each
        functional.

        Newton's method, whose functional is V₃, finishes the descent; V is evaluated at the tensors found.
        """
        problem = posed(V, F)
        stages = [
            LBFGS(functional=functional, iterations=60),
            Newton(iterations=60, resume=True),
        ]
        result = solve(problem, strategy=stages)
        assert result.injective
        start = Objective(problem, functional).evaluate(np.zeros(len(F), dtype=complex))
        mu = inverse_field(problem.domain.mesh("equilateral"), problem.frame.inward(result.uv))
        end = Objective(problem, functional).evaluate(TANH.invert(mu))
        assert end.value < 1e-10 * max(start.value, 1)
        assert end.inverted == 0

    def test_sufficiency(self, name, V, F):
        """Converse of Theorem 6.4: if the Neumann data do not fit, V₃ exceeds twice the inverted area."""
        problem = posed(V, F, noise=0.2)
        iterate = Objective(problem).evaluate(random_xi(F))
        inverted = -iterate.dw.area[iterate.dw.area < 0].sum()
        assert inverted > 0
        assert iterate.value >= 2 * inverted

    def test_v1_and_v2_vanish_only_where_v3_does(self, name, V, F):
        """With r = Lw − g, V₃ = ½ wᴴr at the fixed vertices. It is bounded by the norm of r that V₁ and V₂ use."""
        problem = posed(V, F, noise=0.2)
        at = Objective(problem).evaluate(random_xi(F))
        v1, v2 = (Objective(problem, functional).evaluate(at.xi).value for functional in ("neumann", "sobolev"))
        v3, area = at.value, at.dw.area.sum()
        held = at.w[problem.fixed]
        assert v3 > 0.1 * area
        assert v1 >= 2 * v3**2 / np.linalg.norm(held - held.mean()) ** 2
        assert v2 >= v3**2 / (v3 + area)


def test_v3_of_any_map_is_the_energy_of_its_beltrami_residual():
    """The map need not be the quasi-harmonic map of the tensors; the gradient is for a fixed map."""
    _, V, F = MESHES[0]
    problem = posed(V, F)
    mesh = problem.domain.mesh("equilateral")
    rng = np.random.default_rng(5)
    dw = mesh.derivatives(rng.standard_normal(len(V)) + 1j * rng.standard_normal(len(V)))
    xi = random_xi(F)

    def energy(mu):
        return 2 * mesh.m * np.abs(dw.q - mu * dw.p) ** 2 / (1 - np.abs(mu) ** 2)

    field = TANH.field(xi)
    value, gradient = beltrami_gradient(mesh, field, dw)
    assert value == pytest.approx(energy(field.mu).sum(), rel=1e-12)
    h = 1e-6
    for direction in (1, 1j):
        slope = (energy(field.mu + h * direction) - energy(field.mu - h * direction)) / (2 * h)
        np.testing.assert_allclose(
            (np.conj(gradient) * direction).real, slope, rtol=1e-6, atol=1e-7 * np.abs(gradient).max()
        )


def test_v4_can_be_negative():
    """The paper's V₄ ≥ 0 (§7.3.4, Proposition E.1) does not hold in linear elements.

    There V₄ = V₃ on a disk. Linear elements raise a Dirichlet energy and lower its dual, so on a coarse mesh with a
    rough tensor V₄ is negative. V₂ = V₃ + V₄ ≥ 0 still bounds it from below.
    """
    V, F = random_delaunay(150, seed=3)
    problem = posed(V, F, noise=0.05)
    assert Objective(problem, "poisson").evaluate(random_xi(F)).value < -0.1


def test_v4_vanishes_at_a_map_with_inverted_triangles():
    """A counterexample to Propositions 7.1 and E.1 in linear elements, between 𝒜 = 1 and rough tensors."""
    V, F = disk(10)
    (loop,) = boundary_loops(F, len(V))
    turn = np.angle(V[loop] @ (1, 1j))
    problem = Problem(V, F, loop, (1 + 0.7 * np.cos(5 * turn))[:, None] * V[loop])
    # An injective map exists, as the propositions require.
    assert solve(problem).injective

    poisson, rough = Objective(problem, "poisson"), random_xi(F, 1.5)
    along = brentq(lambda t: poisson.evaluate(t * rough).value, 0, 1, xtol=1e-15)
    at, area = poisson.evaluate(along * rough), poisson.evaluate(0 * rough).dw.area.sum()
    assert abs(at.value) < 1e-12 * area
    assert at.dirichlet > 0.5 * area
    assert np.count_nonzero(signed_areas(F, problem.frame.outward(at.w)) < 0) > 50
    # The functional decreases further along this line, so zero is no minimum either.
    assert poisson.evaluate(rough).value < -0.1 * area
