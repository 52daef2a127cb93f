"""Untangle a patch repeatedly with growing weights of the inverted triangles.

Untangling starts with a large ε, for which its energy has hardly more than one minimum. From any start a patch
therefore ends in one of the same few maps, and another result needs another energy. Triangles that stay inverted get
more weight in every round, as constraints do in searches for satisfying assignments. They are untangled at the expense
of others, which gain weight in turn, until all triangles fit.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from quasiharmonic.energies.deformation import signed_areas
from quasiharmonic.solver.methods.local_repair import Patch, RepairEffort, untangle_fully
from quasiharmonic.solver.methods.untangling import GRADINGS
from quasiharmonic.util.arrays import ComplexArray

Generator = np.random.Generator


class ReweightingTuning(NamedTuple):
    """Numbers that tune the rounds of reweighting."""

    # Possible factors of an inverted triangle's weight per round; one is drawn for all rounds.
    factors: tuple[float, ...] = (3.0, 10.0)
    # Maximum number of rounds.
    rounds: int = 15
    # If a map has this many more inverted triangles than the first, it does not recover, and the rounds end.
    max_extra: int = 15


_TUNING = ReweightingTuning()


def reweight(
    rng: Generator, patch: Patch, w: ComplexArray, linear_solver: str, effort: RepairEffort | None = None
) -> ComplexArray:
    """Return another map of a patch, found by weighting its inverted triangles.

    It is the first map without inverted triangles, or else the last one with no more of them than ``w`` (v,). ``rng``
    draws the factor and the grading of every round.
    """
    factor = float(rng.choice(_TUNING.factors))
    weights = np.ones(len(patch.F))
    inverted = signed_areas(patch.F, w) <= 0
    first, last = inverted.sum(), w
    for _ in range(_TUNING.rounds):
        weights[inverted] *= factor
        w = untangle_fully(patch, w, patch.fixed, float(rng.choice(GRADINGS)), linear_solver, weights, effort)
        inverted = signed_areas(patch.F, w) <= 0
        if inverted.sum() <= first:
            last = w
        if not inverted.any() or inverted.sum() > first + _TUNING.max_extra:
            break
    return last
