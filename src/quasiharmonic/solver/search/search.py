"""Run stages one after another until one finds a map without inverted triangles (§9.2).

If no stage finds one, the search reports the reason if a diagnosis proves it, and then returns the map of least area.

Stages for large meshes run on a coarse mesh that keeps all fixed vertices, because the number of iterations does not
depend on the mesh size, but the cost of each does. The map is then transferred to the fine mesh vertex by vertex,
without any factorisation or descent there.
"""

from __future__ import annotations

import time
from dataclasses import replace
from typing import TYPE_CHECKING, NamedTuple
from weakref import WeakKeyDictionary

import numpy as np

from quasiharmonic.energies.polishing import polish_map
from quasiharmonic.geometry.coarsening import coarsen
from quasiharmonic.geometry.exact.certificate import certify
from quasiharmonic.geometry.mesh.reference import rest_shapes
from quasiharmonic.geometry.prolongation import prolong
from quasiharmonic.linsolve import NotPositiveDefinite, available
from quasiharmonic.problem import Domain, Frame, Problem
from quasiharmonic.problem.result import MapResult, Status
from quasiharmonic.problem.run import finish
from quasiharmonic.solver.methods import Descent, LineShift, Newton, Untangling, VectorAdam
from quasiharmonic.solver.methods.base import SearchState
from quasiharmonic.solver.methods.local_repair import MAX_INVERTED
from quasiharmonic.solver.search.record import (
    BestMap,
    RepairBudget,
    SearchRecord,
    StageRun,
    count_not_positive,
    single_rounds,
    visit_rounds,
)
from quasiharmonic.solver.search.stages import Stages, stages_of
from quasiharmonic.util.arrays import ComplexArray, FloatArray, IntArray, invert_indices, map_array, mark, pad_to_space
from quasiharmonic.util.options import MapOptions, PolishOptions

if TYPE_CHECKING:
    from quasiharmonic.problem.diagnosis import Diagnosis

# Maximum cost of failed patch repairs in all stages together, in units of the search's iteration budget. If boundary
# vertices share a target position, V₃ is almost zero at folded maps, too, and repairs hardly ever help.
_FAILED_REPAIRS, _FAILED_REPAIRS_OF_TOUCHING = 16, 2
# Stages that untangle the last few triangles.
LOCAL_REPAIRS = (LineShift(resume=True),)
# Stages that follow the first stage on a coarse mesh.
_COARSE_STAGES = *LOCAL_REPAIRS, Untangling(resume=True), *LOCAL_REPAIRS


class CoarseTuning(NamedTuple):
    """Numbers that tune the coarse mesh and its use."""

    # Vertices of the coarse mesh, as a fraction of the fine mesh's.
    share: float = 1 / 8
    # Maximum number of vertices of the coarse mesh, unless the fixed vertices, all of which are kept, require more.
    max_vertices: int = 1000
    # This many vertices per fixed vertex suffice to grade the triangles from the boundary to the interior.
    vertices_per_fixed: int = 3
    # Coarsening to this fraction of the vertices or more saves too little.
    worthwhile: float = 0.5
    # Meshes with fewer vertices are not coarsened, because searching them is fast.
    min_vertices: int = 1500
    # Coarse triangles whose height is below this fraction of their longest side carry no useful shape, and their
    # weights in an energy exceed double precision.
    min_height: float = 1e-3
    # Corners of such triangles are moved by up to this fraction of the shortest edge there.
    perturbation: float = 0.2


_COARSE = CoarseTuning()
# Coarse meshes of the domains in use; None if a domain has none.
_COARSE_MESHES: WeakKeyDictionary[Domain, CoarseMesh | None] = WeakKeyDictionary()


