"""The operators of §6.2 by their identities."""

from __future__ import annotations

import numpy as np
import pytest

from quasiharmonic.geometry.mesh.reference import ReferenceMesh, operators
from quasiharmonic.linsolve.laplacian import Laplacian
from quasiharmonic.solver.field.tensor import TANH
from quasiharmonic.surfaces import annulus, random_delaunay
from shared.meshes import bend, lift, random_xi, signed_areas, surfaces

MESHES = surfaces()
IDS = [name for name, _, _ in MESHES]


def cotangent_laplacian(V, F):
    """Assemble the matrix angle by angle from its definition."""
    n = len(V)
    P = V if V.shape[1] == 3 else np.column_stack([V, np.zeros(n)])
    L = np.zeros((n, n))
    for i, j, k in F:
        for a, b, c in ((i, j, k), (j, k, i), (k, i, j)):
            e, g = P[a] - P[c], P[b] - P[c]
            cot = np.dot(e, g) / np.linalg.norm(np.cross(e, g))
            L[a, b] -= cot / 2
            L[b, a] -= cot / 2
    return L - np.diag(L.sum(axis=1))


@pytest.mark.parametrize(("name", "V", "F"), MESHES, ids=IDS)
class TestOperators:
    def test_laplacian_is_the_cotangent_laplacian(self, name, V, F):
        np.testing.assert_allclose(operators(V, F).laplacian().toarray(), cotangent_laplacian(V, F), atol=1e-11)

    def test_d_measures_the_area(self, name, V, F, rng):
        u, v = rng.standard_normal((2, len(V)))
        op = operators(V, F)
        areas = signed_areas(F, np.stack([u, v], axis=1)) / 2
        assert u @ (op.D @ v) == pytest.approx(areas.sum(), rel=1e-10)
        b_u, b_v = op.R.T @ u, op.R.T @ v
        assert b_u @ (op.C @ b_v) == pytest.approx(areas.sum(), rel=1e-10)
        np.testing.assert_array_equal(op.D.toarray(), -op.D.T.toarray())

    def test_areas_and_gradients(self, name, V, F):
        op = operators(V, F)
        P = V if V.shape[1] == 3 else np.column_stack([V, np.zeros(len(V))])
        normals = np.cross(P[F[:, 1]] - P[F[:, 0]], P[F[:, 2]] - P[F[:, 0]])
        np.testing.assert_allclose(op.m, np.linalg.norm(normals, axis=1) / 2, rtol=1e-12)
        # The squared norms of the coordinates' gradients add up to 2, the trace of the tangent projection.
        gradients = (op.G @ P).reshape(2, len(F), 3)
        np.testing.assert_allclose((gradients**2).sum(axis=(0, 2)), 2.0, rtol=1e-10)

    def test_selections_divide_the_vertices(self, name, V, F):
        op = operators(V, F)
        both = op.R @ op.R.T + op.S @ op.S.T
        np.testing.assert_array_equal(both.toarray(), np.eye(len(V)))
        assert op.R.shape[1] + op.S.shape[1] == len(V)


@pytest.mark.parametrize("mesh", [random_delaunay(150, seed=3), annulus(8)], ids=["disk", "annulus"])
def test_linear_precision(mesh):
    """Eq. 38: a planar mesh's own coordinates are harmonic, and their flux is (C b_v, −C b_u)."""
    V, F = mesh
    op = operators(V, F)
    L = op.laplacian()
    b = op.R.T @ V
    np.testing.assert_allclose(op.S.T @ L @ V, 0, atol=1e-12)
    np.testing.assert_allclose(op.R.T @ L @ V, np.column_stack([op.C @ b[:, 1], -(op.C @ b[:, 0])]), atol=1e-12)


