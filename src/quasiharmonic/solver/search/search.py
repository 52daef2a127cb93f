"""Run stages one after another until one finds a map without inverted triangles (§9.2).

If no stage finds one, the search reports the reason if a diagnosis proves it, and then returns the map of least area.
"""

from __future__ import annotations

import time
from dataclasses import replace
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from quasiharmonic.energies.polishing import PolishOptions, polish_map
from quasiharmonic.geometry.mesh.reference import Reference
from quasiharmonic.linsolve import NotPositiveDefinite, available
from quasiharmonic.problem import Frame, Problem
from quasiharmonic.problem.result import Snapshot, Stage, Status, Step
from quasiharmonic.solver.field.objective import Iterate
from quasiharmonic.solver.field.tensor import TANH, TensorField, own_tensor
from quasiharmonic.solver.methods import Descent, LineShift, LocalRepair, Newton, Untangling, VectorAdam
from quasiharmonic.solver.methods.base import SearchStage, SearchState
from quasiharmonic.solver.methods.local_repair import MAX_INVERTED
from quasiharmonic.solver.search.coarse import coarse_mesh
from quasiharmonic.solver.search.options import FailedRepairs, SearchOptions
from quasiharmonic.solver.search.stage_run import StageRun, count_not_positive, single_rounds, visit_rounds
from quasiharmonic.solver.search.stages import IfManyInverted, Stages, TentativeStage
from quasiharmonic.util.arrays import ComplexArray, FloatArray

if TYPE_CHECKING:
    from quasiharmonic.problem.diagnosis import Diagnosis

# Maximum cost of failed patch repairs in all stages together, in units of the search's iteration budget. If boundary
# vertices share a target position, V₃ is almost zero at folded maps, too, and repairs hardly ever help.
_FAILED_REPAIRS, _FAILED_REPAIRS_OF_TOUCHING = 16, 2
# Fraction of inverted triangles above which a stage `IfManyInverted` runs.
MANY_INVERTED = 0.02
# Stages that untangle the last few triangles.
LOCAL_REPAIRS = LineShift(resume=True), LocalRepair(tries=15, resume=True)
# Stages that follow the first stage on a coarse mesh.
_COARSE_STAGES = *LOCAL_REPAIRS, Untangling(resume=True), *LOCAL_REPAIRS
# Newton steps towards the map of least area if no injective map exists; later steps cause no visible change.
_AREA_STEPS = 30


class _State(NamedTuple):
    """The best map of a search and the map of lowest V₃; see `Search`."""

    best: tuple[int, float]
    best_map: ComplexArray
    best_field: TensorField | None
    best_reference: Reference
    lowest_energy: Iterate | None


def allowed_repairs(problem: Problem, options: SearchOptions) -> int:
    """Return the iterations that failed patch repairs of a search may cost."""
    boundary = np.unique(np.concatenate(problem.domain.loops))
    target = problem.target[np.isin(problem.fixed, boundary)]
    touching = len(np.unique(target, axis=0)) < len(target)
    return options.max_iterations * (_FAILED_REPAIRS_OF_TOUCHING if touching else _FAILED_REPAIRS)


