"""Matrices and right-hand sides for the tests of linear solvers."""

from __future__ import annotations

import os

import numpy as np
import pytest
import scipy.sparse as sp

from quasiharmonic.linsolve import (
    BACKENDS,
    available,
    make_solver,
    mkl,
    packages,
    rslab,
)

ALL = tuple(BACKENDS)
# Run the code for other matrix sizes on small matrices.
OTHER_SIZES = {
    "mkl for large": (mkl, "SEQUENTIAL_BELOW"),
    "mkl padded": (mkl, "PAD_FROM"),
    "cholmod for large": (packages, "SIMPLICIAL_BELOW"),
    "rslab for large": (rslab, "SEQUENTIAL_BELOW"),
}


def backend_of(case, monkeypatch):
    """Return the backend of one of `ALL` and `OTHER_SIZES`, set up for it; skip the test if it is not installed."""
    backend = case.split()[0]
    if backend not in available():
        pytest.skip(f"the library behind {backend} is not installed")
    if case in OTHER_SIZES:
        monkeypatch.setattr(*OTHER_SIZES[case], 0)
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


def solver_for(triangle, name, **options):
    return make_solver(triangle.indptr, triangle.indices, name=name, **options)


def solve(triangle, rhs, name):
    with solver_for(triangle, name) as solver:
        solver.factor(triangle.data)
        return solver.solve(rhs)


# Tests use one thread (conftest.py) unless they test threads.
UNLIMITED = {key: value for key, value in os.environ.items() if not key.endswith("_NUM_THREADS")}
