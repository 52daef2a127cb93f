"""Run stages one after another until one finds a map without inverted triangles (§9.2).

If no stage finds one, the search reports the reason if a diagnosis proves it, and then returns the map of least area.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from itertools import chain
from typing import TYPE_CHECKING, ClassVar, NamedTuple, TypeAlias

import numpy as np

from quasiharmonic.energies.polishing import polish_map
from quasiharmonic.geometry.exact.triangles import triangle_signs
from quasiharmonic.geometry.mesh.reference import Reference
from quasiharmonic.linsolve import NotPositiveDefinite, available
from quasiharmonic.problem import Problem
from quasiharmonic.problem.result import Snapshot, Stage, Status, Step
from quasiharmonic.solver.field.objective import Iterate, Objective
from quasiharmonic.solver.field.tensor import TANH, TensorField, own_tensor
from quasiharmonic.solver.methods import Descent, LineShift, LocalRepair, Newton, Untangling, VectorAdam
from quasiharmonic.solver.methods.base import FunctionalDescent, Patience, SearchStage, SearchState, StageRunner, Steps
from quasiharmonic.solver.methods.local_repair import MOST_FLIPS
from quasiharmonic.solver.search.coarse import coarse_mesh
from quasiharmonic.util.arrays import ComplexArray, FloatArray

if TYPE_CHECKING:
    from quasiharmonic.problem.diagnosis import Diagnosis

# Maximum cost of failed patch repairs in all stages together, in units of the search's iteration budget.
_IN_VAIN = 16
# Fraction of inverted triangles above which a stage `WhereMany` runs.
MANY_INVERTED = 0.02
# Stages that untangle the last few triangles, and stages that follow the first stage on a coarse mesh.
LOCAL_REPAIRS = LineShift(resume=True), LocalRepair(tries=15, resume=True)
_COARSE = *LOCAL_REPAIRS, Untangling(resume=True), *LOCAL_REPAIRS
# Newton steps towards the map of least area if no injective map exists; later steps cause no visible change.
_TO_LEAST_AREA = 30


@dataclass(frozen=True)
class CoarseToFine(SearchStage):
    """Stage that searches on a coarse mesh and transfers the map to the fine mesh; skipped if the mesh is small.

    Attributes
    ----------
    first : Descent
        First stage on the coarse mesh; local repair and untangling follow.
    """

    first: Descent

    coarse: ClassVar[bool] = True

    @property
    def name(self) -> str:
        """Name of this stage in reports."""
        return f"coarse-to-fine, {self.first.name}"

    @property
    def begins_with(self) -> Descent:
        """``first``."""
        return self.first

    def run(self, search: StageRunner, before: Status) -> Status:
        """See `SearchStage`."""
        return search.attempt_on_coarse(self, before)


@dataclass(frozen=True)
class _OneDescent(SearchStage):
    """Stage of one way to descend, under conditions of its own.

    Attributes
    ----------
    tried : Descent
    """

    tried: Descent

    @property
    def name(self) -> str:
        """Name of this stage in reports."""
        return self.tried.name

    @property
    def begins_with(self) -> Descent:
        """``tried``."""
        return self.tried


class TentativeStage(_OneDescent):
    """Stage whose iterations are discarded if it finds no map (§9.2). Later stages continue from the earlier state."""

    def run(self, search: StageRunner, before: Status) -> Status:
        """See `SearchStage`."""
        return search.attempt_tentatively(self.tried, before)


class WhereMany(_OneDescent):
    """Stage that runs only if so many triangles are inverted that local repair would be slower."""

    def run(self, search: StageRunner, before: Status) -> Status:
        """See `SearchStage`."""
        return search.attempt_where_many(self.tried, before)


@dataclass(frozen=True, eq=False)
class ResumedStage(SearchStage):
    """Stage that already ran elsewhere without finding a map; the search continues from its state.

    Attributes
    ----------
    descent : FunctionalDescent
        The stage that ran.
    history : list of Step
        Its iterations, the start included.
    best, best_map, best_xi
        The map with the fewest inverted triangles, as compared by `Search`, and its tensors.
    deepest_map, deepest_xi : (n,), (f,) complex128
        The map of lowest V₃ and its tensors.
    stage : Stage
        Its entry in reports.
    """

    descent: FunctionalDescent
    history: list[Step]
    best: tuple[int, float]
    best_map: ComplexArray
    best_xi: ComplexArray
    deepest_map: ComplexArray
    deepest_xi: ComplexArray
    stage: Stage

    @property
    def name(self) -> str:
        """Name of this stage in reports."""
        return self.descent.name

    @property
    def begins_with(self) -> Descent:
        """``descent``."""
        return self.descent

    def run(self, search: StageRunner, before: Status) -> Status:
        """See `SearchStage`."""
        return search.take_over(self)


class _State(NamedTuple):
    """The best map of a search and the map of lowest V₃; see `Search`."""

    best: tuple[int, float]
    best_map: ComplexArray
    best_field: TensorField | None
    best_reference: Reference
    lowest_energy: Iterate | None


#: Stages of a strategy.
Stages: TypeAlias = Sequence[SearchStage]


class Search:
    """Run stages one after another, keep the best map and record the history.

    Parameters
    ----------
    problem : Problem
        Its domain must not be used elsewhere while the search runs.
    linear_solver : str
        A name of `quasiharmonic.linsolve`, or ``"auto"``.
    callback : callable, optional
        Called with a `Step` at every iteration.
    budget : int
        Maximum number of iterations.
    record_every : int
        Keep every ``record_every``-th map in ``path``; 0 keeps no maps.
    first : (n,) complex128, optional
        Initial map, of any size and position.

    Attributes
    ----------
    best_map : (n,) complex128
        The map with the fewest inverted triangles so far, and among those the one of lowest V₃, in the problem's frame.
        If a diagnosis forbids an injective map: the map of lowest V₃.
    best_field, best_reference : TensorField or None, str
        Its tensors, and the reference triangles in whose frames they are expressed.
    history, stages, path, diagnosis, linear_solver
        See `MapResult`.
    """

    def __init__(
        self,
        problem: Problem,
        linear_solver: str,
        callback: Callable[[Step], object] | None,
        budget: int,
        record_every: int = 0,
        first: ComplexArray | None = None,
    ) -> None:
        self.problem = problem
        self._first = first
        self.linear_solver = self._asked = linear_solver
        # If a factorisation fails because of rounding, another backend with another elimination order may succeed.
        self._spare: tuple[str, ...] | None = None if linear_solver == "auto" else ()
        self.callback = callback
        self.budget = budget
        self._in_vain = _IN_VAIN * budget
        self.record_every = record_every
        self.path: list[Snapshot] = []
        self.history: list[Step] = []
        self.stages: list[Stage] = []
        self.diagnosis: Diagnosis | None = None
        # Initial value: every free vertex at the centre of the target.
        self.best_map = np.zeros(problem.n, dtype=np.complex128)
        self.best_field: TensorField | None = None
        self.best_reference: Reference = "equilateral"
        self.lowest_energy: Iterate | None = None
        self.best = len(problem.F), np.inf
        self._aside: _State | None = None
        self._rounded = self._tried = False

    def run(self, stages: Stages) -> Status:
        """Run stages until one finds an injective map; return the status at the end of the search."""
        try:
            return self._run(stages)
        except KeyboardInterrupt:
            return Status.INTERRUPTED

    def _run(self, stages: Stages) -> Status:
        """Run the stages in order until a map is found, the budget is spent or a diagnosis forbids a map."""
        status = Status.OUT_OF_ITERATIONS
        on_the_mesh = [stage.begins_with for stage in stages if not stage.coarse]
        fallback = on_the_mesh[0] if on_the_mesh else stages[0].begins_with
        if not self.problem.encloses_area:
            self._descend(VectorAdam(iterations=1))
            self._examine()
            return Status.IMPOSSIBLE
        if self._first is not None:
            # With an initial map, run the first stage before all others and skip stages on a coarse mesh.
            status = self._descend_by_any(fallback, status)
            stages = on_the_mesh or [fallback]
        for stage in stages:
            if status is Status.INJECTIVE or self._left <= 0 or self._in_vain <= 0:
                break
            # Later stages are slow, and useless if no injective map exists.
            if self._tried and not stage.quick and self._examine().forbids_injective:
                break
            status = stage.run(self, status)
        if self.best_field is None and self._left > 0:
            # All stages were for a coarse mesh, which does not exist or gave no map.
            status = self._descend_by_any(fallback, status)
        if status is Status.INJECTIVE:
            return status
        if self._examine().forbids_injective:
            self._towards_least_area()
            return Status.IMPOSSIBLE
        if self._aside is not None and self._aside.best < self.best:
            self._state = self._aside
        return Status.ROUNDED if self._rounded else status

    def attempt(self, stage: Descent, before: Status) -> Status:
        """Run a stage on the mesh itself."""
        self._tried = True
        return self._descend_by_any(stage, before)

    def attempt_tentatively(self, stage: Descent, before: Status) -> Status:
        """Run a stage on the mesh itself; if it finds no map, restore the previous map of lowest V₃."""
        lowest_energy = self.lowest_energy
        status = self.attempt(stage, before)
        if status is not Status.INJECTIVE:
            self.lowest_energy = lowest_energy
        return status

    def attempt_where_many(self, stage: Descent, before: Status) -> Status:
        """Run a stage on the mesh itself if many triangles of the best map are inverted."""
        return self.attempt(stage, before) if self.best[0] > MANY_INVERTED * len(self.problem.F) else before

    def take_over(self, begun: ResumedStage) -> Status:
        """Continue from a stage that ran elsewhere, as after `attempt`."""
        objective = begun.descent.objective(self.problem, self._asked)
        self.linear_solver = objective.laplacian.solver.name
        for step in begun.history:
            self._note(step)
        tensors = objective.parameterisation.field
        self.best, self.best_map, self.best_field = begun.best, begun.best_map, tensors(begun.best_xi)
        self.best_reference = objective.mesh.kind
        self.lowest_energy = Iterate(objective, tensors(begun.deepest_xi), begun.deepest_map)
        self.stages.append(begun.stage)
        self._tried = True
        return Status.OUT_OF_ITERATIONS

    def _descend_by_any(self, stage: Descent, before: Status) -> Status:
        """Run a stage, with another linear solver if one fails; return its status or that of the search so far."""
        status = self._descend(stage)
        while status is Status.UNSOLVABLE and self._spare and self._left > 0:
            self._asked = self._spare[0]
            status = self._descend(replace(stage, resume=True))
        # A stalled vertex descent does not mean that the tensor search before it converged.
        if status is not Status.INJECTIVE and stage.moves_vertices and before is Status.UNSOLVABLE:
            return before
        return status

    def attempt_on_coarse(self, stage: SearchStage, before: Status) -> Status:
        """Search on a coarse mesh if one exists, and transfer its map to the fine mesh."""
        # ``path`` contains only maps of this mesh, so skip the coarse mesh if maps are recorded.
        coarse = None if self.record_every else coarse_mesh(self.problem)
        if coarse is None:
            return before
        done, began, before_it = max(len(self.history), 1), time.perf_counter(), self._state
        problem = Problem.on(coarse.domain, self.problem.target, reference="equilateral")
        first, left = stage.begins_with, self._left
        status, uv, inverted, self.linear_solver = search_coarse(problem, first, self._asked, left, self._note)
        certain = status in (Status.INJECTIVE, Status.INTERRUPTED)
        if certain or (status is not Status.IMPOSSIBLE and inverted <= MOST_FLIPS):
            w = coarse.prolong(problem.frame.inward(uv))
            inverted = self._not_positive(w)
            if certain or inverted <= min(MOST_FLIPS, self.best[0] - 1):
                self._take(w, inverted)
                self._rounded |= status is Status.INJECTIVE and inverted > 0
                self._note(Step(0, *self.best))
        self.stages.append(
            Stage(
                name=f"{stage.name}, {len(problem.F)} triangles",
                iterations=len(self.history) - done,
                seconds=time.perf_counter() - began,
                inverted=(before_it.best[0], self.best[0]),
                energy=(before_it.best[1], self.best[1]),
                kept=self.best != before_it.best,
            )
        )
        if status is Status.INTERRUPTED:
            raise KeyboardInterrupt
        if self.best != before_it.best and self.best[0]:
            self._repair_carried(before_it)
        return Status.INJECTIVE if self.best[0] == 0 else before

    def _take(self, w: ComplexArray, inverted: int) -> None:
        """Replace the best map by ``w`` with its own tensors."""
        mesh = self.problem.domain.mesh("equilateral")
        dw = mesh.derivatives(w)
        field = TANH.field(TANH.invert(own_tensor(dw.p, dw.q)))
        self._state = _State((inverted, 0.0 if inverted == 0 else np.inf), w, field, mesh.kind, self.lowest_energy)

    def _repair_carried(self, before_it: _State) -> None:
        """Untangle the last inverted triangles of a map from a coarse mesh; if that fails, set the map aside.

        Later stages then start from the previous state, because the transferred map may contain obstacles from the
        coarse mesh.
        """
        for stage in LOCAL_REPAIRS:
            if self._left > 0 and 0 < self.best[0] <= MOST_FLIPS:
                self.lowest_energy = stage.objective(self.problem, self._asked).of_map(self.best_map)
                self._descend(stage)
        if self.best[0]:
            self._aside, self._state = self._state, before_it

    @property
    def _state(self) -> _State:
        """The best map and the map of lowest V₃."""
        return _State(self.best, self.best_map, self.best_field, self.best_reference, self.lowest_energy)

    @_state.setter
    def _state(self, state: _State) -> None:
        self.best, self.best_map, self.best_field, self.best_reference, self.lowest_energy = state

    def _note(self, step: Step) -> None:
        """Append a step to the history with the next number, and call the callback."""
        step = Step(len(self.history), step.inverted, step.energy)
        self.history.append(step)
        if self.callback is not None:
            self.callback(step)

    def _examine(self) -> Diagnosis:
        """Return the diagnosis of the problem; computed once."""
        from quasiharmonic.problem.diagnosis import diagnose

        if self.diagnosis is None:
            self.diagnosis = diagnose(self.problem)
        return self.diagnosis

    def _towards_least_area(self) -> None:
        """Move to the map of least area, which is the target's area plus V₃ (eq. 42)."""
        if self._left > 0:
            self._descend(Newton(iterations=_TO_LEAST_AREA, resume=True))
        if self.lowest_energy is not None:
            here = self.lowest_energy
            self.best_map, self.best_field, self.best_reference = here.w, here.field, here.objective.mesh.kind

    @property
    def _left(self) -> int:
        """Iterations left; the very first evaluation, the start, is not counted."""
        return self.budget + 1 - len(self.history)

    def _descend(self, stage: Descent) -> Status:
        """Run one stage and record it."""
        before, done, began = None, max(len(self.history), 1), time.perf_counter()
        status = Status.INTERRUPTED
        try:
            objective = stage.objective(self.problem, self._asked)
            solver = objective.laplacian.solver
            self.linear_solver = solver.name
            if self._spare is None:
                self._spare = available(solver.nnz)
            if self.linear_solver in self._spare:
                self._spare = self._spare[self._spare.index(self.linear_solver) + 1 :]
            given = None if self.history else self._first
            start = stage.start(objective, SearchState(given, self.best_map, self.lowest_energy))
            # For the very first stage, compare with its own initial map.
            before = (start.inverted, start.energy) if self.best_field is None else self.best
            status = self._follow(stage, objective, start)
        except NotPositiveDefinite:
            status = Status.UNSOLVABLE
        finally:
            self.stages.append(
                Stage(
                    name=stage.name,
                    iterations=max(len(self.history) - done, 0),
                    seconds=time.perf_counter() - began,
                    inverted=((before or self.best)[0], self.best[0]),
                    energy=((before or self.best)[1], self.best[1]),
                    kept=self.best != before or status is Status.INJECTIVE,
                )
            )
        return status

    def _follow(self, stage: Descent, objective: Objective, start: Iterate) -> Status:
        """Visit every map of a stage until one is injective, progress stops or the budget ends; return the status."""
        patience = Patience(stage.patience)
        steps = Steps(stage.iterates(objective, start))
        last: ComplexArray | None = None
        for here in chain([start], steps):
            if here.w is last:
                self._in_vain -= 1
                if self._in_vain <= 0:
                    return Status.STALLED
                continue
            last = here.w
            step = self._visit(here, tensors=not stage.moves_vertices)
            if step.inverted == 0:
                return Status.INJECTIVE
            if self._left <= 0:
                return Status.OUT_OF_ITERATIONS
            if patience.is_over(step.inverted, here.value):
                return Status.STALLED
        return Status.STALLED if steps.at_rest else Status.OUT_OF_ITERATIONS

    def _visit(self, here: Iterate, *, tensors: bool) -> Step:
        """Record an iterate and update the best map."""
        inverted = here.inverted
        if inverted == 0:
            # Check the returned coordinates, not those of the solver.
            inverted = self._not_positive(here.w)
            self._rounded |= inverted > 0
        step = Step(len(self.history), inverted, here.energy)
        self._note(step)
        if self.record_every and step.iteration % self.record_every == 0:
            self.path.append(Snapshot(step.iteration, self.problem.positions(here.w)))
        if (inverted, step.energy) < self.best:
            self.best = inverted, step.energy
            self.best_map, self.best_field, self.best_reference = here.w, here.field, here.objective.mesh.kind
        if tensors and (self.lowest_energy is None or here.energy < self.lowest_energy.energy):
            self.lowest_energy = here
        return step

    def _not_positive(self, w: ComplexArray) -> int:
        """Number of triangles that are not positive, computed exactly on the returned coordinates."""
        sign, _ = triangle_signs(self.problem.F, self.problem.positions(w))
        return int(np.count_nonzero(sign <= 0))


def search_coarse(
    problem: Problem, first: Descent, linear_solver: str, budget: int, callback: Callable[[Step], object]
) -> tuple[Status, FloatArray, int, str]:
    """Solve a coarse problem and lower the distortion of its map slightly.

    Returns
    -------
    tuple of Status, (n, 2) float64, int, str
        The status, the map, its number of inverted triangles and the linear solver used.
    """
    search = Search(problem, linear_solver, callback, budget)
    status = search.run([first, *_COARSE])
    uv = problem.positions(search.best_map)
    if status is Status.INJECTIVE:
        # Fine vertices crowd in thin coarse triangles. A few polishing steps avoid much later work.
        polish = polish_map(problem.domain, uv, energy="mips", max_iterations=10, linear_solver=linear_solver)
        uv = polish.uv
    return status, uv, search.best[0], search.linear_solver
