"""The functionals of edges, and settings of the functionals."""

from __future__ import annotations

import numpy as np
import pytest

from quasiharmonic import Problem, solve
from quasiharmonic.geometry.mesh.reference import ReferenceMesh
from quasiharmonic.geometry.mesh.topology import boundary_edges, boundary_loops
from quasiharmonic.linsolve.laplacian import Laplacian
from quasiharmonic.solver.field.functionals import FUNCTIONALS
from quasiharmonic.solver.field.objective import Objective, own_sweep
from quasiharmonic.solver.methods import LBFGS, VectorAdam
from quasiharmonic.surfaces import annulus, disk, random_delaunay
from shared.functionals import MESHES, NAMES, SIGHTED, matrices, posed
from shared.meshes import bend, boundary_of, random_xi, signed_areas


def edge_matrices(problem, field):
    """Crouzeix–Raviart elements by their definition: Laplacian, Neumann data and edge midpoints, dense."""
    V, F = problem.V, problem.F
    pairs = np.sort(np.concatenate([F[:, (1, 2)], F[:, (2, 0)], F[:, (0, 1)]]), axis=1)
    ends, number = np.unique(pairs, axis=0, return_inverse=True)
    number = number.reshape(3, -1).T
    L, g = np.zeros((len(ends), len(ends))), np.zeros(len(ends), complex)
    middles = V[ends].mean(axis=1)
    w = np.zeros(problem.n, complex)
    w[problem.fixed] = problem.frame.inward(problem.target)
    for corners, edges_of, (a11, a12, a22), (e1, _) in zip(
        F, number, field.entries().T, V[F][:, 1:] - V[F][:, :1], strict=True
    ):
        # The first side of each triangle is along x in the frame of its tensor.
        x = e1 / np.hypot(*e1)
        frame = np.stack([x, [-x[1], x[0]]])
        A = frame.T @ [[a11, a12], [a12, a22]] @ frame
        # The functions that are 1 at one midpoint and 0 at the other two.
        grad = np.linalg.inv(np.column_stack([np.ones(3), middles[edges_of]]))[1:]
        (bx, by), (cx, cy) = V[corners[1]] - V[corners[0]], V[corners[2]] - V[corners[0]]
        L[np.ix_(edges_of, edges_of)] += 0.5 * (bx * cy - by * cx) * grad.T @ A @ grad
    for tail, head in boundary_edges(F, problem.n):
        g[np.flatnonzero((ends == sorted((tail, head))).all(axis=1))] = -1j * (w[head] - w[tail])
    return L, g, w[ends].mean(axis=1)


