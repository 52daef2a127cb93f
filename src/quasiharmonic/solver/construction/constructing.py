"""A map of a refined mesh onto a simple target: constructed, certified and thinned; of all of a mesh, or in patches.

The pieces of the cut mesh are mapped by Tutte's embedding, and repaired if double precision is insufficient.

Where a map has few inverted triangles, only their surroundings are constructed again. A patch is a connected set of
triangles whose boundary the map takes to simple loops. It is a problem of its own with a simple target, so a
construction exists. The rest of the map stays::

    inverted triangles ──▶ rings around them ──▶ connected patches ──▶ simple images? ──▶ constructions
                                ▲                                     │ no
                                └─────── another ring around these ◀──┘
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from itertools import chain
from math import inf
from typing import NamedTuple

import numpy as np

from quasiharmonic.energies.deformation import signed_areas
from quasiharmonic.geometry.coarsening import mark_rings
from quasiharmonic.geometry.exact.certificate import Certificate, certify, inverted_triangles
from quasiharmonic.geometry.exact.loops import LoopEdges, check_loops, find_nesting, winding
from quasiharmonic.geometry.mesh.splitting import Refined
from quasiharmonic.geometry.mesh.topology import group_by_label, label_components
from quasiharmonic.linsolve import NotPositiveDefinite
from quasiharmonic.linsolve.laplacian import embed_tutte
from quasiharmonic.problem import Domain, Problem
from quasiharmonic.solver.construction.cutting import Cutting, TooManyError
from quasiharmonic.solver.construction.thinning import as_refined, midpoints, thin_refinement
from quasiharmonic.solver.field.objective import Objective
from quasiharmonic.solver.methods import LocalRepair, RandomRestarts, Untangling
from quasiharmonic.solver.methods.local_repair import Patch
from quasiharmonic.util.arrays import ComplexArray, FloatArray, IntArray, find_exponent, mark, scale_to_unit, to_complex


class ConstructionTuning(NamedTuple):
    """Numbers that tune the weights and the size of a construction."""

    # Number of weight updates.
    weight_updates: int = 4
    # Exponent of the areas in the weights.
    area_power: float = 0.5
    # Maximum ratio of weights in one update.
    max_ratio: float = 1e6
    # Near a bad map, walks may grow without end, because each runs along those before. So another way to cut is tried
    # if more vertices are added than this, and so many per vertex of the mesh.
    always_added: int = 2500
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


def embed_in_polygons(problem: Problem, w: ComplexArray, fixed: IntArray) -> ComplexArray:
    """Embed convex pieces into their polygons, and untangle triangles that rounding has inverted.

    ``w`` (n,) has the positions of the vertices on the boundaries of pieces, ``fixed`` (k,), in the problem's frame.
    Return the map with the fewest inverted triangles found, counted at its final positions.
    """
    best, fewest = w, len(problem.F) + 1
    weights = np.ones(len(problem.F))
    for _ in range(1 + _TUNING.weight_updates):
        try:
            w = embed_tutte(problem.F, w, fixed, weights)
        except NotPositiveDefinite:
            break
        if (inverted := _count_inverted(problem, w)) < fewest:
            best, fewest = w, inverted
        if fewest == 0:
            return best
        # Small triangles get smaller weights.
        areas = np.abs(signed_areas(problem.F, w))
        weights = weights * np.clip(areas / areas.max(), 1 / _TUNING.max_ratio, 1.0) ** _TUNING.area_power
    return _untangle(problem, best)


def _untangle(problem: Problem, w: ComplexArray) -> ComplexArray:
    """Return the map with the fewest inverted triangles. Each repair starts where the one before it ends."""
    best, fewest = w, _count_inverted(problem, w)
    objective = Objective(problem)
    here = objective.of_map(w)
    for repair in _REPAIRS:
        try:
            for step in repair.iterates(objective, here):
                moved, here = step.w is not here.w, step
                if moved and (inverted := _count_inverted(problem, here.w)) < fewest:
                    best, fewest = here.w, inverted
                if fewest == 0:
                    return best
        except NotPositiveDefinite:
            break
    return best


def _count_inverted(problem: Problem, w: ComplexArray) -> int:
    """Return how many triangles are not positive at the final positions of a map in the problem's frame."""
    return int(inverted_triangles(problem.F, problem.positions(w)).size)


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
    """Yield constructions near the best known map (n, 2) and without a guide, none worse than those before.

    The target satisfies `is_simple`. At least one construction is yielded; the last one adds the fewest vertices. A
    certified map is yielded before it is thinned. One with many added vertices is the last, and one with more than
    another is usually not thinned. A mesh usually gets fewer vertices without a guide, a ``patch`` near the best map.
    If every way to cut needs too many vertices, ``best_map`` is yielded with ``cut`` False.
    """
    usual = _TUNING.always_added + _TUNING.added_per_vertex * problem.n
    guides = (best_map, None) if patch else (None, best_map)
    best: Construction | None = None
    # Vertices that each certified construction adds before it is thinned.
    certified: list[int] = []
    for guide, limit in *((guide, usual) for guide in guides), (best_map, max(usual, _TUNING.max_added)):
        if best is not None and _is_final(best, certified, larger_limit=limit > usual):
            break
        steps = construct_and_thin(problem, guide, max_added=limit)
        try:
            made = next(steps)
        except TooManyError:
            continue
        added = len(made.refined.parents)
        worth_thinning = added <= max(min(certified, default=inf), _TUNING.few_added)
        if made.certificate.bijective:
            certified.append(added)
        for one in chain([made], steps if worth_thinning else []):
            if best is None or _rank(one) <= _rank(best):
                best = one
                yield one
    if best is None:
        certificate = certify(problem.F, best_map, loops=problem.domain.loops)
        uncut = as_refined(problem.V, problem.F, problem.F, [])
        yield Construction(uncut, best_map, certificate, np.empty(0, dtype=np.int64), cut=False)


