"""The general tensor, conjugate maps and the boundary condition of §D against their definitions."""

from __future__ import annotations

import numpy as np
import pytest

from general_tensor import (
    beltrami_pair,
    beltrami_tensor,
    conjugate_quasi_harmonic_map,
    conjugate_tensor,
    conormal_derivative,
    edge_conormal,
    vertex_conormal,
)
from quasiharmonic import Problem, quasi_harmonic_map
from quasiharmonic.geometry.mesh.reference import ReferenceMesh, operators
from quasiharmonic.solver.field.tensor import TANH
from quasiharmonic.surfaces import random_delaunay
from shared.meshes import bend, boundary_of, lift, random_xi, signed_areas, surfaces

STAR = np.array([[0.0, -1.0], [1.0, 0.0]])
MESHES = surfaces()
IDS = [name for name, _, _ in MESHES]


def random_pair(rng, count, real=False):
    """Random pairs in |μ| + |ν| < 1."""
    total, share = np.sqrt(rng.random(count)) * 0.98, rng.random(count)
    turn = np.exp(2j * np.pi * rng.random((2, count)))
    nu = total * (1 - share) * (np.sign(turn[1].real) if real else turn[1])
    return total * share * turn[0], nu


def random_tensor(rng, count, symmetric=False):
    """Random elliptic matrices, independent of the module's formulas."""
    B = rng.standard_normal((count, 2, 2))
    A = B @ np.swapaxes(B, 1, 2) + 0.05 * np.eye(2)
    return A if symmetric else A + rng.standard_normal(count)[:, None, None] * STAR


def wirtinger(J):
    """Return f_z and f_z̄ from rows ∇u and ∇v."""
    (ux, uy), (vx, vy) = np.moveaxis(J, 0, -1)
    return 0.5 * (ux + vy + 1j * (vx - uy)), 0.5 * (ux - vy + 1j * (vx + uy))


def admitted_pair(problem, w, rng, complex_nu=True):
    """Return, for every triangle of a positive map, a random pair whose Beltrami equation the map satisfies."""
    p, q, _ = ReferenceMesh(problem.V, problem.F, "rest").derivatives(w)
    nu = 0.49 * (1 - np.abs(q / p)) * np.sqrt(rng.random(p.size))
    nu = nu * (np.exp(2j * np.pi * rng.random(p.size)) if complex_nu else rng.choice([-1, 1], p.size))
    return (q - nu * p.conj()) / p, nu


def bent(V, F, rng):
    """A problem with a known solution: `bend` with a perturbed interior, still positive."""
    fixed = boundary_of(F)
    uv, length = bend(V[:, :2]), 0.3 / np.sqrt(len(F))
    noise = length * rng.uniform(-1, 1, uv.shape)
    noise[fixed] = 0
    while np.any(signed_areas(F, uv + noise) <= 0):
        noise *= 0.7
    uv = uv + noise
    return Problem(V, F, fixed, uv[fixed]), uv


