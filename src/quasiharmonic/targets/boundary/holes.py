"""Match the holes of a surface to the holes of an outline, and choose their rotation."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from quasiharmonic.geometry.mesh.fans import make_fans
from quasiharmonic.linsolve.laplacian import Laplacian
from quasiharmonic.problem import Domain
from quasiharmonic.util.arrays import ComplexArray, FloatArray, to_complex

# Number of choices per loop for which the full energy is computed.
_CANDIDATES = 8


def match_holes(
    surface: Domain, outer: int, positions: FloatArray, contours: list[FloatArray], to: Mapping[int, int]
) -> dict[int, int]:
    """Assign a nearby contour to every loop that has none in ``to``, which has ``outer``; return these only.

    The surface, its holes filled, is mapped into the outer contour by Tutte's embedding with the outer loop at
    ``positions`` (l, 2). The assignment minimises the sum of squared distances between the centres of its holes and
    those of the contours. The positions of ``surface`` are not used.
    """
    from scipy.optimize import linear_sum_assignment

    loops = [i for i in range(len(surface.loops)) if i not in to]
    holes = [c for c in range(len(contours)) if c not in to.values()]
    if len(loops) < 2:
        return dict(zip(loops, holes, strict=True))
    middles = _middles(surface, outer, positions)
    centres = np.array([_centroid(contours[c]) for c in holes])
    rows, columns = linear_sum_assignment(np.abs(middles[loops, None] - centres) ** 2)
    return {loops[i]: holes[c] for i, c in zip(rows, columns, strict=True)}


def choose_least_stretch(
    surface: Domain, given: Mapping[int, FloatArray], choices: Mapping[int, list[FloatArray]]
) -> dict[int, FloatArray]:
    """Choose positions of loops for which Tutte's embedding has the least Dirichlet energy.

    ``given`` has the positions of some loops, ``choices`` the possible positions of every other one. A hole that is
    rotated against the surrounding surface twists the embedding, which increases the energy. The energy is a quadratic
    form in the boundary's positions. Its part linear in one loop's positions, with the other loops given or shrunk to
    points, needs one solve for all choices. It selects the few most promising choices, for which the whole form is
    computed. Then each loop in turn takes its best choice until none changes.
    """
    loops = surface.loops
    if all(len(positions) == 1 for positions in choices.values()):
        return {i: positions[0] for i, positions in choices.items()}
    pattern = Laplacian(surface.F, surface.n, np.concatenate(loops))
    # Weights of equilateral triangles, up to a factor.
    laplacian = pattern.factor(np.full((3, len(surface.F)), -1.0))

    def forces(positions: Mapping[int, ComplexArray]) -> ComplexArray:
        w = np.zeros(surface.n, dtype=np.complex128)
        for i, points in positions.items():
            w[loops[i]] = points
        return laplacian.flux(laplacian.extend(w))

    def work(i: int, offsets: list[ComplexArray], force: ComplexArray) -> FloatArray:
        return np.array([np.vdot(offset, force[loops[i]]).real for offset in offsets])

    of_given = {i: to_complex(positions) for i, positions in given.items()}
    offsets = {}
    for i, positions in choices.items():
        turned = [to_complex(points) for points in positions]
        of_given[i] = np.full(len(loops[i]), np.mean([points.mean() for points in turned]))
        offsets[i] = [points - of_given[i] for points in turned]
    pull = forces(of_given)
    kept, answers, own = {}, {}, {}
    for i in choices:
        linear = 2 * work(i, offsets[i], pull)
        kept[i] = np.argsort(linear, kind="stable")[:_CANDIDATES]
        offsets[i] = [offsets[i][k] for k in kept[i]]
        answers[i] = [forces({i: offset}) for offset in offsets[i]]
        # The quadratic part of each choice by itself.
        alone = [work(i, [offset], answer)[0] for offset, answer in zip(offsets[i], answers[i], strict=True)]
        own[i] = linear[kept[i]] + alone
    taken = {i: int(np.argmin(own[i])) for i in choices}
    # The descent ends after finitely many combinations, but rounding could make it cycle.
    for _ in range(100):
        before = dict(taken)
        for i in choices:
            others = sum((answers[j][k] for j, k in taken.items() if j != i), np.zeros(surface.n, dtype=np.complex128))
            taken[i] = int(np.argmin(own[i] + 2 * work(i, offsets[i], others)))
        if taken == before:
            break
    return {i: choices[i][kept[i][k]] for i, k in taken.items()}


def _middles(surface: Domain, outer: int, positions: FloatArray) -> ComplexArray:
    """Positions of the centres of the holes, each filled by a fan; one complex number for every loop."""
    holes = [loop for i, loop in enumerate(surface.loops) if i != outer]
    F, n = np.concatenate([surface.F, make_fans(holes, surface.n)]), surface.n + len(holes)
    laplacian = Laplacian(F, n, surface.loops[outer]).factor(np.full((3, len(F)), -1.0))
    w = np.zeros(n, dtype=np.complex128)
    w[surface.loops[outer]] = to_complex(positions)
    # The outer loop has no centre.
    return np.insert(laplacian.extend(w)[surface.n :], outer, np.nan)


def _centroid(contour: FloatArray) -> complex:
    """Centroid of the area inside a contour."""
    w = to_complex(contour - contour[0])
    following = np.roll(w, -1)
    cross = (w.conj() * following).imag
    return complex(*contour[0]) + complex((cross * (w + following)).sum() / (3 * cross.sum()))