def _is_final(best: Construction, certified: list[int], *, larger_limit: bool) -> bool:
    """Whether no further construction is tried: none can be better, or it would take long, or need a larger limit."""
    adds_nothing = not len(best.refined.parents)
    return adds_nothing or max(certified, default=0) > _TUNING.many_added or larger_limit


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
    refined, uv = _map_cut_mesh(unit, Cutting(unit, near, max_added))
    made = certify_map(refined, uv)
    yield made
    if len(refined.parents) and certify(refined.F, uv, loops=problem.domain.loops).bijective:
        yield certify_map(*thin_refinement(unit, refined, uv))


def _map_cut_mesh(problem: Problem, cutting: Cutting) -> tuple[Refined, FloatArray]:
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
    return refined, fine.positions(embed_in_polygons(fine, fine.frame.inward(uv), fixed))


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


class PatchLimits(NamedTuple):
    """Limits of the patches."""

    # Minimum and maximum number of rings of triangles around an inverted one.
    min_rings: int = 2
    max_rings: int = 100
    # Maximum fractions of the triangles that may be inverted, and that all patches together may contain.
    max_inverted: float = 0.05
    max_share: float = 0.6


_LIMITS = PatchLimits()


class _PatchProblem(NamedTuple):
    """Triangles (p,) of a mesh, the mesh's index of each of their vertices (v,), and the problem that they make."""

    rows: IntArray
    vertices: IntArray
    problem: Problem


def construct_patches(problem: Problem, uv: FloatArray) -> Construction | None:
    """Return a construction that differs from a map (n, 2) only around its inverted triangles.

    Return None if too many triangles are inverted, if there are no suitable patches, or if a construction is not
    certified.
    """
    inverted = inverted_triangles(problem.F, uv)
    if not 0 < inverted.size <= _LIMITS.max_inverted * len(problem.F):
        return None
    patches = _find_patches(problem, uv, inverted)
    if patches is None:
        return None
    F, w, n = problem.F.copy(), uv.copy(), problem.n
    # The added triangles with their parents, and the added vertices with their images, parents and weights.
    added: list[Refined] = []
    images = [w]
    for rows, vertices, patch in patches:
        *_, made = constructions(patch, uv[vertices], patch=True)
        if not made.certificate.bijective:
            return None
        refined, old = made.refined, len(vertices)
        triangles = np.append(vertices, n + np.arange(len(refined.parents)))[refined.F]
        n += len(refined.parents)
        F[rows], w[vertices] = triangles[: len(rows)], made.uv[:old]
        images.append(made.uv[old:])
        parent, parents = rows[refined.parent[len(rows) :]], vertices[refined.parents]
        added.append(Refined(refined.V[old:], triangles[len(rows) :], parent, parents, refined.weights))
    whole = Refined(
        np.concatenate([problem.V, *(one.V for one in added)]),
        np.concatenate([F, *(one.F for one in added)]),
        np.concatenate([np.arange(len(F)), *(one.parent for one in added)]),
        np.concatenate([one.parents for one in added]),
        np.concatenate([one.weights for one in added]),
    )
    image = np.concatenate(images)
    certificate = certify(whole.F, image, loops=problem.domain.loops)
    return Construction(whole, image, certificate, np.empty(0, dtype=np.int64)) if certificate.bijective else None


def _find_patches(problem: Problem, uv: FloatArray, inverted: IntArray) -> list[_PatchProblem] | None:
    """Return patches around the inverted triangles as rows, vertices and problems; None if they are too large."""
    F, n = problem.F, problem.n
    inside = mark_rings(F, mark(n, F[inverted]), _LIMITS.min_rings)
    # A set of triangles grows or stays, so its first triangle and its size identify it.
    known: dict[tuple[int, int], _PatchProblem | None] = {}
    for _ in range(_LIMITS.min_rings, _LIMITS.max_rings):
        rows = np.flatnonzero(inside[F].all(axis=1))
        if rows.size > _LIMITS.max_share * len(F):
            return None
        T = F[rows]
        label = label_components(T[:, :2], T[:, 1:], n)[T[:, 0]]
        found: list[_PatchProblem] = []
        poor = np.zeros(n, dtype=bool)
        for group in group_by_label(label):
            some = rows[group]
            key = int(some[0]), some.size
            if key not in known:
                known[key] = _as_problem(problem, uv, some)
            patch = known[key]
            if patch is None:
                poor[F[some]] = True
            else:
                found.append(patch)
        if not poor.any():
            return found
        inside |= mark_rings(F, poor)
    return None


def _as_problem(problem: Problem, uv: FloatArray, rows: IntArray) -> _PatchProblem | None:
    """Return the problem of some triangles, or None if they are no surface or its target is not simple."""
    patch = Patch.of(problem.F[rows], problem.fixed)
    try:
        domain = Domain(problem.V[patch.vertices], patch.F, np.flatnonzero(patch.fixed))
    except ValueError:
        return None
    own = Problem.on(domain, uv[patch.vertices[domain.fixed]], reference="equilateral")
    return _PatchProblem(rows, patch.vertices, own) if is_simple(own) else None
