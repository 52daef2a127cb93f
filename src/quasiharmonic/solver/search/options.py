"""Options of a search, as the functions inside the solver pass them on."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

from quasiharmonic.problem.result import Step
from quasiharmonic.solver.methods.base import SearchStage
from quasiharmonic.util.arrays import FloatArray

#: Default maximum number of iterations of a search.
MAX_ITERATIONS = 2000


@dataclass
class FailedRepairs:
    """Cost of failed repairs, in iterations, that one or several searches may still spend together."""

    left: int


@dataclass(frozen=True, kw_only=True)
class SearchOptions:
    """Options of one search, as for `quasiharmonic.injective_map`; the public functions have checked them.

    ``failed_repairs`` is a budget that the search shares with others. By default it has a budget of its own.
    """

    strategy: str | Sequence[SearchStage] = "speed"
    start: FloatArray | None = None
    max_iterations: int = MAX_ITERATIONS
    linear_solver: str = "auto"
    callback: Callable[[Step], object] | None = None
    record_every: int = 0
    failed_repairs: FailedRepairs | None = None
