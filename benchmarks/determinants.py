"""Tensors ``e^s 𝒜(μ)`` with determinant e^2s: one more variable per triangle (future work in §12).

The map is the quasi-harmonic map of the scaled tensors. The objective is V₃ of that map at the unscaled tensors,
``Σ 2m |q − μp|²/(1 − |μ|²)``. It is zero exactly at the tensors of injective maps, for any s that leads there. With the
scaled tensors in V₃, s would decrease without bound, or stay at 0 if determinants were bounded below by 1.
"""

from __future__ import annotations

import numpy as np

from quasiharmonic import Problem
from quasiharmonic.geometry.exact.certificate import inverted_triangles
from quasiharmonic.solver.field.functionals import beltrami_gradient, twist
from quasiharmonic.solver.field.objective import Objective
from quasiharmonic.solver.field.tensor import TensorField
from quasiharmonic.util.arrays import ComplexArray, FloatArray, IntArray

# Bound of |s|, so that the factors of two triangles differ by at most e^12.
FARTHEST = 6.0


class Scaled:
    """The functional of (ξ, s).

    Parameters
    ----------
    problem : Problem
    parameterisation : str
    """

    def __init__(self, problem: Problem, parameterisation: str = "tanh") -> None:
        self.objective = Objective(problem, "dirichlet", parameterisation)
        self._boundary = np.zeros(problem.n, dtype=np.complex128)
        self._boundary[problem.fixed] = problem.frame.inward(problem.target)

    def evaluate(self, xi: ComplexArray, s: FloatArray) -> tuple[float, ComplexArray, FloatArray, ComplexArray]:
        """Return its value, its gradients in ξ and in s, and the map."""
        objective, mesh = self.objective, self.objective.mesh
        field: TensorField = objective.parameterisation.field(xi)
        stiffness = mesh.edge_stiffness(field.entries())
        scaled = objective.laplacian.factor(np.exp(s) * stiffness)
        w = scaled.extend(self._boundary)
        dw = mesh.derivatives(w)
        value, by_mu = beltrami_gradient(mesh, field, dw)
        # V₃ is ½ wᴴLw minus the area, whose derivative by inner vertices is zero.
        adjoint = mesh.derivatives(scaled.respond(product(objective.problem.F, stiffness, w)))
        by_c, by_w = twist(mesh, adjoint, dw)
        by_mu = by_mu - np.exp(s) * field.pull_twist(by_c, by_w)
        c = (2 - field.defect) / field.defect
        by_s = -np.exp(s) * (by_c * c + (np.conj(by_w) * 2 * field.mu / field.defect).real)
        return value, field.pull(by_mu), by_s, w


def product(F: IntArray, stiffness: FloatArray, w: ComplexArray) -> ComplexArray:
    """Return ``Gᵀ A G w`` from every triangle's off-diagonal entries (3, f), edge by edge."""
    out = np.zeros(w.size, dtype=np.complex128)
    for entry, tail, head in zip(stiffness, F.T, np.roll(F, -1, axis=1).T, strict=True):
        pull = entry * (w[head] - w[tail])
        np.add.at(out, tail, pull)
        np.subtract.at(out, head, pull)
    return out


def descend(problem: Problem, *, iterations: int, free: bool, parameterisation: str = "tanh") -> tuple[int, int]:
    """Run VectorAdam over ξ, and Adam over s if ``free``; return final inverted triangles and iterations."""
    functional = Scaled(problem, parameterisation)
    objective, f = functional.objective, len(problem.F)
    xi, s = np.zeros(f, dtype=np.complex128), np.zeros(f)
    means, squares = [np.zeros_like(xi), np.zeros_like(s)], [np.zeros(f), np.zeros(f)]
    steps = ((0, 0.5), (10, 0.2), (39, 0.2), (40, 0.05)) if parameterisation == "tanh" else ((0, 0.5),)
    fewest = f
    for k in range(1, iterations + 1):
        _, *slopes, w = functional.evaluate(xi, s)
        flips = inverted_triangles(problem.F, problem.positions(w)).size
        fewest = min(fewest, flips)
        if flips == 0:
            return 0, k - 1
        length = float(np.interp(k - 1, *zip(*steps, strict=True))) * np.sqrt(1 - 0.9**k) / (1 - 0.6**k)
        moves = []
        for j in range(2):
            means[j] = 0.6 * means[j] + 0.4 * slopes[j]
            squares[j] = 0.9 * squares[j] + 0.1 * np.abs(slopes[j]) ** 2
            moves.append(
                np.divide(-length * means[j], np.sqrt(squares[j]), out=np.zeros_like(means[j]), where=squares[j] > 0)
            )
        xi = objective.bounded(xi + moves[0])
        if free:
            s = np.clip(s + moves[1], -FARTHEST, FARTHEST)
    return fewest, iterations
