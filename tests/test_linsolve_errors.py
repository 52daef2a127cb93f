"""Linear solvers: indefinite and broken matrices, wrong solutions, order of calls, threads and memory."""

from __future__ import annotations

import subprocess
import sys
import threading
from concurrent.futures import ThreadPoolExecutor
from functools import cache

import numpy as np
import pytest
import scipy.sparse as sp
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from quasiharmonic.linsolve import (
    NotPositiveDefinite,
    make_solver,
)
from shared.matrices import ALL, OTHER_SIZES, backend_of, both, diagonal, solve, solver_for, stiffness, upper


@pytest.fixture(params=(*ALL, *OTHER_SIZES))
def name(request, monkeypatch):
    return backend_of(request.param, monkeypatch)


@cache
def smallest_eigenvalue(side):
    return np.linalg.eigvalsh(both(stiffness(side)).toarray())[0]


def dense(matrix):
    """Return a symmetric dense matrix as a full upper triangle, including zeros."""
    n = len(matrix)
    rows, columns = np.triu_indices(n)
    return sp.csr_array((matrix[rows, columns], columns, np.r_[0, np.cumsum(np.arange(n, 0, -1))]), shape=(n, n))


# ---- matrices that are not positive definite ----------------------------------------------------------------------


@pytest.mark.slow
@settings(max_examples=25, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(
    n=st.integers(1, 30),
    negative=st.integers(0, 3),
    smallest=st.floats(-6, 0),
    seed=st.integers(0, 2**32 - 1),
)
def test_inertia_decides(name, n, negative, smallest, seed):
    rng = np.random.default_rng(seed)
    Q, _ = np.linalg.qr(rng.standard_normal((n, n)))
    eigenvalues = 10 ** rng.uniform(smallest, 0, n)
    eigenvalues[: min(negative, n)] *= -1
    A = dense((Q * eigenvalues) @ Q.T)
    rhs = rng.standard_normal(n)
    if negative:
        with pytest.raises(NotPositiveDefinite):
            solver_for(A, name).factor(A.data)
    else:
        np.testing.assert_allclose(both(A) @ solve(A, rhs, name), rhs, rtol=0, atol=1e-7)


@pytest.mark.parametrize("share", [1e-3, 0.5, 1.5])
def test_an_indefinite_matrix_is_reported_and_the_next_one_is_solved(name, share):
    A = stiffness(15)
    smallest = smallest_eigenvalue(15)
    shifted = A.copy()
    shifted.data[A.indptr[:-1]] -= smallest * (1 + share)
    with solver_for(A, name) as solver:
        for _ in range(2):
            with pytest.raises(NotPositiveDefinite, match="not positive definite"):
                solver.factor(shifted.data)
            with pytest.raises(RuntimeError, match="was not called or failed"):
                solver.solve(np.ones(225))
            solver.factor(A.data)
            np.testing.assert_allclose(both(A) @ solver.solve(np.ones(225)), 1, rtol=1e-10)


@pytest.mark.parametrize("decades", [10, 60])
def test_an_indefinite_matrix_of_any_scaling_is_reported(name, decades):
    A = stiffness(12)
    smallest = smallest_eigenvalue(12)
    scale = 2.0 ** np.round(np.random.default_rng(5).uniform(-decades, decades, 144) * np.log2(10))
    for share, definite in [(0.5, True), (1.5, False)]:
        shifted = A.copy()
        shifted.data[A.indptr[:-1]] -= share * smallest
        scaled = upper(diagonal(scale) @ both(shifted) @ diagonal(scale))
        with solver_for(scaled, name) as solver:
            if definite:
                solver.factor(scaled.data)
            else:
                with pytest.raises(NotPositiveDefinite, match="not positive definite"):
                    solver.factor(scaled.data)


@pytest.mark.parametrize("contrast", [0.0, 3.0])
@pytest.mark.parametrize("side", [3, 20])
def test_a_semidefinite_matrix_is_reported(name, side, contrast):
    A = stiffness(side, contrast=contrast, boundary=True)
    with pytest.raises(NotPositiveDefinite):
        solve(A, np.random.default_rng(0).random((A.shape[0], 2)), name)


def test_exactly_singular(name):
    path = dense(np.array([[1.0, -1, 0], [-1, 2, -1], [0, -1, 1]]))
    with pytest.raises(NotPositiveDefinite):
        solve(path, [1.0, 2, 4], name)
    pair = dense(np.array([[0.0, 1], [1, 0]]))
    with pytest.raises(NotPositiveDefinite, match="diagonal entry 0 is 0"):
        solver_for(pair, name).factor(pair.data)


@pytest.mark.parametrize("bad", [np.nan, np.inf, -np.inf, -1.0, 0.0])
@pytest.mark.parametrize("where", ["first", "middle", "last"])
def test_bad_diagonal_entries(name, bad, where):
    A = stiffness(6)
    row = {"first": 0, "middle": 17, "last": 35}[where]
    A.data[A.indptr[row]] = bad
    expected = "NaN or too large" if bad == np.inf else f"diagonal entry {row} is {bad:g}"
    with pytest.raises(NotPositiveDefinite, match=expected):
        solver_for(A, name).factor(A.data)


@pytest.mark.parametrize("bad", [np.nan, np.inf, -np.inf, 1e308])
def test_bad_entries_off_the_diagonal(name, bad):
    A = stiffness(6)
    A.data[A.indptr[17] + 1] = bad
    with pytest.raises(NotPositiveDefinite, match="not positive definite"):
        solver_for(A, name).factor(A.data)


@pytest.mark.parametrize("bad", [np.nan, np.inf])
def test_bad_right_hand_sides(name, bad):
    A = stiffness(6)
    rhs = np.ones((36, 2))
    rhs[20, 1] = bad
    with pytest.raises(NotPositiveDefinite, match="the right-hand side has NaN or infinite entries"):
        solve(A, rhs, name)


# ---- the residual test --------------------------------------------------------------------------------------------


def broken(damage, name="superlu"):
    """Return a solver whose solutions go through `damage`, and the list of its calls."""
    A, calls = stiffness(15), []

    class Damaged(type(solver_for(A, name))):
        def _solve(self, b):
            calls.append(b)
            return damage(super()._solve(b))

    solver = Damaged(A.indptr, A.indices)
    solver.factor(A.data)
    return A, solver, calls


def one_wrong_entry(x):
    x[100, -1] += 1e-2 * np.abs(x[:, -1]).max()
    return x


@pytest.mark.parametrize(
    "damage",
    [
        np.zeros_like,
        np.negative,
        lambda x: np.full_like(x, np.nan),
        lambda x: np.full_like(x, np.inf),
        lambda x: 1e30 * x,
        lambda x: x[::-1],
        lambda x: x + np.random.default_rng(0).standard_normal(x.shape) * np.abs(x).max(),
        one_wrong_entry,
    ],
)
@pytest.mark.parametrize("unit", [1.0, 1e-30, 1e180])
def test_a_wrong_solution_is_not_returned(damage, unit):
    _, solver, calls = broken(damage)
    rhs = np.random.default_rng(1).standard_normal((225, 2)) * [1, unit]
    with pytest.raises(NotPositiveDefinite, match=r"not numerically positive definite: the residual .* superlu"):
        solver.solve(rhs)
    assert len(calls) == 2, "one step of refinement, and no more"


def test_an_inaccurate_solution_is_refined():
    A, solver, calls = broken(lambda x: x * (1 + 1e-6))
    rhs = np.random.default_rng(1).standard_normal((225, 2))
    np.testing.assert_allclose(both(A) @ solver.solve(rhs), rhs, rtol=0, atol=1e-9)
    assert len(calls) == 2


def test_solutions_of_every_backend_are_checked(name):
    """Solutions wrong in one entry, also at the second attempt, are rejected; inaccurate ones are refined."""
    rhs = np.random.default_rng(1).standard_normal((225, 2))
    _, wrong, _ = broken(one_wrong_entry, name)
    with wrong, pytest.raises(NotPositiveDefinite, match="not numerically positive definite"):
        wrong.solve(rhs)
    A, inaccurate, calls = broken(lambda x: x * (1 + 1e-6), name)
    with inaccurate:
        np.testing.assert_allclose(both(A) @ inaccurate.solve(rhs), rhs, rtol=0, atol=1e-9)
    assert len(calls) == 2


def test_a_correct_solution_is_not_changed():
    _, solver, calls = broken(lambda x: x)
    solver.solve(np.random.default_rng(1).standard_normal((225, 3)))
    assert len(calls) == 1


# --- use of a solver --------------------------------------------------------------------------------------------------


def test_order_of_calls(name):
    A = stiffness(4)
    solver = solver_for(A, name)
    with pytest.raises(RuntimeError, match=r"factor\(\) was not called"):
        solver.solve(np.ones(16))
    solver.factor(A.data)
    with pytest.raises(ValueError, match=r"values has shape \(5,\); the analysed pattern has 49 entries"):
        solver.factor(np.ones(5))
    for shape in [(15,), (15, 2), (2, 16), (), (16, 1, 1)]:
        with pytest.raises(ValueError, match=r"expected \(16,\) or \(16, k\)"):
            solver.solve(np.ones(shape))
    solver.solve(np.ones(16))
    solver.close()
    solver.close()
    with pytest.raises(ValueError, match="the solver is closed"):
        solver.solve(np.ones(16))
    with pytest.raises(ValueError, match="the solver is closed"):
        solver.factor(A.data)


@pytest.mark.slow
def test_two_threads_with_a_solver_each(name):
    barrier = threading.Barrier(2)

    def work(seed):
        A = stiffness(25, seed=seed)
        rhs = np.random.default_rng(seed).standard_normal((625, 1 + seed))
        barrier.wait()
        worst = 0.0
        with solver_for(A, name) as solver:
            for _ in range(20):
                solver.factor(A.data)
                worst = max(worst, np.abs(both(A) @ solver.solve(rhs) - rhs).max())
        return worst

    with ThreadPoolExecutor(2) as pool:
        assert max(pool.map(work, range(2))) < 1e-10


def test_two_threads_with_one_solver(name):
    A = stiffness(25)
    rhs = np.random.default_rng(0).standard_normal((625, 8))
    with solver_for(A, name) as solver, ThreadPoolExecutor(2) as pool:
        solver.factor(A.data)
        expected = [solver.solve(column) for column in rhs.T]
        for _ in range(10):
            for x, known in zip(pool.map(solver.solve, rhs.T), expected, strict=True):
                np.testing.assert_array_equal(x, known)


_THOUSANDS = """
import os, sys
import numpy as np
from quasiharmonic.linsolve import make_solver
name, count, indptr, indices, values = sys.argv[1], int(sys.argv[2]), *map(np.load, sys.argv[3:])
rhs = np.ones((len(indptr) - 1, 2))
def work(factorisations, analyses):
    with make_solver(indptr, indices, name=name) as solver:
        for _ in range(factorisations):
            solver.factor(values)
            solver.solve(rhs)
    for _ in range(analyses):
        with make_solver(indptr, indices, name=name) as solver:
            solver.factor(values)
def megabytes():
    with open("/proc/self/statm") as file:
        return int(file.read().split()[1]) * os.sysconf("SC_PAGE_SIZE") / 2**20
work(50, 20)
before = megabytes()
work(count, count // 10)
print(megabytes() - before)
"""


@pytest.mark.long
@pytest.mark.skipif(not sys.platform.startswith("linux"), reason="reads memory from /proc")
@pytest.mark.parametrize("factorisations", [300, pytest.param(10_000, marks=pytest.mark.nightly)])
@pytest.mark.parametrize("name", ALL, indirect=True)
def test_thousands_of_factorisations_and_analyses_leak_no_memory(name, factorisations, tmp_path):
    A = stiffness(20)
    paths = [tmp_path / f"{part}.npy" for part in ("indptr", "indices", "data")]
    for path in paths:
        np.save(path, getattr(A, path.stem))
    command = [sys.executable, "-c", _THOUSANDS, name, str(factorisations), *map(str, paths)]
    run = subprocess.run(command, capture_output=True, text=True, check=True)
    # One leaked factor each would be three hundred megabytes for ten thousand, nine for three hundred.
    assert float(run.stdout) < 4


# ---- patterns ------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("indptr", "indices", "message"),
    [
        ([], [], "indptr must be one-dimensional"),
        ([1, 2], [0, 0], "start with 0"),
        ([0, 2], [0], "end with the number of indices"),
        ([[0, 1]], [0], "one-dimensional"),
        ([0, 1, 1], [0], "row 1 has no entries"),
        ([0, 1, 2], [0, 0], "row 1 does not start with its diagonal entry"),
        ([0, 2, 3], [1, 0, 1], "row 0 does not start with its diagonal entry"),
        ([0, 3, 4, 5], [0, 2, 1, 1, 2], "ascending within each row"),
        ([0, 2, 3], [0, 0, 1], "ascending within each row"),
        ([0, 2, 3], [0, 5, 1], "smaller than the number of rows"),
        ([0, 2, 3], [0, 2**32 + 1, 1], "smaller than the number of rows"),
    ],
)
def test_malformed_patterns(indptr, indices, message):
    with pytest.raises(ValueError, match=message):
        make_solver(indptr, indices)
