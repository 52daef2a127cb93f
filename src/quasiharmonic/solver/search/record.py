"""The record of a search: its best map, its history, and the loop that visits the maps of its stages.

A round has the next map of each stage that still runs. A single search has rounds of one map; many small searches that
run in a batch have rounds of many maps (`quasiharmonic.solver.search.first_stage`).
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from itertools import chain
from typing import TYPE_CHECKING, NamedTuple, TypeAlias

import numpy as np

from quasiharmonic.geometry.exact.triangles import triangle_signs
from quasiharmonic.geometry.mesh.reference import Reference
from quasiharmonic.problem import Problem
from quasiharmonic.problem.result import Stage, Status
from quasiharmonic.problem.run import Run
from quasiharmonic.solver.field.objective import Iterate, Objective
from quasiharmonic.solver.field.tensor import TANH, TensorField, own_tensor
from quasiharmonic.solver.methods.base import Descent, Patience, Steps
from quasiharmonic.util.arrays import ComplexArray, as_offsets
from quasiharmonic.util.options import MapOptions

if TYPE_CHECKING:
    from quasiharmonic.problem.diagnosis import Diagnosis


class BestMap(NamedTuple):
    """The best map of a search and the map of lowest V₃; see `SearchRecord`."""

    best: tuple[int, float]
    best_map: ComplexArray
    best_field: TensorField | None
    best_reference: Reference
    lowest_energy: Iterate | None


@dataclass
class RepairBudget:
    """Cost of failed repairs, in iterations, that a search may still spend."""

    left: int


class SearchRecord:
    """The maps that a search has visited.

    Attributes
    ----------
    problem : Problem
        The problem. While the search runs, no other search uses its domain.
    work : Run
        History, stages and recorded maps.
    status : Status
        Status after the stages that have run.
    best_map : (n,) complex128
        The map with the fewest inverted triangles so far, and among those the one of lowest V₃, in the problem's frame.
        If a diagnosis forbids an injective map: the map of lowest V₃.
    best_field, best_reference : TensorField or None, str
        Its tensors, and the reference triangles in whose frames they are expressed.
    best : (int, float)
        Its number of inverted triangles, and its V₃ divided by its area.
    lowest_energy : Iterate or None
        The map of lowest V₃ among those of tensor descents.
    repairs : RepairBudget
        Failed work that is still allowed.
    diagnosis : Diagnosis or None
        Why there is no map, if that was examined.
    linear_solver : str
        Name of the linear solver.
    rounded : bool
        Whether a map was injective before its positions were rounded.
    """

    def __init__(self, problem: Problem, options: MapOptions, repairs: RepairBudget) -> None:
        self.problem = problem
        self.work = Run(options.callback, options.record_every)
        self.repairs = repairs
        self.linear_solver = options.linear_solver
        self.status = Status.OUT_OF_ITERATIONS
        self.diagnosis: Diagnosis | None = None
        # Initial value: every free vertex at the centre of the target.
        self.best_map = np.zeros(problem.n, dtype=np.complex128)
        self.best_field: TensorField | None = None
        self.best_reference: Reference = "equilateral"
        self.lowest_energy: Iterate | None = None
        self.best = len(problem.F), np.inf
        self.rounded = False
        self._budget = options.max_iterations

    @property
    def left(self) -> int:
        """Iterations left; the very first evaluation, the start, is not counted."""
        return self._budget + 1 - len(self.work.history)

    @property
    def state(self) -> BestMap:
        """The best map and the map of lowest V₃."""
        return BestMap(self.best, self.best_map, self.best_field, self.best_reference, self.lowest_energy)

    @state.setter
    def state(self, state: BestMap) -> None:
        self.best, self.best_map, self.best_field, self.best_reference, self.lowest_energy = state

    def record_iterate(self, here: Iterate, inverted: int, *, tensors: bool) -> None:
        """Record an iterate with this number of inverted triangles, and update the best map.

        If ``tensors``, it comes from a tensor descent.
        """
        self.rounded |= inverted > here.inverted == 0
        if (inverted, here.energy) < self.best:
            self.best = inverted, here.energy
            self.best_map, self.best_field, self.best_reference = here.w, here.field, here.objective.reference
        if tensors and (self.lowest_energy is None or here.energy < self.lowest_energy.energy):
            self.lowest_energy = here
        # Last, because the callback may end the search.
        self.work.record(inverted, here.energy, lambda: self.problem.positions(here.w))

    def record_stage(self, name: str, first_step: int, seconds: float, before: tuple[int, float], kept: bool) -> None:
        """Append the report of a stage that began with a step of the history and with a best map as ``before``."""
        n_iterations, best = max(len(self.work.history) - first_step, 0), self.best
        inverted, energy = (before[0], best[0]), (before[1], best[1])
        self.work.stages.append(Stage(name, n_iterations, seconds, inverted, energy, kept))

    def replace_best(self, w: ComplexArray, inverted: int) -> None:
        """Replace the best map by ``w`` with its own tensors, at which V₃ vanishes if the map is injective."""
        mesh = self.problem.domain.mesh("equilateral")
        dw = mesh.derivatives(w)
        field = TANH.field(TANH.invert(own_tensor(dw.p, dw.q)))
        self.state = BestMap((inverted, 0.0 if inverted == 0 else np.inf), w, field, mesh.kind, self.lowest_energy)


class StageRun:
    """One stage of one search while it runs: it visits maps and decides when the stage ends.

    ``status`` is the reason why the stage ended, None while it runs. ``seconds`` is the time spent, for the report.
    """

    def __init__(self, search: SearchRecord, stage: Descent) -> None:
        self.search, self.stage = search, stage
        self.status: Status | None = None
        self.seconds = 0.0
        self._patience = Patience(stage.patience)
        self._last: ComplexArray | None = None
        self._first_step = max(len(search.work.history), 1)
        self._before: tuple[int, float] | None = None

    def is_repeated(self, here: Iterate) -> bool:
        """Whether a map is the previous one again, which reports failed work worth one iteration."""
        return here.w is self._last

    def count_failed_work(self) -> None:
        """Count failed work; the stage ends if the search allows no more of it."""
        self.search.repairs.left -= 1
        if self.search.repairs.left <= 0:
            self.status = Status.STALLED

    def record_iterate(self, here: Iterate, inverted: int) -> None:
        """Record a new map with ``inverted`` inverted triangles; set ``status`` if the stage ends with it."""
        if self._last is None:
            # Compare the very first stage with its own initial map.
            self._before = (here.inverted, here.energy) if self.search.best_field is None else self.search.best
        self._last = here.w
        self.search.record_iterate(here, inverted, tensors=not self.stage.moves_vertices)
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
        kept = best != before or self.status is Status.INJECTIVE
        self.search.record_stage(self.stage.name, self._first_step, self.seconds, before or best, kept)


#: The next maps of some stages.
Round: TypeAlias = Sequence[tuple[StageRun, Iterate]]


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
            run.record_iterate(here, here.inverted or next(exact))


def single_rounds(run: StageRun, objective: Objective, start: Iterate) -> Iterator[Round]:
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
