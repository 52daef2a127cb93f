"""The search: stages run one after another until one finds a map without inverted triangles (§9.2).

Where none does, the search ends with the reason, if one is known, and then with the map of least area.
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

# Iterations that tries at patches may amount to in vain, in all stages together, as a multiple of the search's.
_IN_VAIN = 16
# The share of inverted triangles above which they count as many.
MANY_INVERTED = 0.02
# What rights the last few triangles; and what follows the first stage on a coarse mesh.
LOCAL_REPAIRS = LineShift(resume=True), LocalRepair(tries=15, resume=True)
_COARSE = *LOCAL_REPAIRS, Untangling(resume=True), *LOCAL_REPAIRS
# Newton steps towards the map of least area where there is no injective one: what follows moves nothing one would see.
_TO_LEAST_AREA = 30


@dataclass(frozen=True)
class CoarseToFine(SearchStage):
    """A stage that searches on a coarse mesh, if this one is large, and carries the map that it finds to this one.

    Attributes
    ----------
    first : Descent
        What the search on the coarse mesh begins with; local repair and untangling follow.
    """

    first: Descent

    coarse: ClassVar[bool] = True

    @property
    def name(self) -> str:
        """How reports call this stage."""
        return f"coarse-to-fine, {self.first.name}"

    @property
    def begins_with(self) -> Descent:
        """``first``."""
        return self.first

    def run(self, search: StageRunner, before: Status) -> Status:
        """As of `SearchStage`."""
        return search.attempt_on_coarse(self, before)


@dataclass(frozen=True)
class TentativeStage(SearchStage):
    """A stage whose iterations are discarded where it finds no map (§9.2): what follows goes on from before it.

    Attributes
    ----------
    tried : Descent
    """

    tried: Descent

    @property
    def name(self) -> str:
        """How reports call this stage."""
        return self.tried.name

    @property
    def begins_with(self) -> Descent:
        """``tried``."""
        return self.tried

    def run(self, search: StageRunner, before: Status) -> Status:
        """As of `SearchStage`."""
        return search.attempt_tentatively(self.tried, before)


@dataclass(frozen=True)
class WhereMany(SearchStage):
    """A stage that is run only where so many triangles are inverted that local repair would take longer than it does.

    Attributes
    ----------
    tried : Descent
    """

    tried: Descent

    @property
    def name(self) -> str:
        """How reports call this stage."""
        return self.tried.name

    @property
    def begins_with(self) -> Descent:
        """``tried``."""
        return self.tried

    def run(self, search: StageRunner, before: Status) -> Status:
        """As of `SearchStage`."""
        return search.attempt_where_many(self.tried, before)


@dataclass(frozen=True, eq=False)
class ResumedStage(SearchStage):
    """A stage that has been run elsewhere and has found no map, as a search is to go on from it.

    Attributes
    ----------
    descent : FunctionalDescent
        What was run.
    history : list of Step
        Its iterations, the start included.
    best, best_map, best_xi
        The map of the fewest inverted triangles, as `Search` compares them, and its tensors.
    deepest_map, deepest_xi : (n,), (f,) complex128
        The map of the lowest V₃, and its tensors.
    stage : Stage
        What reports say of it.
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
        """How reports call this stage."""
        return self.descent.name

    @property
    def begins_with(self) -> Descent:
        """``descent``."""
        return self.descent

    def run(self, search: StageRunner, before: Status) -> Status:
        """As of `SearchStage`."""
        return search.take_over(self)


class _State(NamedTuple):
    """What a search knows of the best map, and the map of the lowest V₃; see `Search`."""

    best: tuple[int, float]
    best_map: ComplexArray
    best_field: TensorField | None
    best_reference: Reference
    lowest_energy: Iterate | None


#: Whatever a strategy is made of.
Stages: TypeAlias = Sequence[SearchStage]


