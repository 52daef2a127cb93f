"""Remove added vertices from a map as long as it stays injective.

The polygon left by a removed vertex is triangulated so that every triangle is positive in the map and lies within a
triangle of the original mesh. If possible, dynamic programming finds the triangulation whose worst triangle is best
[1]_. Otherwise the best triangulation at rest is used, and the map is untangled around it. A constructed map is evened
out and thinned as its triangles gain area.

A `Refined` relates the mesh, after splitting edges one at a time, to the original mesh.

References
----------
.. [1] G. T. Klincsek, Minimal triangulations of polygonal domains. Annals of Discrete Mathematics 9 (1980).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from fractions import Fraction
from functools import partial
from itertools import cycle, islice
from typing import NamedTuple

import numpy as np

from quasiharmonic.geometry.exact.certificate import is_injective
from quasiharmonic.geometry.mesh.splitting import Refined, Shares, combine_shares, parents_and_weights
from quasiharmonic.problem import Frame, Problem
from quasiharmonic.solver.construction.half_edges import HalfEdges, Triangle
from quasiharmonic.solver.methods.local_repair import Patch
from quasiharmonic.solver.methods.untangling import GRADINGS, open_triangles, untangle
from quasiharmonic.util.arrays import (
    ComplexArray,
    FloatArray,
    IntArray,
    find_exponent,
    invert_indices,
    to_complex,
    to_points,
)
from quasiharmonic.util.progress import heartbeat


class ThinningTuning(NamedTuple):
    """Numbers that tune the removal of added vertices."""

    # Rounding of a determinant relative to the sum of its terms' magnitudes, with a margin.
    flat: float = 1e-15
    # Vertices with more neighbours are not removed.
    max_neighbours: int = 24
    # Maximum number of rounds of evening out and thinning.
    rounds: int = 6
    # Maximum number of vertices that are then removed by untangling around them.
    tries: int = 30
    # Rings around such a vertex that are untangled.
    rings: int = 2
    # Maximum number of untangling steps.
    steps: int = 20


_TUNING = ThinningTuning()


class Thinning:
    """A refined mesh, its injective map, and the positions of its vertices in the original mesh.

    Parameters
    ----------
    F : (f, 3) int64
        The original mesh.
    fixed : (k,) int64
    triangles : (t, 3) int64
        The refined mesh.
    shares : sequence of dict
        For each added vertex, the original vertices that it lies between, with their weights.
    w : (n + s,) complex128

    Attributes
    ----------
    mesh : HalfEdges
        With the original indices, also after removals.
    left : set of int
        The added vertices that remain.
    w : (n + s,) complex128
    """

    def __init__(
        self,
        F: IntArray,
        fixed: IntArray,
        triangles: IntArray,
        shares: Sequence[dict[int, float]],
        w: ComplexArray,
    ) -> None:
        n = len(w) - len(shares)
        self.mesh = HalfEdges(triangles)
        self.left = set(range(n, len(w)))
        self.w = w.copy()
        self._fixed = fixed
        self._old = {frozenset(row): row for row in F.tolist()}
        self._shares = [*({vertex: 1.0} for vertex in range(n)), *shares]

    def thin(self) -> None:
        """Remove vertices, the last added first, until none can be removed."""
        # Whether a vertex can be removed depends on its star, which changes only if a neighbour is removed.
        waiting = set(self.left)
        while waiting:
            for vertex in sorted(waiting, reverse=True):
                heartbeat()
                waiting.discard(vertex)
                cut = self._retriangulate(vertex, self._quality_in_map)
                if cut is not None:
                    beside = {tail for tail, _ in self.mesh.link(vertex)}
                    self._replace_star(vertex, cut)
                    waiting |= beside & self.left

    def remove_by_untangling(
        self, vertex: int, untangle: Callable[[Patch, ComplexArray], ComplexArray], rings: int
    ) -> bool:
        """Remove one of the vertices ``left`` if the map around it can be untangled; return whether it was removed.

        ``untangle`` returns another map of a patch from a map of it; the patch has this many rings. If the vertex was
        not removed, nothing has changed.
        """
        heartbeat()
        cut = self._retriangulate(vertex, self._quality_untangled)
        if cut is None:
            return False
        ring = [tail for tail, _ in self.mesh.link(vertex)]
        star = [(vertex, a, b) for a, b in self.mesh.link(vertex)]
        self._replace_star(vertex, cut)
        before = self.w
        patch = self._patch(ring, rings)
        if patch is not None:
            self.w = before.copy()
            self.w[patch.vertices] = untangle(patch, before[patch.vertices])
            if all(self._quality_in_map(*corners) > 0 for corners in patch.vertices[patch.F].tolist()):
                return True
        self.w = before
        self.mesh.remove(cut)
        self.mesh.add(star)
        self.left.add(vertex)
        return False

    def _replace_star(self, vertex: int, cut: list[Triangle]) -> None:
        """Replace the triangles around a vertex by others."""
        self.mesh.remove([(vertex, a, b) for a, b in self.mesh.link(vertex)])
        self.mesh.add(cut)
        self.left.remove(vertex)

    def _retriangulate(self, vertex: int, measure: Callable[[int, int, int], float]) -> list[Triangle] | None:
        """Triangulate the star of an added vertex without the vertex; None if no triangulation has positive quality."""
        ring = [tail for tail, _ in self.mesh.link(vertex)]
        polygons = [ring]
        edge = self._shares[vertex].keys()
        if len(edge) == 2:
            # One polygon on either side of the original edge that contains the vertex.
            i, j = (k for k, other in enumerate(ring) if self._shares[other].keys() <= edge)
            polygons = [ring[i : j + 1], ring[j:] + ring[: i + 1]]
        found = []
        for polygon in polygons:
            cut = triangulate_best(polygon, measure) if len(polygon) <= _TUNING.max_neighbours else None
            if cut is None:
                return None
            found += cut
        return found

    def _quality_in_map(self, a: int, b: int, c: int) -> float:
        """Return the worse of a triangle's qualities in the map and in the original triangle that contains it."""
        there = quality(*(complex(self.w[vertex]) for vertex in (a, b, c)))
        return min(there, self._quality_at_rest(a, b, c)) if there > 0 else there

    def _quality_untangled(self, a: int, b: int, c: int) -> float:
        """Return a quality that is positive also for triangles that are inverted in the map, but lower for these."""
        rest = self._quality_at_rest(a, b, c)
        there = quality(*(complex(self.w[vertex]) for vertex in (a, b, c)))
        return 1.0 + there if rest > 0 else rest

    def _quality_at_rest(self, a: int, b: int, c: int) -> float:
        """Return the quality of a triangle in its original triangle, drawn as half a square; 0 if it spans several."""
        rows = [self._shares[vertex] for vertex in (a, b, c)]
        old = self._old.get(frozenset().union(*rows))
        if old is None:
            return 0.0
        return quality(*(complex(row.get(old[1], 0.0), row.get(old[2], 0.0)) for row in rows))

    def _patch(self, ring: list[int], rings: int) -> Patch | None:
        """Return the triangles within some rings of some vertices; None if no map of them can be positive.

        That is the case if no vertex is free, or if a triangle of fixed vertices is not positive.
        """
        inside = set(ring)
        for _ in range(rings):
            inside |= {end for vertex in inside for side in self.mesh.link(vertex) for end in side}
        rows = [
            (vertex, a, b)
            for vertex in sorted(inside)
            for a, b in self.mesh.link(vertex)
            if vertex < a and vertex < b and a in inside and b in inside
        ]
        patch = Patch.of(np.array(rows), self._fixed)
        stay = patch.vertices[patch.F[patch.fixed[patch.F].all(axis=1)]].tolist()
        if patch.fixed.all() or any(self._quality_in_map(*corners) <= 0 for corners in stay):
            return None
        return patch