class TestEdgePoisson:
    """V₄ in Crouzeix–Raviart elements, for which the paper's statements hold, and its value there."""

    @pytest.mark.parametrize("mesh", [0, 2, 4], ids=["disk", "annulus", "random annulus"])
    def test_agrees_with_the_elements_definition(self, mesh):
        _, V, F = MESHES[mesh]
        boundary = boundary_of(F)
        target = bend(V[boundary]) + 0.05 * np.random.default_rng(0).standard_normal((len(boundary), 2))
        problem = Problem(V, F, boundary, target, reference="rest")
        at = Objective(problem, "edge-poisson").evaluate(random_xi(F))
        L, g, b = edge_matrices(problem, at.field)
        value = (g.conj() @ np.linalg.pinv(L, hermitian=True) @ g - g.conj() @ b).real / 2
        assert at.value == pytest.approx(value, rel=1e-9)

    @pytest.mark.parametrize("pins", [0, 5])
    @pytest.mark.parametrize("mesh", [0, 1], ids=["disk", "bowl"])
    @pytest.mark.parametrize("reference", ["equilateral", "rest"])
    # At twice that, the determinants of the rounded tensors differ from 1 in the sixth digit.
    @pytest.mark.parametrize("scale", [0.0, 0.7, 1.0])
    def test_equals_v3_without_pins_on_a_disk(self, mesh, pins, reference, scale):
        _, V, F = MESHES[mesh]
        pinned = posed(V, F, pins, noise=0.05)
        k = len(boundary_of(F))
        free = Problem(V, F, pinned.fixed[:k], pinned.target[:k])
        xi = random_xi(F, scale)
        v4 = Objective(pinned, "edge-poisson", reference=reference).evaluate(xi)
        v3 = Objective(free, "dirichlet", reference=reference).evaluate(xi)
        # The frame size depends on the target including pins.
        unit = (pinned.frame.outward(np.array([1 + 0j])) - pinned.frame.outward(np.array([0j])))[0, 0]
        unit /= (free.frame.outward(np.array([1 + 0j])) - free.frame.outward(np.array([0j])))[0, 0]
        assert v4.value * unit**2 == pytest.approx(v3.value, rel=1e-8)
        np.testing.assert_allclose(v4.gradient * unit**2, v3.gradient, atol=1e-7 * np.abs(v3.gradient).max())

    @pytest.mark.parametrize("mesh", [2, 4], ids=["annulus", "random annulus"])
    def test_equals_v3_with_inner_loops_at_their_best_position(self, mesh):
        _, V, F = MESHES[mesh]
        problem, xi = posed(V, F, noise=0.05), random_xi(F)
        at = Objective(problem).evaluate(xi)
        L, _, _ = matrices(problem, at)
        inner = np.sort(min(problem.domain.loops, key=len))
        assert not np.isin(inner, max(problem.domain.loops, key=len)).any()
        # The response of the map to a unit translation of the inner loop gives its best position.
        carried, fixed = np.zeros(problem.n), problem.fixed
        carried[inner] = 1
        free = np.setdiff1d(np.arange(problem.n), fixed)
        carried[free] = -np.linalg.solve(L[np.ix_(free, free)], L[np.ix_(free, fixed)] @ carried[fixed])
        gain = abs(carried @ L @ at.w) ** 2 / (carried @ L @ carried) / 2
        assert gain > 1e-3
        assert Objective(problem, "edge-poisson").evaluate(xi).value == pytest.approx(at.value - gain, rel=1e-9)

    @pytest.mark.slow
    def test_descends_to_an_injective_map_where_linear_elements_fail(self):
        V, F = disk(10)
        (loop,) = boundary_loops(F, len(V))
        turn = np.angle(V[loop] @ (1, 1j))
        problem = Problem(V, F, loop, (1 + 0.7 * np.cos(5 * turn))[:, None] * V[loop])
        found = {
            name: solve(problem, strategy=[VectorAdam(functional=name, iterations=100)])
            for name in ("dirichlet", "edge-poisson", "poisson")
        }
        assert found["edge-poisson"].injective
        # It follows exactly the path of V₃.
        assert found["edge-poisson"].n_iterations == found["dirichlet"].n_iterations
        np.testing.assert_allclose(found["edge-poisson"].uv, found["dirichlet"].uv, atol=1e-6)
        assert not found["poisson"].injective


class TestPoissonIsBlind:
    def test_to_a_translation_of_an_inner_loop(self):
        """V₄ depends on C b only: moving an inner loop out of the outer one changes nothing."""
        V, F = annulus(8)
        boundary = boundary_of(F)
        target = V[boundary].copy()
        inner = np.abs(target).max(axis=1) < 0.75
        xi = np.zeros(len(F), dtype=complex)
        here = Problem(V, F, boundary, target, reference="rest")
        target[inner] += [0.25, 0.0]
        there = Problem(V, F, boundary, target, reference="rest")
        assert Objective(there, "poisson").evaluate(xi).value == pytest.approx(
            Objective(here, "poisson").evaluate(xi).value, abs=1e-12
        )
        assert Objective(there, "dirichlet").evaluate(xi).value > 1e-2

    def test_to_pins(self):
        V, F = random_delaunay(150, seed=3)
        free = Problem(V, F, boundary_of(F), V[boundary_of(F)], reference="rest")
        middle = int(np.argmin((V**2).sum(axis=1)))
        fixed = np.append(boundary_of(F), middle)
        pinned = Problem(V, F, fixed, np.vstack([V[boundary_of(F)], [[0.5, 0.0]]]), reference="rest")
        xi = np.zeros(len(F), dtype=complex)
        assert Objective(pinned, "poisson").evaluate(xi).value == pytest.approx(0, abs=1e-12)
        assert Objective(free, "dirichlet").evaluate(xi).value == pytest.approx(0, abs=1e-12)
        for sighted in SIGHTED:
            assert Objective(pinned, sighted).evaluate(xi).value > 1e-2

    def test_is_declared(self):
        assert [name for name in NAMES if name not in SIGHTED] == ["poisson", "edge-poisson"]


