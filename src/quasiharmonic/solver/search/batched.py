"""The first stage of many small searches, run as one.

A call of NumPy or of a sparse solver takes some microseconds however little there is to do, and one iteration on a few
hundred triangles is a hundred such calls. So small meshes are laid side by side, none joined to another: their
Laplacian has one block for each, one analysis, one factorisation and one solve serve all, and VectorAdam does not mind,
as it looks at each triangle by itself. Every problem walks the way that it would walk alone, to rounding. Whichever is
solved falls out; what is left of several groups after the first iterations is joined, and whenever half have fallen
out, the others move up.

What is left when the stage has run is handed on as `ResumedStage`, and each is searched on by itself.
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

# What has more triangles is solved by itself: NumPy has enough to do at each call.
SMALL = 4_000
# Triangles of what is laid side by side. Twice as many are no sooner solved, triangle for triangle: their arrays leave
# the processor's cache. And QDLDL is still the first choice for such a system where MKL is not installed.
GROUP = 28_000
# Iterations before groups are joined. After two, nine in ten of what is not hard is solved, and the rest of one group
# would be too little to be worth a call.
_APART = 2
# Patterns kept for meshes that come again, as where one mesh is mapped to many targets.
_PATTERNS = 8


class Patterns:
    """Laplacians of meshes side by side, the last few of them, each analysed once. For one thread at a time.

    Parameters
    ----------
    linear_solver : str
        A name of `quasiharmonic.linsolve`, or ``"auto"``.
    """

    def __init__(self, linear_solver: str) -> None:
        self._linear_solver = linear_solver
        self._kept: dict[tuple[Domain, ...], Laplacian] = {}

    def of(self, domains: tuple[Domain, ...], F: IntArray, n: int, fixed: IntArray) -> Laplacian:
        """That of these domains, whose triangles and fixed vertices are given in their common numbers."""
        pattern = self._kept.pop(domains, None) or Laplacian(F, n, fixed, self._linear_solver)
        self._kept[domains] = pattern
        if len(self._kept) > _PATTERNS:
            del self._kept[next(iter(self._kept))]
        return pattern


class _Member:
    """One of the problems, and what `Search` would know of it after the same iterations.

    Attributes
    ----------
    problem : Problem
    live : bool
        Whether the stage has anything left to do for it.
    seconds : float
        Its share of what has been spent.
    tries : Tries
        When the vertices of its last inverted triangles are placed.
    found : MapResult, Begun or None
        What has come of it.
    placed_mu : (f,) complex128 or None
        The tensors of its best map where that was not descended to, but had vertices placed.
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
        """Take note of a map and its tensors."""
        self.history.append(Step(len(self.history), inverted, energy))
        better, deeper = (inverted, energy) < self.best, energy < self._deepest or not self._deepest_map.size
        if better or deeper:
            w, xi = w.copy(), xi.copy()
        if better:
            self.best, self.best_map, self.best_xi = (inverted, energy), w, xi
        if deeper:
            self._deepest, self._deepest_map, self._deepest_xi = energy, w, xi

    def note_placed(self, w: ComplexArray, mu: ComplexArray, energy: float) -> None:
        """Take note of a map with vertices placed, none of whose triangles is inverted, at its own tensors."""
        self.history.append(Step(len(self.history), 0, energy))
        self.best, self.best_map, self.placed_mu = (0, energy), w, mu

    def stage(self, descent: VectorAdam) -> Stage:
        """What reports say of what was done."""
        first, last = self.history[0], self.best
        return Stage(
            name=descent.name,
            iterations=len(self.history) - 1,
            seconds=self.seconds,
            inverted=(first.inverted, last[0]),
            energy=(first.energy, last[1]),
        )

    def hand_on(self, descent: VectorAdam) -> None:
        """The stage is over, and a search by itself begins."""
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
    """Maps of all meshes at some tensors: places, gradient of V₃ in ξ, and for each mesh its flips and its energy."""

    w: ComplexArray
    gradient: ComplexArray
    inverted: IntArray
    energy: FloatArray


