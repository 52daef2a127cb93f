"""Combing: all vertices glide along parallel lines at once, as far as a linear programme says.

With every vertex confined to its line of one direction, the signed area of each triangle is *linear* in where on the
lines its corners are. So the least inverted area that can be reached along that direction is the solution of a linear
programme, whatever folds and walls are in between: no step length, no local minimum. A vertex slips past another one
without coming near it, and a fold of many triangles moves as a whole. Directions are drawn at random, one after the
other, and patches around inverted triangles are combed, large and small.

With ``s`` the places along the lines in units of the triangles' widths there, and a triangle's row ``A`` scaled to a
largest entry of one,

    least Σ z      where  A (s + d) + z ≥ δ,   z ≥ 0,

δ is a fraction of what a positive triangle has, so that it stays positive, and a little for an inverted one.
Directions are drawn after an affine map has made the patch as wide as it is long: orientations do not mind, and a
target that is flat or a limb that is thin is like any other.
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

# Rings around an inverted triangle, one of them drawn for every patch; triangles of a patch at most, and of one of the
# fewest rings, which has many where a vertex has very many neighbours.
_RINGS = 3, 8, 24
_MOST_TRIANGLES, _MOST_NEAR = 2000, 20000
# What a positive triangle keeps of its height over its widest side at the least, as a fraction and in widths; what an
# inverted one is to get.
_KEPT, _ENOUGH, _RIGHTED = 0.1, 1.0, 1e-3
# How far a vertex may move, in widths of the triangles around it.
_REACH = 20.0
# Steps of the simplex method at most, each of which takes time like the triangles: a tenth of a second or two in all.
_PIVOTS_TIMES_TRIANGLES = 4_000_000
# A programme takes about as long as so many steps of untangling the patch.
_STEPS_A_PROGRAMME = 100


@dataclass(frozen=True, kw_only=True)
class LineShift(VertexDescent):
    """Right inverted triangles by linear programmes along random directions.

    The directions are drawn from a generator of its own, always the same.

    Attributes
    ----------
    in_vain : int
        So many programmes in a row may right no triangle.
    """

    in_vain: int = 5

    word: ClassVar[str] = "combing"
    quick: ClassVar[bool] = True

    def __post_init__(self) -> None:
        whole_number("in_vain", self.in_vain, least=1)

    def iterates(self, objective: Objective, start: Iterate) -> Iterates:
        """As of `Descent`; a map after every programme that left fewer inverted triangles."""
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
    """A map with the least inverted area, as defined above, along one direction.

    Parameters
    ----------
    rng : Generator
        Draws the direction.
    F : (p, 3) int64
        Triangles of a patch.
    w : (v,) complex128
        Its map.
    held : (v,) bool
        Vertices that stay.

    Returns
    -------
    (v,) complex128
        ``w`` where the programme has no solution that it can find.
    """
    places = frame_along(w, rng.uniform(0, np.pi))
    if places is None:
        return w
    x, y, along = places
    step = best_shift(F, x, y, held)
    return w if step is None else w + step * along


def frame_along(w: ComplexArray, angle: float) -> tuple[FloatArray, FloatArray, complex] | None:
    """Coordinates along a direction and across it, in which points are as wide as they are long.

    Parameters
    ----------
    w : (v,) complex128
    angle : float
        Of the direction, in those coordinates.

    Returns
    -------
    x, y : (v,) float64
        Of the points' orientation.
    along : complex
        The step that adds one to ``x``.

    None where the points lie on a line.
    """
    centred = np.stack([w.real, w.imag], axis=1)
    centred -= centred.mean(axis=0)
    _, size, axes = np.linalg.svd(centred, full_matrices=False)
    if not size[1] > 0:
        return None
    # A reflection would turn all triangles over.
    axes[1] *= np.sign(np.linalg.det(axes))
    size /= np.sqrt(len(w))
    turn = np.array([[np.cos(angle), np.sin(angle)], [-np.sin(angle), np.cos(angle)]])
    x, y = turn @ (axes @ centred.T / size[:, None])
    step = axes.T @ (size * turn[0])
    return x, y, complex(step[0], step[1])


def best_shift(F: IntArray, x: FloatArray, y: FloatArray, held: BoolArray) -> FloatArray | None:
    """Steps along x that leave the least inverted area.

    Parameters
    ----------
    F : (p, 3) int64
    x, y : (v,) float64
    held : (v,) bool

    Returns
    -------
    (v,) float64 or None
        Zero where ``held``. None where the solver finds no solution.
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
