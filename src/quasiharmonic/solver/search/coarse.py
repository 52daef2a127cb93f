"""Coarse problems whose injective maps extend to injective maps of the original problem.

The number of iterations does not depend on the mesh size, but the cost of each does. The search therefore runs on a
coarse mesh that keeps all fixed vertices. Its map is then transferred to the fine mesh vertex by vertex, without any
factorisation or descent on the fine mesh.
"""

from __future__ import annotations

from typing import NamedTuple
from weakref import WeakKeyDictionary

import numpy as np

from quasiharmonic.geometry.coarsening import coarsen
from quasiharmonic.geometry.mesh.reference import rest_shapes
from quasiharmonic.geometry.prolongation import prolong
from quasiharmonic.problem import Domain, Problem
from quasiharmonic.util.arrays import ComplexArray, FloatArray, IntArray, invert_indices, mark, pad_to_space


class CoarseTuning(NamedTuple):
    """Numbers that tune the coarse mesh and its use."""

    # Vertices of the coarse mesh, as a fraction of the fine mesh's.
    share: float = 1 / 8
    # Maximum number of vertices of the coarse mesh, unless the fixed vertices, all of which are kept, require more.
    max_vertices: int = 1000
    # This many vertices per fixed vertex suffice to grade the triangles from the boundary to the interior.
    vertices_per_fixed: int = 3
    # Coarsening to this fraction of the vertices or more saves too little.
    worthwhile: float = 0.5
    # Meshes with fewer vertices are not coarsened, because searching them is fast.
    min_vertices: int = 1500
    # Coarse triangles whose height is below this fraction of their longest side carry no useful shape, and their
    # weights in an energy exceed double precision.
    min_height: float = 1e-3
    # Corners of such triangles are moved by up to this fraction of the shortest edge there.
    perturbation: float = 0.2


_TUNING = CoarseTuning()


#: Coarse meshes of the domains in use; None if a domain has none.
_COARSE_MESHES: WeakKeyDictionary[Domain, CoarseMesh | None] = WeakKeyDictionary()


class CoarseMesh:
    """A coarse mesh that keeps the fixed vertices of a fine one, with the prolongation to the fine mesh.

    ``goal`` is the approximate number of vertices. ``domain`` is the coarse mesh, with the same fixed vertices in the
    same order.
    """

    def __init__(self, fine: Domain, goal: int) -> None:
        self._fixed = mark(fine.n, fine.fixed)
        self._coarsening = coarsen(fine.F, fine.n, self._fixed, goal)
        self._vertices = np.flatnonzero(mark(fine.n, self._coarsening.F))
        number = invert_indices(fine.n, self._vertices)
        F = number[self._coarsening.F]
        self.domain = Domain(_perturb_flat(fine.V[self._vertices], F), F, number[fine.fixed])

    def prolong(self, w: ComplexArray) -> ComplexArray:
        """Extend a map of the coarse mesh to the fine mesh, in the same frame.

        The result is injective if ``w`` is, except for rounding.
        """
        fine = np.zeros(self._fixed.size, dtype=np.complex128)
        fine[self._vertices] = w
        return prolong(fine, self._coarsening, self._fixed)


def coarse_mesh(problem: Problem) -> CoarseMesh | None:
    """Return the coarse mesh of a large problem, computed once per domain.

    None if the mesh is small, most of its vertices are fixed, or the problem prescribes its own reference triangles.
    """
    if problem.reference not in (None, "equilateral"):
        return None
    fine = problem.domain
    if fine not in _COARSE_MESHES:
        goal = int(max(_TUNING.vertices_per_fixed * fine.fixed.size, min(_TUNING.share * fine.n, _TUNING.max_vertices)))
        worthwhile = fine.n >= _TUNING.min_vertices and goal < _TUNING.worthwhile * fine.n
        _COARSE_MESHES[fine] = CoarseMesh(fine, goal) if worthwhile else None
    return _COARSE_MESHES[fine]


def _perturb_flat(V: FloatArray, F: IntArray) -> FloatArray:
    """Return positions in space, perturbed slightly at the corners of triangles that have almost no area.

    The shape of a coarse triangle is only a rough guide to the size of the fine triangles.
    """
    shapes = rest_shapes(V, F)
    lengths = np.abs(shapes.sides)
    low = ~(2 * shapes.m >= _TUNING.min_height * lengths.max(axis=0) ** 2)
    if not low.any():
        return V
    space = pad_to_space(V)
    shortest = np.full(len(V), np.inf)
    for length, ends in zip(lengths, ((0, 1), (1, 2), (2, 0)), strict=True):
        for corner in ends:
            np.minimum.at(shortest, F[:, corner], np.where(length > 0, length, np.inf))
    corners = np.unique(F[low])
    by = _TUNING.perturbation * shapes.unit * shortest[corners, None]
    space[corners] += by * np.random.default_rng(0).uniform(-1, 1, (corners.size, 3))
    return space
