"""Even out a constructed map and thin it as its triangles gain area.

A `Refined` relates the mesh, after splitting edges one at a time, to the original mesh.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from itertools import cycle, islice

import numpy as np

from quasiharmonic.geometry.exact.certificate import is_injective
from quasiharmonic.geometry.mesh.refinement import Refined, Shares, combine_shares, parents_and_weights
from quasiharmonic.problem import Frame, Problem
from quasiharmonic.solver.construction.thinning import Thinning
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

# Maximum number of rounds of evening out and thinning.
_ROUNDS = 6
# Maximum number of vertices that are then removed by untangling around them.
_TRIES = 30
# Rings around such a vertex that are untangled.
_RINGS = 2
# Maximum number of untangling steps.
_STEPS = 20


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
    for _ in range(_ROUNDS):
        refined, uv = _remove_vertices(unit, refined, uv)
        if not len(refined.parents):
            break
        uv = _open_triangles(unit, refined, uv, next(gradings))
    refined, uv = _remove_vertices(unit, refined, uv, _TRIES)
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
        thinning.remove_by_untangling(vertex, partial(_untangle_patch, problem.frame), _RINGS)
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
    *_, last = inward, *islice(steps, _STEPS)
    return np.where(patch.fixed, w, to_complex(frame.outward(last)))