class TestTensor:
    def test_solves_the_beltrami_equation(self, rng):
        """The definition: ∇v = * A ∇u is f_z̄ = μ f_z + ν conj(f_z)."""
        mu, nu = random_pair(rng, 300)
        du = rng.standard_normal((300, 2))
        dv = np.einsum("ij,fjk,fk->fi", STAR, beltrami_tensor(mu, nu), du)
        p, q = wirtinger(np.stack([du, dv], axis=1))
        np.testing.assert_allclose(q, mu * p + nu * p.conj(), atol=1e-11 * np.abs(p).max())

    def test_eq_32_as_printed_is_the_symmetric_part(self, rng):
        mu, nu = random_pair(rng, 100)
        printed = np.array(
            [
                [np.abs(1 - mu) ** 2 - np.abs(nu) ** 2, -2 * mu.imag],
                [-2 * mu.imag, np.abs(1 + mu) ** 2 - np.abs(nu) ** 2],
            ]
        ) / (np.abs(1 + nu) ** 2 - np.abs(mu) ** 2)
        A = beltrami_tensor(mu, nu)
        np.testing.assert_allclose((A + np.swapaxes(A, 1, 2)) / 2, np.moveaxis(printed, 2, 0), rtol=1e-12)
        # Its own pair is different, so it does not represent the Beltrami equation of (μ, ν).
        assert np.max(np.abs(beltrami_pair(np.moveaxis(printed, 2, 0))[1] - nu)) > 0.1

    @pytest.mark.parametrize("real", [True, False])
    def test_round_trips(self, rng, real):
        mu, nu = random_pair(rng, 300, real)
        found = beltrami_pair(beltrami_tensor(mu, nu))
        np.testing.assert_allclose(found, (mu, nu), atol=1e-12)
        A = random_tensor(rng, 300, symmetric=real)
        mu, nu = beltrami_pair(A)
        assert np.all(np.abs(mu) + np.abs(nu) < 1)
        np.testing.assert_allclose(beltrami_tensor(mu, nu), A, rtol=1e-8, atol=1e-8)
        if real:
            np.testing.assert_allclose(nu.imag, 0, atol=1e-15)

    def test_determinant_and_eigenvalues(self, rng):
        mu, nu = random_pair(rng, 300)
        det = (np.abs(1 - nu) ** 2 - np.abs(mu) ** 2) / (np.abs(1 + nu) ** 2 - np.abs(mu) ** 2)
        np.testing.assert_allclose(np.linalg.det(beltrami_tensor(mu, nu)), det, rtol=1e-9)
        mu, nu = random_pair(rng, 300, real=True)
        k, nu = np.abs(mu), nu.real
        values = np.linalg.eigvalsh(beltrami_tensor(mu, nu))
        np.testing.assert_allclose(values[:, 0], (1 - k - nu) / (1 + k + nu), rtol=1e-9)
        np.testing.assert_allclose(values[:, 1], (1 + k - nu) / (1 - k + nu), rtol=1e-9)
        assert np.all(values > 0)

    def test_unit_determinant_and_zero_nu_give_eq_33(self, rng):
        field = TANH.field(random_xi(np.zeros(200)))
        A = beltrami_tensor(field.mu, 0)
        np.testing.assert_allclose(np.linalg.det(A), 1, rtol=1e-10)
        np.testing.assert_allclose(A.reshape(-1, 4)[:, [0, 1, 3]].T, field.entries(), rtol=1e-9, atol=1e-9)
        unit = random_tensor(rng, 200, symmetric=True)
        unit /= np.sqrt(np.linalg.det(unit))[:, None, None]
        np.testing.assert_allclose(beltrami_pair(unit)[1], 0, atol=1e-13)
        assert np.all(np.sign(np.linalg.det(beltrami_tensor(0.2j, [0.3, -0.3])) - 1) == (-1, 1))

    def test_rotates_with_the_frame(self, rng):
        mu, nu = random_pair(rng, 50)
        c, s = np.cos(0.7), np.sin(0.7)
        Q = np.array([[c, -s], [s, c]])
        np.testing.assert_allclose(
            beltrami_tensor(mu * np.exp(-1.4j), nu), Q.T @ beltrami_tensor(mu, nu) @ Q, rtol=1e-9, atol=1e-9
        )

    def test_rejects_tensors_that_are_not_elliptic(self):
        with pytest.raises(ValueError, match="entry 1"):
            beltrami_tensor([0.5, 0.5, 0.1], [0.1, 0.5, 0.1])
        with pytest.raises(ValueError, match="below 1"):
            beltrami_tensor(np.nan, 0)


