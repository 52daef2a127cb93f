"""A map of a refined mesh onto a simple target: constructed, certified and thinned.

The pieces of the cut mesh are mapped by Tutte's embedding, and repaired if double precision is insufficient.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from math import inf
from typing import NamedTuple

import numpy as np

from quasiharmonic.energies.deformation import signed_areas
from quasiharmonic.geometry.exact.certificate import Certificate, certify, inverted_triangles
from quasiharmonic.geometry.exact.loops import LoopEdges, check_loops, find_nesting, winding
from quasiharmonic.geometry.mesh.splitting import Refined
from quasiharmonic.linsolve import NotPositiveDefinite
from quasiharmonic.linsolve.laplacian import embed_tutte
from quasiharmonic.problem import Domain, Problem
from quasiharmonic.solver.construction.cutting import Cutting, TooManyError
from quasiharmonic.solver.construction.thinning import as_refined, midpoints, thin_refinement
from quasiharmonic.solver.field.objective import Objective
from quasiharmonic.solver.methods import LocalRepair, RandomRestarts, Untangling
from quasiharmonic.util.arrays import ComplexArray, FloatArray, IntArray, find_exponent, scale_to_unit, to_complex


class ConstructionTuning(NamedTuple):
    """Numbers that tune the weights and the size of a construction."""

    # Number of weight updates.
    weight_updates: int = 4
    # Exponent of the areas in the weights.
    area_power: float = 0.5
    # Maximum ratio of weights in one update.
    max_ratio: float = 1e6
    # Maximum number of added vertices per mesh vertex before another way to cut is tried.
    added_per_vertex: int = 50
    # Final maximum of added vertices: walks around many displaced pins can grow without bound.
    max_added: int = 60_000
    # Cutting and thinning take long with more added vertices than this.
    many_added: int = 1000
    # A construction with at most so many is also thinned if another one has fewer.
    few_added: int = 100


_TUNING = ConstructionTuning()

# Methods that untangle the last triangles and may also move vertices on cuts. Each is limited, because double precision
# may be insufficient.
_REPAIRS = LocalRepair(tries=30), Untangling(iterations=200), RandomRestarts(max_failures=20, tries=20)


def embed_pieces(problem: Problem, w: ComplexArray, fixed: IntArray) -> ComplexArray:
    """Embed convex pieces into their polygons, and untangle triangles that rounding has inverted.

    ``w`` (n,) has the positions of the vertices on the boundaries of pieces, ``fixed`` (k,), in the problem's frame.
    Return the map with the fewest inverted triangles found, counted at its final positions.
    """
    best, fewest = w, len(problem.F) + 1
    for candidate in _candidates(problem, w, fixed):
        inverted = inverted_triangles(problem.F, problem.positions(candidate)).size
        if inverted < fewest:
            best, fewest = candidate, inverted
        if fewest == 0:
            break
    return best


def _candidates(problem: Problem, w: ComplexArray, fixed: IntArray) -> Iterator[ComplexArray]:
    """Yield embeddings with different weights, then maps from untangling the best of them."""
    weights, best, fewest = np.ones(len(problem.F)), w, np.inf
    for _ in range(1 + _TUNING.weight_updates):
        try:
            w = embed_tutte(problem.F, w, fixed, weights)
        except NotPositiveDefinite:
            break
        yield w
        inverted = inverted_triangles(problem.F, problem.positions(w)).size
        if inverted < fewest:
            best, fewest = w, inverted
        # Small triangles get smaller weights.
        areas = np.abs(signed_areas(problem.F, w))
        weights = weights * np.clip(areas / areas.max(), 1 / _TUNING.max_ratio, 1.0) ** _TUNING.area_power
    objective = Objective(problem)
    here = objective.of_map(best)
    for repair in _REPAIRS:
        try:
            for step in repair.iterates(objective, here):
                again, here = step.w is here.w, step
                if not again:
                    yield here.w
        except NotPositiveDefinite:
            return


def is_simple(problem: Problem) -> bool:
    """Whether a surface can be mapped bijectively onto its target if its mesh is fine enough, determined exactly.

    True if the surface has no handles and the target is simple. Its loops must be simple, disjoint, nested as an outer
    one around all others, and wound as the mesh's. Pins must be distinct and strictly inside.
    """
    domain = problem.domain
    if domain.euler != 2 - len(domain.loops):
        return False
    if len(np.unique(problem.target, axis=0)) < len(problem.target):
        return False
    uv = problem.place_fixed()
    if check_loops(domain.loops, uv)[1]:
        return False
    if np.count_nonzero(find_nesting(LoopEdges.of(domain.loops, uv))[0] > 0) != 1:
        return False
    turns, on = winding(uv[domain.pins], *uv[domain.edges.boundary.T])
    return bool(np.all(~on & (turns == 1)))


@dataclass(frozen=True, eq=False)
class Construction:
    """A map of a refined mesh.

    Attributes
    ----------
    refined : Refined
        Relation of the refined mesh to the problem's mesh.
    uv : (n + s, 2) float64
        The map, with fixed vertices exactly at their target positions.
    certificate : Certificate
        If triangles are not positive, double precision is insufficient there.
    crowded : (c,) int64
        Fixed vertices nearest to those triangles; empty if there are none.
    cut : bool
        False if cutting needs more vertices than allowed; the map is then one of the original mesh.
    """

    refined: Refined
    uv: FloatArray
    certificate: Certificate
    crowded: IntArray
    cut: bool = True


def constructions(problem: Problem, best_map: FloatArray, *, patch: bool = False) -> Iterator[Construction]:
    """Yield constructions near the best known map (n, 2) and without a guide, each better than the previous ones.

    The target satisfies `is_simple`. At least one construction is yielded; the last one adds the fewest vertices. A
    certified map is yielded before it is thinned. One with many added vertices is the last, and one with more than
    another is usually not thinned. A mesh usually gets fewer vertices without a guide, a ``patch`` near the best map.
    If every way to cut needs too many vertices, ``best_map`` is yielded with ``cut`` False.
    """
    best: tuple[bool, int] | None = None

    def is_better(made: Construction) -> bool:
        nonlocal best
        if best is not None and _rank(made) > best:
            return False
        best = _rank(made)
        return True

    fewest, large = inf, False
    # Near a bad map walks may grow without end, because each runs along the previous ones.
    first = _TUNING.added_per_vertex * (problem.n + _TUNING.added_per_vertex)
    guides = (best_map, None) if patch else (None, best_map)
    for guide, limit in (*((guide, first) for guide in guides), (best_map, max(first, _TUNING.max_added))):
        if best is not None and (limit > first or not best[1] or large):
            break
        steps = construct_and_thin(problem, guide, max_added=limit)
        try:
            made = next(steps)
        except TooManyError:
            continue
        if is_better(made):
            yield made
        added = len(made.refined.parents)
        if added <= max(fewest, _TUNING.few_added):
            yield from filter(is_better, steps)
        if made.certificate.bijective:
            fewest, large = min(added, fewest), added > _TUNING.many_added
    if best is None:
        certificate = certify(problem.F, best_map, loops=problem.domain.loops)
        uncut = as_refined(problem.V, problem.F, problem.F, [])
        yield Construction(uncut, best_map, certificate, np.empty(0, dtype=np.int64), cut=False)


def _rank(made: Construction) -> tuple[bool, int]:
    """Sort key of a construction; lower is better."""
    return not made.certificate.bijective, len(made.refined.parents)


def construct_and_thin(
    problem: Problem, guide: FloatArray | None, *, max_added: int | None = None
) -> Iterator[Construction]:
    """Yield the map of a simple target whose existence is proved and, if it is certified, its thinned version.

    The mesh is cut near ``guide`` (n, 2), which may have inverted triangles. Without a guide, it is cut open near
    Tutte's embedding; once it is a disk, it is cut near its map into a circle. Rounding may leave inverted triangles.
    If the target's coordinates span too many orders of magnitude for their products at any scale, the mesh stays uncut.

    Raises
    ------
    TooManyError
        If more than ``max_added`` vertices would be added.
    """
    exponent = find_exponent(problem.target)
    unit = Problem.on(problem.domain, np.ldexp(problem.target, -exponent), reference="equilateral")

    def certify_map(refined: Refined, uv: FloatArray) -> Construction:
        uv = np.ldexp(uv, exponent)
        uv[problem.fixed] = problem.target
        certificate = certify(refined.F, uv, loops=problem.domain.loops)
        return Construction(refined, uv, certificate, _find_nearest(problem, refined.F, uv, certificate))

    if not np.array_equal(np.ldexp(unit.target, exponent), problem.target) and not is_simple(unit):
        uncut = as_refined(problem.V, problem.F, problem.F, [])
        yield certify_map(uncut, np.zeros((problem.n, 2)) if guide is None else np.ldexp(guide, -exponent))
        return
    near = None if guide is None else to_complex(np.ldexp(guide, -exponent))
    refined, uv = _embed_pieces(unit, Cutting(unit, near, max_added))
    made = certify_map(refined, uv)
    yield made
    if len(refined.parents) and certify(refined.F, uv, loops=problem.domain.loops).bijective:
        yield certify_map(*thin_refinement(unit, refined, uv))


def _embed_pieces(problem: Problem, cutting: Cutting) -> tuple[Refined, FloatArray]:
    """Return the cut mesh joined again, and the map of its pieces into convex polygons."""
    sheet = cutting.sheet
    triangles = np.array(sheet.vertex)[sheet.rows()]
    refined = as_refined(problem.V, problem.F, triangles, midpoints(problem.n, sheet.parents))
    fine = refined_problem(problem, refined)
    uv = np.zeros((len(refined.V), 2))
    uv[problem.fixed] = problem.target
    on_cuts = np.array(sorted(cutting.positions), dtype=np.int64)
    for vertex in on_cuts.tolist():
        uv[vertex] = cutting.positions[vertex].real, cutting.positions[vertex].imag
    fixed = np.concatenate([problem.fixed, on_cuts])
    return refined, fine.positions(embed_pieces(fine, fine.frame.inward(uv), fixed))


def _find_nearest(problem: Problem, F: IntArray, uv: FloatArray, certificate: Certificate) -> IntArray:
    """Return the fixed vertices nearest to triangles that are not positive, ascending."""
    from scipy.spatial import cKDTree

    bad = np.concatenate([certificate.inverted, certificate.degenerate, certificate.nonfinite])
    if not bad.size:
        return bad
    middles = np.nan_to_num(np.ldexp(uv[F[bad]], -find_exponent(problem.target))).mean(axis=1)
    _, nearest = cKDTree(scale_to_unit(problem.target)).query(middles)
    return np.unique(problem.fixed[nearest])


def refined_problem(problem: Problem, refined: Refined) -> Problem:
    """Return a problem on a refinement of its mesh; rest triangles may be arbitrarily thin."""
    return Problem.on(Domain(refined.V, refined.F, problem.fixed), problem.target, reference=problem.reference)
