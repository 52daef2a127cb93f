"""Every backend against dense algebra, and against matrices that are not positive definite."""

from __future__ import annotations

import gc
import os
import re
import subprocess
import sys
import threading
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import numpy as np
import pytest
import scipy.sparse as sp
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from quasiharmonic.linsolve import (
    BACKENDS,
    QDLDL_UP_TO,
    NotPositiveDefinite,
    available,
    cholmod,
    make_solver,
    mkl,
    qdldl,
    rslab,
    superlu,
)
from quasiharmonic.linsolve.dissection import nested_dissection

ALL = tuple(BACKENDS)


# Run the code for other matrix sizes on small matrices.
OTHER_SIZES = {
    "mkl for large": (mkl, "SEQUENTIAL_BELOW"),
    "mkl padded": (mkl, "PAD_FROM"),
    "cholmod for large": (cholmod, "SIMPLICIAL_BELOW"),
    "rslab for large": (rslab, "SEQUENTIAL_BELOW"),
}


@pytest.fixture(params=(*ALL, *OTHER_SIZES))
def name(request, monkeypatch):
    backend = request.param.split()[0]
    if backend not in available():
        pytest.skip(f"the library behind {backend} is not installed")
    if request.param in OTHER_SIZES:
        monkeypatch.setattr(*OTHER_SIZES[request.param], 0)
    return backend


def stiffness(side, seed=0, contrast=1.0, boundary=False):
    """Return a P1 stiffness matrix with a random tensor of determinant one per triangle, on a grid.

    The grid has side² interior vertices. With `boundary` the outer ring is included, so that constants are in the null
    space.
    """
    rng = np.random.default_rng(seed)
    m = side + 2
    ids = np.arange(m * m).reshape(m, m)
    a, b, c, d = ids[:-1, :-1].ravel(), ids[1:, :-1].ravel(), ids[1:, 1:].ravel(), ids[:-1, 1:].ravel()
    F = np.vstack([np.column_stack([a, b, c]), np.column_stack([a, c, d])])
    grid = np.stack(np.meshgrid(np.arange(m), np.arange(m), indexing="ij"), -1).reshape(-1, 2)
    P = grid + 0.2 * rng.uniform(-1, 1, (m * m, 2))
    E = np.stack([P[F[:, 1]] - P[F[:, 0]], P[F[:, 2]] - P[F[:, 0]]], axis=1)
    g = np.linalg.inv(E)
    G = np.concatenate([-g.sum(axis=2, keepdims=True), g], axis=2)
    rho, theta = contrast * rng.random(len(F)), rng.uniform(0, 2 * np.pi, len(F))
    cosh, sinh = np.cosh(2 * rho), np.sinh(2 * rho)
    A = np.empty((len(F), 2, 2))
    A[:, 0, 0], A[:, 1, 1] = cosh - sinh * np.cos(theta), cosh + sinh * np.cos(theta)
    A[:, 0, 1] = A[:, 1, 0] = -sinh * np.sin(theta)
    K = np.einsum("fai,fab,fbj->fij", G, A, G) * np.abs(np.linalg.det(E))[:, None, None]
    full = sp.coo_array((K.ravel(), (np.repeat(F, 3, axis=1).ravel(), np.tile(F, 3).ravel())), shape=(m * m, m * m))
    full = full.tocsr()
    if not boundary:
        inner = ids[1:-1, 1:-1].ravel()
        full = full[inner][:, inner]
    return upper(full)


def upper(matrix):
    triangle = sp.csr_array(sp.triu(matrix, format="csr"))
    triangle.sort_indices()
    return triangle


def diagonal(entries):
    return sp.csr_array(sp.diags(entries))


def both(triangle):
    return triangle + sp.triu(triangle, 1).T


def dense(matrix):
    """Return a symmetric dense matrix as a full upper triangle, including zeros."""
    n = len(matrix)
    rows, columns = np.triu_indices(n)
    return sp.csr_array((matrix[rows, columns], columns, np.r_[0, np.cumsum(np.arange(n, 0, -1))]), shape=(n, n))


