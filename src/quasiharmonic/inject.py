"""From a problem to a map without inverted triangles: the strategy (§9.2).

``injective_map`` is the one-shot call and ``solve`` the same for a `Problem` at hand. The search stops at
the first map whose every triangle is strictly positive, decided exactly on the coordinates that are
handed back.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import TYPE_CHECKING, get_args

import numpy as np
from numpy.typing import ArrayLike, NDArray

from quasiharmonic.certificate import certify, flipped_triangles
from quasiharmonic.coarse_problem import coarse_problem
from quasiharmonic.energies import Energy
from quasiharmonic.linsolve import NotPositiveDefinite, available
from quasiharmonic.mesh.reference import Reference
from quasiharmonic.mesh.topology import named
from quasiharmonic.objective import Iterate, Objective
from quasiharmonic.optimize import Stop
from quasiharmonic.optimize.alternating import alternating, own_tensor
from quasiharmonic.optimize.lbfgs import lbfgs
from quasiharmonic.optimize.newton import newton
from quasiharmonic.optimize.patches import patches
from quasiharmonic.optimize.shaking import shaking
from quasiharmonic.optimize.untangling import iterate_of, untangling
from quasiharmonic.optimize.vector_adam import vector_adam
from quasiharmonic.polishing import energy_named, polish_map, polished
from quasiharmonic.problem import Problem
from quasiharmonic.result import MapResult, Snapshot, Stage, Status, Step
from quasiharmonic.strategy import Descent, stages_of, whole_number
from quasiharmonic.tensor import TANH, TensorField

if TYPE_CHECKING:
    from quasiharmonic.diagnosis import Diagnosis

FloatArray = NDArray[np.float64]
ComplexArray = NDArray[np.complex128]


def injective_map(
    V: ArrayLike,
    F: ArrayLike,
    fixed: ArrayLike,
    target: ArrayLike,
    *,
    reference: Reference | None = None,
    strategy: str | Sequence[Descent] = "speed",
    polish: str | Energy | None = None,
    start: ArrayLike | None = None,
    max_iterations: int = 2000,
    linear_solver: str = "auto",
    callback: Callable[[Step], object] | None = None,
    record: int = 0,
) -> MapResult:
    """Map a triangle mesh into the plane with no triangle inverted.

    Parameters
    ----------
    V : (n, 2) or (n, 3) array
        Rest positions of a planar or curved mesh, disk-like or with holes.
    F : (f, 3) array of int
        Triangles, consistently oriented.
    fixed : (k,) array of int
        Vertices with given positions: the whole boundary and any pinned interior vertices.
    target : (k, 2) array
        Where they go.
    reference : {"equilateral", "rest", "corrected"}, optional
        Shape of the triangles in which gradients are taken (§9.3), whatever the strategy would choose.
    strategy : {"speed", "quality"} or sequence of Descent
        ``"speed"`` finds a map soonest; ``"quality"`` takes longer and keeps angles; or stages of one's own.
    polish : str or Energy, optional
        Once injective, lower this distortion energy; see `quasiharmonic.polish` for the names.
    start : (n, 2) array, optional
        A map to begin with, for instance that of the same mesh for a target near this one: the search starts at
        its tensors, and afresh where that leads nowhere.
    max_iterations : int
        Linear solves to spend at most on finding the map.
    linear_solver : str
        ``"auto"`` or one of `quasiharmonic.linsolve.available`.
    callback : callable, optional
        Called with a `Step` at every iteration.
    record : int
        Keep the map of every ``record``-th iteration in the result's ``path``; none of them by default.

    Returns
    -------
    MapResult
        With the certified map, or with the best map found and a status that says why it is not
        injective. Failure to find a map is not an exception. Ctrl-C ends the search and returns the best
        map so far.

    Raises
    ------
    ValueError
        When the input is malformed; see `Problem`.

    Examples
    --------
    A square annulus whose hole is turned by a quarter:

    >>> import numpy as np
    >>> from quasiharmonic import injective_map
    >>> from quasiharmonic.surfaces import annulus
    >>> from quasiharmonic.mesh.topology import boundary_loops
    >>> V, F = annulus()
    >>> outer, inner = sorted(boundary_loops(F, len(V)), key=len, reverse=True)
    >>> target = np.concatenate([V[outer], V[inner] @ [[0, 1], [-1, 0]]])
    >>> result = injective_map(V, F, np.concatenate([outer, inner]), target)
    >>> result.injective, bool(result.certificate.bijective)
    (True, True)
    """
    began = time.perf_counter()
    problem = Problem(V, F, fixed, target, reference=reference)
    return solve(
        problem,
        strategy=strategy,
        polish=polish,
        start=start,
        max_iterations=max_iterations,
        linear_solver=linear_solver,
        callback=callback,
        record=record,
        _began=began,
    )


def solve(
    problem: Problem,
    *,
    strategy: str | Sequence[Descent] = "speed",
    polish: str | Energy | None = None,
    start: ArrayLike | None = None,
    max_iterations: int = 2000,
    linear_solver: str = "auto",
    callback: Callable[[Step], object] | None = None,
    record: int = 0,
    _began: float | None = None,
) -> MapResult:
    """Solve a problem at hand; parameters and result as `injective_map` has them."""
    began = time.perf_counter() if _began is None else _began
    whole_number("max_iterations", max_iterations, least=1)
    whole_number("record", record, least=0)
    lower = None if polish is None else energy_named(polish)
    first = None if start is None else _first_map(problem, start)
    with problem.exclusive() as own:
        search = _Search(own, linear_solver, callback, max_iterations, record, first)
        status = search.run(stages_of(strategy, own))
    uv = problem.positions(search.best_map)
    certificate = certify(problem.F, uv, loops=problem.loops)
    field = search.best_field
    result = MapResult(
        uv=uv,
        status=Status.INJECTIVE if certificate.injective else status,
        certificate=certificate,
        stages=search.stages,
        history=search.history,
        path=search.path,
        diagnosis=search.diagnosis,
        linear_solver=search.linear_solver,
        mu=None if field is None else field.mu,
        reference=search.best_reference,
    )
    if lower is not None and status is Status.INJECTIVE:
        result = polished(problem, result, energy=lower, callback=callback)
    return replace(result, seconds=time.perf_counter() - began)


def quasi_harmonic_map(
    problem: Problem,
    mu: ComplexArray | None = None,
    *,
    reference: Reference = "equilateral",
    linear_solver: str = "auto",
) -> FloatArray:
    """The map of a tensor field (eq. 12): Tutte's embedding where no field is given.

    Parameters
    ----------
    problem : Problem
    mu : (f,) complex128, optional
        Beltrami coefficients of the tensors, below 1 in modulus; zero by default.
    reference : {"equilateral", "rest", "corrected"}
        The triangles in whose frames they are expressed, unless the problem itself names others.
    linear_solver : str
        ``"auto"`` or one of `quasiharmonic.linsolve.available`.

    Returns
    -------
    (n, 2) float64
        Positions, the fixed vertices exactly at their target. Injective only where the target is convex
        or μ is right.

    Raises
    ------
    ValueError
        When μ has another shape or is not below 1 in modulus; the message names the triangles.
    quasiharmonic.linsolve.NotPositiveDefinite
        When rounding leaves no positive definite Laplacian.
    """
    if reference not in get_args(Reference):
        raise ValueError(f"reference must be one of {', '.join(get_args(Reference))}, not {reference!r}")
    coefficients = np.zeros(len(problem.F)) if mu is None else np.asarray(mu)
    if coefficients.shape != (len(problem.F),) or coefficients.dtype.kind not in "iufc":
        raise ValueError(f"mu must hold {len(problem.F)} numbers, one a triangle, not an array of {coefficients.shape}")
    bad = np.flatnonzero(~(np.abs(coefficients) < 1))
    if bad.size:
        raise ValueError(f"mu is not below 1 in modulus at {named('triangle', 'triangles', bad)}")
    with problem.exclusive() as own:
        objective = Objective(own, reference=reference, linear_solver=linear_solver)
        return own.positions(objective.evaluate(TANH.invert(coefficients.astype(np.complex128))).w)


def _on_coarse(
    problem: Problem, stage: Descent, linear_solver: str, budget: int, callback: Callable[[Step], object]
) -> MapResult:
    """Solve a coarse problem, and lower the distortion of its map a little."""
    stages = [
        replace(stage, optimizer="vector-adam"),
        Descent("patches", iterations=30, resume=True),
        Descent("untangling", iterations=300, resume=True),
    ]
    result = solve(problem, strategy=stages, max_iterations=budget, linear_solver=linear_solver, callback=callback)
    if not result.injective:
        return result
    # Fine vertices crowd where coarse triangles are thin: a few steps against that pay many times over.
    evened = polish_map(problem, result.uv, energy="mips", max_iterations=10, linear_solver=result.linear_solver)
    return replace(result, uv=evened.uv)


def _first_map(problem: Problem, start: ArrayLike) -> ComplexArray:
    """The caller's first map, checked, as complex numbers in the problem's frame."""
    uv = np.array(start, dtype=np.float64, order="C")
    if uv.shape != (problem.n, 2):
        raise ValueError(f"start must have shape ({problem.n}, 2), a place for every vertex, not {uv.shape}")
    bad = np.flatnonzero(~np.isfinite(uv).all(axis=1))
    if bad.size:
        raise ValueError(f"start is not finite at {named('vertex', 'vertices', bad)}")
    return problem.frame.inward(uv)


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


class _Search:
    """Runs stages one after another, keeps the best map and writes down what happened."""

    def __init__(
        self,
        problem: Problem,
        linear_solver: str,
        callback: Callable[[Step], object] | None,
        budget: int,
        record: int,
        first: ComplexArray | None,
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
            here = [stage for stage in given if stage.optimizer != "coarse-to-fine"] or [Descent()]
            if not self.problem.encloses_area:
                self._descend(replace(here[0], iterations=1))
                return self._diagnosed(Status.IMPOSSIBLE)
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
                if self._left <= 0 or (number == 0 and self._diagnosed(status) is Status.IMPOSSIBLE):
                    break
            return self._diagnosed(Status.ROUNDED if self._rounded else status)
        except KeyboardInterrupt:
            return Status.INTERRUPTED

    def _from_coarse(self, stage: Descent) -> Status:
        """Search on a coarse mesh, if there is one to be had, and carry its map to this one."""
        # What is recorded are maps of this mesh.
        coarse = None if self.record or self._left <= 0 else coarse_problem(self.problem)
        if coarse is None:
            return Status.OUT_OF_ITERATIONS
        done, began, before = max(len(self.history), 1), time.perf_counter(), self.best
        result = _on_coarse(coarse.problem, stage, self.linear_solver, self._left, self._note)
        self.linear_solver = result.linear_solver
        if result.status in (Status.INJECTIVE, Status.INTERRUPTED):
            w = coarse.prolong(result.uv)
            mesh, flipped = (
                self.problem.mesh("equilateral"),
                flipped_triangles(self.problem.F, self.problem.positions(w)),
            )
            self.best, self.best_map, self.best_reference = (
                (flipped.size, 0.0 if flipped.size == 0 else np.inf),
                w,
                mesh.kind,
            )
            self.best_field = TANH.field(TANH.invert(own_tensor(mesh.derivatives(w))))
            self._rounded |= result.injective and flipped.size > 0
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
        if result.status is Status.INTERRUPTED:
            raise KeyboardInterrupt
        return Status.INJECTIVE if self.best[0] == 0 else Status.SETTLED

    def _note(self, step: Step) -> None:
        """Write a step down, whatever its number was where it was made."""
        step = replace(step, iteration=len(self.history))
        self.history.append(step)
        if self.callback is not None:
            self.callback(step)

    def _diagnosed(self, status: Status) -> Status:
        """The status once it is known whether anything forbids a map."""
        from quasiharmonic.diagnosis import diagnose

        if self.diagnosis is None:
            self.diagnosis = diagnose(self.problem)
        return Status.IMPOSSIBLE if self.diagnosis.forbids_injective else status

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
            # A method that returns before its iterations are spent has nothing left to do.
            spent = len(self.history) - begun >= allowed
            ended = (spent or stage.optimizer == "newton") and not stage.moves_vertices
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
        flips, energy = self._mark
        if flipped < flips or step.energy < (1 - self._progress) * energy:
            self._mark = min(flipped, flips), min(step.energy, energy)
            self._marked = len(self.history)
        elif len(self.history) - self._marked > self._patience:
            raise Stop(Status.SETTLED)