class TestSettings:
    def test_every_functional_of_the_table_can_be_descended(self, monkeypatch):
        class Logarithm(FUNCTIONALS["dirichlet"]):
            def value(self, at):
                return float(np.log1p(at.dirichlet))

            def gradient(self, at):
                return at.dirichlet_gradient / (1 + at.dirichlet)

        with pytest.raises(
            ValueError, match="functional must be one of neumann, sobolev, dirichlet, poisson, edge-poisson, not"
        ):
            LBFGS(functional="logarithm")
        monkeypatch.setitem(FUNCTIONALS, "logarithm", Logarithm)
        _, V, F = MESHES[0]
        result = solve(posed(V, F), strategy=[LBFGS(functional="logarithm", iterations=300)])
        assert result.injective
        assert result.stages[0].name == "l-bfgs, tanh, logarithm"

    @pytest.mark.parametrize("name", NAMES)
    def test_value_and_gradient_share_one_more_factorisation_by_the_same_solver(self, monkeypatch, name):
        further = 0 if name in ("neumann", "dirichlet") else 1
        made, factored = [], []

        class Recorded(Laplacian):
            def __init__(self, F, n, fixed, linear_solver):
                super().__init__(F, n, fixed, linear_solver)
                made.append((len(fixed), linear_solver))

            def factor(self, stiffness):
                factored.append(stiffness)
                return super().factor(stiffness)

        monkeypatch.setattr("quasiharmonic.solver.field.functionals.Laplacian", Recorded)
        _, V, F = MESHES[0]
        problem = posed(V, F)
        objective = Objective(problem, name, linear_solver="superlu")
        for seed in (1, 2):
            at = objective.evaluate(random_xi(F, 0.3, seed))
            assert np.isfinite(at.value)
            assert np.abs(at.gradient).max() > 0
        assert made == [(1, "superlu")] * further
        assert len(factored) == 2 * further
        assert objective.functional.problem is problem
        assert objective.functional.mesh is objective.mesh

    @pytest.mark.parametrize("setting", ["functional", "parameterisation", "reference"])
    @pytest.mark.parametrize("word", ["v3", None, ["tanh"]])
    def test_other_names_are_rejected(self, setting, word):
        with pytest.raises(ValueError, match=f"{setting} must be one of "):
            LBFGS(**{setting: word})


def test_maps_at_their_own_tensors():
    """There, V₃ of each triangle is twice its area if it is inverted, and zero otherwise."""
    V, F = random_delaunay(80, seed=2)
    mesh = ReferenceMesh(V, F, "equilateral")
    w = V[:, 0] + 1j * V[:, 1]
    folded = w + 0.08 * np.random.default_rng(1).standard_normal(len(V))
    starts = np.array([0, 30, len(F)])
    for places in (w, folded):
        sums, mu = own_sweep(mesh, places, starts)
        area = 0.5 * signed_areas(F, np.stack([places.real, places.imag], axis=1))
        expected = [np.where(part < 0, -2 * part, 0).sum() for part in np.split(area, starts[1:-1])]
        np.testing.assert_allclose(sums[:, 0], expected, rtol=1e-9, atol=1e-12)
        np.testing.assert_allclose(sums[:, 1], [part.sum() for part in np.split(area, starts[1:-1])], rtol=1e-12)
        dw = mesh.derivatives(places)
        upright = area > 0
        np.testing.assert_allclose(mu[upright], (dw.q / dw.p)[upright], rtol=1e-9)
        np.testing.assert_allclose(mu[~upright], (dw.p / dw.q)[~upright].conj(), rtol=1e-9)
    assert (~upright).sum() > 3
