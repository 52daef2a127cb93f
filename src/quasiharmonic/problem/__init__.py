"""Mapping problems and results: a surface with fixed vertices and targets, the map, and the diagnosis.

The package builds on `geometry` and `linsolve`. Start reading in `domain`, then `problem`; `result` is the solver's
result, and `diagnosis` reports obstructions to a map.
"""

from __future__ import annotations

from quasiharmonic.problem.domain import Domain
from quasiharmonic.problem.problem import Frame, Problem, check_problem

__all__ = ["Domain", "Frame", "Problem", "check_problem"]