class _SideBySide:
    """Meshes with common numbers for their vertices and triangles, one mesh after another."""

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
        """As `Objective.evaluate` and what an `Iterate` computes."""
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
        """Place the vertices of inverted triangles of some of the meshes; those of which none is left take note."""
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
        """ξ with moduli clipped, in place, to where the rounded tensor is still positive definite."""
        clip_moduli(xi, self._parameterisation.bound)
        return xi

    def vertices_of(self, k: int) -> slice:
        """The vertices of the k-th mesh."""
        return slice(int(self.vertices[k]), int(self.vertices[k + 1]))

    def triangles_of(self, k: int) -> slice:
        """The triangles of the k-th mesh."""
        return slice(int(self.triangles[k]), int(self.triangles[k + 1]))


def beginning_alike(problems: Mapping[int, Problem], strategy: str | Stages) -> dict[VectorAdam, list[int]]:
    """Small problems whose searches begin in the same way, and in one in which they can be run together.

    Parameters
    ----------
    problems : mapping of int to Problem
    strategy : str or sequence of stages
        As `quasiharmonic.solve` takes it.

    Returns
    -------
    dict of VectorAdam to list of int
        For each beginning the keys of those problems. All others are in none.
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
    """Whether a stage is one that `first_stage` runs."""
    if not isinstance(stage, VectorAdam) or type(stage) is not VectorAdam:
        return False
    return stage.functional == "dirichlet" and stage.reference == "equilateral"


def first_stage(
    problems: Sequence[Problem], descent: VectorAdam, patterns: Patterns, budget: int, still_wanted: Callable[[], None]
) -> list[MapResult | ResumedStage | None]:
    """Run a stage on many problems together.

    Parameters
    ----------
    problems : sequence of Problem
        Of any targets that enclose an area, with no kind of reference triangles of their own but equilateral ones.
    descent : VectorAdam
        Down V₃, by equilateral triangles.
    patterns : Patterns
        Of the thread that calls.
    budget : int
        Iterations at most.
    still_wanted : callable
        Called at every iteration; what it raises comes out of here.

    Returns
    -------
    list
        For each problem its result, or how far the stage has come with it; None where rounding has spoilt something
        for all of its group: then it is as if nothing had been done.
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
    """Some of the problems on their way, side by side.

    Parameters
    ----------
    members : sequence of _Member
    xi : (f,) complex128
        Of the triangles of all of them, one mesh after another.
    pace : Pace
        Of the same triangles.
    descent : VectorAdam
    patterns : Patterns
    """

    def __init__(
        self, members: Sequence[_Member], xi: ComplexArray, pace: AdamState, descent: VectorAdam, patterns: Patterns
    ) -> None:
        self.members, self.xi, self.pace, self.descent, self.patterns = members, xi, pace, descent, patterns

    def go(self, iterations: range, last: int, still_wanted: Callable[[], None]) -> bool:
        """Descend until all are solved or these iterations are over; ``last`` is the last of the stage.

        Where rounding spoils something, False is returned, and nothing comes of what is not solved yet.
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
            # Nobody knows what an iteration takes for one of them alone: all are charged alike.
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
        """Whether those that are left had better move up, for so many iterations that are still to come."""
        if _of_one_mesh(self.members):
            return iterations > 0 and 5 * _filled_up(left) <= 3 * len(self.members)
        # To analyse a pattern takes as long as two iterations.
        return iterations > 1 and 2 * left <= len(self.members)


def _joined(walks: Sequence[_Walk]) -> list[_Walk]:
    """What is live of these walks, after as many iterations each, in as few as there may be."""
    members = [member for walk in walks for member in walk.members]
    chosen = [k for k, member in enumerate(members) if member.live]
    if not chosen:
        return []
    if _of_one_mesh(members):
        # A power of two, so that equal meshes are met with in equal numbers, whose pattern is known.
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
    """Whether all have one domain."""
    return len({member.problem.domain for member in members}) == 1


def _filled_up(count: int) -> int:
    """The least power of two that is no less."""
    return 1 << (count - 1).bit_length()


def _runs(sizes: Sequence[int]) -> list[tuple[int, int]]:
    """From where to where things of these sizes, in their order, make up a group each."""
    runs, first, total = list[tuple[int, int]](), 0, 0
    for k, size in enumerate(sizes):
        if k > first and total + size > GROUP:
            runs.append((first, k))
            first, total = k, 0
        total += size
    return [*runs, (first, len(sizes))] if sizes else []


def _judge(members: list[_Member], descent: VectorAdam, solver: str) -> None:
    """Decide exactly on maps without inverted triangles, as far as floating point can tell."""
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
