"""Every backend against dense algebra, and against matrices that are not positive definite."""

from __future__ import annotations

import numpy as np
import pytest
import scipy.sparse as sp

from quasiharmonic.linsolve import (
    NotPositiveDefinite,
    make_solver,
)
from shared.matrices import ALL, OTHER_SIZES, backend_of, both, diagonal, solve, solver_for, stiffness, upper


@pytest.fixture(params=(*ALL, *OTHER_SIZES))
def name(request, monkeypatch):
    return backend_of(request.param, monkeypatch)


# --- correct solutions ------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("side", [1, 2, 5, 20])
@pytest.mark.parametrize("columns", [None, 1, 2, 5])
def test_agrees_with_dense_algebra(name, side, columns):
    A = stiffness(side)
    rhs = np.random.default_rng(1).standard_normal((side * side,) if columns is None else (side * side, columns))
    x = solve(A, rhs, name)
    assert x.shape == rhs.shape
    assert x.dtype == np.float64
    np.testing.assert_allclose(x, np.linalg.solve(both(A).toarray(), rhs), rtol=1e-10, atol=1e-12)


def test_high_contrast(name):
    A = stiffness(20, contrast=6.0)
    rhs = both(A) @ np.ones(400)
    np.testing.assert_allclose(solve(A, rhs, name), 1, rtol=1e-4)


def test_new_values_on_the_same_pattern(name):
    with solver_for(stiffness(12), name) as solver:
        assert solver.name == name
        for seed in range(5):
            A = stiffness(12, seed=seed, contrast=0.5 * seed)
            solver.factor(A.data)
            for columns in (1, 3):
                rhs = np.random.default_rng(seed).standard_normal((144, columns))
                np.testing.assert_allclose(both(A) @ solver.solve(rhs), rhs, rtol=0, atol=1e-9)


def test_the_callers_arrays_are_neither_stored_nor_changed(name):
    A = stiffness(10)
    indptr, indices, values = A.indptr.copy(), A.indices.copy(), A.data.copy()
    solver = make_solver(indptr, indices, name=name)
    solver.factor(values)
    indptr[:], indices[:], values[:] = 7, 7, np.nan
    rhs = np.arange(200.0).reshape(100, 2)
    before = rhs.copy()
    x = solver.solve(rhs)
    np.testing.assert_array_equal(rhs, before)
    assert not np.shares_memory(x, rhs)
    np.testing.assert_allclose(both(A) @ x, rhs, rtol=0, atol=1e-10)
    kept = x.copy()
    solver.solve(-rhs)
    np.testing.assert_array_equal(x, kept)


def test_any_layout_and_dtype_of_input(name):
    A = stiffness(10)
    rounded = sp.csr_array((A.data.astype(np.float32), A.indices, A.indptr), shape=A.shape)
    solver = make_solver(A.indptr.astype(np.uint64), A.indices.tolist(), name=name)
    solver.factor(np.repeat(rounded.data, 2)[::2])
    wide = np.random.default_rng(0).integers(-9, 9, (100, 6))
    for rhs in (wide, wide[:, ::2], wide[::-1], np.asfortranarray(wide), wide.astype(np.float32), wide[:, 3]):
        np.testing.assert_allclose(both(rounded) @ solver.solve(rhs), rhs, rtol=0, atol=1e-10)


def test_uncoupled_unknowns(name):
    A = upper(
        sp.block_diag([both(stiffness(4)), sp.csr_array(sp.eye(3)) * 5, both(stiffness(6, seed=2))], format="csr")
    )
    rhs = np.random.default_rng(0).standard_normal((A.shape[0], 2))
    np.testing.assert_allclose(both(A) @ solve(A, rhs, name), rhs, rtol=0, atol=1e-11)


def test_zero_unknowns_and_one_unknown(name):
    with make_solver([0], [], name=name) as none:
        none.factor([])
        assert none.solve(np.zeros(0)).shape == (0,)
        assert none.solve(np.zeros((0, 2))).shape == (0, 2)
    with make_solver([0, 1], [0], name=name) as one:
        one.factor([4.0])
        assert one.solve([2.0]).tolist() == [0.5]
        assert one.solve([[2.0, 4.0]]).tolist() == [[0.5, 1.0]]
        assert one.solve(np.zeros((1, 0))).shape == (1, 0)
        with pytest.raises(NotPositiveDefinite, match="diagonal entry 0 is 0"):
            one.factor([0.0])


