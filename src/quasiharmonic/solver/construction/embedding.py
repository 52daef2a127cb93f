"""Tutte's embedding of the pieces of a cut mesh, and repairs if double precision is insufficient."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from quasiharmonic.energies.deformation import signed_areas
from quasiharmonic.geometry.exact.certificate import inverted_triangles
from quasiharmonic.linsolve import NotPositiveDefinite
from quasiharmonic.linsolve.laplacian import embed_tutte
from quasiharmonic.problem import Problem
from quasiharmonic.solver.field.objective import Objective
from quasiharmonic.solver.methods import LocalRepair, RandomRestarts, Untangling
from quasiharmonic.util.arrays import ComplexArray, IntArray

# Number of weight updates.
_WEIGHT_UPDATES = 4
# Exponent of the areas in the weights.
_AREA_POWER = 0.5
# Maximum ratio of weights in one update.
_MAX_RATIO = 1e6
# Methods that untangle the last triangles and may also move vertices on cuts. Each is limited, because double precision
# may be insufficient.
_REPAIRS = LocalRepair(tries=30), Untangling(iterations=200), RandomRestarts(max_failures=20, tries=20)


def embed_pieces(problem: Problem, w: ComplexArray, fixed: IntArray) -> ComplexArray:
    """Embed convex pieces into their polygons, and untangle triangles that rounding has inverted.

    ``w`` (n,) has the positions of the vertices on the boundaries of pieces, ``fixed`` (k,), in the problem's frame.
    Return the map with the fewest inverted triangles found, counted at its final positions.
    """
    best, fewest = w, len(problem.F) + 1
    for candidate in _candidates(problem, w, fixed):
        inverted = inverted_triangles(problem.F, problem.positions(candidate)).size
        if inverted < fewest:
            best, fewest = candidate, inverted
        if fewest == 0:
            break
    return best


def _candidates(problem: Problem, w: ComplexArray, fixed: IntArray) -> Iterator[ComplexArray]:
    """Yield embeddings with different weights, then maps from untangling the best of them."""
    weights, best, fewest = np.ones(len(problem.F)), w, np.inf
    for _ in range(1 + _WEIGHT_UPDATES):
        try:
            w = embed_tutte(problem.F, w, fixed, weights)
        except NotPositiveDefinite:
            break
        yield w
        inverted = inverted_triangles(problem.F, problem.positions(w)).size
        if inverted < fewest:
            best, fewest = w, inverted
        # Small triangles get smaller weights.
        areas = np.abs(signed_areas(problem.F, w))
        weights = weights * np.clip(areas / areas.max(), 1 / _MAX_RATIO, 1.0) ** _AREA_POWER
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