class Search:
    """Runs stages one after another, keeps the best map and writes down what happened.

    Parameters
    ----------
    problem : Problem
        On a domain that is nobody else's while the search runs.
    linear_solver : str
        A name of `quasiharmonic.linsolve`, or ``"auto"``.
    callback : callable, optional
        Called with a `Step` at every iteration.
    budget : int
        Iterations at most.
    record_every : int
        Keep every so many-th map in ``path``; none for 0.
    first : (n,) complex128, optional
        A map to begin with, of any size and anywhere.

    Attributes
    ----------
    best_map : (n,) complex128
        The map of fewest inverted triangles so far, and of these the one of lowest V₃, in the problem's frame; the one
        of lowest V₃ where a diagnosis says that none is injective.
    best_field, best_reference : TensorField or None, str
        Its tensors and the triangles in whose frames they are expressed.
    history, stages, path, diagnosis, linear_solver
        As `MapResult` has them.
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
        # Where rounding defeats one backend's factorisation, another's order of elimination may do.
        self._spare: tuple[str, ...] | None = None if linear_solver == "auto" else ()
        self.callback = callback
        self.budget = budget
        self._in_vain = _IN_VAIN * budget
        self.record_every = record_every
        self.path: list[Snapshot] = []
        self.history: list[Step] = []
        self.stages: list[Stage] = []
        self.diagnosis: Diagnosis | None = None
        # Should nothing at all be computed, every free vertex lies at the middle of the target.
        self.best_map = np.zeros(problem.n, dtype=np.complex128)
        self.best_field: TensorField | None = None
        self.best_reference: Reference = "equilateral"
        self.lowest_energy: Iterate | None = None
        self.best = len(problem.F), np.inf
        self._aside: _State | None = None
        self._rounded = self._tried = False

    def run(self, stages: Stages) -> Status:
        """Run stages until one finds an injective map; why the search ended."""
        try:
            return self._run(stages)
        except KeyboardInterrupt:
            return Status.INTERRUPTED

    def _run(self, stages: Stages) -> Status:
        """Stage after stage, as long as there is hope."""
        status = Status.OUT_OF_ITERATIONS
        on_the_mesh = [stage.begins_with for stage in stages if not stage.coarse]
        fallback = on_the_mesh[0] if on_the_mesh else stages[0].begins_with
        if not self.problem.encloses_area:
            self._descend(VectorAdam(iterations=1))
            self._examine()
            return Status.IMPOSSIBLE
        if self._first is not None:
            # From a map at hand the first stage is tried before all, and no coarse mesh.
            status = self._descend_by_any(fallback, status)
            stages = on_the_mesh or [fallback]
        for stage in stages:
            if status is Status.INJECTIVE or self._left <= 0 or self._in_vain <= 0:
                break
            # Later stages take long, and are in vain where no injective map exists.
            if self._tried and not stage.quick and self._examine().forbids_injective:
                break
            status = stage.run(self, status)
        if self.best_field is None and self._left > 0:
            # Every stage was for a coarse mesh, and there was none or its search came to nothing.
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
        """Run a stage on the mesh itself, and forget the lowest V₃ that it came to if it finds no map."""
        lowest_energy = self.lowest_energy
        status = self.attempt(stage, before)
        if status is not Status.INJECTIVE:
            self.lowest_energy = lowest_energy
        return status

    def attempt_where_many(self, stage: Descent, before: Status) -> Status:
        """Run a stage on the mesh itself, if many of its triangles are inverted in the best map."""
        return self.attempt(stage, before) if self.best[0] > MANY_INVERTED * len(self.problem.F) else before

    def take_over(self, begun: ResumedStage) -> Status:
        """Go on from a stage that was run elsewhere, as `attempt` does from its own."""
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
        """Run one stage, by another linear solver where one has failed; how it ended, or else the search so far."""
        status = self._descend(stage)
        while status is Status.UNSOLVABLE and self._spare and self._left > 0:
            self._asked = self._spare[0]
            status = self._descend(replace(stage, resume=True))
        # That vertices got nowhere does not mean that tensors had settled.
        if status is not Status.INJECTIVE and stage.moves_vertices and before is Status.UNSOLVABLE:
            return before
        return status

    def attempt_on_coarse(self, stage: SearchStage, before: Status) -> Status:
        """Search on a coarse mesh, if there is one to be had, and carry its map to this one."""
        # A recording shows maps of this mesh only, so no coarse one is searched.
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
        """Take on a map from elsewhere, at its own tensors."""
        mesh = self.problem.domain.mesh("equilateral")
        dw = mesh.derivatives(w)
        field = TANH.field(TANH.invert(own_tensor(dw.p, dw.q)))
        self._state = _State((inverted, 0.0 if inverted == 0 else np.inf), w, field, mesh.kind, self.lowest_energy)

    def _repair_carried(self, before_it: _State) -> None:
        """Right the last inverted triangles of a map from a coarse mesh; where that fails, it is put aside.

        Other stages then begin anew, and not in front of a wall that the coarse mesh may have put up.
        """
        for stage in LOCAL_REPAIRS:
            if self._left > 0 and 0 < self.best[0] <= MOST_FLIPS:
                self.lowest_energy = stage.objective(self.problem, self._asked).of_map(self.best_map)
                self._descend(stage)
        if self.best[0]:
            self._aside, self._state = self._state, before_it

    @property
    def _state(self) -> _State:
        """What is known of the best map."""
        return _State(self.best, self.best_map, self.best_field, self.best_reference, self.lowest_energy)

    @_state.setter
    def _state(self, state: _State) -> None:
        self.best, self.best_map, self.best_field, self.best_reference, self.lowest_energy = state

    def _note(self, step: Step) -> None:
        """Write a step down, whatever its number was where it was made."""
        step = Step(len(self.history), step.inverted, step.energy)
        self.history.append(step)
        if self.callback is not None:
            self.callback(step)

    def _examine(self) -> Diagnosis:
        """Whether anything forbids a map; found out once."""
        from quasiharmonic.problem.diagnosis import diagnose

        if self.diagnosis is None:
            self.diagnosis = diagnose(self.problem)
        return self.diagnosis

    def _towards_least_area(self) -> None:
        """Where no map is injective, go to the one of least area: the target's area and V₃ make it up (eq. 42)."""
        if self._left > 0:
            self._descend(Newton(iterations=_TO_LEAST_AREA, resume=True))
        if self.lowest_energy is not None:
            here = self.lowest_energy
            self.best_map, self.best_field, self.best_reference = here.w, here.field, here.objective.mesh.kind

    @property
    def _left(self) -> int:
        """Iterations left; the first evaluation of all is the start and costs none."""
        return self.budget + 1 - len(self.history)

    def _descend(self, stage: Descent) -> Status:
        """Run one stage."""
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
            # The first map of all is what the first stage begins with.
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
        """Look at every map of a stage until one is injective or nothing moves any more; why it ended."""
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
        """Take note of an iterate."""
        inverted = here.inverted
        if inverted == 0:
            # Not on the solver's own coordinates.
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
        """How many triangles are not, decided exactly on the coordinates that are handed back."""
        sign, _ = triangle_signs(self.problem.F, self.problem.positions(w))
        return int(np.count_nonzero(sign <= 0))


def search_coarse(
    problem: Problem, first: Descent, linear_solver: str, budget: int, callback: Callable[[Step], object]
) -> tuple[Status, FloatArray, int, str]:
    """Solve a coarse problem, and lower the distortion of its map a little.

    Why it ended, the map, its inverted triangles, the backend.
    """
    search = Search(problem, linear_solver, callback, budget)
    status = search.run([first, *_COARSE])
    uv = problem.positions(search.best_map)
    if status is Status.INJECTIVE:
        # Fine vertices crowd where coarse triangles are thin: a few steps against that pay many times over.
        polish = polish_map(problem.domain, uv, energy="mips", max_iterations=10, linear_solver=linear_solver)
        uv = polish.uv
    return status, uv, search.best[0], search.linear_solver
