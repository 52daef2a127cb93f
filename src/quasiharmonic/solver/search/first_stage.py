"""Run the first stage of many small searches in one batch, with V₃ of all meshes evaluated in one pass.

A call of NumPy or of a sparse solver has an overhead of some microseconds, and one evaluation on a few hundred
triangles needs about a hundred calls. Small meshes are therefore combined into one disconnected mesh. Their Laplacian
is block diagonal, so one analysis, one factorisation and one solve serve all meshes. Up to rounding, each map is the
same as by `Objective`.

VectorAdam treats each triangle separately, so up to rounding every search visits the same maps as it would alone.
Solved problems leave a batch when half of them are solved. After the stage, each unsolved search continues separately.
"""

from __future__ import annotations

import time
from collections.abc import Iterator, Mapping, Sequence
from itertools import compress
from typing import NamedTuple, TypeGuard

import numpy as np

from quasiharmonic.geometry.mesh.reference import ReferenceMesh
from quasiharmonic.linsolve import NotPositiveDefinite
from quasiharmonic.linsolve.laplacian import Laplacian
from quasiharmonic.problem import Domain, Problem
from quasiharmonic.problem.result import Status
from quasiharmonic.solver.field.objective import (
    Iterate,
    Objective,
    Sums,
    clip_moduli,
    own_sweep,
    stiffness_of,
    sums_of,
    sweep,
)
from quasiharmonic.solver.field.tensor import TANH, TensorField
from quasiharmonic.solver.methods import VectorAdam
from quasiharmonic.solver.methods.relocation import RetrySchedule, relocate_each
from quasiharmonic.solver.search.record import Round, StageRun, visit_rounds
from quasiharmonic.solver.search.search import Search
from quasiharmonic.solver.search.stages import Stages, stages_of
from quasiharmonic.util.arrays import ComplexArray, IntArray, repeat_each
from quasiharmonic.util.options import MapOptions

# Number of patterns kept for reuse, for instance if one mesh is mapped to many targets.
_PATTERNS = 8
# Meshes with more triangles are solved separately: the overhead per NumPy call is then negligible.
SMALL = 4_000
# Maximum number of triangles of a batch. Twice as many are not faster per triangle, because the arrays exceed the
# cache. At this size QDLDL is still the default solver if MKL is not installed.
MAX_BATCH = 28_000


class Patterns:
    """Cache of the last few Laplacians of batches, each analysed once. Not thread-safe."""

    def __init__(self, linear_solver: str) -> None:
        self._linear_solver = linear_solver
        self._cache: dict[tuple[Domain, ...], Laplacian] = {}

    def of(self, domains: tuple[Domain, ...], F: IntArray, n: int, fixed: IntArray) -> Laplacian:
        """Return the Laplacian of these domains; triangles and fixed vertices use the indices of the batch."""
        pattern = self._cache.pop(domains, None) or Laplacian(F, n, fixed, self._linear_solver)
        self._cache[domains] = pattern
        if len(self._cache) > _PATTERNS:
            del self._cache[next(iter(self._cache))]
        return pattern


class MapBatch(NamedTuple):
    """The maps w (n,) of all meshes of a batch: ξ (f,), the gradient of V₃ in ξ (f,), and the sums of each mesh."""

    xi: ComplexArray
    w: ComplexArray
    gradient: ComplexArray
    sums: list[Sums]


