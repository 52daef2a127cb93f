"""V₃ of many small problems, evaluated in one pass.

A call of NumPy or of a sparse solver has an overhead of some microseconds, and one evaluation on a few hundred
triangles needs about a hundred calls. Small meshes are therefore combined into one disconnected mesh. Their Laplacian
is block diagonal, so one analysis, one factorisation and one solve serve all meshes. Up to rounding, each map is the
same as by `Objective`.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from quasiharmonic.geometry.mesh.reference import ReferenceMesh
from quasiharmonic.linsolve import NotPositiveDefinite
from quasiharmonic.linsolve.laplacian import Laplacian
from quasiharmonic.problem import Domain
from quasiharmonic.solver.field.objective import (
    Iterate,
    Objective,
    Sums,
    clip_moduli,
    own_sweep,
    stiffness_of,
    sums_of,
    sweep,
)
from quasiharmonic.solver.field.tensor import TANH, TensorField
from quasiharmonic.util.arrays import ComplexArray, IntArray

# Number of patterns kept for reuse, for instance if one mesh is mapped to many targets.
_PATTERNS = 8


class Patterns:
    """Cache of the last few Laplacians of batches, each analysed once. Not thread-safe."""

    def __init__(self, linear_solver: str) -> None:
        self._linear_solver = linear_solver
        self._cache: dict[tuple[Domain, ...], Laplacian] = {}

    def of(self, domains: tuple[Domain, ...], F: IntArray, n: int, fixed: IntArray) -> Laplacian:
        """Return the Laplacian of these domains; triangles and fixed vertices use the indices of the batch."""
        pattern = self._cache.pop(domains, None) or Laplacian(F, n, fixed, self._linear_solver)
        self._cache[domains] = pattern
        if len(self._cache) > _PATTERNS:
            del self._cache[next(iter(self._cache))]
        return pattern


class MapBatch(NamedTuple):
    """The maps w (n,) of all meshes of a batch: ξ (f,), the gradient of V₃ in ξ (f,), and the sums of each mesh."""

    xi: ComplexArray
    w: ComplexArray
    gradient: ComplexArray
    sums: list[Sums]


class ObjectiveBatch:
    """V₃ on several meshes, combined into one disconnected mesh with common vertex and triangle indices.

    Each objective is V₃ with equilateral reference triangles; all have the same parameterisation.

    Attributes
    ----------
    F : (f, 3) int64
    fixed : (k,) int64
        Triangles and fixed vertices of all meshes.
    laplacian : Laplacian
    """

    def __init__(self, objectives: Sequence[Objective], patterns: Patterns) -> None:
        self._objectives = objectives
        self._parameterisation = objectives[0].parameterisation
        problems = [objective.problem for objective in objectives]
        self._vertices = np.cumsum([0, *(problem.n for problem in problems)])
        self._triangles = np.cumsum([0, *(len(problem.F) for problem in problems)])
        starts, n = self._vertices[:-1].tolist(), int(self._vertices[-1])
        F = np.concatenate([problem.F + start for problem, start in zip(problems, starts, strict=True)])
        self.fixed = np.concatenate([problem.fixed + start for problem, start in zip(problems, starts, strict=True)])
        self._mesh = ReferenceMesh(np.empty((n, 2)), F, "equilateral")
        self.F = self._mesh.F
        self.laplacian = patterns.of(tuple(problem.domain for problem in problems), F, n, self.fixed)
        self._boundary = np.concatenate([problem.fixed_positions for problem in problems])

    def evaluate(self, xi: ComplexArray) -> MapBatch:
        """Compute the maps of ``xi`` (f,), as `Objective.evaluate` does.

        Raise `NotPositiveDefinite` if one of the Laplacians is not positive definite after rounding.
        """
        stiffness = stiffness_of(self._mesh, self._parameterisation, xi)
        w = self.laplacian.factor(stiffness).extend(self._boundary)
        if not np.isfinite(w.view(np.float64)).all():
            raise NotPositiveDefinite("the solution is not finite")
        sums, gradient = sweep(self._mesh, self._parameterisation, xi, w, self._triangles)
        return MapBatch(xi, w, gradient, sums_of(sums))

    def iterate(self, maps: MapBatch, k: int) -> Iterate:
        """Return the map of the k-th mesh, in memory of its own."""
        # A search may keep the iterate; a view would keep the arrays of the whole batch.
        field = TensorField(maps.xi[self.triangles_of(k)].copy(), self._parameterisation)
        return Iterate(self._objectives[k], field, maps.w[self._vertices_of(k)].copy(), sums=maps.sums[k])

    def of_maps(self, meshes: Sequence[int], w: ComplexArray) -> list[Iterate]:
        """Return maps of some meshes, without inverted triangles, at their own tensors, as `Objective.of_map` does.

        ``w`` (n,) has the positions of all vertices of the batch.
        """
        F = np.concatenate([self.F[self.triangles_of(k)] for k in meshes])
        starts = np.concatenate([[0], np.cumsum([len(self._objectives[k].problem.F) for k in meshes])])
        sums, mu = own_sweep(ReferenceMesh(np.empty((w.size, 2)), F, "equilateral"), w, starts)
        xi = np.split(TANH.invert(mu), starts[1:-1])
        return [
            Iterate(self._objectives[k], TANH.field(own.copy()), w[self._vertices_of(k)].copy(), sums=Sums(0, *values))
            for k, own, values in zip(meshes, xi, sums.tolist(), strict=True)
        ]

    def step(self, maps: MapBatch, step: ComplexArray) -> ComplexArray:
        """Return ``ξ + step``, clipped to the range in which the rounded tensors are positive definite."""
        xi = maps.xi + step
        clip_moduli(xi, self._parameterisation.bound)
        return xi

    def triangles_of(self, k: int) -> slice:
        """Triangles of the k-th mesh."""
        return slice(int(self._triangles[k]), int(self._triangles[k + 1]))

    def _vertices_of(self, k: int) -> slice:
        """Vertices of the k-th mesh."""
        return slice(int(self._vertices[k]), int(self._vertices[k + 1]))