class TestConjugate:
    def test_is_defined_by_the_hodge_star(self, rng):
        A = random_tensor(rng, 100)
        np.testing.assert_allclose(conjugate_tensor(A), STAR.T @ np.linalg.inv(A) @ STAR, rtol=1e-9, atol=1e-12)
        np.testing.assert_allclose(conjugate_tensor(conjugate_tensor(A)), A, rtol=1e-9)

    def test_has_the_pair_mu_minus_nu(self, rng):
        mu, nu = random_pair(rng, 100)
        np.testing.assert_allclose(beltrami_pair(conjugate_tensor(beltrami_tensor(mu, nu))), (mu, -nu), atol=1e-12)

    def test_is_equal_to_the_map_exactly_at_unit_determinant(self, rng):
        A = random_tensor(rng, 100, symmetric=True)
        apart = np.abs(conjugate_tensor(A) - A).max(axis=(1, 2))
        assert np.all((apart > 1e-9) == (np.abs(np.linalg.det(A) - 1) > 1e-9))
        A /= np.sqrt(np.linalg.det(A))[:, None, None]
        np.testing.assert_allclose(conjugate_tensor(A), A, rtol=1e-9, atol=1e-12)


@pytest.mark.parametrize(("name", "V", "F"), MESHES, ids=IDS)
class TestMap:
    @pytest.mark.parametrize("complex_nu", [False, True])
    def test_reproduces_every_positive_map_from_every_pair_it_admits(self, name, V, F, rng, complex_nu):
        """Proposition B.2 for any det A, including Neumann data."""
        problem, uv = bent(V, F, rng)
        w = uv.view(complex).ravel()
        mu, nu = admitted_pair(problem, w, rng, complex_nu)
        A = beltrami_tensor(mu, nu)
        assert np.ptp(np.linalg.det(A)) > 0.5
        found = conjugate_quasi_harmonic_map(problem, A)
        np.testing.assert_allclose(found, uv, atol=1e-11)
        D = operators(V, F).D
        np.testing.assert_allclose(self.flux(problem, A, uv[:, 0]), D @ uv[:, 1], atol=1e-12)
        np.testing.assert_allclose(self.flux(problem, conjugate_tensor(A), uv[:, 1]), -D @ uv[:, 0], atol=1e-12)
        # The same tensor for both coordinates gives another map: Definition 8.1 differs from Definition 4.1.
        same = conjugate_quasi_harmonic_map(problem, conjugate_tensor(A))
        assert np.abs(same[:, 0] - uv[:, 0]).max() > 1e-3

    def test_is_the_solvers_if_nu_is_zero(self, name, V, F, rng):
        problem, _ = bent(V, F, rng)
        xi = random_xi(F)
        problem = Problem(V, F, problem.fixed, problem.target, reference="equilateral")
        found = conjugate_quasi_harmonic_map(problem, beltrami_tensor(TANH.field(xi).mu, 0))
        np.testing.assert_allclose(found, quasi_harmonic_map(problem, TANH.field(xi).mu), atol=1e-10)

    def test_sandwich(self, name, V, F, rng):
        """Eq. 42 for conjugate pairs: ½(uᵀLu + vᵀL̄v) ≥ unsigned area, with equality if the Beltrami equation holds."""
        problem, uv = bent(V, F, rng)
        A = beltrami_tensor(*admitted_pair(problem, uv.view(complex).ravel(), rng))
        assert self.energy(problem, A, uv) == pytest.approx(0.5 * signed_areas(F, uv).sum(), rel=1e-12)
        other = uv + 0.3 * rng.standard_normal(uv.shape)
        assert self.energy(problem, A, other) > 0.5 * np.abs(signed_areas(F, other)).sum()

    @staticmethod
    def flux(problem, A, u):
        """``Gᵀ A G u`` from the paper's G."""
        op = operators(problem.V, problem.F)
        f = len(problem.F)
        gradient = np.stack([op.G[:f] @ u, op.G[f:] @ u], axis=1)
        pulled = op.m[:, None] * np.einsum("fij,fj->fi", A, gradient)
        return op.G.T @ pulled.T.ravel()

    def energy(self, problem, A, uv):
        u, v = uv.T
        return 0.5 * (u @ self.flux(problem, A, u) + v @ self.flux(problem, conjugate_tensor(A), v))


