"""A map of a refined mesh onto a simple target: constructed, certified and thinned."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from itertools import islice

import numpy as np

from quasiharmonic.geometry.exact.certificate import Certificate, certify
from quasiharmonic.geometry.mesh.refinement import Refined
from quasiharmonic.problem import Domain, Problem
from quasiharmonic.solver.construction.ancestry import as_refined, midpoints
from quasiharmonic.solver.construction.cutting import Cutting, TooManyError
from quasiharmonic.solver.construction.embedding import embedded
from quasiharmonic.solver.construction.opening import thinned
from quasiharmonic.solver.construction.simplicity import is_simple
from quasiharmonic.util.arrays import FloatArray, IntArray

# Maximum number of added vertices per mesh vertex before another way to cut is tried, and the final maximum: walks
# around many displaced pins can grow without bound.
_MANY, _MOST = 50, 60_000


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
        Its exact certificate. If triangles are not positive, double precision is insufficient there.
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


def constructions(problem: Problem, best_map: FloatArray) -> Iterator[Construction]:
    """Yield constructions near a given map and without one, each better than the previous ones.

    The last construction adds the fewest vertices.

    Parameters
    ----------
    problem : Problem
        Its target satisfies `is_simple`.
    best_map : (n, 2) float64
        The best map known, with inverted triangles.

    Yields
    ------
    Construction
        At least one. A certified map is yielded before it is thinned. If every way to cut needs too many vertices, the
        given map with ``cut`` False.
    """
    least = None
    # Near a bad map walks may grow without end, because each runs along the previous ones.
    most = _MANY * (problem.n + _MANY)
    for guide, limit in ((best_map, most), (None, most), (best_map, max(most, _MOST))):
        if least is not None and (limit > most or not least[1]):
            break
        try:
            for made in _constructions(problem, guide, most=limit):
                rank = not made.certificate.bijective, len(made.refined.parents)
                if least is None or rank <= least:
                    least = rank
                    yield made
        except TooManyError:
            continue
    if least is None:
        certificate = certify(problem.F, best_map, loops=problem.domain.loops)
        nowhere = np.empty(0, dtype=np.int64)
        yield Construction(as_refined(problem.V, problem.F, problem.F, []), best_map, certificate, nowhere, cut=False)


def construct(problem: Problem, guide: FloatArray | None = None, *, thin: bool = True) -> Construction:
    """Construct a map onto a simple target.

    Parameters
    ----------
    problem : Problem
        Its target satisfies `is_simple`.
    guide : (n, 2) array, optional
        A map near which the mesh is cut; it may have inverted triangles. Without it, the mesh is cut open near Tutte's
        embedding. Once it is a disk, it is cut near its map into a circle.
    thin : bool
        Remove added vertices that the map does not need.

    Returns
    -------
    Construction
        The map whose existence is proved; rounding may leave inverted triangles. If the target's coordinates span too
        many orders of magnitude for their products at any scale, the original mesh.
    """
    *_, made = islice(_constructions(problem, guide), None if thin else 1)
    return made


def _constructions(problem: Problem, guide: FloatArray | None, *, most: int | None = None) -> Iterator[Construction]:
    """Yield a construction and, if it is certified, its thinned version.

    Raises
    ------
    TooManyError
        If more than ``most`` vertices would be added.
    """
    # Scale to a magnitude of about one, so that no product overflows.
    exponent = int(np.frexp(np.abs(problem.target).max())[1])
    unit = Problem.on(problem.domain, np.ldexp(problem.target, -exponent), reference="equilateral")

    def judged(refined: Refined, uv: FloatArray) -> Construction:
        uv = np.ldexp(uv, exponent)
        uv[problem.fixed] = problem.target
        certificate = certify(refined.F, uv, loops=problem.domain.loops)
        return Construction(refined, uv, certificate, _nearest(problem, refined.F, uv, certificate))

    if not np.array_equal(np.ldexp(unit.target, exponent), problem.target) and not is_simple(unit):
        whole = as_refined(problem.V, problem.F, problem.F, [])
        yield judged(whole, np.zeros((problem.n, 2)) if guide is None else np.ldexp(guide, -exponent))
        return
    near = None if guide is None else np.ldexp(guide, -exponent) @ np.array([1, 1j])
    refined, uv = _embedded(unit, Cutting(unit, near, most))
    made = judged(refined, uv)
    yield made
    if len(refined.parents) and certify(refined.F, uv, loops=problem.domain.loops).bijective:
        yield judged(*thinned(unit, refined, uv))


def _embedded(problem: Problem, cutting: Cutting) -> tuple[Refined, FloatArray]:
    """Return the cut mesh joined again, and the map of its pieces into convex polygons."""
    sheet = cutting.sheet
    triangles = np.array(sheet.vertex)[sheet.rows()]
    refined = as_refined(problem.V, problem.F, triangles, midpoints(problem.n, sheet.parents))
    fine = refined_problem(problem, refined)
    uv = np.zeros((len(refined.V), 2))
    uv[problem.fixed] = problem.target
    walked = np.array(sorted(cutting.places), dtype=np.int64)
    for vertex in walked.tolist():
        uv[vertex] = cutting.places[vertex].real, cutting.places[vertex].imag
    held = np.concatenate([problem.fixed, walked])
    return refined, fine.positions(embedded(fine, fine.frame.inward(uv), held))


def _nearest(problem: Problem, F: IntArray, uv: FloatArray, certificate: Certificate) -> IntArray:
    """Return the fixed vertices nearest to triangles that are not positive, ascending."""
    from scipy.spatial import cKDTree

    bad = np.concatenate([certificate.inverted, certificate.degenerate, certificate.nonfinite])
    if not bad.size:
        return bad
    # Scale to a magnitude of about one, so that distances neither overflow nor underflow.
    scale = -int(np.frexp(np.abs(problem.target).max())[1])
    middles = np.nan_to_num(np.ldexp(uv[F[bad]], scale)).mean(axis=1)
    _, nearest = cKDTree(np.ldexp(problem.target, scale)).query(middles)
    return np.unique(problem.fixed[nearest])


def refined_problem(problem: Problem, refined: Refined) -> Problem:
    """Return a problem on a refinement of its mesh; rest triangles may be arbitrarily thin."""
    return Problem.on(Domain(refined.V, refined.F, problem.fixed), problem.target, reference=problem.reference)
