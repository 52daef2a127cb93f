"""A problem with a fraction of the unknowns, whose injective maps become injective maps of the problem itself.

The number of iterations does not depend on the mesh's size, but what each of them costs does. So the search is
made on a coarse mesh, with every fixed vertex in its place, and what it finds is carried to the fine mesh vertex by
vertex: a fine mesh is neither factored nor descended on at all.
"""

from __future__ import annotations

from weakref import WeakKeyDictionary

import numpy as np

from quasiharmonic.geometry.coarsening.levels import coarsen
from quasiharmonic.geometry.coarsening.prolongation import prolong
from quasiharmonic.geometry.mesh.shapes import rest_shapes
from quasiharmonic.problem import Domain, Problem
from quasiharmonic.util.arrays import ComplexArray, FloatArray, IntArray

# Vertices of the coarse mesh as a fraction of the mesh's.
_SHARE = 1 / 8
# Vertices of the coarse mesh at most,
_MOST = 1500
# unless there are so many fixed vertices, all of which stay, that it takes more: so many for each of them suffice to
# grade the triangles from the boundary to the inside.
_PER_FIXED = 3
# A coarse mesh with this fraction of the vertices or more saves too little to be made.
_WORTHWHILE = 0.5
# Nor is one made of a mesh with fewer vertices than these, which is quickly searched itself.
_LEAST = 1500
# Coarse triangles that are lower than this share of their longest side are no guide to anything, and their weights in
# an energy are beyond what doubles tell apart. Their corners are moved by up to this part of the shortest edge there.
_LOWEST, _STIRRED = 1e-3, 0.2


#: Coarse meshes of domains in use, None where there is none to be had.
_MADE: WeakKeyDictionary[Domain, CoarseMesh | None] = WeakKeyDictionary()


class CoarseMesh:
    """A coarse mesh with the fixed vertices of a fine one, and the way back.

    Parameters
    ----------
    fine : Domain
    goal : int
        Vertices that it is to have, about.

    Attributes
    ----------
    domain : Domain
        The coarse mesh, with the same vertices held in the same order.
    """

    def __init__(self, fine: Domain, goal: int) -> None:
        self._held = np.zeros(fine.n, dtype=bool)
        self._held[fine.fixed] = True
        self._coarsening = coarsen(fine.F, fine.n, self._held, goal)
        used = np.zeros(fine.n, dtype=bool)
        used[self._coarsening.F] = True
        self._vertices = np.flatnonzero(used)
        number = np.full(fine.n, -1)
        number[self._vertices] = np.arange(self._vertices.size)
        F = number[self._coarsening.F]
        self.domain = Domain(_not_flat(fine.V[self._vertices], F), F, number[fine.fixed])

    def prolong(self, w: ComplexArray) -> ComplexArray:
        """Carry a map of the coarse mesh to the fine one.

        Parameters
        ----------
        w : (nc,) complex128
            ``u + i v``, in any frame.

        Returns
        -------
        (n,) complex128
            In the same frame, injective where ``w`` is, but for rounding.
        """
        fine = np.zeros(self._held.size, dtype=np.complex128)
        fine[self._vertices] = w
        return prolong(fine, self._coarsening, self._held)


def coarse_mesh(problem: Problem) -> CoarseMesh | None:
    """The coarse mesh for a problem that is large enough, made once for a domain and all its targets.

    None where the mesh is small, most of its vertices are fixed, or the caller wants its own triangles looked at.
    """
    if problem.reference not in (None, "equilateral"):
        return None
    fine = problem.domain
    if fine not in _MADE:
        goal = int(max(_PER_FIXED * fine.fixed.size, min(_SHARE * fine.n, _MOST)))
        worthwhile = fine.n >= _LEAST and goal < _WORTHWHILE * fine.n
        _MADE[fine] = CoarseMesh(fine, goal) if worthwhile else None
    return _MADE[fine]


def _not_flat(V: FloatArray, F: IntArray) -> FloatArray:
    """Positions in space (n, 3), stirred a little at the corners of triangles that have hardly an area there.

    A coarse triangle was never there: its shape is a guide to how large the fine ones were, and no more.
    """
    shapes = rest_shapes(V, F)
    lengths = np.abs(shapes.sides)
    low = ~(2 * shapes.m >= _LOWEST * lengths.max(axis=0) ** 2)
    if not low.any():
        return V
    space = np.zeros((len(V), 3))
    space[:, : V.shape[1]] = V
    shortest = np.full(len(V), np.inf)
    for length, ends in zip(lengths, ((0, 1), (1, 2), (2, 0)), strict=True):
        for corner in ends:
            np.minimum.at(shortest, F[:, corner], np.where(length > 0, length, np.inf))
    corners = np.unique(F[low])
    by = _STIRRED * shapes.unit * shortest[corners, None]
    space[corners] += by * np.random.default_rng(0).uniform(-1, 1, (corners.size, 3))
    return space
