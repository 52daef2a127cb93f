"""Even out a constructed map and thin it as its triangles gain area."""

from __future__ import annotations

from functools import partial
from itertools import cycle, islice

import numpy as np

from quasiharmonic.geometry.exact.certificate import is_injective
from quasiharmonic.geometry.mesh.refinement import Refined
from quasiharmonic.problem import Frame, Problem
from quasiharmonic.solver.construction.ancestry import as_refined, shares_of
from quasiharmonic.solver.construction.thinning import Thinning
from quasiharmonic.solver.methods.local_repair import Patch
from quasiharmonic.solver.methods.untangling import GRADINGS, opened, untangled
from quasiharmonic.util.arrays import ComplexArray, FloatArray

# Maximum number of rounds of evening out and thinning. Then more expensive tries: maximum number of vertices, rings
# around each that are untangled, and steps.
_ROUNDS, _TRIES, _RINGS, _STEPS = 6, 30, 2, 20


def thinned(problem: Problem, refined: Refined, uv: FloatArray) -> tuple[Refined, FloatArray]:
    """Remove vertices from a refinement as long as its map stays bijective.

    Parameters
    ----------
    problem : Problem
        On the original mesh.
    refined : Refined
    uv : (n + s, 2) float64
        A bijective map of it.

    Returns
    -------
    refined : Refined
        With as many vertices or fewer.
    uv : (n + s, 2) float64
        A bijective map of it; exactly the given one if no vertex was removed.
    """
    # Scale to a magnitude of about one, so that no product overflows.
    exponent = int(np.frexp(np.abs(problem.target).max())[1])
    given, uv = uv, np.ldexp(uv, -exponent)
    if not np.array_equal(np.ldexp(uv, exponent), given):
        # Leave coordinates with too large a span unchanged: scaling would round them and could invert triangles.
        return refined, given
    unit = Problem.on(problem.domain, np.ldexp(problem.target, -exponent))
    gradings = cycle(GRADINGS)
    for _ in range(_ROUNDS):
        refined, uv = _taken_out(unit, refined, uv)
        if not len(refined.parents):
            break
        uv = _opened(unit, refined, uv, next(gradings))
    refined, uv = _taken_out(unit, refined, uv, _TRIES)
    uv = np.ldexp(uv, exponent)
    uv[problem.fixed] = problem.target
    return refined, uv


def _opened(problem: Problem, refined: Refined, uv: FloatArray, grading: float) -> FloatArray:
    """Return the map with evened out triangles, or the given map if rounding would invert one."""
    loose = problem.frame.outward(opened(refined.F, problem.frame.inward(uv), problem.fixed, grading=grading))
    loose[problem.fixed] = problem.target
    return loose if is_injective(refined.F, loose) else uv


def _taken_out(problem: Problem, refined: Refined, uv: FloatArray, tries: int = 0) -> tuple[Refined, FloatArray]:
    """Remove vertices by thinning, and by untangling around up to ``tries`` of the rest."""
    shares = shares_of(refined)
    thinning = Thinning(problem.F, problem.fixed, refined.F, shares, uv @ np.array([1, 1j]))
    thinning.thin()
    for vertex in sorted(thinning.left, reverse=True)[:tries]:
        thinning.try_hard(vertex, partial(_untangled, problem.frame), _RINGS)
    if len(thinning.left) == len(shares):
        return refined, uv
    left = sorted(thinning.left)
    kept = np.concatenate([np.arange(problem.n), left]).astype(np.int64)
    number = np.full(len(uv), -1)
    number[kept] = np.arange(len(kept))
    V = refined.V[: problem.n]
    triangles = number[np.array(thinning.mesh.triangles(), dtype=np.int64)]
    refined = as_refined(V, problem.F, triangles, [shares[vertex - problem.n] for vertex in left])
    return refined, thinning.w[kept].view(np.float64).reshape(-1, 2)


def _untangled(frame: Frame, patch: Patch, w: ComplexArray) -> ComplexArray:
    """Untangle a map of a patch, in units of the target; return the last map."""
    inward = frame.inward(w.view(np.float64).reshape(-1, 2))
    steps = untangled(patch.F, inward, np.flatnonzero(patch.held), grading=GRADINGS[0])
    *_, last = inward, *islice(steps, _STEPS)
    return np.where(patch.held, w, frame.outward(last).view(np.complex128).ravel())
