"""Solve a problem with refinement: the given mesh, edges of the diagnosis, edges at inverted triangles, construction.

    as given, shortly ──▶ constructed, if no vertex has to be added
                      ──▶ as given ──▶ named edges ──▶ around inverted triangles ──▶ constructed

An attempt is made only if those before it found no map. The construction takes little time, while a failing search
takes much. The construction is therefore made as soon as the first stages of the search fail, if the target is simple.
The number of vertices that it adds determines whether the attempts in between are worth their time. If they are, they
get a reduced budget. The construction is used if they fail or add more vertices.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import replace

import numpy as np
from numpy.typing import ArrayLike

from quasiharmonic.energies.energies import Energy
from quasiharmonic.energies.newton.sliding import moved_onto
from quasiharmonic.energies.polishing import energy_named, polished
from quasiharmonic.geometry.curves.boundary_curves import BoundaryCurves
from quasiharmonic.geometry.exact.certificate import Certificate, certify
from quasiharmonic.geometry.mesh.refinement import Refined, composed, split_edges
from quasiharmonic.geometry.mesh.topology import edge_keys, edges
from quasiharmonic.problem import Problem
from quasiharmonic.problem.result import MapResult, RefinementAttempt, Stage, Status, Step
from quasiharmonic.solver.construction.constructing import Construction, constructions, refined_problem
from quasiharmonic.solver.construction.opening import thinned
from quasiharmonic.solver.construction.simplicity import is_simple
from quasiharmonic.solver.refine.refining import refine_problem
from quasiharmonic.solver.search.solving import solve
from quasiharmonic.solver.search.stages import Stages
from quasiharmonic.solver.search.strategy import soonest, stages_of, without_restarts
from quasiharmonic.targets.boundary.chords import flattened_edges
from quasiharmonic.util.arrays import IntArray
from quasiharmonic.util.progress import reports_progress

AS_GIVEN, NAMED, AROUND, CONSTRUCTED = (
    "as given",
    "edges split that the diagnosis names",
    "edges split around inverted triangles",
    "constructed",
)
_Choice = Callable[[Stages], Stages]
_Search = Callable[[Problem, ArrayLike | None, int, _Choice], MapResult]
# Iteration limit of a search if a construction exists, and its limit in triangles times iterations for large meshes.
# Then the rounds of splitting around inverted triangles with a construction, and without one.
_FEW_ITERATIONS, _FEW_TRIANGLES, _FEW_ROUNDS, _ROUNDS = 600, 1_500_000, 1, 3
# A construction with at most this many added vertices is used as soon as the given mesh has no map.
_LEAST = 1


@reports_progress
def solve_refining(
    problem: Problem,
    *,
    strategy: str | Stages = "speed",
    polish: str | Energy | None = None,
    start: ArrayLike | None = None,
    max_iterations: int = 2000,
    linear_solver: str = "auto",
    callback: Callable[[Step], object] | None = None,
    record_every: int = 0,
    slide: bool | BoundaryCurves = False,
) -> MapResult:
    """Solve a problem, with refinement if needed.

    Parameters
    ----------
    problem : Problem
    strategy, polish, start, max_iterations, linear_solver, callback, record_every, slide
        See `injective_map`. ``start`` and ``record_every`` apply to the given mesh.

    Returns
    -------
    MapResult
        See `injective_map` with ``refine``.

    Raises
    ------
    ValueError, ImportError
        See `solve`.
    """
    began = time.perf_counter()
    lower = None if polish is None else energy_named(polish)
    if slide is not False:
        if lower is None:
            raise ValueError("the boundary slides only while distortion is lowered: give an energy as well")
        problem = moved_onto(slide, problem)

    def search(on: Problem, first: ArrayLike | None, budget: int, some: _Choice) -> MapResult:
        return solve(
            on,
            strategy=some(stages_of(strategy, on)),
            start=first,
            max_iterations=min(budget, max_iterations),
            linear_solver=linear_solver,
            callback=callback,
            record_every=record_every if on is problem else 0,
        )

    result = _Ladder(problem, search).solve_refining(start, max_iterations)
    if lower is not None and result.status is Status.INJECTIVE:
        fine = on_refinement(problem, result.refined)
        result = polished(fine, result, energy=lower, linear_solver=linear_solver, callback=callback, slide=slide)
    return replace(result, seconds=time.perf_counter() - began)


def on_refinement(problem: Problem, refined: Refined | None) -> Problem:
    """Return the problem on the refined mesh, or the problem itself without refinement."""
    return problem if refined is None else refined_problem(problem, refined)


class _Ladder:
    """A problem, its search function, and the attempts so far."""

    def __init__(self, problem: Problem, search: _Search) -> None:
        self._problem = problem
        self._search = search
        # Selects the stages of a strategy to run.
        self._some: _Choice = list
        # Interior edges that a straight side of the target makes degenerate.
        self._flat = flattened_edges(problem.F, problem.fixed, problem.target)
        self._rungs: list[RefinementAttempt] = []
        # The latest result, with the stages and the history of all attempts so far, and the best result.
        self._last: MapResult | None = None
        self._best: MapResult | None = None

    def solve_refining(self, start: ArrayLike | None, budget: int) -> MapResult:
        """Return the map that adds the fewest vertices; if no attempt finds one, the result of the last attempt."""
        try:
            return replace(self._climb(start, budget), refinement_attempts=self._rungs)
        except KeyboardInterrupt:
            if self._last is None or self._best is None:
                raise
            best = self._taken(self._best) if self._best.stages[-1].name == CONSTRUCTED else self._best
            best = replace(best, stages=self._last.stages, history=self._last.history)
            return replace(best, status=Status.INTERRUPTED, refinement_attempts=self._rungs)

    def _climb(self, start: ArrayLike | None, budget: int) -> MapResult:
        problem = self._problem
        few = min(budget, _FEW_ITERATIONS, 1 + _FEW_TRIANGLES // len(problem.F))
        if not is_simple(problem):
            # If a straight side makes edges degenerate, a map seldom exists, and then only by a rounding error.
            first = self._searched(AS_GIVEN, None, start, few if len(self._flat) else budget)
            # If refinement does not help, report the result on the given mesh.
            return first if first.injective else self._between(first, budget, _ROUNDS) or first
        self._some = soonest
        first = self._searched(AS_GIVEN, None, start, budget)
        if first.injective:
            return first
        made = self._constructed(first)
        self._some = without_restarts if made.injective else list
        if not made.added and made.injective:
            return self._taken(made)
        if first.status is not Status.IMPOSSIBLE:
            first = self._searched(AS_GIVEN, None, start, few if made.injective else budget)
            if first.injective:
                return first
        if made.injective and made.added <= _LEAST:
            return self._taken(made)
        found = self._between(first, few, _FEW_ROUNDS)
        if found is not None and (not made.injective or found.added <= made.added):
            return found
        return self._taken(made)

    def _taken(self, made: MapResult) -> MapResult:
        """Record the construction as an attempt and return it."""
        self._rungs.append(RefinementAttempt(CONSTRUCTED, made.added, made.injective, made.stages[-1].seconds))
        return made

    def _between(self, first: MapResult, budget: int, rounds: int) -> MapResult | None:
        """Split the edges that a diagnosis names, then edges at inverted triangles; return the map if one is found."""
        problem = self._problem
        straight = split_edges(problem.V, problem.F, self._flat)
        named = refine_problem(refined_problem(problem, straight))
        if named.diagnosis.forbids_injective:
            return None
        refined, result = composed(straight, named.refined), first
        if len(refined.parents):
            result = self._searched(NAMED, refined, None, budget)
        for _ in range(rounds):
            if result.injective:
                return result
            finer = split_edges(refined.V, refined.F, _around(refined, result.certificate))
            refined = composed(refined, finer)
            result = self._searched(AROUND, refined, finer.extend(result.uv), budget)
        return result if result.injective else None

    def _searched(self, name: str, refined: Refined | None, start: ArrayLike | None, budget: int) -> MapResult:
        """Search for a map of the given mesh or of a refined mesh, which is then thinned.

        Raises
        ------
        KeyboardInterrupt
            If the search was interrupted.
        """
        began = time.perf_counter()
        problem = self._problem
        result = self._search(on_refinement(problem, refined), start, budget, self._some)
        if refined is not None:
            uv = result.uv
            try:
                if result.certificate.bijective:
                    refined, uv = thinned(problem, refined, uv)
            except KeyboardInterrupt:
                result = replace(result, status=Status.INTERRUPTED)
            certificate = certify(refined.F, uv, loops=problem.domain.loops)
            result = replace(result, uv=uv, certificate=certificate, mu=None, V=refined.V, refined=_if_any(refined))
        result = self._continued(result)
        if result.status is Status.INTERRUPTED:
            raise KeyboardInterrupt
        self._rungs.append(RefinementAttempt(name, result.added, result.injective, time.perf_counter() - began))
        return result

    def _constructed(self, first: MapResult) -> MapResult:
        """Return a constructed map, certified, or a map that shows where double precision is insufficient."""
        began, before, result = time.perf_counter(), self._last, first
        for made in constructions(self._problem, first.uv):
            # Replace the previous construction, which is kept if an interrupt stops the improvement.
            self._last = before
            result = self._continued(self._as_result(made, first, time.perf_counter() - began))
        # Include the time of constructions tried after the best one.
        *others, last = result.stages
        return replace(result, stages=[*others, replace(last, seconds=time.perf_counter() - began)])

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
            refined=_if_any(made.refined),
            crowded=made.crowded,
        )

    def _continued(self, result: MapResult) -> MapResult:
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


def _if_any(refined: Refined) -> Refined | None:
    """Return the refinement, or None if it has no added vertices."""
    return refined if len(refined.parents) else None


def _around(refined: Refined, certificate: Certificate) -> IntArray:
    """Interior edges (s, 2) of triangles that are not positive, and of their neighbours."""
    F, n = refined.F, len(refined.V)
    bad = np.concatenate([certificate.inverted, certificate.degenerate])
    near = np.zeros(n, dtype=np.bool_)
    near[F[bad]] = True
    tail, head = F[near[F].any(axis=1)], np.roll(F[near[F].any(axis=1)], -1, axis=1)
    beside = np.unique(edge_keys(tail.ravel(), head.ravel(), n))
    inner = edges(F, n).interior
    return inner[np.isin(edge_keys(inner[:, 0], inner[:, 1], n), beside)]