def test_zero_right_hand_sides(name):
    A = stiffness(5)
    rhs = np.zeros((25, 3))
    rhs[:, 1] = 1
    x = solve(A, rhs, name)
    assert not x[:, [0, 2]].any()
    np.testing.assert_allclose(both(A) @ x, rhs, atol=1e-12)


def test_explicit_zeros_in_the_pattern(name):
    A = stiffness(8)
    solver = solver_for(A, name)
    A.data[np.flatnonzero(A.indices != np.repeat(np.arange(64), np.diff(A.indptr)))[::3]] = 0
    rhs = np.ones(64)
    solver.factor(A.data)
    np.testing.assert_allclose(both(A) @ solver.solve(rhs), rhs, rtol=0, atol=1e-11)


@pytest.mark.parametrize("decades", [3, 10, 60])
def test_diagonal_scaling_changes_nothing(name, decades):
    A = stiffness(12, contrast=1.0)
    scale = 2.0 ** np.round(np.random.default_rng(3).uniform(-decades, decades, 144) * np.log2(10))
    scaled = upper(diagonal(scale) @ both(A) @ diagonal(scale))
    rhs = np.random.default_rng(4).standard_normal((144, 2))
    x = solve(scaled, scale[:, None] * rhs, name)
    np.testing.assert_allclose(scale[:, None] * x, solve(A, rhs, name), rtol=1e-11, atol=1e-13)


@pytest.mark.parametrize("factor", [1e-200, 1e-20, 1e20, 1e200])
def test_units_do_not_matter(name, factor):
    A = stiffness(10)
    rhs = np.random.default_rng(0).standard_normal((100, 2)) * [1, 1e-9]
    expected = solve(A, rhs, name)
    A.data *= factor
    np.testing.assert_allclose(solve(A, rhs, name) * factor, expected, rtol=1e-9, atol=0)
    np.testing.assert_allclose(solve(A, rhs * factor, name), expected, rtol=1e-9, atol=0)


def test_solutions_are_deterministic(name):
    A = stiffness(40, contrast=2.0)
    rhs = np.random.default_rng(0).standard_normal((1600, 2))
    first, second = solver_for(A, name), solver_for(A, name)
    results = []
    for solver in (first, second, first):
        solver.factor(A.data)
        results.append(solver.solve(rhs))
    np.testing.assert_array_equal(results[0], results[1])
    np.testing.assert_array_equal(results[0], results[2])


def test_unknowns_in_a_good_order(name):
    A = stiffness(20)
    smallest = np.linalg.eigvalsh(both(A).toarray())[0]
    rng = np.random.default_rng(0)
    with solver_for(A, name, ordered=True) as solver:
        for columns in [(), (1,), (2,), (5,)]:
            solver.factor(A.data)
            rhs = rng.standard_normal((400, *columns))
            np.testing.assert_allclose(both(A) @ solver.solve(rhs), rhs, rtol=0, atol=1e-10)
            indefinite = A.data.copy()
            indefinite[A.indptr[:-1]] -= 1.5 * smallest
            with pytest.raises(NotPositiveDefinite, match="not positive definite"):
                solver.factor(indefinite)


def test_semidefinite_matrices_are_solved_and_singular_ones_found(name):
    """Without the test of pivots, the residual shows that a matrix is singular."""
    A = stiffness(20)
    rhs = np.random.default_rng(0).standard_normal(400)
    with solver_for(A, name, semidefinite=True) as solver:
        solver.factor(A.data)
        np.testing.assert_array_equal(solver.solve(rhs), solve(A, rhs, name))
        whole = both(A)
        singular = A.data.copy()
        singular[A.indptr[:-1]] -= whole.sum(axis=1)

        def solve_singular():
            solver.factor(singular)
            solver.solve(rhs)

        with pytest.raises(NotPositiveDefinite, match=r"not (numerically )?positive definite"):
            solve_singular()