class ObjectiveBatch:
    """V₃ on several meshes, combined into one disconnected mesh with common vertex and triangle indices.

    Each objective is V₃ with equilateral reference triangles; all have the same parameterisation.

    Attributes
    ----------
    F : (f, 3) int64
    fixed : (k,) int64
        Triangles and fixed vertices of all meshes.
    laplacian : Laplacian
    """

    def __init__(self, objectives: Sequence[Objective], patterns: Patterns) -> None:
        self._objectives = objectives
        self._parameterisation = objectives[0].parameterisation
        problems = [objective.problem for objective in objectives]
        self._vertices = np.cumsum([0, *(problem.n for problem in problems)])
        self._triangles = np.cumsum([0, *(len(problem.F) for problem in problems)])
        starts, n = self._vertices[:-1].tolist(), int(self._vertices[-1])
        F = np.concatenate([problem.F + start for problem, start in zip(problems, starts, strict=True)])
        self.fixed = np.concatenate([problem.fixed + start for problem, start in zip(problems, starts, strict=True)])
        self._mesh = ReferenceMesh(np.empty((n, 2)), F, "equilateral")
        self.F = self._mesh.F
        self.laplacian = patterns.of(tuple(problem.domain for problem in problems), F, n, self.fixed)
        self._boundary = np.concatenate([problem.fixed_positions for problem in problems])

    def evaluate(self, xi: ComplexArray) -> MapBatch:
        """Compute the maps of ``xi`` (f,), as `Objective.evaluate` does.

        Raise `NotPositiveDefinite` if one of the Laplacians is not positive definite after rounding.
        """
        stiffness = stiffness_of(self._mesh, self._parameterisation, xi)
        w = self.laplacian.factor(stiffness).extend(self._boundary)
        if not np.isfinite(w.view(np.float64)).all():
            raise NotPositiveDefinite("the solution is not finite")
        sums, gradient = sweep(self._mesh, self._parameterisation, xi, w, self._triangles)
        return MapBatch(xi, w, gradient, sums_of(sums))

    def iterate(self, maps: MapBatch, k: int) -> Iterate:
        """Return the map of the k-th mesh, in memory of its own."""
        # A search may keep the iterate; a view would keep the arrays of the whole batch.
        field = TensorField(maps.xi[self.triangles_of(k)].copy(), self._parameterisation)
        return Iterate(self._objectives[k], field, maps.w[self._vertices_of(k)].copy(), sums=maps.sums[k])

    def of_maps(self, meshes: Sequence[int], w: ComplexArray) -> list[Iterate]:
        """Return maps of some meshes, without inverted triangles, at their own tensors, as `Objective.of_map` does.

        ``w`` (n,) has the positions of all vertices of the batch.
        """
        F = np.concatenate([self.F[self.triangles_of(k)] for k in meshes])
        starts = np.concatenate([[0], np.cumsum([len(self._objectives[k].problem.F) for k in meshes])])
        sums, mu = own_sweep(ReferenceMesh(np.empty((w.size, 2)), F, "equilateral"), w, starts)
        xi = np.split(TANH.invert(mu), starts[1:-1])
        return [
            Iterate(self._objectives[k], TANH.field(own.copy()), w[self._vertices_of(k)].copy(), sums=Sums(0, *values))
            for k, own, values in zip(meshes, xi, sums.tolist(), strict=True)
        ]

    def step(self, maps: MapBatch, step: ComplexArray) -> ComplexArray:
        """Return ``ξ + step``, clipped to the range in which the rounded tensors are positive definite."""
        xi = maps.xi + step
        clip_moduli(xi, self._parameterisation.bound)
        return xi

    def triangles_of(self, k: int) -> slice:
        """Triangles of the k-th mesh."""
        return slice(int(self._triangles[k]), int(self._triangles[k + 1]))

    def _vertices_of(self, k: int) -> slice:
        """Vertices of the k-th mesh."""
        return slice(int(self._vertices[k]), int(self._vertices[k + 1]))


def group_by_first_stage(problems: Mapping[int, Problem], strategy: str | Stages) -> list[tuple[VectorAdam, list[int]]]:
    """Return the first stages of small problems that can run in a batch, each with the keys of its problems.

    Other problems are left out.
    """
    alike: list[tuple[VectorAdam, list[int]]] = []
    for k, problem in problems.items():
        if len(problem.F) > SMALL or not problem.encloses_area:
            continue
        descent = stages_of(strategy, problem)[0]
        if not _is_plain(descent) or problem.reference not in (None, "equilateral"):
            continue
        for other, keys in alike:
            if other == descent:
                keys.append(k)
                break
        else:
            alike.append((descent, [k]))
    return alike


def _is_plain(stage: object) -> TypeGuard[VectorAdam]:
    """Whether a stage can run in a batch."""
    if not isinstance(stage, VectorAdam) or type(stage) is not VectorAdam:
        return False
    return stage.functional == "dirichlet" and stage.reference == "equilateral"


def run_first_stage(
    problems: Sequence[Problem], descent: VectorAdam, patterns: Patterns, options: MapOptions
) -> list[Search | None]:
    """Run the first stage of many searches in batches.

    Parameters
    ----------
    problems : sequence of Problem
        Their targets enclose an area; their reference triangles are unset or equilateral.
    descent : VectorAdam
        Descent of V₃ with equilateral reference triangles.
    patterns : Patterns
        Cache of the calling thread.
    options : MapOptions
        Without ``start`` and ``record_every``.

    Returns
    -------
    list
        For each problem the search after the stage, to be completed by `finish_search`. None if rounding broke the
        factorisation of its batch; a new search must then begin.
    """
    members = []
    searches = [Search(problem, options) for problem in problems]
    for problem, search in zip(problems, searches, strict=True):
        run = search.begin_in_batch(descent)
        members.append(_BatchMember(run, descent.objective(problem, options.linear_solver), RetrySchedule()))
    for first, last in _divide([member.size for member in members]):
        _BatchDescent(members[first:last], descent, patterns).run()
    for member in members:
        member.run.end(Status.OUT_OF_ITERATIONS)
    return [None if search.status is Status.UNSOLVABLE else search for search in searches]