def allowed_repairs(problem: Problem, max_iterations: int) -> int:
    """Return the iterations that failed patch repairs of a search may cost."""
    boundary = np.unique(np.concatenate(problem.domain.loops))
    target = problem.target[np.isin(problem.fixed, boundary)]
    touching = len(np.unique(target, axis=0)) < len(target)
    return max_iterations * (_FAILED_REPAIRS_OF_TOUCHING if touching else _FAILED_REPAIRS)


class Search(SearchRecord):
    """Run stages one after another, keep the best map and record the history.

    ``options`` are those of `quasiharmonic.injective_map`. ``repairs`` is the budget for failed repairs, by
    default `allowed_repairs`.
    """

    def __init__(self, problem: Problem, options: MapOptions, repairs: RepairBudget | None = None) -> None:
        super().__init__(problem, options, repairs or RepairBudget(allowed_repairs(problem, options.max_iterations)))
        start = None if options.start is None else map_array("start", options.start, problem.n)
        # Only the tensors of the initial map are used, so it gets its own frame.
        self._start = None if start is None else Frame(start).inward(start)
        self._options = options
        self._solver_name = options.linear_solver
        # If a factorisation fails because of rounding, another backend with another elimination order may succeed.
        self._other_solvers: tuple[str, ...] | None = None if options.linear_solver == "auto" else ()
        self._set_aside: BestMap | None = None
        self._has_tried = False

    def run(self, stages: Stages) -> Status:
        """Run stages until one finds an injective map; return the status at the end of the search.

        If the first stage already ran in a batch (`begin_in_batch`), run the others.
        """
        with self.problem.exclusive() as self.problem, self.work.until_interrupted():
            self.status = self._run(stages)
        if self.work.interrupted:
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
            self.attempt(fallback)
            stages = on_the_mesh or [fallback]
        for stage in stages[1:] if self._has_tried else stages:
            if self.status is Status.INJECTIVE or self.left <= 0 or self.repairs.left <= 0:
                break
            # Later stages are slow, and useless if no injective map exists.
            if self._has_tried and not stage.quick and self._diagnose().forbids_injective:
                break
            self._has_tried |= not stage.coarse
            stage.run(self)
        if self.best_field is None and self.left > 0:
            # All stages were for a coarse mesh, which does not exist or gave no map.
            self.attempt(fallback)
        if self.status is Status.INJECTIVE:
            return self.status
        if self._diagnose().forbids_injective:
            self._minimise_area()
            return Status.IMPOSSIBLE
        if self._set_aside is not None and self._set_aside.best < self.best:
            self.state = self._set_aside
        return Status.ROUNDED if self.rounded else self.status

    def attempt(self, stage: Descent) -> Status:
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
            given = None if self.work.history else self._start
            start = stage.start(objective, SearchState(given, self.best_map, self.lowest_energy))
            visit_rounds(single_rounds(run, objective, start))
        except NotPositiveDefinite:
            run.status = Status.UNSOLVABLE
        finally:
            run.seconds = time.perf_counter() - began
            run.record()
        assert run.status is not None
        return run.status

    def begin_in_batch(self, stage: Descent) -> StageRun:
        """Return the run of the first stage, which a batch then performs."""
        self._has_tried = True
        return StageRun(self, stage)

    def search_on_coarse(self, name: str, first: Descent) -> None:
        """Search on a coarse mesh if one exists, beginning with a descent, and transfer its map to the fine mesh."""
        # ``path`` contains only maps of this mesh, so skip the coarse mesh if maps are recorded.
        coarse = None if self._options.record_every else coarse_mesh(self.problem)
        if coarse is None:
            return
        done, began, before = max(len(self.work.history), 1), time.perf_counter(), self.state
        problem = Problem.on(coarse.domain, self.problem.target, reference="equilateral")
        options = MapOptions(
            max_iterations=self.left,
            linear_solver=self._solver_name,
            callback=lambda step: self.work.record(step.inverted, step.energy),
        )
        try:
            status, uv, inverted, self.linear_solver = search_coarse(problem, first, options)
            is_final = status in (Status.INJECTIVE, Status.INTERRUPTED)
            if is_final or (status is not Status.IMPOSSIBLE and inverted <= MAX_INVERTED):
                w = coarse.prolong(problem.frame.inward(uv))
                (inverted,) = count_not_positive([(self.problem, w)])
                if is_final or inverted <= min(MAX_INVERTED, self.best[0] - 1):
                    self.replace_best(w, inverted)
                    self.rounded |= status is Status.INJECTIVE and inverted > 0
                    if status is not Status.INTERRUPTED:
                        self.work.record(*self.best)
        finally:
            name, seconds = f"{name}, {len(problem.F)} triangles", time.perf_counter() - began
            self.record_stage(name, done, seconds, before.best, self.best != before.best)
        if status is Status.INTERRUPTED:
            raise KeyboardInterrupt
        if self.best != before.best and self.best[0]:
            self._repair_transferred(before)
        if self.best[0] == 0:
            self.status = Status.INJECTIVE

    def _repair_transferred(self, before: BestMap) -> None:
        """Untangle the last inverted triangles of a map from a coarse mesh; if that fails, set the map aside.

        Later stages then start from the previous state, because the transferred map may contain obstacles from the
        coarse mesh.
        """
        for stage in LOCAL_REPAIRS:
            if self.left > 0 and 0 < self.best[0] <= MAX_INVERTED:
                self.lowest_energy = stage.objective(self.problem, self._solver_name).of_map(self.best_map)
                self._descend(stage)
        if self.best[0]:
            self._set_aside, self.state = self.state, before

    def _diagnose(self) -> Diagnosis:
        """Return the diagnosis of the problem; computed once."""
        from quasiharmonic.problem.diagnosis import diagnose

        if self.diagnosis is None:
            self.diagnosis = diagnose(self.problem)
        return self.diagnosis

    def _minimise_area(self) -> None:
        """Move to the map of least area, which is the target's area plus V₃ (eq. 42)."""
        # Newton steps towards the map of least area if no injective map exists; later steps cause no visible change.
        area_steps = 30
        if self.left > 0:
            self._descend(Newton(iterations=area_steps, resume=True))
        if self.lowest_energy is not None:
            here = self.lowest_energy
            self.best_map, self.best_field, self.best_reference = here.w, here.field, here.objective.reference


