"""The search: stages run one after another until one finds a map without inverted triangles (§9.2).

Where none does, the search ends with the reason, if one is known, and then with the map of least area.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from quasiharmonic.certificate import flipped_triangles
from quasiharmonic.coarse_problem import coarse_problem
from quasiharmonic.linsolve import NotPositiveDefinite, available
from quasiharmonic.mesh.reference import Reference
from quasiharmonic.objective import Iterate, Objective
from quasiharmonic.optimize import Stop
from quasiharmonic.optimize.alternating import alternating, own_tensor
from quasiharmonic.optimize.lbfgs import lbfgs
from quasiharmonic.optimize.newton import newton
from quasiharmonic.optimize.patches import patches
from quasiharmonic.optimize.shaking import shaking
from quasiharmonic.optimize.untangling import iterate_of, untangling
from quasiharmonic.optimize.vector_adam import vector_adam
from quasiharmonic.polishing import polish_map
from quasiharmonic.problem import Problem
from quasiharmonic.result import Snapshot, Stage, Status, Step
from quasiharmonic.strategy import Descent
from quasiharmonic.tensor import TANH, TensorField

if TYPE_CHECKING:
    from quasiharmonic.diagnosis import Diagnosis

FloatArray = NDArray[np.float64]
ComplexArray = NDArray[np.complex128]

# Newton steps towards the map of least area where there is no injective one: what follows moves nothing one would see.
_TO_LEAST_AREA = 30

_Visit = Callable[[Iterate], None]
_METHODS: dict[str, Callable[[Objective, Iterate, _Visit, Descent, int], None]] = {
    "vector-adam": lambda o, start, visit, stage, n: vector_adam(o, start, visit, iterations=n, schedule=stage.steps),
    "l-bfgs": lambda o, start, visit, stage, n: lbfgs(o, start, visit, iterations=n),
    "newton": lambda o, start, visit, stage, n: newton(o, start, visit, iterations=n),
    "alternating": lambda o, start, visit, stage, n: alternating(o, start, visit, iterations=n),
    "untangling": lambda o, start, visit, stage, n: untangling(o, start, visit, iterations=n),
    "shaking": lambda o, start, visit, stage, n: shaking(o, start, visit, iterations=n),
    "patches": lambda o, start, visit, stage, n: patches(o, start, visit, iterations=n),
}


class Search:
    """Runs stages one after another, keeps the best map and writes down what happened.

    Parameters
    ----------
    problem : Problem
        Nobody else's while the search runs.
    linear_solver : str
        A name of `quasiharmonic.linsolve`, or ``"auto"``.
    callback : callable, optional
        Called with a `Step` at every iteration.
    budget : int
        Iterations at most.
    record : int
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
        record: int = 0,
        first: ComplexArray | None = None,
    ) -> None:
        self.problem = problem
        self._first = first
        # Where rounding defeats one backend's factorisation, another's order of elimination may do.
        self.linear_solver = linear_solver
        self._spare = available() if linear_solver == "auto" else ()
        self.callback = callback
        self.budget = budget
        self.record = record
        self.path: list[Snapshot] = []
        self.history: list[Step] = []
        self.stages: list[Stage] = []
        self.diagnosis: Diagnosis | None = None
        # Should nothing at all be computed, every free vertex lies at the middle of the target.
        self.best_map = np.zeros(problem.n, dtype=np.complex128)
        self.best_field: TensorField | None = None
        self.best_reference: Reference = "equilateral"
        self.deepest: Iterate | None = None
        self.best = len(problem.F), np.inf
        self._rounded = False
        self._mark, self._marked = self.best, 0
        self._patience, self._progress = 0, 0.0
        self._moves_tensors = True

    def run(self, given: Sequence[Descent]) -> Status:
        """Run stages until one finds an injective map; why the search ended."""
        status = Status.OUT_OF_ITERATIONS
        try:
            plain = replace(given[0], optimizer="vector-adam")
            here = [stage for stage in given if stage.optimizer != "coarse-to-fine"] or [plain]
            if not self.problem.encloses_area:
                self._descend(replace(here[0], iterations=1))
                self._examine()
                return Status.IMPOSSIBLE
            # From a map at hand the first stage is tried before all.
            stages, number = (given, -1) if self._first is None else ([here[0], *here], -2)
            for stage in stages:
                if stage.optimizer == "coarse-to-fine":
                    if self._from_coarse(stage) is Status.INJECTIVE:
                        return Status.INJECTIVE
                    continue
                number += 1
                before, status = status, self._descend(stage)
                while status is Status.UNSOLVABLE and self._spare and self._left > 0:
                    self.linear_solver = self._spare[0]
                    status = self._descend(replace(stage, resume=True))
                if status is Status.INJECTIVE:
                    return status
                # That vertices got nowhere does not mean that tensors had settled.
                if stage.moves_vertices and before is Status.UNSOLVABLE:
                    status = before
                # What is tried after the first stage takes long, and is pointless where there is a reason.
                if self._left <= 0 or (number == 0 and self._examine().forbids_injective):
                    break
            if number == -1 and self.best_field is None and self._left > 0:
                # Stages for a coarse mesh alone, and none was to be had or it led to nothing.
                status = self._descend(here[0])
                if status is Status.INJECTIVE:
                    return status
            if self._examine().forbids_injective:
                self._sink()
                return Status.IMPOSSIBLE
            return Status.ROUNDED if self._rounded else status
        except KeyboardInterrupt:
            return Status.INTERRUPTED

    def _from_coarse(self, stage: Descent) -> Status:
        """Search on a coarse mesh, if there is one to be had, and carry its map to this one."""
        # What is recorded are maps of this mesh.
        coarse = None if self.record or self._left <= 0 else coarse_problem(self.problem)
        if coarse is None:
            return Status.OUT_OF_ITERATIONS
        done, began, before = max(len(self.history), 1), time.perf_counter(), self.best
        status, uv, self.linear_solver = _on_coarse(coarse.problem, stage, self.linear_solver, self._left, self._note)
        if status in (Status.INJECTIVE, Status.INTERRUPTED):
            w = coarse.prolong(uv)
            mesh = self.problem.mesh("equilateral")
            flipped = flipped_triangles(self.problem.F, self.problem.positions(w)).size
            self.best = flipped, 0.0 if flipped == 0 else np.inf
            self.best_map, self.best_reference = w, mesh.kind
            self.best_field = TANH.field(TANH.invert(own_tensor(mesh.derivatives(w))))
            self._rounded |= status is Status.INJECTIVE and flipped > 0
            self._note(Step(0, *self.best))
        self.stages.append(
            Stage(
                name=f"{stage.name}, {len(coarse.problem.F)} triangles",
                iterations=len(self.history) - done,
                seconds=time.perf_counter() - began,
                flipped=(before[0], self.best[0]),
                energy=(before[1], self.best[1]),
                kept=self.best != before,
            )
        )
        if status is Status.INTERRUPTED:
            raise KeyboardInterrupt
        return Status.INJECTIVE if self.best[0] == 0 else Status.SETTLED

    def _note(self, step: Step) -> None:
        """Write a step down, whatever its number was where it was made."""
        step = replace(step, iteration=len(self.history))
        self.history.append(step)
        if self.callback is not None:
            self.callback(step)

    def _examine(self) -> Diagnosis:
        """Whether anything forbids a map; found out once."""
        from quasiharmonic.diagnosis import diagnose

        if self.diagnosis is None:
            self.diagnosis = diagnose(self.problem)
        return self.diagnosis

    def _sink(self) -> None:
        """Where no map is injective, go to the one of least area: the target's area and V₃ make it up (eq. 42)."""
        if self._left > 0:
            self._descend(Descent("newton", iterations=_TO_LEAST_AREA, resume=True))
        if self.deepest is not None:
            here = self.deepest
            self.best_map, self.best_field, self.best_reference = here.w, here.field, here.objective.mesh.kind

    @property
    def _left(self) -> int:
        """Iterations left; the first evaluation of all is the start and costs none."""
        return self.budget + 1 - len(self.history)

    def _descend(self, stage: Descent) -> Status:
        """Run one stage."""
        before, done, began = None, max(len(self.history), 1), time.perf_counter()
        status = Status.INTERRUPTED
        self._mark, self._marked = (len(self.problem.F) + 1, np.inf), len(self.history)
        self._patience, self._progress = stage.patience
        self._moves_tensors = not stage.moves_vertices
        try:
            objective = Objective(
                self.problem, stage.functional, stage.parameterization, stage.reference, self.linear_solver
            )
            self.linear_solver = objective.laplacian.solver.name
            if self.linear_solver in self._spare:
                self._spare = self._spare[self._spare.index(self.linear_solver) + 1 :]
            start = self._start(objective, stage)
            # The first map of all is what the first stage begins with.
            before = (start.flipped, start.energy) if self.best_field is None else self.best
            self._visit(start)
            begun, allowed = len(self.history), min(stage.iterations, self._left)
            _METHODS[stage.optimizer](objective, start, self._visit, stage, allowed)
            # A method that returns before its iterations are spent has nothing left to do. Those of local repair are
            # tries, of which it has made enough.
            spent = len(self.history) - begun >= allowed
            ended = (spent or stage.optimizer == "newton") and stage.optimizer not in ("patches", "shaking")
            status = Status.OUT_OF_ITERATIONS if ended or self._left <= 0 else Status.SETTLED
        except Stop as stop:
            status = stop.status
        except NotPositiveDefinite:
            status = Status.UNSOLVABLE
        finally:
            self.stages.append(
                Stage(
                    name=stage.name,
                    iterations=max(len(self.history) - done, 0),
                    seconds=time.perf_counter() - began,
                    flipped=((before or self.best)[0], self.best[0]),
                    energy=((before or self.best)[1], self.best[1]),
                    kept=self.best != before or status is Status.INJECTIVE,
                )
            )
        return status

    def _start(self, objective: Objective, stage: Descent) -> Iterate:
        """Where a stage begins: at ξ = 0; at the tensors of the lowest V₃ so far; or at the best map. The very first
        begins at the caller's map, if there is one.

        Tensors are not resumed from the map of the fewest flips, which may have been passed by early on, far from
        any solution. For local repair it is the one to repair.
        """
        best = self.deepest if stage.resume else None
        if best is not None and stage.moves_vertices:
            return iterate_of(objective, best.w if stage.optimizer == "untangling" else self.best_map)
        if self._first is not None and not self.history:
            mu = own_tensor(objective.mesh.derivatives(self._first))
        elif best is None:
            mu = np.zeros(len(self.problem.F), dtype=np.complex128)
        elif best.objective.mesh is objective.mesh:
            mu = best.field.mu
        else:
            mu = own_tensor(objective.mesh.derivatives(best.w))
        return objective.evaluate(objective.bounded(objective.parameterization.invert(mu)))

    def _visit(self, here: Iterate) -> None:
        """Take note of an iterate; stop at an injective one and where nothing moves any more."""
        flipped = here.flipped
        if flipped == 0:
            # Decided on the coordinates that are handed back, not on the solver's own.
            flipped = flipped_triangles(self.problem.F, self.problem.positions(here.w)).size
            self._rounded |= flipped > 0
        step = Step(len(self.history), flipped, here.energy)
        self._note(step)
        if self.record and step.iteration % self.record == 0:
            self.path.append(Snapshot(step.iteration, self.problem.positions(here.w)))
        if (flipped, step.energy) < self.best:
            self.best = flipped, step.energy
            self.best_map, self.best_field, self.best_reference = here.w, here.field, here.objective.mesh.kind
        if self._moves_tensors and (self.deepest is None or here.energy < self.deepest.energy):
            self.deepest = here
        if flipped == 0:
            raise Stop(Status.INJECTIVE)
        if self._left <= 0:
            raise Stop(Status.OUT_OF_ITERATIONS)
        flips, energy = self._mark
        if flipped < flips or step.energy < (1 - self._progress) * energy:
            self._mark = min(flipped, flips), min(step.energy, energy)
            self._marked = len(self.history)
        elif len(self.history) - self._marked > self._patience:
            raise Stop(Status.SETTLED)


def _on_coarse(
    problem: Problem, stage: Descent, linear_solver: str, budget: int, callback: Callable[[Step], object]
) -> tuple[Status, FloatArray, str]:
    """Solve a coarse problem, and lower the distortion of its map a little: why it ended, the map, the backend."""
    search = Search(problem, linear_solver, callback, budget)
    status = search.run(
        [
            replace(stage, optimizer="vector-adam"),
            Descent("patches", iterations=30, resume=True),
            Descent("untangling", iterations=300, resume=True),
        ]
    )
    uv = problem.positions(search.best_map)
    if status is Status.INJECTIVE:
        # Fine vertices crowd where coarse triangles are thin: a few steps against that pay many times over.
        uv = polish_map(problem, uv, energy="mips", max_iterations=10, linear_solver=search.linear_solver).uv
    return status, uv, search.linear_solver
