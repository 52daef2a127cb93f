"""Run the first stage of many small searches in one batch.

A call of NumPy or of a sparse solver has an overhead of some microseconds, and one iteration on a few hundred triangles
needs about a hundred calls. Small meshes are therefore combined into one disconnected mesh. Their Laplacian is block
diagonal, so one analysis, one factorisation and one solve serve all meshes. VectorAdam treats each triangle separately.
Up to rounding, every problem follows the same path as it would alone. Solved problems leave the batch. After the first
iterations the unsolved problems of several groups are joined, and a group is compacted when half of it is solved.

Problems that are unsolved after the stage are returned as `ResumedStage`; each search then continues separately.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping, Sequence
from itertools import islice
from typing import NamedTuple, TypeGuard

import numpy as np

from quasiharmonic.geometry.exact.batched_loops import certify_each
from quasiharmonic.geometry.mesh.reference import ReferenceMesh
from quasiharmonic.linsolve import NotPositiveDefinite
from quasiharmonic.linsolve.laplacian import Laplacian
from quasiharmonic.problem import Domain, Problem
from quasiharmonic.problem.result import MapResult, Stage, Status, Step
from quasiharmonic.solver.field.passes import clip_moduli, own_sweep, stiffness_of, sweep
from quasiharmonic.solver.field.tensor import PARAMETERISATIONS
from quasiharmonic.solver.methods import VectorAdam
from quasiharmonic.solver.methods.relocation import RetrySchedule, placed_each
from quasiharmonic.solver.methods.vector_adam import AdamState
from quasiharmonic.solver.search.stages import ResumedStage, Stages
from quasiharmonic.solver.search.strategy import stages_of
from quasiharmonic.util.arrays import ComplexArray, FloatArray, IntArray

# Meshes with more triangles are solved separately: the overhead per NumPy call is then negligible.
SMALL = 4_000
# Maximum number of triangles of a batch. Twice as many are not faster per triangle, because the arrays exceed the
# cache. At this size QDLDL is still the default solver if MKL is not installed.
GROUP = 28_000
# Iterations before groups are joined. After two, nine in ten easy problems are solved; the rest of one group would be
# too small for a batch.
_APART = 2
# Number of patterns kept for reuse, for instance if one mesh is mapped to many targets.
_PATTERNS = 8


class Patterns:
    """Cache of the last few Laplacians of batches, each analysed once. Not thread-safe.

    Parameters
    ----------
    linear_solver : str
        A name of `quasiharmonic.linsolve`, or ``"auto"``.
    """

    def __init__(self, linear_solver: str) -> None:
        self._linear_solver = linear_solver
        self._kept: dict[tuple[Domain, ...], Laplacian] = {}

    def of(self, domains: tuple[Domain, ...], F: IntArray, n: int, fixed: IntArray) -> Laplacian:
        """Return the Laplacian of these domains; triangles and fixed vertices use the indices of the batch."""
        pattern = self._kept.pop(domains, None) or Laplacian(F, n, fixed, self._linear_solver)
        self._kept[domains] = pattern
        if len(self._kept) > _PATTERNS:
            del self._kept[next(iter(self._kept))]
        return pattern


class _Member:
    """One problem of a batch, and the state that `Search` would have after the same iterations.

    Attributes
    ----------
    problem : Problem
    live : bool
        Whether the stage still runs for this problem.
    seconds : float
        Its share of the time spent.
    tries : RetrySchedule
        Schedule of relocation: when to move the vertices of the last inverted triangles.
    found : MapResult, ResumedStage or None
        Its result so far.
    placed_mu : (f,) complex128 or None
        Tensors of the best map if that was found by relocation and not by the descent.
    """

    def __init__(self, problem: Problem) -> None:
        self.problem = problem
        self.live = True
        self.seconds = 0.0
        self.tries = RetrySchedule()
        self.found: MapResult | ResumedStage | None = None
        self.placed_mu: ComplexArray | None = None
        self.history: list[Step] = []
        self.best, self._deepest = (len(problem.F) + 1, np.inf), np.inf
        self.best_map = self._deepest_map = np.empty(0, dtype=np.complex128)
        self.best_xi = self._deepest_xi = np.empty(0, dtype=np.complex128)

    def note(self, inverted: int, energy: float, w: ComplexArray, xi: ComplexArray) -> None:
        """Record a map and its tensors."""
        self.history.append(Step(len(self.history), inverted, energy))
        better, deeper = (inverted, energy) < self.best, energy < self._deepest or not self._deepest_map.size
        if better or deeper:
            w, xi = w.copy(), xi.copy()
        if better:
            self.best, self.best_map, self.best_xi = (inverted, energy), w, xi
        if deeper:
            self._deepest, self._deepest_map, self._deepest_xi = energy, w, xi

    def note_placed(self, w: ComplexArray, mu: ComplexArray, energy: float) -> None:
        """Record a map without inverted triangles that relocation found, at its own tensors."""
        self.history.append(Step(len(self.history), 0, energy))
        self.best, self.best_map, self.placed_mu = (0, energy), w, mu

    def stage(self, descent: VectorAdam) -> Stage:
        """Entry of this stage in reports."""
        first, last = self.history[0], self.best
        return Stage(
            name=descent.name,
            iterations=len(self.history) - 1,
            seconds=self.seconds,
            inverted=(first.inverted, last[0]),
            energy=(first.energy, last[1]),
        )

    def hand_on(self, descent: VectorAdam) -> None:
        """End the stage so that a separate search continues."""
        self.live = False
        self.found = ResumedStage(
            descent=descent,
            history=self.history,
            best=self.best,
            best_map=self.best_map,
            best_xi=self.best_xi,
            deepest_map=self._deepest_map,
            deepest_xi=self._deepest_xi,
            stage=self.stage(descent),
        )


class _Maps(NamedTuple):
    """Maps of all meshes: positions, gradient of V₃ in ξ, and per mesh the inverted triangles and the energy."""

    w: ComplexArray
    gradient: ComplexArray
    inverted: IntArray
    energy: FloatArray


class _SideBySide:
    """Several meshes combined into one disconnected mesh with common vertex and triangle indices."""

    def __init__(self, members: Sequence[_Member], descent: VectorAdam, patterns: Patterns) -> None:
        self.members = members
        self._parameterisation = PARAMETERISATIONS[descent.parameterisation]
        problems = [member.problem for member in members]
        self.vertices = np.cumsum([0, *(problem.n for problem in problems)])
        self.triangles = np.cumsum([0, *(len(problem.F) for problem in problems)])
        starts, n = self.vertices[:-1].tolist(), int(self.vertices[-1])
        F = np.concatenate([problem.F + start for problem, start in zip(problems, starts, strict=True)])
        self._fixed = np.concatenate([problem.fixed + start for problem, start in zip(problems, starts, strict=True)])
        self._mesh = ReferenceMesh(np.empty((n, 2)), F, "equilateral")
        self.laplacian = patterns.of(tuple(problem.domain for problem in problems), F, n, self._fixed)
        self._boundary = np.concatenate([problem.held for problem in problems])

    def evaluate(self, xi: ComplexArray) -> _Maps:
        """Compute the maps of ``xi`` and their energies, as `Objective.evaluate` and `Iterate` do."""
        stiffness = stiffness_of(self._mesh, self._parameterisation, xi)
        w = self.laplacian.factor(stiffness).extend(self._boundary)
        if not np.isfinite(w.view(np.float64)).all():
            raise NotPositiveDefinite("the solution is not finite")
        sums, gradient = sweep(self._mesh, self._parameterisation, xi, w, self.triangles)
        inverted, dirichlet, area, unsigned = sums.T
        covered = np.where(area > 0, area, unsigned)
        with np.errstate(divide="ignore", invalid="ignore"):
            energy = np.where(covered > 0, dirichlet / covered, np.inf)
        return _Maps(w, gradient, inverted.astype(np.int64), energy)

    def place(self, some: Sequence[int], w: ComplexArray) -> list[_Member]:
        """Relocate vertices of inverted triangles of some meshes; return the members without any left."""
        count = np.diff(self.triangles)
        F = np.concatenate([self._mesh.F[self.triangles_of(k)] for k in some])
        moved, righted = placed_each(F, w, self._fixed, np.repeat(np.arange(len(some)), count[some]))
        good = np.asarray(some)[righted]
        if not good.size:
            return []
        F = np.concatenate([self._mesh.F[self.triangles_of(k)] for k in good])
        starts = np.concatenate([[0], np.cumsum(count[good])])
        sums, mu = own_sweep(ReferenceMesh(np.empty((w.size, 2)), F, "equilateral"), moved, starts)
        noting = [self.members[k] for k in good.tolist()]
        energy = (sums[:, 0] / sums[:, 1]).tolist()
        for member, k, first, end, value in zip(noting, good, starts[:-1], starts[1:], energy, strict=True):
            member.note_placed(moved[self.vertices_of(k)].copy(), mu[first:end].copy(), value)
        return noting

    def bounded(self, xi: ComplexArray) -> ComplexArray:
        """Clip the moduli of ``xi`` in place to the range in which the rounded tensor is positive definite."""
        clip_moduli(xi, self._parameterisation.bound)
        return xi

    def vertices_of(self, k: int) -> slice:
        """Vertices of the k-th mesh."""
        return slice(int(self.vertices[k]), int(self.vertices[k + 1]))

    def triangles_of(self, k: int) -> slice:
        """Triangles of the k-th mesh."""
        return slice(int(self.triangles[k]), int(self.triangles[k + 1]))


def beginning_alike(problems: Mapping[int, Problem], strategy: str | Stages) -> dict[VectorAdam, list[int]]:
    """Group small problems whose searches begin with the same stage, if that stage can run in a batch.

    Parameters
    ----------
    problems : mapping of int to Problem
    strategy : str or sequence of stages
        See `quasiharmonic.solve`.

    Returns
    -------
    dict of VectorAdam to list of int
        The keys of the problems for each first stage. Other problems are left out.
    """
    alike: dict[VectorAdam, list[int]] = {}
    for k, problem in problems.items():
        if len(problem.F) > SMALL or not problem.encloses_area:
            continue
        descent = stages_of(strategy, problem)[0]
        if _plain(descent) and problem.reference in (None, "equilateral"):
            alike.setdefault(descent, []).append(k)
    return alike


def _plain(stage: object) -> TypeGuard[VectorAdam]:
    """Whether `first_stage` can run this stage."""
    if not isinstance(stage, VectorAdam) or type(stage) is not VectorAdam:
        return False
    return stage.functional == "dirichlet" and stage.reference == "equilateral"


def first_stage(
    problems: Sequence[Problem], descent: VectorAdam, patterns: Patterns, budget: int, still_wanted: Callable[[], None]
) -> list[MapResult | ResumedStage | None]:
    """Run the first stage of many problems in a batch.

    Parameters
    ----------
    problems : sequence of Problem
        Their targets enclose an area; their reference triangles are unset or equilateral.
    descent : VectorAdam
        Descent of V₃ with equilateral reference triangles.
    patterns : Patterns
        Cache of the calling thread.
    budget : int
        Maximum number of iterations.
    still_wanted : callable
        Called at every iteration; an exception that it raises is passed on.

    Returns
    -------
    list
        For each problem its result or the state after the stage. None if rounding broke the factorisation of its group;
        the search must then start from the beginning.
    """
    members = [_Member(problem) for problem in problems]
    last = min(descent.iterations, budget)
    walks = []
    for first, end in _runs([len(problem.F) for problem in problems]):
        xi = np.zeros(sum(len(problem.F) for problem in problems[first:end]), dtype=np.complex128)
        walk = _Walk(members[first:end], xi, descent.pace(xi.size), descent, patterns)
        if walk.go(range(min(_APART, last + 1)), last, still_wanted):
            walks.append(walk)
    for walk in _joined(walks):
        walk.go(range(_APART, last + 1), last, still_wanted)
    for member in members:
        if member.live:
            member.hand_on(descent)
    return [member.found for member in members]


class _Walk:
    """A batch of problems during the descent.

    Parameters
    ----------
    members : sequence of _Member
    xi : (f,) complex128
        Variables of the triangles of all members, one mesh after another.
    pace : AdamState
        State of the same triangles.
    descent : VectorAdam
    patterns : Patterns
    """

    def __init__(
        self, members: Sequence[_Member], xi: ComplexArray, pace: AdamState, descent: VectorAdam, patterns: Patterns
    ) -> None:
        self.members, self.xi, self.pace, self.descent, self.patterns = members, xi, pace, descent, patterns

    def go(self, iterations: range, last: int, still_wanted: Callable[[], None]) -> bool:
        """Descend until all problems are solved or the iterations are over; ``last`` is the last one of the stage.

        Return False if a factorisation fails because of rounding; unsolved problems then have no result.
        """
        try:
            self._go(iterations, last, still_wanted)
        except NotPositiveDefinite:
            for member in self.members:
                member.live = False
            return False
        return True

    def _go(self, iterations: range, last: int, still_wanted: Callable[[], None]) -> None:
        side, since = _SideBySide(self.members, self.descent, self.patterns), time.perf_counter()
        for iteration in iterations:
            still_wanted()
            if iteration:
                side.bounded(self.xi)
            maps = side.evaluate(self.xi)
            live = [k for k, member in enumerate(self.members) if member.live]
            inverted, energy = maps.inverted.tolist(), maps.energy.tolist()
            for k in live:
                self.members[k].note(inverted[k], energy[k], maps.w[side.vertices_of(k)], self.xi[side.triangles_of(k)])
            ready = [self.members[k] for k in live if inverted[k] == 0]
            due = [k for k in live if inverted[k] and iteration < last and self.members[k].tries.due(inverted[k])]
            if self.descent.placing and due:
                ready += side.place(due, maps.w)
            # The time of one problem within an iteration cannot be measured; divide it equally.
            now = time.perf_counter()
            for k in live:
                self.members[k].seconds += (now - since) / len(live)
            since = now
            _judge(ready, self.descent, side.laplacian.solver.name)
            left = sum(self.members[k].live for k in live)
            if not left:
                return
            self.xi += self.pace.step(maps.gradient)
            if self._too_many(left, iterations.stop - iteration - 1):
                (fewer,) = _joined([self])
                self.members, self.xi, self.pace = fewer.members, fewer.xi, fewer.pace
                side = _SideBySide(self.members, self.descent, self.patterns)

    def _too_many(self, left: int, iterations: int) -> bool:
        """Whether compacting the batch pays, given the live problems and the iterations to come."""
        if _of_one_mesh(self.members):
            return iterations > 0 and 5 * _filled_up(left) <= 3 * len(self.members)
        # The analysis of a pattern takes as long as two iterations.
        return iterations > 1 and 2 * left <= len(self.members)


def _joined(walks: Sequence[_Walk]) -> list[_Walk]:
    """Join the live problems of batches that have made equally many iterations into as few batches as possible."""
    members = [member for walk in walks for member in walk.members]
    chosen = [k for k, member in enumerate(members) if member.live]
    if not chosen:
        return []
    if _of_one_mesh(members):
        # Use a power of two as count, so that batches of one mesh recur in equal sizes and their pattern is cached.
        done = (k for k, member in enumerate(members) if not member.live)
        chosen = sorted([*chosen, *islice(done, _filled_up(len(chosen)) - len(chosen))])
    ends = np.cumsum([len(member.problem.F) for member in members])
    xi, pace = np.concatenate([walk.xi for walk in walks]), AdamState.joined([walk.pace for walk in walks])
    descent, patterns, joined = walks[0].descent, walks[0].patterns, []
    for first, end in _runs([len(members[k].problem.F) for k in chosen]):
        some = chosen[first:end]
        triangles = np.concatenate([np.arange(ends[k] - len(members[k].problem.F), ends[k]) for k in some])
        joined.append(_Walk([members[k] for k in some], xi[triangles], pace.part(triangles), descent, patterns))
    return joined


def _of_one_mesh(members: Sequence[_Member]) -> bool:
    """Whether all members have the same domain."""
    return len({member.problem.domain for member in members}) == 1


def _filled_up(count: int) -> int:
    """Smallest power of two that is not below ``count``."""
    return 1 << (count - 1).bit_length()


def _runs(sizes: Sequence[int]) -> list[tuple[int, int]]:
    """Start and end indices of consecutive groups of at most ``GROUP`` triangles."""
    runs, first, total = list[tuple[int, int]](), 0, 0
    for k, size in enumerate(sizes):
        if k > first and total + size > GROUP:
            runs.append((first, k))
            first, total = k, 0
        total += size
    return [*runs, (first, len(sizes))] if sizes else []


def _judge(members: list[_Member], descent: VectorAdam, solver: str) -> None:
    """Certify maps without inverted triangles in floating point, and set the results of the injective ones."""
    problems = [member.problem for member in members]
    uv = [member.problem.positions(member.best_map) for member in members]
    verdicts = certify_each([problem.F for problem in problems], uv, [problem.domain.loops for problem in problems])
    mapped = [member for member, verdict in zip(members, verdicts, strict=True) if verdict.injective]
    descended = [member for member in mapped if member.placed_mu is None]
    tensors = list[ComplexArray]()
    if descended:
        xi = np.concatenate([member.best_xi for member in descended])
        ends = np.cumsum([member.best_xi.size for member in descended])
        tensors = np.split(PARAMETERISATIONS[descent.parameterisation].field(xi).mu, ends[:-1])
    own = iter(tensors)
    for member, places, certificate in zip(members, uv, verdicts, strict=True):
        member.live = False
        if certificate.injective:
            member.found = MapResult(
                uv=places,
                status=Status.INJECTIVE,
                certificate=certificate,
                stages=[member.stage(descent)],
                history=member.history,
                linear_solver=solver,
                seconds=member.seconds,
                mu=next(own).copy() if member.placed_mu is None else member.placed_mu,
                V=member.problem.V,
            )