def test_beltrami_equation_holds_for_affine_maps_of_constant_pairs(rng):
    """One pair for the whole plane: the map a z + (μ a + ν ā) z̄, with A in the frame of each triangle."""
    V, F = random_delaunay(120, seed=2)
    problem_fixed = boundary_of(F)
    edge = V[F[:, 1]] - V[F[:, 0]]
    angle = np.arctan2(edge[:, 1], edge[:, 0])
    z = V.view(complex).ravel()
    for mu, nu, a in ((0.3 + 0.2j, 0.4, 1 - 2j), (-0.1j, -0.5 + 0.2j, 0.3j)):
        w = a * z + (mu * a + nu * np.conj(a)) * z.conj()
        uv = w[:, None].view(float)
        problem = Problem(V, F, problem_fixed, uv[problem_fixed])
        A = beltrami_tensor(mu * np.exp(-2j * angle), nu)
        found = conjugate_quasi_harmonic_map(problem, A)
        p, q, area = ReferenceMesh(problem.V, problem.F, "rest").derivatives(found.view(complex).ravel())
        np.testing.assert_allclose(q, mu * np.exp(-2j * angle) * p + nu * p.conj(), atol=1e-12)
        assert np.all(area > 0)
        np.testing.assert_allclose(np.abs(p), abs(a), rtol=1e-12)


