"""The loop of every search: visit the maps of its stages, round by round.

A round has the next map of each stage that still runs. A single search has rounds of one map; many small searches that
run in a batch have rounds of many maps (`quasiharmonic.solver.search.first_stage`).
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from itertools import chain
from typing import Any, Generic, Protocol, TypeAlias, TypeVar

import numpy as np

from quasiharmonic.geometry.exact.triangles import triangle_signs
from quasiharmonic.problem import Problem
from quasiharmonic.problem.result import Stage, Status, Step
from quasiharmonic.solver.field.objective import Iterate, Objective
from quasiharmonic.solver.field.tensor import TensorField
from quasiharmonic.solver.methods.base import Descent, Patience, Steps
from quasiharmonic.solver.search.options import FailedRepairs
from quasiharmonic.util.arrays import ComplexArray, as_offsets


class SearchRecord(Protocol):
    """What a stage uses of its search; `quasiharmonic.solver.search.search.Search` documents the attributes."""

    problem: Problem
    status: Status
    history: list[Step]
    stages: list[Stage]
    best: tuple[int, float]
    best_field: TensorField | None
    failed_repairs: FailedRepairs

    @property
    def left(self) -> int: ...
    def visit(self, here: Iterate, inverted: int, *, tensors: bool) -> None: ...


AnySearch = TypeVar("AnySearch", bound=SearchRecord)


class StageRun(Generic[AnySearch]):
    """One stage of one search while it runs: it visits maps and decides when the stage ends.

    ``status`` is the reason why the stage ended, None while it runs. ``seconds`` is the time spent, for the report.
    """

    def __init__(self, search: AnySearch, stage: Descent) -> None:
        self.search, self.stage = search, stage
        self.status: Status | None = None
        self.seconds = 0.0
        self._patience = Patience(stage.patience)
        self._last: ComplexArray | None = None
        self._first_step = max(len(search.history), 1)
        self._before: tuple[int, float] | None = None

    def is_repeated(self, here: Iterate) -> bool:
        """Whether a map is the previous one again, which reports failed work worth one iteration."""
        return here.w is self._last

    def count_failed_work(self) -> None:
        """Count failed work; the stage ends if the search allows no more of it."""
        self.search.failed_repairs.left -= 1
        if self.search.failed_repairs.left <= 0:
            self.status = Status.STALLED

    def visit(self, here: Iterate, inverted: int) -> None:
        """Record a new map with ``inverted`` inverted triangles; set ``status`` if the stage ends with it."""
        if self._last is None:
            # Compare the very first stage with its own initial map.
            self._before = (here.inverted, here.energy) if self.search.best_field is None else self.search.best
        self._last = here.w
        self.search.visit(here, inverted, tensors=not self.stage.moves_vertices)
        if inverted == 0:
            self.status = Status.INJECTIVE
        elif self.search.left <= 0:
            self.status = Status.OUT_OF_ITERATIONS
        elif self._patience.is_over(inverted, here.value):
            self.status = Status.STALLED

    def end(self, status: Status) -> None:
        """End a stage that may still run, update the status of its search and record the stage."""
        self.status = self.search.status = self.status or status
        self.record()

    def record(self) -> None:
        """Append the report of this stage to those of the search."""
        best, before = self.search.best, self._before
        first = before or best
        self.search.stages.append(
            Stage(
                name=self.stage.name,
                n_iterations=max(len(self.search.history) - self._first_step, 0),
                seconds=self.seconds,
                inverted=(first[0], best[0]),
                energy=(first[1], best[1]),
                kept=best != before or self.status is Status.INJECTIVE,
            )
        )


#: The next maps of some stages.
Round: TypeAlias = Sequence[tuple[StageRun[Any], Iterate]]


def visit_rounds(rounds: Iterable[Round]) -> None:
    """Visit all maps of all rounds. The source of the rounds leaves out stages that have ended."""
    for maps in rounds:
        new = []
        for run, here in maps:
            if run.is_repeated(here):
                run.count_failed_work()
            else:
                new.append((run, here))
        # Check the returned coordinates, not those of the solver.
        exact = iter(count_not_positive([(run.search.problem, here.w) for run, here in new if here.inverted == 0]))
        for run, here in new:
            run.visit(here, here.inverted or next(exact))


def single_rounds(run: StageRun[Any], objective: Objective, start: Iterate) -> Iterator[Round]:
    """Yield the maps of a single descent as rounds of one map until it ends."""
    steps = Steps(run.stage.iterates(objective, start))
    for here in chain([start], steps):
        yield [(run, here)]
        if run.status is not None:
            return
    run.status = Status.STALLED if steps.converged else Status.OUT_OF_ITERATIONS


def count_not_positive(maps: Sequence[tuple[Problem, ComplexArray]]) -> list[int]:
    """Count the triangles of each map that are not positive, exactly on the returned coordinates."""
    if not maps:
        return []
    starts = np.cumsum([0, *(problem.n for problem, _ in maps)]).tolist()
    F = np.concatenate([problem.F + first for (problem, _), first in zip(maps, starts[:-1], strict=True)])
    sign, _ = triangle_signs(F, np.concatenate([problem.positions(w) for problem, w in maps]))
    first = np.cumsum([0, *(len(problem.F) for problem, _ in maps[:-1])])
    counts: list[int] = np.add.reduceat(sign <= 0, as_offsets(first), dtype=np.int64).tolist()
    return counts