def search_coarse(problem: Problem, first: Descent, options: MapOptions) -> tuple[Status, FloatArray, int, str]:
    """Solve a coarse problem and lower the distortion of its map slightly.

    Return the status, the map (n, 2), its number of inverted triangles and the linear solver used.
    """
    # Newton steps on a coarse map. Fine vertices crowd in thin coarse triangles, so a few steps avoid much later work.
    polishing_steps = 3
    search = Search(problem, options)
    status = search.run([first, *_COARSE_STAGES])
    uv = problem.positions(search.best_map)
    if status is Status.INJECTIVE:
        polishing = PolishOptions(energy="mips", max_iterations=polishing_steps, linear_solver=options.linear_solver)
        status = Status.INTERRUPTED
        with search.work.until_interrupted():
            polish = polish_map(problem.domain, uv, polishing)
            uv, status = polish.uv, Status.INTERRUPTED if polish.status is Status.INTERRUPTED else Status.INJECTIVE
    return status, uv, search.best[0], search.linear_solver


def search_map(problem: Problem, options: MapOptions, repairs: RepairBudget | None = None) -> MapResult:
    """Run the stages of a strategy on a problem and certify the best map; see `quasiharmonic.solve` for the result."""
    return finish_search(Search(problem, options, repairs), options.strategy)