def solver_for(triangle, name, **options):
    return make_solver(triangle.indptr, triangle.indices, name=name, **options)


def solve(triangle, rhs, name):
    with solver_for(triangle, name) as solver:
        solver.factor(triangle.data)
        return solver.solve(rhs)


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


# ---- matrices that are not positive definite ----------------------------------------------------------------------


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
    smallest = np.linalg.eigvalsh(both(A).toarray())[0]
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
    smallest = np.linalg.eigvalsh(both(A).toarray())[0]
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


# Tests use one thread (conftest.py) unless they test threads.
UNLIMITED = {key: value for key, value in os.environ.items() if not key.endswith("_NUM_THREADS")}

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
work(100, 100)
before = megabytes()
work(count, count // 10)
print(megabytes() - before)
"""


@pytest.mark.slow
@pytest.mark.skipif(not sys.platform.startswith("linux"), reason="reads memory from /proc")
@pytest.mark.parametrize("factorisations", [1_000, pytest.param(10_000, marks=pytest.mark.nightly)])
def test_thousands_of_factorisations_and_analyses_leak_no_memory(name, factorisations, tmp_path):
    A = stiffness(20)
    paths = [tmp_path / f"{part}.npy" for part in ("indptr", "indices", "data")]
    for path in paths:
        np.save(path, getattr(A, path.stem))
    command = [sys.executable, "-c", _THOUSANDS, name, str(factorisations), *map(str, paths)]
    run = subprocess.run(command, capture_output=True, text=True, check=True)
    # One leaked factor each would be three hundred megabytes for ten thousand, thirty for one thousand.
    assert float(run.stdout) < 4


# ---- patterns and names -------------------------------------------------------------------------------------------


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


def test_unknown_name():
    with pytest.raises(ValueError, match=r"unknown linear solver 'umfpack'.*'auto', 'mkl'.*available: .*superlu"):
        make_solver([0, 1], [0], name="umfpack")


@pytest.mark.parametrize(
    ("backend", "command"),
    [
        (mkl.MKL, "pip install mkl"),
        (cholmod.Cholmod, "pip install scikit-sparse"),
        (qdldl.Qdldl, "pip install qdldl"),
        (rslab.Rslab, "pip install rslab"),
    ],
)
def test_a_backend_that_is_not_installed(monkeypatch, backend, command):
    monkeypatch.setattr(backend, "present", classmethod(lambda cls: False))
    assert backend.name not in available()
    with pytest.raises(ImportError, match=f"'{backend.name}' is not installed; available: .*superlu.*: {command}"):
        make_solver([0, 1], [0], name=backend.name)
    assert make_solver([0, 1], [0]).name != backend.name


def test_auto_uses_the_first_backend_that_loads(monkeypatch):
    def fail(self, *pattern, **ordered):
        raise ImportError("undefined symbol")

    left = list(available(1))
    assert left[-1] == "superlu"
    for expected in left[:-1]:
        solver = make_solver([0, 1], [0])
        assert solver.name == expected
        monkeypatch.setattr(type(solver), "__init__", fail)
        with pytest.raises(ImportError, match="undefined symbol"):
            make_solver([0, 1], [0], name=expected)
    assert make_solver([0, 1], [0]).name == "superlu"


def test_preference_depends_on_the_number_of_entries(monkeypatch):
    for backend in (mkl.MKL, cholmod.Cholmod, rslab.Rslab, qdldl.Qdldl):
        monkeypatch.setattr(backend, "present", classmethod(lambda cls: True))
    assert available() == available(QDLDL_UP_TO + 1) == ALL == ("mkl", "cholmod", "rslab", "qdldl", "superlu")
    assert available(QDLDL_UP_TO) == ("mkl", "cholmod", "qdldl", "rslab", "superlu")
    monkeypatch.setattr(qdldl.Qdldl, "present", classmethod(lambda cls: False))
    assert available(1) == ("mkl", "cholmod", "rslab", "superlu")


def test_import_loads_no_backend():
    code = (
        "import sys, quasiharmonic.linsolve as l; l.available(); "
        "print([m for m in ('scipy', 'qdldl', 'rslab', 'sksparse') if m in sys.modules])"
    )
    run = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert run.stdout.strip() == "[]"


# ---- rslab --------------------------------------------------------------------------------------------------------

needs_rslab = pytest.mark.skipif(not rslab.Rslab.present(), reason="rslab is not installed")


class Panic(BaseException):
    """A failed assertion in Rust appears like this."""


Panic.__name__ = "PanicException"


@pytest.fixture
def damaged(monkeypatch):
    """Make rslab's symbolic and numeric objects fail in a given way."""
    if not rslab.Rslab.present():
        pytest.skip("rslab is not installed")
    library = rslab.library()
    analyze = library.analyze

    class Stub:
        def __init__(self, of, **instead):
            self.of, self.instead = of, instead

        def __getattr__(self, name):
            return self.instead.get(name, getattr(self.of, name))

    def damage(**instead):
        def analysed(*pattern, **settings):
            if "analyze" in instead:
                return instead["analyze"]()
            symbolic = analyze(*pattern, **settings)
            return Stub(symbolic, factor=instead.get("factor", lambda data: Stub(symbolic.factor(data), **instead)))

        monkeypatch.setattr(library, "analyze", analysed)

    return damage


def raising(error):
    def fail(*_):
        raise error

    return fail


@pytest.mark.parametrize("qdldl_present", [True, False])
@pytest.mark.parametrize("step", ["analyze", "factor", "solve", "solve_many"])
@pytest.mark.parametrize("error", [RuntimeError("index out of bounds"), Panic("called `unwrap`")])
def test_another_backend_replaces_rslab_on_failure(damaged, monkeypatch, step, error, qdldl_present):
    if not qdldl_present:
        monkeypatch.setattr(qdldl.Qdldl, "present", classmethod(lambda cls: False))
    damaged(**{step: raising(error)})
    A = stiffness(12)
    rng = np.random.default_rng(0)
    with solver_for(A, "rslab") as solver:
        for _ in range(2):
            solver.factor(A.data)
            for columns in [(), (1,), (3,), ()]:
                rhs = rng.standard_normal((144, *columns))
                np.testing.assert_allclose(both(A) @ solver.solve(rhs), rhs, rtol=0, atol=1e-10)
        indefinite = A.data.copy()
        indefinite[A.indptr[:-1]] *= 0.5
        with pytest.raises(NotPositiveDefinite, match="not positive definite"):
            solver.factor(indefinite)


@pytest.mark.parametrize("damage", [np.zeros_like, np.negative, lambda x: np.full_like(x, np.nan), lambda x: x[::-1]])
def test_another_backend_corrects_a_wrong_solution_of_rslab(damaged, damage):
    damaged(solve=lambda b: damage(b), solve_many=lambda b: damage(b))
    A = stiffness(12)
    with solver_for(A, "rslab") as solver:
        solver.factor(A.data)
        for rhs in (np.ones(144), np.random.default_rng(0).standard_normal((144, 2))):
            np.testing.assert_allclose(both(A) @ solver.solve(rhs), rhs, rtol=0, atol=1e-10)


def test_each_solve_reports_that_the_replacement_failed_too(damaged, monkeypatch):
    """After the first failure the solver must not be without a factor, or the next solve would blame the caller."""
    damaged(solve=np.zeros_like)
    A = stiffness(4)
    with solver_for(A, "rslab") as solver:
        solver.factor(A.data)
        with monkeypatch.context() as during:
            for other in (qdldl.Qdldl, superlu.SuperLU):
                during.setattr(other, "factor", raising(NotPositiveDefinite("singular")))
            for _ in range(2):
                with pytest.raises(NotPositiveDefinite, match="singular"):
                    solver.solve(np.ones(16))
        np.testing.assert_allclose(both(A) @ solver.solve(np.ones(16)), 1, rtol=0, atol=1e-10)


@pytest.mark.parametrize("error", [MemoryError("no memory"), KeyboardInterrupt(), ValueError("wrong length")])
def test_other_exceptions_of_rslab_are_raised(damaged, error):
    damaged(factor=raising(error))
    A = stiffness(4)
    with solver_for(A, "rslab") as solver, pytest.raises(type(error)):
        solver.factor(A.data)


@needs_rslab
def test_rslab_solves_its_own_test_cases(monkeypatch):
    """No other backend replaces it for matrices that it should handle: any scaling, and indefinite ones."""
    for other in ("Qdldl", "SuperLU"):
        monkeypatch.setattr(rslab, other, None)
    A = stiffness(20, contrast=2.0)
    for decades in (0, 10, 60):
        scale = 2.0 ** np.round(np.random.default_rng(3).uniform(-decades, decades, 400) * np.log2(10))
        scaled = upper(diagonal(scale) @ both(A) @ diagonal(scale))
        rhs = scale * np.random.default_rng(4).standard_normal(400)
        x = solve(scaled, rhs, "rslab") * scale
        np.testing.assert_allclose(both(A) @ x, rhs / scale, rtol=0, atol=1e-9)
        scaled.data[scaled.indptr[:-1]] *= 0.9
        with pytest.raises(NotPositiveDefinite, match="rslab found a pivot"):
            solver_for(scaled, "rslab").factor(scaled.data)


_BITS = """
import sys
import numpy as np
from quasiharmonic.linsolve import make_solver
indptr, indices, data, rhs = (np.load(f"{part}.npy") for part in ("indptr", "indices", "data", "rhs"))
with make_solver(indptr, indices, name="rslab") as solver:
    solver.factor(data)
    np.save(sys.argv[1], solver.solve(rhs))
"""


@pytest.mark.slow
@needs_rslab
def test_rslab_gives_the_same_bits_on_any_number_of_threads(tmp_path):
    A = stiffness(180, contrast=1.0)
    assert A.shape[0] >= rslab.SEQUENTIAL_BELOW
    for part in ("indptr", "indices", "data"):
        np.save(tmp_path / f"{part}.npy", getattr(A, part))
    np.save(tmp_path / "rhs.npy", np.random.default_rng(0).standard_normal((A.shape[0], 2)))
    # The number of threads for solves is set once per process, at the first solve.
    for threads in ("1", "2", "3"):
        environment = UNLIMITED | {"RAYON_NUM_THREADS": threads}
        subprocess.run([sys.executable, "-c", _BITS, f"{threads}.npy"], env=environment, cwd=tmp_path, check=True)
    one, two, three = (np.load(tmp_path / f"{threads}.npy") for threads in ("1", "2", "3"))
    np.testing.assert_array_equal(one, two)
    np.testing.assert_array_equal(one, three)


# Solves with rslab in threads that end before the next one begins.
_THREADS = """
import sys, threading
import numpy as np
from quasiharmonic.linsolve import make_solver
n = 300
indptr, indices = np.append(np.arange(0, 2 * n - 1, 2), 2 * n - 1), np.append(np.repeat(np.arange(n), 2)[1:], [])
values = np.where(np.arange(2 * n - 1) % 2, -1.0, 2.0)
found = []
def solve(name="rslab"):
    with make_solver(indptr, indices.astype(int), name=name) as solver:
        solver.factor(values)
        solver.solve(np.ones(n))
        found.append(solver.name)
def one_by_one(*tasks):
    for task in tasks:
        thread = threading.Thread(target=task)
        thread.start()
        thread.join()
"""
_ENDING = {
    "threads that end": "one_by_one(*[solve] * 30)\nsolve()",
    "threads that overlap": """
barrier = threading.Barrier(3)
def solve_together():
    barrier.wait()
    solve()
for _ in range(3):
    threads = [threading.Thread(target=solve_together) for _ in range(3)]
    for thread in threads: thread.start()
    for thread in threads: thread.join()
one_by_one(*[solve] * 30)
""",
    "a second copy of the module": """
one_by_one(solve)
for name in [name for name in sys.modules if name.startswith("quasiharmonic.linsolve")]: del sys.modules[name]
from quasiharmonic.linsolve import make_solver
one_by_one(*[solve] * 30)
""",
}


def finished(code):
    """Return what a process prints that runs this code."""
    command = [sys.executable, "-W", "ignore", "-c", code]
    return subprocess.run(command, capture_output=True, text=True, check=True, timeout=600).stdout.split()


@pytest.mark.slow
@needs_rslab
@pytest.mark.parametrize("trial", _ENDING)
def test_rslab_works_after_its_first_thread_has_ended(trial):
    assert set(finished(_THREADS + _ENDING[trial] + "\nprint(*found)")) == {"rslab"}


@needs_rslab
def test_rslab_imported_by_other_code_is_not_used():
    """The thread that imported it may have ended; rslab then crashes."""
    code = """
from importlib import import_module
import quasiharmonic.linsolve
for other in ("mkl", "cholmod"): del quasiharmonic.linsolve.BACKENDS[other]
quasiharmonic.linsolve.QDLDL_UP_TO = 0
one_by_one(lambda: import_module("rslab"))
one_by_one(*[lambda: solve("auto")] * 6)
try:
    solve()
except ImportError as error:
    print(*found, error)
"""
    said = finished(_THREADS + code)
    assert " ".join(said[6:]).startswith("rslab was imported by other code before quasiharmonic used it")
    assert len(set(said[:6])) == 1
    assert said[0] in ("qdldl", "superlu")


_FORK = """
import os, signal
import numpy as np
from quasiharmonic.linsolve import make_solver
n = 300
indptr, indices = np.append(np.arange(0, 2 * n - 1, 2), 2 * n - 1), np.append(np.repeat(np.arange(n), 2)[1:], [])
values = np.where(np.arange(2 * n - 1) % 2, -1.0, 2.0)
solver = make_solver(indptr, indices.astype(int), name="rslab")
solver.factor(values)
expected = solver.solve(np.ones((n, 2)))
child = os.fork()
if child == 0:
    signal.alarm(30)
    assert np.allclose(solver.solve(np.ones((n, 2))), expected)
    solver.factor(values)
    assert np.allclose(solver.solve(np.ones((n, 2))), expected)
    fresh = make_solver(indptr, indices.astype(int), name="rslab")
    fresh.factor(values)
    assert np.allclose(fresh.solve(np.ones((n, 2))), expected)
    os._exit(0)
assert os.waitpid(child, 0)[1] == 0
"""


@needs_rslab
@pytest.mark.skipif(not hasattr(os, "fork"), reason="processes are not forked here")
def test_a_forked_process_does_not_wait_for_threads_of_its_parent():
    subprocess.run([sys.executable, "-W", "ignore", "-c", _FORK], check=True, timeout=600)


# ---- MKL ----------------------------------------------------------------------------------------------------------

needs_mkl = pytest.mark.skipif(mkl.find_mkl() is None, reason="MKL is not installed")


@needs_mkl
def test_pardiso_with_all_threads():
    A = stiffness(180, contrast=1.0)
    assert A.shape[0] >= mkl.SEQUENTIAL_BELOW
    rhs = np.random.default_rng(0).standard_normal((A.shape[0], 2))
    with solver_for(A, "mkl") as solver:
        for columns in (rhs, rhs[:, 0]):
            solver.factor(A.data)
            x = solver.solve(columns)
            np.testing.assert_allclose(both(A) @ x, columns, rtol=0, atol=1e-9)
            np.testing.assert_array_equal(x, solver.solve(columns))
        indefinite = A.data.copy()
        indefinite[A.indptr[:-1]] *= 0.9
        with pytest.raises(NotPositiveDefinite, match="PARDISO found a pivot that is not positive"):
            solver.factor(indefinite)
        solver.factor(A.data)
        solver.solve(rhs)


@needs_mkl
def test_pardiso_uses_an_order_that_is_marked_as_good():
    """Eliminating the tip of an arrow matrix first fills the whole factor."""
    n = 1000
    arrow = sp.csr_array(diagonal(np.full(n, 2.0 * n)) + sp.csr_array(np.eye(1, n).T @ np.ones((1, n))))
    megabytes = {}
    for ordered in (False, True):
        with solver_for(arrow, "mkl", ordered=ordered) as solver:
            megabytes[ordered] = solver.handle.iparm[16] / 1024
    assert megabytes[False] < 1
    assert megabytes[True] > n * n / 2 * 8 / 2**20


@needs_mkl
@pytest.mark.parametrize("ordered", [False, True])
def test_pardiso_gives_the_same_result_on_one_thread_and_two(ordered):
    A = stiffness(180, contrast=1.0)
    if ordered:
        points = np.stack(np.divmod(np.arange(A.shape[0]), 180), axis=1) * 1.0
        order = nested_dissection(points, *sp.triu(A, 1).nonzero())
        A = upper(both(A)[order][:, order])
    rng = np.random.default_rng(0)
    loads = [rng.standard_normal((A.shape[0], *columns)) for columns in [(), (1,), (2,), (3,)]]
    library = mkl.load_mkl()
    answers = []
    for threads in (1, 2):
        before = library.MKL_Set_Num_Threads_Local(threads)
        try:
            with solver_for(A, "mkl", ordered=ordered) as solver:
                solver.factor(A.data)
                answers.append([solver.solve(load) for load in loads])
        finally:
            library.MKL_Set_Num_Threads_Local(before)
    for one, two in zip(*answers, strict=True):
        np.testing.assert_allclose(two, one, rtol=0, atol=1e-11 * np.abs(one).max())


_WORKERS = """
import os, sys
import numpy as np
from quasiharmonic.linsolve import make_solver, mkl
from quasiharmonic.surfaces import grid
from quasiharmonic.linsolve.laplacian import Laplacian
mkl.load_mkl()
V, F = grid(200, 200)
rim = np.flatnonzero((V == 0).any(axis=1) | (V == 1).any(axis=1))
def solve():
    laplacian = Laplacian(F, len(V), rim, "mkl", V)
    laplacian.factor(np.full((3, len(F)), -1.0)).extend(V @ [1, 1j])
if sys.argv[1] == "limit":
    from threadpoolctl import threadpool_limits
    with threadpool_limits(1):
        solve()
else:
    solve()
print(len(os.listdir("/proc/self/task")))
"""


@pytest.mark.slow
@needs_mkl
@pytest.mark.skipif(not sys.platform.startswith("linux"), reason="counts threads by /proc")
@pytest.mark.parametrize("way", ["limit", "OMP_NUM_THREADS", "MKL_NUM_THREADS"])
def test_thread_limits_are_respected(way):
    if way == "limit":
        pytest.importorskip("threadpoolctl")
    clean = UNLIMITED | {"OPENBLAS_NUM_THREADS": "1"}  # NumPy's own solver

    def threads(**environment):
        run = subprocess.run(
            [sys.executable, "-c", _WORKERS, way], env=clean | environment, capture_output=True, text=True, check=True
        )
        return int(run.stdout)

    assert threads(**({} if way == "limit" else {way: "1"})) == 1
    if way == "MKL_NUM_THREADS":
        assert threads(MKL_NUM_THREADS="2", MKL_DYNAMIC="FALSE") > 1, "the count sees nothing"


_CHANGES = """
import numpy as np
from quasiharmonic.linsolve.laplacian import Laplacian
from quasiharmonic.linsolve import mkl
from quasiharmonic.surfaces import grid
library = mkl.load_mkl()
V, F = grid(250, 250)
rim = np.flatnonzero((V == 0).any(axis=1) | (V == 1).any(axis=1))
rng = np.random.default_rng(0)
for round in range(4):
    laplacian = Laplacian(F, len(V), rim, "mkl", V)
    for _ in range(8):
        library.MKL_Set_Num_Threads_Local(int(rng.choice([1, 2], p=[0.2, 0.8])))
        laplacian.factor(-np.exp(0.3 * rng.standard_normal((3, len(F)))))
        library.MKL_Set_Num_Threads_Local(int(rng.choice([1, 2])))
        laplacian.solver.solve(rng.standard_normal((laplacian.free.size, rng.integers(1, 4))))
"""


@pytest.mark.slow
@needs_mkl
def test_pardiso_survives_changes_of_threads_between_its_phases():
    """Many factorisations, single and several right-hand sides; the residual of every solution is checked."""
    environment = UNLIMITED | {"MKL_NUM_THREADS": "2", "MKL_DYNAMIC": "FALSE"}
    run = subprocess.run([sys.executable, "-c", _CHANGES], env=environment, capture_output=True, text=True, check=False)
    assert run.returncode == 0, run.stderr[-2000:]


_TEAM = """
import numpy as np
from quasiharmonic.linsolve.laplacian import Laplacian
from quasiharmonic.surfaces import grid
V, F = grid(200, 200)
rim = np.flatnonzero((V == 0).any(axis=1) | (V == 1).any(axis=1))
laplacian = Laplacian(F, len(V), rim, "mkl", V)
laplacian.factor(np.full((3, len(F)), -1.0)).extend(V @ [1, 1j])
print(laplacian.solver.handle.threads)
"""


@pytest.mark.slow
@needs_mkl
@pytest.mark.parametrize(
    ("name", "value", "threads"),
    [
        ("OMP_THREAD_LIMIT", "1", "1"),
        ("OMP_THREAD_LIMIT", "2", "2"),
        ("KMP_DEVICE_THREAD_LIMIT", "1", "1"),
        ("OMP_DYNAMIC", "TRUE", "1"),
        ("OMP_DYNAMIC", "false", "2"),
        ("OMP_MAX_ACTIVE_LEVELS", "0", "1"),
    ],
)
def test_pardiso_does_not_wait_for_threads_that_openmp_refuses(name, value, threads):
    environment = UNLIMITED | {"MKL_NUM_THREADS": "2", "MKL_DYNAMIC": "FALSE", name: value}
    run = subprocess.run(
        [sys.executable, "-c", _TEAM], env=environment, capture_output=True, text=True, check=True, timeout=600
    )
    assert run.stdout.split() == [threads]


@needs_mkl
def test_pardiso_does_not_change_the_number_of_threads():
    library = mkl.load_mkl()
    before = library.MKL_Set_Num_Threads_Local(0)
    try:
        library.MKL_Set_Num_Threads_Local(2)
        solve(stiffness(5), np.ones(25), "mkl")
        assert library.MKL_Set_Num_Threads_Local(0) == 2
    finally:
        library.MKL_Set_Num_Threads_Local(before)


@needs_mkl
@pytest.mark.parametrize(
    ("code", "kind", "message"),
    [
        (-2, MemoryError, "phase 22 with error -2: not enough memory"),
        (-1, RuntimeError, "phase 22 with error -1: input inconsistent"),
        (-77, RuntimeError, "phase 22 with error -77: unknown error"),
        (-4, NotPositiveDefinite, "PARDISO met a pivot"),
        (1, NotPositiveDefinite, "PARDISO met a pivot"),
    ],
)
def test_pardiso_errors(monkeypatch, code, kind, message):
    A = stiffness(4)
    solver = solver_for(A, "mkl")
    with monkeypatch.context() as patch:
        patch.setattr(solver.handle, "call", lambda *_: code)
        with pytest.raises(kind, match=message):
            solver.factor(A.data)
    solver.factor(A.data)
    solver.solve(np.ones(16))


@needs_mkl
def test_pardiso_releases_its_memory():
    A = stiffness(4)
    by_hand, forgotten = solver_for(A, "mkl"), solver_for(A, "mkl")
    handles = by_hand.handle, forgotten.handle
    by_hand.close()
    assert [bool(handle.memory.any()) for handle in handles] == [False, True]
    del forgotten
    gc.collect()
    assert not handles[1].memory.any()


@needs_mkl
def test_mkl_in_64_bit_mode_is_not_used():
    code = (
        "import os; os.environ['MKL_INTERFACE_LAYER'] = 'ILP64'\n"
        "from quasiharmonic.linsolve import make_solver\n"
        "import ctypes; from quasiharmonic.linsolve import mkl\n"
        "ctypes.CDLL(mkl.find_mkl()).MKL_Get_Max_Threads()\n"
        "s = make_solver([0, 1], [0]); s.factor([2.0]); print(s.name, s.solve([2.0]))"
    )
    run = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    solver, answer = run.stdout.split()
    assert answer == "[1.]"
    assert solver in available()
    assert solver != "mkl"


def test_files_that_are_mkl(monkeypatch, tmp_path):
    """Newer versions come before older ones; those without a number are last."""
    yes = ["libmkl_rt.so.3", "libmkl_rt.so.2", "mkl_rt.2.dll", "libmkl_rt.2.dylib", "libmkl_rt.so.1", "libmkl_rt.so"]
    yes += ["mkl_rt.dll"]
    no = ["libmkl_rt.so.3.bak", "libmkl_rt.lib", "libmkl_core.so.3", "mkl_rt.py"]
    (tmp_path / "lib").mkdir()
    for file in yes + no:
        (tmp_path / "lib" / file).touch()
    monkeypatch.setattr(mkl.sys, "prefix", str(tmp_path))
    here = [Path(path).name for path in mkl.candidates() if Path(path).parent == tmp_path / "lib"]
    assert sorted(here) == sorted(yes)
    ages = [int((re.findall(r"\d+", file) or [0])[0]) for file in here]
    assert ages == sorted(ages, reverse=True)


def test_mkl_is_found_in_environments(monkeypatch, tmp_path):
    places = {"lib": ["libmkl_rt.so.2", "libmkl_rt.so.3", "libmkl_core.so.3"], "Library/bin": ["mkl_rt.2.dll"]}
    for folder, files in places.items():
        (tmp_path / folder).mkdir(parents=True)
        for file in files:
            (tmp_path / folder / file).touch()
    monkeypatch.setattr(mkl.sys, "prefix", str(tmp_path))
    candidates = mkl.candidates()
    assert next(candidates) == str(tmp_path / "lib" / "libmkl_rt.so.3")
    monkeypatch.setattr(mkl.sys, "prefix", str(tmp_path / "nowhere"))
    monkeypatch.setattr(mkl.site, "getuserbase", lambda: str(tmp_path))
    assert next(mkl.candidates()) == str(tmp_path / "lib" / "libmkl_rt.so.3")


def test_a_library_that_does_not_load(monkeypatch, tmp_path):
    fake = tmp_path / "libmkl_rt.so.3"
    fake.write_bytes(b"not a library")
    monkeypatch.setattr(mkl, "find_mkl", lambda: str(fake))
    mkl.load_mkl.cache_clear()
    try:
        with pytest.raises(ImportError, match="cannot load"):
            mkl.load_mkl()
        assert make_solver([0, 1], [0]).name != "mkl"
        monkeypatch.setattr(mkl, "find_mkl", lambda: None)
        with pytest.raises(ImportError, match="pip install mkl"):
            mkl.load_mkl()
    finally:
        mkl.load_mkl.cache_clear()