class _BatchMember(NamedTuple):
    """One search of a batch, its objective, and its schedule of relocation."""

    run: StageRun
    objective: Objective
    retries: RetrySchedule

    @property
    def is_running(self) -> bool:
        """Whether its stage still runs."""
        return self.run.status is None

    @property
    def size(self) -> int:
        """Number of triangles."""
        return len(self.objective.problem.F)


class _BatchDescent:
    """`VectorAdam.iterates` on many meshes at once.

    ``xi`` (f,) and ``adam`` have the variables and the state of the triangles of all members, one mesh after another.
    """

    def __init__(self, members: Sequence[_BatchMember], descent: VectorAdam, patterns: Patterns) -> None:
        self.members, self.descent, self.patterns = members, descent, patterns
        self.xi = np.zeros(sum(member.size for member in members), dtype=np.complex128)
        self.adam = descent.make_state(self.xi.size)

    def run(self) -> None:
        """Descend until all stages have ended or the iterations are over.

        If a factorisation fails because of rounding, all stages that still run end as unsolvable.
        """
        try:
            visit_rounds(self._rounds())
        except NotPositiveDefinite:
            for member in self.members:
                if member.is_running:
                    member.run.status = Status.UNSOLVABLE

    def _rounds(self) -> Iterator[Round]:
        """Yield the next maps of all stages that still run."""
        since, batch = time.perf_counter(), self._combine()
        for iteration in range(self.descent.iterations + 1):
            is_running = [k for k, member in enumerate(self.members) if member.is_running]
            maps = batch.evaluate(self.xi)
            yield [(self.members[k].run, batch.iterate(maps, k)) for k in is_running]
            if self.descent.relocation and iteration < self.descent.iterations:
                yield self._relocate(batch, maps)
            # The time of one problem within an iteration cannot be measured; divide it equally.
            now = time.perf_counter()
            for k in is_running:
                self.members[k].run.seconds += (now - since) / len(is_running)
            since = now
            left = sum(member.is_running for member in self.members)
            if not left:
                return
            self.xi = batch.step(maps, self.adam.step(maps.gradient))
            # The analysis of a pattern takes as long as two iterations.
            if self.descent.iterations - iteration > 1 and 2 * left <= len(self.members):
                self._compact()
                batch = self._combine()

    def _combine(self) -> ObjectiveBatch:
        """Return the objectives of all members as a batch."""
        batch = ObjectiveBatch([member.objective for member in self.members], self.patterns)
        for member in self.members:
            member.run.search.linear_solver = batch.laplacian.solver.name
        return batch

    def _relocate(self, batch: ObjectiveBatch, maps: MapBatch) -> Round:
        """Relocate the vertices of inverted triangles where a try is due; return the maps without any left."""
        due = [
            k
            for k, (member, sums) in enumerate(zip(self.members, maps.sums, strict=True))
            if member.is_running and member.retries.is_due(sums.inverted)
        ]
        if not due:
            return []
        F = np.concatenate([batch.F[batch.triangles_of(k)] for k in due])
        mesh = repeat_each(np.arange(len(due)), [self.members[k].size for k in due])
        w, solved = relocate_each(F, maps.w, batch.fixed, mesh)
        good = [k for k, is_good in zip(due, solved.tolist(), strict=True) if is_good]
        if not good:
            return []
        return [(self.members[k].run, here) for k, here in zip(good, batch.of_maps(good, w), strict=True)]

    def _compact(self) -> None:
        """Leave out the members whose stages have ended."""
        is_running = [member.is_running for member in self.members]
        kept = repeat_each(is_running, [member.size for member in self.members])
        self.xi, self.adam = self.xi[kept], self.adam.take_part(kept)
        self.members = list(compress(self.members, is_running))


def _divide(sizes: Sequence[int]) -> list[tuple[int, int]]:
    """Return start and end indices of consecutive portions of at most ``MAX_BATCH`` triangles."""
    portions, first, total = list[tuple[int, int]](), 0, 0
    for k, size in enumerate(sizes):
        if k > first and total + size > MAX_BATCH:
            portions.append((first, k))
            first, total = k, 0
        total += size
    return [*portions, (first, len(sizes))] if sizes else []
