"""Line shift: move all vertices along parallel lines at once by a linear programme.

If every vertex moves only along a line of one direction, the signed area of each triangle is *linear* in the positions
on the lines. A linear programme therefore gives the least inverted area that can be reached along that direction,
whatever obstacles lie in between. It needs no step length and has no local minima. A vertex can pass another without
coming close to it, and a fold of many triangles moves as a whole. Directions are drawn at random, one after another,
for large and small patches around inverted triangles.

With ``s`` the positions along the lines in units of the triangles' widths there, and a triangle's row ``A`` scaled to a
largest entry of one,

    minimise Σ z      subject to  A (s + d) + z ≥ δ,   z ≥ 0.

δ is a fraction of a positive triangle's value, so that it stays positive, and a small value for an inverted triangle.
Before directions are drawn, an affine map makes the patch as wide as it is long. It preserves orientations, so flat
targets and thin limbs need no special treatment.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from quasiharmonic.geometry.exact.certificate import inverted_triangles
from quasiharmonic.solver.field.objective import Iterate, Objective
from quasiharmonic.solver.methods.base import Iterates, VertexDescent
from quasiharmonic.solver.methods.local_repair import Effort, Patch, patch_around, remapped
from quasiharmonic.util.arrays import BoolArray, ComplexArray, FloatArray, IntArray, whole_number
from quasiharmonic.util.progress import heartbeat

Generator = np.random.Generator

# Rings around an inverted triangle, one drawn per patch. Maximum number of triangles of a patch, and of a patch with
# the fewest rings, which is large around a vertex with very many neighbours.
_RINGS = 3, 8, 24
_MOST_TRIANGLES, _MOST_NEAR = 2000, 20000
# Least value δ. For a positive triangle: a fraction of its height over its widest side, at most the given number of
# widths. For an inverted triangle: the last value.
_KEPT, _ENOUGH, _RIGHTED = 0.1, 1.0, 1e-3
# Maximum move of a vertex, in widths of the triangles around it.
_REACH = 20.0
# Maximum number of simplex steps times triangles: each step takes time proportional to the triangles. The total is
# about 0.1 to 0.2 CPU seconds.
_PIVOTS_TIMES_TRIANGLES = 4_000_000
# Cost of a programme, in steps of untangling the patch.
_STEPS_A_PROGRAMME = 100


@dataclass(frozen=True, kw_only=True)
class LineShift(VertexDescent):
    """Untangle inverted triangles by linear programmes along random directions.

    The directions come from a generator with a fixed seed.

    Attributes
    ----------
    in_vain : int
        Maximum number of consecutive programmes that untangle no triangle.
    """

    in_vain: int = 5

    word: ClassVar[str] = "combing"
    quick: ClassVar[bool] = True

    def __post_init__(self) -> None:
        whole_number("in_vain", self.in_vain, least=1)

    def iterates(self, objective: Objective, start: Iterate) -> Iterates:
        """See `Descent`; yields a map after every programme that reduces the number of inverted triangles."""
        problem, effort = objective.problem, Effort(len(objective.problem.F))
        rng = np.random.default_rng(0)

        def other(w: ComplexArray, left: IntArray) -> tuple[Patch, ComplexArray] | None:
            triangle, rings = int(rng.choice(left)), int(rng.choice(_RINGS))
            patch = patch_around(problem, triangle, rings, _MOST_TRIANGLES)
            patch = patch or patch_around(problem, triangle, _RINGS[0], _MOST_NEAR)
            if patch is None:
                return None
            effort.count(len(patch.F), _STEPS_A_PROGRAMME)
            return patch, combed(rng, patch.F, w[patch.vertices], patch.held)

        left = inverted_triangles(problem.F, problem.positions(start.w))
        yield from remapped(objective, start.w, left, other, patience=self.in_vain, effort=effort)
        return True


def combed(rng: Generator, F: IntArray, w: ComplexArray, held: BoolArray) -> ComplexArray:
    """Return a map with the least inverted area, as defined above, along one random direction.

    Parameters
    ----------
    rng : Generator
        Draws the direction.
    F : (p, 3) int64
        Triangles of a patch.
    w : (v,) complex128
        Its map.
    held : (v,) bool
        Fixed vertices.

    Returns
    -------
    (v,) complex128
        ``w`` if the solver finds no solution.
    """
    places = frame_along(w, rng.uniform(0, np.pi))
    if places is None:
        return w
    x, y, along = places
    step = best_shift(F, x, y, held)
    return w if step is None else w + step * along


def frame_along(w: ComplexArray, angle: float) -> tuple[FloatArray, FloatArray, complex] | None:
    """Return coordinates along a direction and across it, in which the points are as wide as they are long.

    Parameters
    ----------
    w : (v,) complex128
    angle : float
        Angle of the direction in those coordinates.

    Returns
    -------
    x, y : (v,) float64
        With the same orientation as the points.
    along : complex
        The step that adds one to ``x``.

    None if the points lie on a line.
    """
    centred = np.stack([w.real, w.imag], axis=1)
    centred -= centred.mean(axis=0)
    _, size, axes = np.linalg.svd(centred, full_matrices=False)
    if not size[1] > 0:
        return None
    # A reflection would invert all triangles.
    axes[1] *= np.sign(np.linalg.det(axes))
    size /= np.sqrt(len(w))
    turn = np.array([[np.cos(angle), np.sin(angle)], [-np.sin(angle), np.cos(angle)]])
    x, y = turn @ (axes @ centred.T / size[:, None])
    step = axes.T @ (size * turn[0])
    return x, y, complex(step[0], step[1])


def best_shift(F: IntArray, x: FloatArray, y: FloatArray, held: BoolArray) -> FloatArray | None:
    """Return the steps along x that leave the least inverted area.

    Parameters
    ----------
    F : (p, 3) int64
    x, y : (v,) float64
    held : (v,) bool
        Fixed vertices.

    Returns
    -------
    (v,) float64 or None
        Zero for fixed vertices. None if the solver finds no solution.
    """
    from scipy.optimize import linprog
    from scipy.sparse import csr_array

    # Twice the area is Σ x dy over the corners.
    dy = y[np.roll(F, -1, axis=1)] - y[np.roll(F, -2, axis=1)]
    wide = np.repeat(np.ptp(x[F], axis=1), 3)
    unit = np.bincount(F.ravel(), wide, len(x)) / np.maximum(np.bincount(F.ravel(), minlength=len(x)), 1)
    free = np.flatnonzero(~held)
    column = np.full(len(x), -1)
    column[free] = np.arange(free.size)
    entry = np.where(held[F], 0.0, dy * unit[F])
    scale = np.abs(entry).max(axis=1)
    concerned = np.flatnonzero(scale > 0)
    if not concerned.size:
        return None
    count, scale = concerned.size, scale[concerned]
    row, corner = np.nonzero(~held[F[concerned]])
    t, every = concerned[row], np.arange(count)
    value = np.concatenate([entry[t, corner] / scale[row], np.ones(count)])
    where = np.concatenate([row, every]), np.concatenate([column[F[t, corner]], free.size + every])
    A = csr_array((value, where), shape=(count, free.size + count))
    area = (x[F] * dy).sum(axis=1)[concerned] / scale
    least = np.where(area > 0, np.minimum(_KEPT * area, _ENOUGH), _RIGHTED)
    heartbeat()
    result = linprog(
        np.repeat([0.0, 1.0], [free.size, count]),
        A_ub=-A,
        b_ub=area - least,
        bounds=np.repeat([[-_REACH, _REACH], [0.0, np.inf]], [free.size, count], axis=0),
        method="highs-ds",
        options={"maxiter": max(1, _PIVOTS_TIMES_TRIANGLES // count)},
    )
    if result.x is None or not np.isfinite(result.x).all():
        return None
    step = np.zeros(len(x))
    step[free] = result.x[: free.size] * unit[free]
    return step
