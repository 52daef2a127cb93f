"""Untangling again and again, what stays inverted counting ever more.

Untangling starts with a large ε, at which its energy has hardly more than one minimum: however a patch is started, it
ends in the same few maps. What leads elsewhere is another energy. So triangles that stay inverted are given more
weight, round after round, as constraints are in searches for satisfying assignments: they are righted at the expense
of others, which become heavier in turn, until a map is found that has room for all.
"""

from __future__ import annotations

import numpy as np

from quasiharmonic.energies.deformation import signed_areas
from quasiharmonic.solver.methods.local_repair import Effort, Patch, last_untangled
from quasiharmonic.solver.methods.untangling import GRADINGS
from quasiharmonic.util.arrays import ComplexArray

Generator = np.random.Generator

# Factors that an inverted triangle's weight may be multiplied by after each round; one is drawn for all rounds.
_FACTORS = 3.0, 10.0
# Rounds at most.
_ROUNDS = 15
# A map with this many more inverted triangles than the first does not recover: the rounds end.
_WILD = 15


def reweighted(
    rng: Generator, patch: Patch, w: ComplexArray, linear_solver: str, effort: Effort | None = None
) -> ComplexArray:
    """Another map of a patch, by weighing its inverted triangles.

    Parameters
    ----------
    rng : Generator
        Draws the factor and every round's grading.
    patch : Patch
    w : (v,) complex128
        Its map.
    linear_solver : str
        A name of `quasiharmonic.linsolve`, or ``"auto"``.
    effort : Effort, optional
        What steps are counted in.

    Returns
    -------
    (v,) complex128
        The first map without inverted triangles, or else the last that has no more of them than ``w``.
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