def finish_search(search: Search, strategy: str | Stages) -> MapResult:
    """Run the stages of a search that have not run yet and certify the best map.

    The search is new, or its first stage ran in a batch.
    """
    began, spent = time.perf_counter(), sum(stage.seconds for stage in search.work.stages)
    if search.status is not Status.INJECTIVE:
        search.run(stages_of(strategy, search.problem))
    uv = search.problem.positions(search.best_map)
    certificate, interrupted = finish(lambda: certify(search.problem.F, uv, loops=search.problem.domain.loops))
    if interrupted:
        search.status = Status.INTERRUPTED
    # An interrupted search stays so even if its map is injective: what follows a search does not begin then.
    found = certificate.injective and search.status is not Status.INTERRUPTED
    return MapResult(
        uv=uv,
        status=Status.INJECTIVE if found else search.status,
        certificate=certificate,
        stages=search.work.stages,
        history=search.work.history,
        path=search.work.path,
        diagnosis=None if certificate.injective else search.diagnosis,
        linear_solver=search.linear_solver,
        seconds=spent + time.perf_counter() - began,
        mu=None if search.best_field is None else search.best_field.mu,
        reference=search.best_reference,
        V=search.problem.V,
    )


class CoarseMesh:
    """A coarse mesh that keeps the fixed vertices of a fine one, with the prolongation to the fine mesh.

    ``goal`` is the approximate number of vertices. ``domain`` is the coarse mesh, with the same fixed vertices in the
    same order.
    """

    def __init__(self, fine: Domain, goal: int) -> None:
        self._fixed = mark(fine.n, fine.fixed)
        self._coarsening = coarsen(fine.F, fine.n, self._fixed, goal)
        self._vertices = np.flatnonzero(mark(fine.n, self._coarsening.F))
        number = invert_indices(fine.n, self._vertices)
        F = number[self._coarsening.F]
        self.domain = Domain(_perturb_flat(fine.V[self._vertices], F), F, number[fine.fixed])

    def prolong(self, w: ComplexArray) -> ComplexArray:
        """Extend a map of the coarse mesh to the fine mesh, in the same frame.

        The result is injective if ``w`` is, except for rounding.
        """
        fine = np.zeros(self._fixed.size, dtype=np.complex128)
        fine[self._vertices] = w
        return prolong(fine, self._coarsening, self._fixed)


def coarse_mesh(problem: Problem) -> CoarseMesh | None:
    """Return the coarse mesh of a large problem, computed once per domain.

    None if the mesh is small, most of its vertices are fixed, or the problem prescribes its own reference triangles.
    """
    if problem.reference not in (None, "equilateral"):
        return None
    fine = problem.domain
    if fine not in _COARSE_MESHES:
        goal = int(max(_COARSE.vertices_per_fixed * fine.fixed.size, min(_COARSE.share * fine.n, _COARSE.max_vertices)))
        worthwhile = fine.n >= _COARSE.min_vertices and goal < _COARSE.worthwhile * fine.n
        _COARSE_MESHES[fine] = CoarseMesh(fine, goal) if worthwhile else None
    return _COARSE_MESHES[fine]


def _perturb_flat(V: FloatArray, F: IntArray) -> FloatArray:
    """Return positions in space, perturbed slightly at the corners of triangles that have almost no area.

    The shape of a coarse triangle is only a rough guide to the size of the fine triangles.
    """
    shapes = rest_shapes(V, F)
    lengths = np.abs(shapes.sides)
    low = ~(2 * shapes.m >= _COARSE.min_height * lengths.max(axis=0) ** 2)
    if not low.any():
        return V
    space = pad_to_space(V)
    shortest = np.full(len(V), np.inf)
    for length, ends in zip(lengths, ((0, 1), (1, 2), (2, 0)), strict=True):
        for corner in ends:
            np.minimum.at(shortest, F[:, corner], np.where(length > 0, length, np.inf))
    corners = np.unique(F[low])
    by = _COARSE.perturbation * shapes.unit * shortest[corners, None]
    space[corners] += by * np.random.default_rng(0).uniform(-1, 1, (corners.size, 3))
    return space
