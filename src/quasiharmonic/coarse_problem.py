"""A problem with a fraction of the unknowns, whose injective maps become injective maps of the problem itself.

The number of iterations does not depend on the mesh's size, but what each of them costs does. So the search is
made on a coarse mesh, with every fixed vertex in its place, and what it finds is carried to the fine mesh vertex by
vertex: a fine mesh is neither factored nor descended on at all.
"""

from __future__ import annotations

from copy import copy
from typing import cast

import numpy as np
from numpy.typing import NDArray

from quasiharmonic.mesh.coarsening import coarsen
from quasiharmonic.mesh.shapes import rest_shapes
from quasiharmonic.problem import Problem
from quasiharmonic.prolongation import prolong

ComplexArray = NDArray[np.complex128]
FloatArray = NDArray[np.float64]

# The coarse mesh has an eighth of the vertices or so many, whichever is less, but some for every fixed vertex: as many
# as it takes to grade the mesh from the boundary, whose vertices all stay, to the inside.
_SHARE, _MOST, _PER_FIXED = 1 / 8, 1500, 3
# Where no more than this share of the vertices would go, or so few are there, the mesh itself is as quickly dealt with.
_WORTHWHILE, _LEAST = 0.5, 1500


class CoarseProblem:
    """A coarse mesh with the fixed vertices of a problem, and the way back.

    Made by `coarse_problem`.

    Attributes
    ----------
    problem : Problem
        The coarse problem, in the same frame as the fine one.
    """

    def __init__(self, fine: Problem, goal: int) -> None:
        self._held = np.zeros(fine.n, dtype=bool)
        self._held[fine.fixed] = True
        self._coarsening = coarsen(fine.F, fine.n, self._held, goal)
        used = np.zeros(fine.n, dtype=bool)
        used[self._coarsening.F] = True
        self._vertices = np.flatnonzero(used)
        number = np.full(fine.n, -1)
        number[self._vertices] = np.arange(self._vertices.size)
        F = number[self._coarsening.F]
        V = _not_flat(fine.V[self._vertices], F)
        self.problem = Problem(V, F, number[fine.fixed], fine.target, reference="equilateral")

    def moved(self, target: FloatArray) -> CoarseProblem:
        """The same with the fixed vertices elsewhere."""
        other = copy(self)
        other.problem = self.problem.moved(target)
        return other

    def prolong(self, uv: FloatArray) -> ComplexArray:
        """Carry a map of the coarse mesh to the fine one.

        Parameters
        ----------
        uv : (nc, 2) float64

        Returns
        -------
        (n,) complex128
            ``u + i v`` in the problem's frame, injective where ``uv`` is, but for rounding.
        """
        fine = np.zeros(self._held.size, dtype=np.complex128)
        fine[self._vertices] = self.problem.frame.inward(uv)
        return prolong(fine, self._coarsening, self._held)


def coarse_problem(fine: Problem) -> CoarseProblem | None:
    """The coarse problem of one that is large enough, made once for a mesh and all its targets.

    None where the mesh is small, most of its vertices are fixed, or the caller wants its own triangles looked at.
    """
    if fine.reference not in (None, "equilateral"):
        return None
    if "coarse" not in fine.derived:
        goal = int(max(_PER_FIXED * fine.fixed.size, min(_SHARE * fine.n, _MOST)))
        worthwhile = fine.n >= _LEAST and goal < _WORTHWHILE * fine.n
        fine.derived["coarse"] = CoarseProblem(fine, goal) if worthwhile else None
    made = cast("CoarseProblem | None", fine.derived["coarse"])
    return None if made is None else made.moved(fine.target)


def _not_flat(V: FloatArray, F: NDArray[np.int64]) -> FloatArray:
    """Positions in space (n, 3), stirred a little if any triangle has no area there, as in the plane many have not.

    A coarse triangle was never there: its shape is a guide to how large the fine ones were, and no more.
    """
    if not rest_shapes(V, F).flat.size:
        return V
    space = np.zeros((len(V), 3))
    space[:, : V.shape[1]] = V
    shortest = np.full(len(V), np.inf)
    for tail, head in ((0, 1), (1, 2), (2, 0)):
        length = np.linalg.norm(space[F[:, tail]] - space[F[:, head]], axis=1)
        for corner in (tail, head):
            np.minimum.at(shortest, F[:, corner], np.where(length > 0, length, np.inf))
    return space + 0.2 * shortest[:, None] * np.random.default_rng(0).uniform(-1, 1, space.shape)