@pytest.mark.parametrize("reference", ["rest", "equilateral", "corrected"])
@pytest.mark.parametrize(("name", "V", "F"), MESHES, ids=IDS)
class TestLaplacian:
    def test_solves_eq_12(self, name, V, F, reference, rng):
        """The fast assembly and its solve, against the paper's matrices and a dense inverse."""
        op = operators(V, F, reference)
        mesh = ReferenceMesh(V, F, reference)
        field = TANH.field(random_xi(F))
        L = op.laplacian(field.entries().T).toarray()
        fixed = np.unique(op.R.nonzero()[0])
        extra = np.setdiff1d(np.arange(len(V)), fixed)[:3]
        fixed = rng.permutation(np.concatenate([fixed, extra]))
        laplacian = Laplacian(F, len(V), fixed).factor(mesh.edge_stiffness(field.entries()))
        w = rng.standard_normal(len(V)) + 1j * rng.standard_normal(len(V))
        out = laplacian.extend(w)
        free = np.setdiff1d(np.arange(len(V)), fixed)
        np.testing.assert_array_equal(laplacian.laplacian.free, free)
        np.testing.assert_array_equal(out[fixed], w[fixed])
        expected = -np.linalg.solve(L[np.ix_(free, free)], L[np.ix_(free, fixed)] @ w[fixed])
        np.testing.assert_allclose(out[free], expected, rtol=1e-9, atol=1e-10)
        flux = laplacian.flux(w)
        np.testing.assert_allclose(flux[fixed], (L @ w)[fixed], rtol=1e-9, atol=1e-9)
        assert not flux[free].any()
        response = laplacian.respond(w)
        np.testing.assert_allclose(L[np.ix_(free, free)] @ response[free], w[free], rtol=1e-9, atol=1e-9)
        assert not response[fixed].any()

    def test_derivatives_are_those_of_g(self, name, V, F, reference, rng):
        op = operators(V, F, reference)
        mesh = ReferenceMesh(V, F, reference)
        w = rng.standard_normal(len(V)) + 1j * rng.standard_normal(len(V))
        gx, gy = (op.G @ w).reshape(2, -1)
        p, q, area = mesh.derivatives(w)
        np.testing.assert_allclose(p, (gx - 1j * gy) / 2, atol=1e-10 * np.abs(p).max())
        np.testing.assert_allclose(q, (gx + 1j * gy) / 2, atol=1e-10 * np.abs(q).max())
        uv = np.stack([w.real, w.imag], axis=1)
        np.testing.assert_allclose(area, signed_areas(F, uv) / 2, atol=1e-12)
        np.testing.assert_allclose(mesh.m * (np.abs(p) ** 2 - np.abs(q) ** 2), area, atol=1e-10)


def test_corrected_triangles():
    """§F.1: no angle is below π/8, good triangles are only rescaled, degenerate ones are repaired."""
    V = np.array([[0, 0, 0], [1, 0, 0], [0.5, 1e-9, 0], [0.5, 1, 0], [0.5, 1, 0], [2, 0, 0]])
    F = np.array([[0, 1, 2], [0, 1, 3], [1, 3, 4], [0, 1, 5]])
    mesh = ReferenceMesh(V, F, "corrected")
    assert np.all(np.isfinite(mesh.gamma))
    # |γᵢ| is the opposite side over 2m; the angles follow from the sides.
    lengths = np.abs(mesh.gamma) * 2 * mesh.m
    cosines = [
        (lengths[i - 1] ** 2 + lengths[i - 2] ** 2 - lengths[i] ** 2) / (2 * lengths[i - 1] * lengths[i - 2])
        for i in range(3)
    ]
    angles = np.arccos(cosines)
    assert angles.min() >= np.pi / 8 - 1e-12
    np.testing.assert_allclose(np.sort(angles[:, 0]), np.array([1, 1, 6]) * np.pi / 8, atol=1e-7)
    np.testing.assert_allclose(angles[:, 1], np.arccos([1 / np.sqrt(5)] * 2 + [0.6]), atol=1e-12)
    np.testing.assert_allclose(angles[:, 2], np.pi / 3, atol=1e-12)


def test_stiffness_does_not_depend_on_scale():
    V, F = random_delaunay(60, seed=1)
    a = TANH.field(random_xi(F)).entries()
    small, large = (ReferenceMesh(V * scale, F, "rest").edge_stiffness(a) for scale in (1e-150, 1e150))
    np.testing.assert_allclose(small, large, rtol=1e-12)


def test_bend_is_injective():
    """The smooth map `bend` of the tests has the properties they rely on."""
    V, F = random_delaunay(400, seed=0)
    assert signed_areas(F, bend(V)).min() > 0
    assert lift(V).shape == (len(V), 3)
