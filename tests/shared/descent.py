"""Starts for the tests of descent."""

from __future__ import annotations

import numpy as np


def path(method, objective, start=None):
    """Return the maps along a descent, including the start."""
    start = start or objective.evaluate(np.zeros(len(objective.problem.F), dtype=complex))
    return [start, *method.iterates(objective, start)]