def quality(p: complex, q: complex, r: complex) -> float:
    """Return twice a triangle's signed area over the sum of its squared sides, up to 0.58; the sign is exact."""
    left = (p.real - r.real) * (q.imag - r.imag)
    right = (p.imag - r.imag) * (q.real - r.real)
    sides = abs(q - p) ** 2 + abs(r - q) ** 2 + abs(p - r) ** 2
    if abs(left - right) > _TUNING.flat * (abs(left) + abs(right)) + 1e-300:
        return (left - right) / sides
    # For a single triangle fractions are much faster than the vectorised predicates.
    (px, py), (qx, qy), (rx, ry) = ((Fraction(z.real), Fraction(z.imag)) for z in (p, q, r))
    difference = (px - rx) * (qy - ry) - (py - ry) * (qx - rx)
    return 1e-300 * ((difference > 0) - (difference < 0))


def triangulate_best(polygon: list[int], measure: Callable[[int, int, int], float]) -> list[Triangle] | None:
    """Return the triangulation of a polygon with the best worst triangle; None if its quality is not positive."""
    k = len(polygon)
    best = {(i, i + 1): (float("inf"), -1) for i in range(k - 1)}
    for span in range(2, k):
        for i in range(k - span):
            j = i + span
            choice = 0.0, -1
            for m in range(i + 1, j):
                value = min(best[i, m][0], best[m, j][0])
                if value > choice[0]:
                    value = min(value, measure(polygon[i], polygon[m], polygon[j]))
                    if value > choice[0]:
                        choice = value, m
            best[i, j] = choice
    if best[0, k - 1][0] <= 0:
        return None
    found, waiting = list[Triangle](), [(0, k - 1)]
    while waiting:
        i, j = waiting.pop()
        m = best[i, j][1]
        if m >= 0:
            found.append((polygon[i], polygon[m], polygon[j]))
            waiting += [(i, m), (m, j)]
    return found


