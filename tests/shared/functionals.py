"""Problems for the tests of functionals."""

from __future__ import annotations

import numpy as np

from quasiharmonic import Problem
from quasiharmonic.geometry.mesh.reference import operators
from quasiharmonic.solver.field.functionals import FUNCTIONALS
from shared.meshes import bend, boundary_of, surfaces

MESHES = surfaces()


NAMES = list(FUNCTIONALS)


SIGHTED = [name for name in NAMES if FUNCTIONALS[name].sees_positions]


def posed(V, F, pins=0, noise=0.0, seed=0):
    """Place the boundary (and pins) by `bend`, with some noise."""
    boundary = boundary_of(F)
    rng = np.random.default_rng(seed)
    inner = np.setdiff1d(np.arange(len(V)), boundary)
    fixed = np.concatenate([boundary, rng.choice(inner, pins, replace=False)])
    target = bend(V[fixed, :2])
    return Problem(V, F, fixed, target + noise * rng.standard_normal(target.shape))


def matrices(problem, iterate, reference="equilateral"):
    """Return dense L, D, pseudo-inverse and Neumann data of an iterate, by the paper's definitions."""
    op = operators(problem.V, problem.F, reference)
    L = op.laplacian(iterate.field.entries().T).toarray()
    return L, op.D.toarray(), np.linalg.pinv(L, hermitian=True)
