"""Problems with a curved surface, and the objective of `harmonise` as the library constructs it."""

from __future__ import annotations

import numpy as np

from quasiharmonic import (
    Problem,
    boundary_loops,
    certify,
    quasi_harmonic_map,
)
from quasiharmonic.energies.deformation import DeformationEnergy, signed_areas
from quasiharmonic.solver.field.objective import Objective
from quasiharmonic.solver.search.harmonic_descent import Conformal, Harmonised
from quasiharmonic.surfaces import grid, random_delaunay
from quasiharmonic.targets import arc_length
from shared.meshes import bend, boundary_of, lift


def bowl(n=80):
    """A curved disk, a map of it, and its boundary."""
    V, F = random_delaunay(n, seed=3)
    return lift(V), F, bend(V), boundary_of(F)


def folded():
    """A square mapped to an L, and its Tutte embedding, which has inverted triangles at the corner."""
    V, F = grid(14, 14, alternating=True)
    (loop,) = boundary_loops(F, len(V))
    outline = np.array([[0, 0], [3, 0], [3, 1], [1, 1], [1, 3], [0, 3.0]])
    problem = Problem(V, F, loop, arc_length(V[loop], outline))
    uv = quasi_harmonic_map(problem)
    assert certify(F, uv).inverted.size
    return problem, uv


def objective_of(V, F, uv, fixed, energy, *, eta=0.3, conformal=0.2, weights=None, reference="rest", sigmoid="tanh"):
    """Return Q as the library constructs it."""
    problem = Problem(V, F, fixed, uv[fixed])
    objective = Objective(problem, "dirichlet", sigmoid, reference)
    area = float(signed_areas(F, problem.frame.inward(uv)).sum())
    deformation = None if energy is None else DeformationEnergy(V, F, energy, area=area, weights=weights)
    regulariser = Conformal(objective.mesh.m / objective.mesh.m.sum())
    return objective.with_functional(
        Harmonised(problem, objective.mesh, area, deformation, regulariser, eta=eta, conformal=conformal)
    )


def energies_of(result):
    return np.array([step.energy for step in result.history])