class TestBoundaryCondition:
    """Proposition D.2."""

    def test_determinant_from_s_at_points(self, rng):
        count = 400
        A, J = random_tensor(rng, count), rng.standard_normal((count, 2, 2))
        angle = 2 * np.pi * rng.random(count)
        n, t = np.array([np.cos(angle), np.sin(angle)]).T, np.array([-np.sin(angle), np.cos(angle)]).T
        image = np.einsum("fij,fj->fi", J, t)
        size = np.linalg.norm(image, axis=1)
        n_hat = np.stack([image[:, 1], -image[:, 0]], axis=1) / size[:, None]
        derivative = conormal_derivative(A, J, n)
        # The definition, for one gradient at a time.
        np.testing.assert_allclose(derivative[:, 0], np.einsum("fi,fij,fj->f", n, A, J[:, 0]), atol=1e-12)
        np.testing.assert_allclose(derivative[:, 1], np.einsum("fi,fij,fj->f", n, A, J[:, 1]), atol=1e-12)
        symmetric = (A + np.swapaxes(A, 1, 2)) / 2
        s = np.einsum("fi,fi->f", n_hat, conormal_derivative(symmetric, J, n))
        weight = np.einsum("fi,fij,fj->f", n, A, n)
        np.testing.assert_allclose(np.linalg.det(J), s * size / weight, rtol=1e-9, atol=1e-9)
        # An antisymmetric part only adds a tangential derivative.
        np.testing.assert_allclose(np.einsum("fi,fi->f", n_hat, derivative), s, atol=1e-9)

    @pytest.mark.parametrize(("name", "V", "F"), MESHES, ids=IDS)
    @pytest.mark.parametrize("reference", ["rest", "equilateral"])
    def test_s_is_positive_on_exactly_those_edges_whose_triangles_are_positive(self, name, V, F, reference, rng):
        problem, uv = bent(V, F, rng)
        uv = uv + 0.25 * rng.standard_normal(uv.shape)
        A = random_tensor(rng, len(F))
        found = edge_conormal(problem, A, uv, reference)
        areas = signed_areas(F, uv)
        sides = {(int(t[k]), int(t[k - 2])): area for t, area in zip(F, areas, strict=True) for k in range(3)}
        beside = np.array([sides[i, j] for i, j in found.at.tolist()])
        assert len(found.at) == len(problem.domain.edges.boundary)
        assert 0.1 < np.mean(beside > 0) < 0.95
        np.testing.assert_array_equal(found.s > 0, beside > 0)

    @pytest.mark.parametrize(("name", "V", "F"), MESHES, ids=IDS)
    def test_own_tensor_satisfies_eq_9_and_any_multiple_satisfies_eq_8(self, name, V, F, rng):
        problem, uv = bent(V, F, rng)
        p, q, _ = ReferenceMesh(problem.V, problem.F, "rest").derivatives(uv.view(complex).ravel())
        A = beltrami_tensor(q / p, 0)
        edges, vertices = edge_conormal(problem, A, uv), vertex_conormal(problem, A, uv)
        for found in (edges, vertices):
            np.testing.assert_allclose(found.flux, found.normal, atol=1e-12)
            np.testing.assert_allclose(found.misalignment, 0, atol=1e-9)
        image = np.linalg.norm(uv[edges.at[:, 1]] - uv[edges.at[:, 0]], axis=1)
        rest = np.linalg.norm(V[edges.at[:, 1]] - V[edges.at[:, 0]], axis=1)
        np.testing.assert_allclose(edges.length, rest, rtol=1e-12)
        np.testing.assert_allclose(edges.s, image / rest, rtol=1e-9)
        normal = -1j * (operators(V, F).D @ uv.view(complex).ravel())[vertices.at]
        np.testing.assert_allclose(vertices.normal, normal, atol=1e-14)
        # det A = 9 everywhere: the same quasi-harmonic map with another positive s.
        np.testing.assert_allclose(edge_conormal(problem, 3 * A, uv).s, 3 * edges.s, rtol=1e-12)
        np.testing.assert_allclose(vertex_conormal(problem, 3 * A, uv).misalignment, 0, atol=1e-9)

    def test_positive_s_does_not_make_a_linear_map_positive(self):
        """The reason why the solver requires eq. 17 instead of a sign.

        Rough tensors of unit determinant invert interior triangles although s > 0 on every edge, and boundary triangles
        although s > 0 at every vertex.
        """
        V, F = random_delaunay(150, seed=1)
        fixed = boundary_of(F)
        problem = Problem(V, F, fixed, V[fixed])
        found = set()
        # Only one or two tensors in a hundred show the second case.
        for seed in range(400):
            A = beltrami_tensor(TANH.field(random_xi(F, 0.5, seed)).mu, 0)
            uv = conjugate_quasi_harmonic_map(problem, A)
            edges, vertices = edge_conormal(problem, A, uv), vertex_conormal(problem, A, uv)
            if np.any(signed_areas(F, uv) <= 0):
                found.add((bool(np.all(edges.s > 0)), bool(np.all(vertices.s > 0))))
            if {(True, False), (False, True)} <= found:
                break
        else:
            pytest.fail(f"of the two cases only {found} were found")

    def test_s_is_not_defined_on_a_collapsed_edge(self):
        V, F = random_delaunay(60, seed=1)
        fixed = boundary_of(F)
        target = V[fixed].copy()
        target[1] = target[0]
        problem = Problem(V, F, fixed, target)
        A = np.broadcast_to(np.eye(2), (len(F), 2, 2))
        found = edge_conormal(problem, A, conjugate_quasi_harmonic_map(problem, A))
        assert np.count_nonzero(found.s == 0) == 1
        assert np.all(np.isfinite(found.misalignment))


def test_rejects_tensors_of_another_shape_or_not_elliptic():
    V, F = random_delaunay(40)
    fixed = boundary_of(F)
    problem = Problem(lift(V), F, fixed, V[fixed])
    with pytest.raises(ValueError, match="a matrix for every triangle"):
        conjugate_quasi_harmonic_map(problem, np.ones((len(F), 3)))
    A = np.tile(np.eye(2), (len(F), 1, 1))
    A[7, 0, 0] = -1
    with pytest.raises(ValueError, match="triangle 7"):
        edge_conormal(problem, A, V)


def test_without_free_vertices():
    problem = Problem(np.eye(3), [[0, 1, 2]], [0, 1, 2], [[0, 0], [1, 0], [0, 1]])
    np.testing.assert_array_equal(conjugate_quasi_harmonic_map(problem, [np.eye(2)]), problem.target)