class Search:
    """Run stages one after another, keep the best map and record the history; see `MapResult` for other attributes.

    Attributes
    ----------
    problem : Problem
        The problem. While the search runs, no other search uses its domain.
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
    failed_repairs : FailedRepairs
        Failed work that is still allowed, in iterations.
    """

    def __init__(self, problem: Problem, options: SearchOptions) -> None:
        self.problem = problem
        # Only the tensors of the initial map are used, so it gets its own frame.
        self._start = None if options.start is None else Frame(options.start).inward(options.start)
        self.linear_solver = self._solver_name = options.linear_solver
        # If a factorisation fails because of rounding, another backend with another elimination order may succeed.
        self._other_solvers: tuple[str, ...] | None = None if options.linear_solver == "auto" else ()
        self._callback = options.callback
        self._budget = options.max_iterations
        self.failed_repairs = options.failed_repairs or FailedRepairs(allowed_repairs(problem, options))
        self._record_every = options.record_every
        self.path: list[Snapshot] = []
        self.history: list[Step] = []
        self.stages: list[Stage] = []
        self.diagnosis: Diagnosis | None = None
        self.status = Status.OUT_OF_ITERATIONS
        # Initial value: every free vertex at the centre of the target.
        self.best_map = np.zeros(problem.n, dtype=np.complex128)
        self.best_field: TensorField | None = None
        self.best_reference: Reference = "equilateral"
        self.lowest_energy: Iterate | None = None
        self.best = len(problem.F), np.inf
        self._set_aside: _State | None = None
        self._rounded = self._has_tried = False

    def run(self, stages: Stages) -> Status:
        """Run stages until one finds an injective map; return the status at the end of the search.

        If the first stage already ran in a batch (`begin_in_batch`), run the others.
        """
        with self.problem.exclusive() as self.problem:
            try:
                self.status = self._run(stages)
            except KeyboardInterrupt:
                self.status = Status.INTERRUPTED
        return self.status

    def _run(self, stages: Stages) -> Status:
        """Run the stages in order until a map is found, the budget is spent or a diagnosis forbids a map."""
        on_the_mesh = [stage.begins_with for stage in stages if not stage.coarse]
        fallback = on_the_mesh[0] if on_the_mesh else stages[0].begins_with
        if not self.problem.encloses_area:
            self._descend(VectorAdam(iterations=1))
            self._diagnose()
            return Status.IMPOSSIBLE
        if self._start is not None:
            # With an initial map, run the first stage before all others and skip stages on a coarse mesh.
            self._attempt(fallback)
            stages = on_the_mesh or [fallback]
        for stage in stages[1:] if self._has_tried else stages:
            if self.status is Status.INJECTIVE or self.left <= 0 or self.failed_repairs.left <= 0:
                break
            # Later stages are slow, and useless if no injective map exists.
            if self._has_tried and not stage.quick and self._diagnose().forbids_injective:
                break
            if stage.coarse:
                self._search_on_coarse(stage)
            elif not isinstance(stage, IfManyInverted) or self.best[0] > MANY_INVERTED * len(self.problem.F):
                self._has_tried = True
                lowest_energy = self.lowest_energy
                status = self._attempt(stage.begins_with)
                if isinstance(stage, TentativeStage) and status is not Status.INJECTIVE:
                    self.lowest_energy = lowest_energy
        if self.best_field is None and self.left > 0:
            # All stages were for a coarse mesh, which does not exist or gave no map.
            self._attempt(fallback)
        if self.status is Status.INJECTIVE:
            return self.status
        if self._diagnose().forbids_injective:
            self._minimise_area()
            return Status.IMPOSSIBLE
        if self._set_aside is not None and self._set_aside.best < self.best:
            self._state = self._set_aside
        return Status.ROUNDED if self._rounded else self.status

    def _attempt(self, stage: Descent) -> Status:
        """Run a descent on the mesh itself, with another linear solver if one fails; return the new status."""
        status = self._descend(stage)
        while status is Status.UNSOLVABLE and self._other_solvers and self.left > 0:
            self._solver_name = self._other_solvers[0]
            status = self._descend(replace(stage, resume=True))
        # A stalled vertex descent does not mean that the tensor search before it converged.
        if status is Status.INJECTIVE or not stage.moves_vertices or self.status is not Status.UNSOLVABLE:
            self.status = status
        return self.status

    def _descend(self, stage: Descent) -> Status:
        """Run a descent with the current linear solver and record it; return its status."""
        run, began = StageRun(self, stage), time.perf_counter()
        try:
            objective = stage.objective(self.problem, self._solver_name)
            solver = objective.laplacian.solver
            self.linear_solver = solver.name
            if self._other_solvers is None:
                self._other_solvers = available(solver.nnz)
            if self.linear_solver in self._other_solvers:
                self._other_solvers = self._other_solvers[self._other_solvers.index(self.linear_solver) + 1 :]
            given = None if self.history else self._start
            start = stage.start(objective, SearchState(given, self.best_map, self.lowest_energy))
            visit_rounds(single_rounds(run, objective, start))
        except NotPositiveDefinite:
            run.status = Status.UNSOLVABLE
        finally:
            run.seconds = time.perf_counter() - began
            run.record()
        assert run.status is not None
        return run.status

    def begin_in_batch(self, stage: Descent) -> StageRun[Search]:
        """Return the run of the first stage, which a batch then performs."""
        self._has_tried = True
        return StageRun(self, stage)

    @property
    def left(self) -> int:
        """Iterations left; the very first evaluation, the start, is not counted."""
        return self._budget + 1 - len(self.history)

    def visit(self, here: Iterate, inverted: int, *, tensors: bool) -> None:
        """Record an iterate with this number of inverted triangles, and update the best map.

        If ``tensors``, it comes from a tensor descent.
        """
        self._rounded |= inverted > here.inverted == 0
        self._append_step(inverted, here.energy)
        number = len(self.history) - 1
        if self._record_every and number % self._record_every == 0:
            self.path.append(Snapshot(number, self.problem.positions(here.w)))
        if (inverted, here.energy) < self.best:
            self.best = inverted, here.energy
            self.best_map, self.best_field, self.best_reference = here.w, here.field, here.objective.reference
        if tensors and (self.lowest_energy is None or here.energy < self.lowest_energy.energy):
            self.lowest_energy = here

    def _append_step(self, inverted: int, energy: float) -> None:
        """Append a step to the history, and call the callback."""
        step = Step(len(self.history), inverted, energy)
        self.history.append(step)
        if self._callback is not None:
            self._callback(step)

    def _search_on_coarse(self, stage: SearchStage) -> None:
        """Search on a coarse mesh if one exists, and transfer its map to the fine mesh."""
        # ``path`` contains only maps of this mesh, so skip the coarse mesh if maps are recorded.
        coarse = None if self._record_every else coarse_mesh(self.problem)
        if coarse is None:
            return
        done, began, before = max(len(self.history), 1), time.perf_counter(), self._state
        problem = Problem.on(coarse.domain, self.problem.target, reference="equilateral")
        options = SearchOptions(
            max_iterations=self.left,
            linear_solver=self._solver_name,
            callback=lambda step: self._append_step(step.inverted, step.energy),
        )
        status, uv, inverted, self.linear_solver = search_coarse(problem, stage.begins_with, options)
        is_final = status in (Status.INJECTIVE, Status.INTERRUPTED)
        if is_final or (status is not Status.IMPOSSIBLE and inverted <= MAX_INVERTED):
            w = coarse.prolong(problem.frame.inward(uv))
            (inverted,) = count_not_positive([(self.problem, w)])
            if is_final or inverted <= min(MAX_INVERTED, self.best[0] - 1):
                self._replace_best(w, inverted)
                self._rounded |= status is Status.INJECTIVE and inverted > 0
                self._append_step(*self.best)
        self.stages.append(
            Stage(
                name=f"{stage.name}, {len(problem.F)} triangles",
                n_iterations=len(self.history) - done,
                seconds=time.perf_counter() - began,
                inverted=(before.best[0], self.best[0]),
                energy=(before.best[1], self.best[1]),
                kept=self.best != before.best,
            )
        )
        if status is Status.INTERRUPTED:
            raise KeyboardInterrupt
        if self.best != before.best and self.best[0]:
            self._repair_transferred(before)
        if self.best[0] == 0:
            self.status = Status.INJECTIVE

    def _replace_best(self, w: ComplexArray, inverted: int) -> None:
        """Replace the best map by ``w`` with its own tensors."""
        mesh = self.problem.domain.mesh("equilateral")
        dw = mesh.derivatives(w)
        field = TANH.field(TANH.invert(own_tensor(dw.p, dw.q)))
        self._state = _State((inverted, 0.0 if inverted == 0 else np.inf), w, field, mesh.kind, self.lowest_energy)

    def _repair_transferred(self, before: _State) -> None:
        """Untangle the last inverted triangles of a map from a coarse mesh; if that fails, set the map aside.

        Later stages then start from the previous state, because the transferred map may contain obstacles from the
        coarse mesh.
        """
        for stage in LOCAL_REPAIRS:
            if self.left > 0 and 0 < self.best[0] <= MAX_INVERTED:
                self.lowest_energy = stage.objective(self.problem, self._solver_name).of_map(self.best_map)
                self._descend(stage)
        if self.best[0]:
            self._set_aside, self._state = self._state, before

    @property
    def _state(self) -> _State:
        """The best map and the map of lowest V₃."""
        return _State(self.best, self.best_map, self.best_field, self.best_reference, self.lowest_energy)

    @_state.setter
    def _state(self, state: _State) -> None:
        self.best, self.best_map, self.best_field, self.best_reference, self.lowest_energy = state

    def _diagnose(self) -> Diagnosis:
        """Return the diagnosis of the problem; computed once."""
        from quasiharmonic.problem.diagnosis import diagnose

        if self.diagnosis is None:
            self.diagnosis = diagnose(self.problem)
        return self.diagnosis

    def _minimise_area(self) -> None:
        """Move to the map of least area, which is the target's area plus V₃ (eq. 42)."""
        if self.left > 0:
            self._descend(Newton(iterations=_AREA_STEPS, resume=True))
        if self.lowest_energy is not None:
            here = self.lowest_energy
            self.best_map, self.best_field, self.best_reference = here.w, here.field, here.objective.reference


def search_coarse(problem: Problem, first: Descent, options: SearchOptions) -> tuple[Status, FloatArray, int, str]:
    """Solve a coarse problem and lower the distortion of its map slightly.

    Return the status, the map (n, 2), its number of inverted triangles and the linear solver used.
    """
    search = Search(problem, options)
    status = search.run([first, *_COARSE_STAGES])
    uv = problem.positions(search.best_map)
    if status is Status.INJECTIVE:
        # Fine vertices crowd in thin coarse triangles. A few polishing steps avoid much later work.
        polish = polish_map(
            problem.domain, uv, PolishOptions(energy="mips", max_iterations=10, linear_solver=options.linear_solver)
        )
        uv = polish.uv
    return status, uv, search.best[0], search.linear_solver
