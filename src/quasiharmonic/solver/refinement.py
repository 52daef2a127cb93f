"""Refinement: split edges of a mesh that is too coarse for a target, as named, or until a search finds a map.

`refine` splits edges that the caller names, `refine_problem` those of a diagnosis. `search_refining` solves a problem
in several attempts::

    as given, shortly ──▶ constructed, if no vertex has to be added
                      ──▶ as given ──▶ named edges ──▶ around inverted triangles ──▶ constructed

An attempt is made only if those before it found no map. The construction takes little time, and a failing search
takes long. The construction is therefore made as soon as the first stages of the search fail, if the target is simple;
only around the inverted triangles, if these are few. The number of vertices that it adds determines whether the
attempts in between are worth their time. If they are, they get a reduced budget. The construction is used if they fail
or add more vertices.

All attempts share the iterations of one search and its budget for failed repairs. Random restarts cost the most, so
they run on the given mesh only.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from quasiharmonic.geometry.exact.certificate import Certificate, certify
from quasiharmonic.geometry.mesh.splitting import Refined, compose, split_edges
from quasiharmonic.geometry.mesh.topology import edge_keys, edges, pair_keys
from quasiharmonic.io.accepts_mesh import accepts_mesh
from quasiharmonic.problem import Problem, check_problem
from quasiharmonic.problem.diagnosis import Diagnosis, diagnose
from quasiharmonic.problem.result import MapResult, RefinementAttempt, Stage, Status
from quasiharmonic.problem.run import Run
from quasiharmonic.solver.construction.constructing import (
    Construction,
    construct_patches,
    constructions,
    is_simple,
    refined_problem,
)
from quasiharmonic.solver.construction.thinning import thin_refinement
from quasiharmonic.solver.search.record import RepairBudget
from quasiharmonic.solver.search.search import allowed_repairs, search_map
from quasiharmonic.solver.search.stages import Stages, quick_stages, stages_of, without_restarts
from quasiharmonic.targets.boundary.placement import flattened_edges
from quasiharmonic.util.arrays import FloatArray, IntArray, check_integer, mark
from quasiharmonic.util.options import MapOptions
from quasiharmonic.util.outcome import BaseOutcome


@dataclass(frozen=True, eq=False, repr=False)
class RefinedProblem(BaseOutcome):
    """A problem on a refined mesh.

    Attributes
    ----------
    problem : Problem
        The same vertices are fixed, at the same positions.
    refined : Refined
        Relation of its mesh to the original one.
    diagnosis : Diagnosis
        Obstructions to a map; refinement does not remove these.
    rounds : int
        Number of rounds of edge splitting.

    See Also
    --------
    refine_problem : Makes it.

    Examples
    --------
    >>> from quasiharmonic import Problem, boundary_loops, refine_problem
    >>> from quasiharmonic.surfaces import disk
    >>> V, F = disk(4)
    >>> (rim,) = boundary_loops(F)
    >>> refine_problem(Problem(V, F, rim, V[rim])).diagnosis.obstructions
    ()
    """

    problem: Problem
    refined: Refined
    diagnosis: Diagnosis
    rounds: int

    @property
    def success(self) -> bool:
        """Whether no known obstruction to an injective map remains."""
        return not self.diagnosis.forbids_injective

    @property
    def message(self) -> str:
        """The summary of the diagnosis."""
        return self.diagnosis.summary()


@accepts_mesh
def refine(V: ArrayLike, F: ArrayLike, edges: ArrayLike, *, boundary: bool = False) -> Refined:
    """Split edges of a mesh at their midpoints, and divide the triangles beside these edges.

    A triangle with one split edge becomes two, with two split edges three (along the shorter diagonal of the remaining
    quadrilateral), with three split edges four. Other triangles do not change. Original vertices keep their positions
    and indices, so ``fixed`` remains valid.

    Parameters
    ----------
    V : (n, 2) or (n, 3) array, or a mesh in place of ``V`` and ``F``
        Vertices.
    F : (f, 3) array of int
        Triangles, no edge in more than two of them.
    edges : (s, 2) array of int
        Edges to split, as pairs of vertices in any order; duplicates are allowed. `Diagnosis.split` names the edges
        that prevent a map.
    boundary : bool
        Also split edges on the boundary. Their midpoints are new boundary vertices, which need a position in the
        target; `Refined.extend` computes one.

    Returns
    -------
    Refined

    Raises
    ------
    ValueError
        If a pair is not an edge of the mesh, or is on its boundary and ``boundary`` is false. If indices are not
        integers, have the wrong shape or are out of range. If positions are not real, not finite or of the wrong shape.

    See Also
    --------
    refine_problem : Splits the edges that a diagnosis names.
    diagnose : Names edges that prevent a map.

    Examples
    --------
    >>> V = [[0.0, 0.0], [1.0, 0.0], [1.0, 1.0], [0.0, 1.0]]
    >>> refined = refine(V, [[0, 1, 2], [0, 2, 3]], [[0, 2]])
    >>> refined.F.tolist(), refined.parent.tolist()
    ([[4, 1, 2], [4, 3, 0], [4, 0, 1], [4, 2, 3]], [0, 1, 0, 1])
    """
    return split_edges(V, F, edges, boundary=boundary)


def refine_problem(problem: Problem, *, max_rounds: int = 20) -> RefinedProblem:
    """Split the edges that a diagnosis names until it names none.

    Parameters
    ----------
    problem : Problem
    max_rounds : int
        Maximum number of rounds of diagnosis and splitting. One round usually suffices. If the mesh is much too coarse,
        split edges may have to be split again.

    Returns
    -------
    RefinedProblem
        If no edge is named, the original problem on the original mesh.

    See Also
    --------
    refine : Splits edges that the caller names.
    diagnose : Names the edges.
    injective_map : Splits edges itself with ``refine=True``.

    Examples
    --------
    >>> from quasiharmonic import Problem, boundary_loops, refine_problem
    >>> from quasiharmonic.surfaces import disk
    >>> V, F = disk(4)
    >>> (rim,) = boundary_loops(F)
    >>> refined = refine_problem(Problem(V, F, rim, V[rim]))
    >>> refined.success, refined.rounds
    (True, 0)
    """
    check_problem("refine_problem", problem)
    check_integer("max_rounds", max_rounds, minimum=0)
    refined = split_edges(problem.V, problem.F, [])
    diagnosis = diagnose(problem)
    rounds = 0
    while rounds < max_rounds and len(diagnosis.split):
        refined = compose(refined, split_edges(refined.V, refined.F, diagnosis.split))
        problem = Problem(refined.V, refined.F, problem.fixed, problem.target, reference=problem.reference)
        diagnosis = diagnose(problem)
        rounds += 1
    return RefinedProblem(problem, refined, diagnosis, rounds)


# Names of the attempts.
AS_GIVEN = "as given"
NAMED = "edges split that the diagnosis names"
AROUND = "edges split around inverted triangles"
CONSTRUCTED = "constructed"
_Selection = Callable[[Stages], Stages]
_Search = Callable[[Problem, FloatArray | None, int, _Selection], MapResult]


class AttemptLimits(NamedTuple):
    """Limits of the attempts before and after a construction."""

    # Limits of a search if a construction exists: iterations, and triangles times iterations for large meshes.
    reduced_iterations: int = 600
    reduced_work: int = 1_500_000
    # Rounds of splitting around inverted triangles, with and without a construction.
    reduced_rounds: int = 1
    rounds: int = 3
    # With a construction, edges around inverted triangles are split only if that adds no more vertices than the
    # construction or this number. Thinning may remove most of so few.
    many_added: int = 1000
    # Of the budget for failed repairs, an attempt may spend the part 1 / `budget_divisor` of what is left.
    budget_divisor: int = 4
    # Up to this number of triangles, a construction of the whole map follows one in patches.
    small: int = 2000
    # If the search on the given mesh fails, a construction with at most this many added vertices is returned
    # immediately.
    max_added_at_once: int = 1


_LIMITS = AttemptLimits()


def search_refining(problem: Problem, options: MapOptions) -> MapResult:
    """Search for a map, with refinement if needed; see `quasiharmonic.injective_map` with ``refine`` for the result.

    ``start`` and ``record_every`` apply to the given mesh.
    """
    left = options.max_iterations
    repairs = allowed_repairs(problem, options.max_iterations)

    def search(on: Problem, first: FloatArray | None, budget: int, select: _Selection) -> MapResult:
        nonlocal left, repairs
        share = repairs // _LIMITS.budget_divisor
        own = replace(
            options,
            strategy=select(stages_of(options.strategy, on)),
            start=first,
            max_iterations=max(min(budget, left), 1),
            record_every=options.record_every if on is problem else 0,
        )
        allowed = RepairBudget(share)
        result = search_map(on, own, allowed)
        left -= result.n_iterations
        repairs -= share - allowed.left
        return result

    return _Refinement(problem, search).run(options.start, options.max_iterations)


def on_refinement(problem: Problem, refined: Refined | None) -> Problem:
    """Return the problem on the refined mesh, or the problem itself without refinement."""
    return problem if refined is None else refined_problem(problem, refined)


class _Refinement:
    """A problem, its search function, and the attempts so far."""

    def __init__(self, problem: Problem, search: _Search) -> None:
        self._problem = problem
        self._search = search
        # Selects the stages of a strategy to run.
        self._select: _Selection = list
        # Interior edges that a straight side of the target makes degenerate.
        self._flat = flattened_edges(problem.F, problem.fixed, problem.target)
        self._attempts: list[RefinementAttempt] = []
        # The latest result, with the stages and the history of all attempts so far, and the best result.
        self._last: MapResult | None = None
        self._best: MapResult | None = None

    def run(self, start: FloatArray | None, budget: int) -> MapResult:
        """Return the map that adds the fewest vertices; if no attempt finds one, the result of the last attempt."""
        with Run().until_interrupted():
            return replace(self._run_attempts(start, budget), refinement_attempts=self._attempts)
        if self._last is None or self._best is None:
            raise KeyboardInterrupt
        best = self._best
        if best.stages and best.stages[-1].name == CONSTRUCTED:
            best = self._use_construction(best)
        best = replace(best, stages=self._last.stages, history=self._last.history)
        return replace(best, status=Status.INTERRUPTED, refinement_attempts=self._attempts)

    def _run_attempts(self, start: FloatArray | None, budget: int) -> MapResult:
        problem = self._problem
        reduced = min(budget, _LIMITS.reduced_iterations, 1 + _LIMITS.reduced_work // len(problem.F))
        if not is_simple(problem):
            # If a straight side makes edges degenerate, a map seldom exists, and then only by a rounding error.
            first = self._search_on(AS_GIVEN, None, start, reduced if len(self._flat) else budget)
            # If refinement does not help, report the result on the given mesh.
            return first if first.injective else self._split_edges_and_search(first, budget, _LIMITS.rounds) or first
        self._select = quick_stages
        first = self._search_on(AS_GIVEN, None, start, budget)
        if first.injective:
            return first
        made = self._construct(first)
        self._select = without_restarts if made.injective else list
        if not made.added and made.injective:
            return self._use_construction(made)
        if first.status is not Status.IMPOSSIBLE:
            first = self._search_on(AS_GIVEN, None, start, reduced if made.injective else budget)
            if first.injective:
                return first
        if made.injective and made.added <= _LIMITS.max_added_at_once:
            return self._use_construction(made)
        most = max(made.added, _LIMITS.many_added) if made.injective else np.inf
        found = self._split_edges_and_search(first, reduced, _LIMITS.reduced_rounds, most)
        if found is not None and (not made.injective or found.added <= made.added):
            return found
        return self._use_construction(made)

    def _use_construction(self, made: MapResult) -> MapResult:
        """Record the construction as an attempt and return it."""
        self._attempts.append(RefinementAttempt(CONSTRUCTED, made.added, made.injective, made.stages[-1].seconds))
        return made

    def _split_edges_and_search(
        self, first: MapResult, budget: int, rounds: int, most: float = np.inf
    ) -> MapResult | None:
        """Split the edges that a diagnosis names, then edges at inverted triangles; return the map if one is found.

        Edges at inverted triangles are not split if that adds more than ``most`` vertices.
        """
        problem, self._select = self._problem, without_restarts
        straight = split_edges(problem.V, problem.F, self._flat)
        named = refine_problem(refined_problem(problem, straight))
        if named.diagnosis.forbids_injective:
            return None
        refined, result = compose(straight, named.refined), first
        if len(refined.parents):
            result = self._search_on(NAMED, refined, None, budget)
        for _ in range(rounds):
            if result.injective:
                return result
            finer = split_edges(refined.V, refined.F, _edges_around_inverted(refined, result.certificate))
            refined = compose(refined, finer)
            if len(refined.parents) > most:
                break
            result = self._search_on(AROUND, refined, finer.extend(result.uv), budget)
        return result if result.injective else None

    def _search_on(self, name: str, refined: Refined | None, start: FloatArray | None, budget: int) -> MapResult:
        """Search for a map of the given mesh or of a refined mesh, which is then thinned.

        Raise KeyboardInterrupt if the search was interrupted.
        """
        began = time.perf_counter()
        problem = self._problem
        result = self._search(on_refinement(problem, refined), start, budget, self._select)
        if refined is not None:
            uv = result.uv
            thinning = Run()
            with thinning.until_interrupted():
                if result.certificate.bijective:
                    refined, uv = thin_refinement(problem, refined, uv)
            if thinning.interrupted:
                result = replace(result, status=Status.INTERRUPTED)
            certificate = certify(refined.F, uv, loops=problem.domain.loops)
            result = replace(
                result, uv=uv, certificate=certificate, mu=None, V=refined.V, refined=_none_if_empty(refined)
            )
        result = self._append(result)
        if result.status is Status.INTERRUPTED:
            raise KeyboardInterrupt
        self._attempts.append(RefinementAttempt(name, result.added, result.injective, time.perf_counter() - began))
        return result

    def _construct(self, first: MapResult) -> MapResult:
        """Return a constructed map, certified, or a map that shows where double precision is insufficient."""
        began, before, result = time.perf_counter(), self._last, first
        for made in self._constructions(first.uv):
            # Replace the previous construction, which is kept if an interrupt stops the improvement.
            self._last = before
            result = self._append(self._as_result(made, first, time.perf_counter() - began))
        # Include the time of constructions tried after the best one.
        *others, last = result.stages
        return replace(result, stages=[*others, replace(last, seconds=time.perf_counter() - began)])

    def _constructions(self, uv: FloatArray) -> Iterator[Construction]:
        """Yield constructions near a map (n, 2), each better than the previous ones; one in patches is tried first."""
        patched = construct_patches(self._problem, uv)
        if patched is None:
            yield from constructions(self._problem, uv)
            return
        yield patched
        added = len(patched.refined.parents)
        if added and len(self._problem.F) <= _LIMITS.small:
            for made in constructions(self._problem, uv):
                if made.certificate.bijective and len(made.refined.parents) < added:
                    yield made

    def _as_result(self, made: Construction, first: MapResult, seconds: float) -> MapResult:
        bad = made.certificate.inverted.size + made.certificate.degenerate.size
        stage = Stage(CONSTRUCTED, 0, seconds, (len(self._problem.F), bad), (np.inf, np.inf))
        return replace(
            first,
            uv=made.uv,
            status=_status(made),
            certificate=made.certificate,
            stages=[stage],
            history=[],
            diagnosis=None,
            mu=None,
            path=[],
            V=made.refined.V,
            refined=_none_if_empty(made.refined),
            crowded=made.crowded,
        )

    def _append(self, result: MapResult) -> MapResult:
        """Prepend the stages and history of earlier attempts to a result, and store it as the latest."""
        last, best = self._last, self._best
        if last is not None:
            result = replace(result, stages=last.stages + result.stages, history=last.history + result.history)
        self._last = result
        if best is None or _rank(result) <= _rank(best):
            self._best = result
        return result


def _status(made: Construction) -> Status:
    if made.certificate.bijective:
        return Status.INJECTIVE
    return Status.PRECISION_LIMIT if made.cut else Status.TOO_MANY_SPLITS


def _rank(result: MapResult) -> tuple[int, bool, int]:
    """Sort key of a result; lower is better."""
    certificate = result.certificate
    bad = certificate.inverted.size + certificate.degenerate.size + certificate.nonfinite.size
    return bad, not certificate.bijective, result.added


def _none_if_empty(refined: Refined) -> Refined | None:
    """Return the refinement, or None if it has no added vertices."""
    return refined if len(refined.parents) else None


def _edges_around_inverted(refined: Refined, certificate: Certificate) -> IntArray:
    """Interior edges (s, 2) of triangles that are not positive, and of their neighbours."""
    F, n = refined.F, len(refined.V)
    bad = np.concatenate([certificate.inverted, certificate.degenerate])
    near = mark(n, F[bad])
    tail, head = F[near[F].any(axis=1)], np.roll(F[near[F].any(axis=1)], -1, axis=1)
    beside = np.unique(edge_keys(tail.ravel(), head.ravel(), n))
    inner = edges(F, n).interior
    return inner[np.isin(pair_keys(inner, n), beside)]
