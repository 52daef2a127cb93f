"""Tutte's embedding of the pieces of a cut mesh, and repairs if double precision is insufficient."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from quasiharmonic.energies.deformation import signed_areas
from quasiharmonic.geometry.exact.certificate import inverted_triangles
from quasiharmonic.geometry.mesh.reference import ReferenceMesh
from quasiharmonic.linsolve import NotPositiveDefinite
from quasiharmonic.linsolve.laplacian import Laplacian
from quasiharmonic.problem import Problem
from quasiharmonic.solver.field.objective import Objective
from quasiharmonic.solver.methods import LocalRepair, RandomRestarts, Untangling
from quasiharmonic.util.arrays import ComplexArray, FloatArray, IntArray

# Number of weight updates; exponent of the areas in the weights; maximum ratio of weights in one update.
_RENEWALS, _POWER, _SPAN = 4, 0.5, 1e6
# Methods that untangle the last triangles and may also move vertices on cuts. Each is limited, because double precision
# may be insufficient.
_REPAIRS = LocalRepair(tries=30), Untangling(iterations=200), RandomRestarts(in_vain=20, tries=20)


def tutte(F: IntArray, w: ComplexArray, held: IntArray, weights: FloatArray | float = 1.0) -> ComplexArray:
    """Place every free vertex at the weighted mean of its neighbours.

    Parameters
    ----------
    F : (f, 3) int64
    w : (n,) complex128
        Positions; only those of fixed vertices are read.
    held : (k,) int64
        Fixed vertices, at least one on every component of the mesh.
    weights : (f,) float64
        Positive; the weight of an edge is the sum over its triangles.

    Returns
    -------
    (n,) complex128

    Raises
    ------
    quasiharmonic.linsolve.NotPositiveDefinite
        If the system is not positive definite after rounding.
    """
    if len(np.unique(held)) == len(w):
        return w
    alike = np.broadcast_to(np.array([[1.0], [0.0], [1.0]]), (3, len(F)))
    stiffness = ReferenceMesh(np.zeros((len(w), 2)), F, "equilateral").edge_stiffness(alike * weights)
    return Laplacian(F, len(w), held).factor(stiffness).extend(w)


def embedded(problem: Problem, w: ComplexArray, held: IntArray) -> ComplexArray:
    """Embed convex pieces into their polygons, and untangle triangles that rounding has inverted.

    Parameters
    ----------
    problem : Problem
    w : (n,) complex128
        Positions of the fixed vertices in the problem's frame.
    held : (k,) int64
        Vertices on the boundaries of pieces.

    Returns
    -------
    (n,) complex128
        The map with the fewest inverted triangles found, counted at its final positions.
    """
    best, least = w, len(problem.F) + 1
    for now in _candidates(problem, w, held):
        inverted = inverted_triangles(problem.F, problem.positions(now)).size
        if inverted < least:
            best, least = now, inverted
        if least == 0:
            break
    return best


def _candidates(problem: Problem, w: ComplexArray, held: IntArray) -> Iterator[ComplexArray]:
    """Yield embeddings with different weights, then maps from untangling the best of them."""
    weights, best, least = np.ones(len(problem.F)), w, np.inf
    for _ in range(1 + _RENEWALS):
        try:
            w = tutte(problem.F, w, held, weights)
        except NotPositiveDefinite:
            break
        yield w
        inverted = inverted_triangles(problem.F, problem.positions(w)).size
        if inverted < least:
            best, least = w, inverted
        # Small triangles get smaller weights.
        areas = np.abs(signed_areas(problem.F, w))
        weights = weights * np.clip(areas / areas.max(), 1 / _SPAN, 1.0) ** _POWER
    objective = Objective(problem)
    here = objective.of_map(best)
    for repair in _REPAIRS:
        try:
            for step in repair.iterates(objective, here):
                again, here = step.w is here.w, step
                if not again:
                    yield here.w
        except NotPositiveDefinite:
            return
