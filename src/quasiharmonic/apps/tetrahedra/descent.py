"""Descent of the energy of a tetrahedral mesh with fixed vertices: Newton's method by conjugate gradients.

Conjugate gradients with the diagonal blocks as preconditioner solve the systems, because a factorisation of a mesh in
space fills in. Untangling lowers the regularised energy, and the regularisation parameter after each step, until no
tetrahedron is inverted. Polishing lowers the energy without regularisation, which is infinite at inverted tetrahedra.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from quasiharmonic.apps.tetrahedra.energy import BlockMatrix, ShapeEnergy, reduce_epsilon
from quasiharmonic.apps.tetrahedra.sliding import project
from quasiharmonic.energies.newton.line_search import backtrack
from quasiharmonic.util.arrays import FloatArray, IntArray
from quasiharmonic.util.progress import heartbeat

# Relative residual of the linear systems, and maximum number of iterations.
_RESIDUAL = 0.05
_MAX_CONJUGATE_STEPS = 250
# The regularisation parameter is kept after a step that lowers the energy by more than this share, but not more often.
_QUICK_DECREASE = 0.1
_MAX_REPEATED = 10
# Step lengths that a line search tries.
_TRIES = 30
# First and least regularisation parameter; determinants are about 1.
_FIRST_EPSILON = 1.0
_MIN_EPSILON = 1e-14


class TetrahedraDescent:
    """Newton's method on the energy of a mesh with free vertices ``free`` (k,); ``X`` (n, 3) are the positions.

    With ``anchor``, positions (n, 3) and a weight, half the weighted sum of squared distances from them is added.
    ``projections`` (k, 3, 3), if given, restrict the directions in which free vertices move.
    """

    def __init__(
        self,
        energy: ShapeEnergy,
        free: IntArray,
        X: FloatArray,
        anchor: tuple[FloatArray, float] | None = None,
        projections: FloatArray | None = None,
    ) -> None:
        self.energy, self.free, self.X, self.anchor = energy, free, X.copy(), anchor
        self.projections = projections
        self._blocks = BlockMatrix(energy.T, energy.n, free)
        self.iterations = 0
        self.converged = False

    def untangle(self, max_steps: int) -> Iterator[float]:
        """Lower the regularised energy; yield the least determinant after each step, and end when it is positive."""
        epsilon, repeated = _FIRST_EPSILON, 0
        for _ in range(max_steps):
            before = self._value(self.X, epsilon)
            after = self._step(epsilon)
            least = float(self.energy.determinants(self.X).min()) - self.energy.floor
            yield least
            if least > 0 or (after is None and epsilon < _MIN_EPSILON):
                return
            ratio = 1.0 if after is None else after / before
            # While the energy falls quickly, keep the parameter. Lowering it too early leads to worse local minima.
            repeated += 1
            if ratio > 1.0 - _QUICK_DECREASE or repeated > _MAX_REPEATED:
                epsilon, repeated = max(reduce_epsilon(epsilon, least, ratio), _MIN_EPSILON), 0

    def make_valid(self, max_steps: int) -> bool:
        """Untangle the mesh if necessary; return whether all determinants are above the floor."""
        if not self.is_valid():
            for _ in self.untangle(max_steps):
                pass
        return self.is_valid()

    def is_valid(self) -> bool:
        """Return whether all determinants are above the floor."""
        return bool(self.energy.determinants(self.X).min() > self.energy.floor)

    def polish(self, max_steps: int, tol: float) -> Iterator[float]:
        """Lower the energy of positive tetrahedra; yield it after each step, and end when it has converged."""
        before = self._value(self.X, 0.0)
        for _ in range(max_steps):
            after = self._step(0.0)
            if after is None:
                self.converged = True
                return
            self.converged = before - after < tol * after
            yield after
            if self.converged:
                return
            before = after

    def _value(self, X: FloatArray, epsilon: float) -> float:
        """The function that is lowered."""
        return self.energy.value(X, epsilon) + self._pull(X)[0]

    def _pull(self, X: FloatArray) -> tuple[float, FloatArray | float]:
        """The value and the gradient (n, 3) of the term that pulls towards the anchor."""
        if self.anchor is None:
            return 0.0, 0.0
        places, weight = self.anchor
        away = X - places
        return 0.5 * weight * float((away * away).sum()), weight * away

    def _step(self, epsilon: float) -> float | None:
        """Take a Newton step; return the energy after it, or None if no step lowers the energy."""
        heartbeat()
        value, gradient, blocks = self.energy.derivatives(self.X, epsilon)
        data = self._blocks.assemble(blocks)
        pull, by_pull = self._pull(self.X)
        value, gradient = value + pull, gradient + by_pull
        if self.anchor is not None:
            data[self._blocks.diagonal] += self.anchor[1] * np.eye(3)
        g = project(self.projections, gradient[self.free]).ravel()
        p = self._direction(data, g)
        decrease = -float(g @ p)
        self.iterations += 1
        if not decrease > 0:
            return None
        direction = p.reshape(-1, 3)

        def trial(t: float, bound: float) -> tuple[float, FloatArray | None]:
            X = self.X.copy()
            X[self.free] += t * direction
            found = self._value(X, epsilon)
            return found, X if found < bound else None

        accepted = backtrack(trial, value, decrease, tries=_TRIES)
        if accepted is None:
            return None
        self.X = accepted.state
        return accepted.value

    def _direction(self, data: FloatArray, g: FloatArray) -> FloatArray:
        """Solve the Newton system approximately by preconditioned conjugate gradients."""
        matrix = self._blocks.matrix(data)
        diagonal = data[self._blocks.diagonal]
        scale = np.trace(diagonal, axis1=1, axis2=2)
        shift = 1e-12 * np.where(scale > 0, scale, 1.0)
        if self.projections is not None:
            # Directions in which a vertex cannot move get a unit of the block's own size.
            P = self.projections
            diagonal = P @ diagonal @ P + scale[:, None, None] * (np.eye(3) - P)
        inverse = np.linalg.inv(diagonal + shift[:, None, None] * np.eye(3))
        x, r = np.zeros_like(g), -g
        z = project(self.projections, np.einsum("iab,ib->ia", inverse, r.reshape(-1, 3))).ravel()
        p, rz = z.copy(), float(r @ z)
        first = rz
        for _ in range(_MAX_CONJUGATE_STEPS):
            if not rz > _RESIDUAL**2 * first:
                break
            Ap = project(self.projections, (matrix @ p).reshape(-1, 3)).ravel()
            curvature = float(p @ Ap)
            if not curvature > 0:
                break
            alpha = rz / curvature
            x += alpha * p
            r -= alpha * Ap
            z = project(self.projections, np.einsum("iab,ib->ia", inverse, r.reshape(-1, 3))).ravel()
            rz, old = float(r @ z), rz
            p = z + (rz / old) * p
        return x if x.any() else z
