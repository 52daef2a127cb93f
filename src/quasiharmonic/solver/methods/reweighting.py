"""Untangle a patch repeatedly with growing weights of the inverted triangles.

Untangling starts with a large ε, for which its energy has hardly more than one minimum. From any start a patch
therefore ends in one of the same few maps, and another result needs another energy. Triangles that stay inverted get
more weight in every round, as constraints do in searches for satisfying assignments. They are untangled at the expense
of others, which gain weight in turn, until all triangles fit.
"""

from __future__ import annotations

import numpy as np

from quasiharmonic.energies.deformation import signed_areas
from quasiharmonic.solver.methods.local_repair import Effort, Patch, last_untangled
from quasiharmonic.solver.methods.untangling import GRADINGS
from quasiharmonic.util.arrays import ComplexArray

Generator = np.random.Generator

# Possible factors of an inverted triangle's weight per round; one is drawn for all rounds.
_FACTORS = 3.0, 10.0
# Maximum number of rounds.
_ROUNDS = 15
# If a map has this many more inverted triangles than the first, it does not recover, and the rounds end.
_WILD = 15


def reweighted(
    rng: Generator, patch: Patch, w: ComplexArray, linear_solver: str, effort: Effort | None = None
) -> ComplexArray:
    """Return another map of a patch, found by weighting its inverted triangles.

    Parameters
    ----------
    rng : Generator
        Draws the factor and the grading of every round.
    patch : Patch
    w : (v,) complex128
        Its map.
    linear_solver : str
        A name of `quasiharmonic.linsolve`, or ``"auto"``.
    effort : Effort, optional
        Cost account of the steps.

    Returns
    -------
    (v,) complex128
        The first map without inverted triangles, or else the last one with no more of them than ``w``.
    """
    factor = float(rng.choice(_FACTORS))
    weights = np.ones(len(patch.F))
    inverted = signed_areas(patch.F, w) <= 0
    first, last = inverted.sum(), w
    for _ in range(_ROUNDS):
        weights[inverted] *= factor
        w = last_untangled(patch, w, patch.held, float(rng.choice(GRADINGS)), linear_solver, weights, effort)
        inverted = signed_areas(patch.F, w) <= 0
        if inverted.sum() <= first:
            last = w
        if not inverted.any() or inverted.sum() > first + _WILD:
            break
    return last