def as_refined(V: FloatArray, F: IntArray, triangles: IntArray, shares: Sequence[Shares]) -> Refined:
    """Return the relation of a refined mesh to the original mesh ``V``, ``F``.

    ``triangles`` (t, 3) are the new ones, each within an original one, in any order. For each added vertex, in order,
    ``shares`` has the original vertices that it lies between and their weights.
    """
    n = len(V)
    support = [*({vertex} for vertex in range(n)), *(set(row) for row in shares)]
    number = {tuple(sorted(row)): k for k, row in enumerate(F.tolist())}
    rows = triangles.tolist()
    parent = np.array([number[tuple(sorted(support[a] | support[b] | support[c]))] for a, b, c in rows], dtype=np.int64)
    order = np.argsort(parent, kind="stable")
    triangles, parent = triangles[order], parent[order]
    _, first = np.unique(parent, return_index=True)
    further = np.setdiff1d(np.arange(len(parent)), first)
    order = np.concatenate([first, further])
    triangles, parent = triangles[order], parent[order]
    # Unsplit triangles keep their order of corners.
    whole = (np.sort(triangles, axis=1) == np.sort(F[parent], axis=1)).all(axis=1)
    triangles[whole] = F[parent[whole]]
    parents, weights = parents_and_weights(shares)
    added = np.einsum("sk,skd->sd", weights, V[parents])
    return Refined(np.concatenate([V, added]), triangles, parent, parents, weights)


def midpoints(n: int, parents: Sequence[tuple[int, int]]) -> list[Shares]:
    """Return the weights of original vertices in vertices that are midpoints of two earlier vertices each."""
    shares: list[Shares] = []
    for a, b in parents:
        shares.append(combine_shares({a: 0.5, b: 0.5}, shares, n))
    return shares


def thin_refinement(problem: Problem, refined: Refined, uv: FloatArray) -> tuple[Refined, FloatArray]:
    """Remove vertices from a refinement of the problem's mesh as long as its map ``uv`` (n + s, 2) stays bijective.

    Return the new refinement and its map, which is exactly the given one if no vertex was removed.
    """
    exponent = find_exponent(problem.target)
    given, uv = uv, np.ldexp(uv, -exponent)
    if not np.array_equal(np.ldexp(uv, exponent), given):
        # Leave coordinates with too large a span unchanged: scaling would round them and could invert triangles.
        return refined, given
    unit = Problem.on(problem.domain, np.ldexp(problem.target, -exponent))
    gradings = cycle(GRADINGS)
    for _ in range(_TUNING.rounds):
        refined, uv = _remove_vertices(unit, refined, uv)
        if not len(refined.parents):
            break
        uv = _open_triangles(unit, refined, uv, next(gradings))
    refined, uv = _remove_vertices(unit, refined, uv, _TUNING.tries)
    uv = np.ldexp(uv, exponent)
    uv[problem.fixed] = problem.target
    return refined, uv


def _open_triangles(problem: Problem, refined: Refined, uv: FloatArray, grading: float) -> FloatArray:
    """Return the map with evened out triangles, or the given map if rounding would invert one."""
    evened = problem.frame.outward(open_triangles(refined.F, problem.frame.inward(uv), problem.fixed, grading=grading))
    evened[problem.fixed] = problem.target
    return evened if is_injective(refined.F, evened) else uv


def _remove_vertices(problem: Problem, refined: Refined, uv: FloatArray, tries: int = 0) -> tuple[Refined, FloatArray]:
    """Remove vertices by thinning, and by untangling around up to ``tries`` of the rest."""
    shares = refined.shares()
    thinning = Thinning(problem.F, problem.fixed, refined.F, shares, to_complex(uv))
    thinning.thin()
    for vertex in sorted(thinning.left, reverse=True)[:tries]:
        thinning.remove_by_untangling(vertex, partial(_untangle_patch, problem.frame), _TUNING.rings)
    if len(thinning.left) == len(shares):
        return refined, uv
    left = sorted(thinning.left)
    kept = np.concatenate([np.arange(problem.n), left]).astype(np.int64)
    number = invert_indices(len(uv), kept)
    V = refined.V[: problem.n]
    triangles = number[np.array(thinning.mesh.triangles(), dtype=np.int64)]
    refined = as_refined(V, problem.F, triangles, [shares[vertex - problem.n] for vertex in left])
    return refined, to_points(thinning.w[kept])


def _untangle_patch(frame: Frame, patch: Patch, w: ComplexArray) -> ComplexArray:
    """Untangle a map of a patch, in units of the target; return the last map."""
    inward = frame.inward(to_points(w))
    steps = untangle(patch.F, inward, np.flatnonzero(patch.fixed), grading=GRADINGS[0])
    *_, last = inward, *islice(steps, _TUNING.steps)
    return np.where(patch.fixed, w, to_complex(frame.outward(last)))
