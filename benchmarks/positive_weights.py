"""Tutte's embedding with positive weights, one or two per edge; two are asymmetric (future work in §6.1).

Every interior vertex is a mean of its neighbours with positive weights, ``w_i = Σ λ_ij w_j``. Symmetric weights have
one value per edge, asymmetric ones two. Every injective map has asymmetric weights, since each vertex lies inside the
polygon of its neighbours. V₃ requires an energy, which asymmetric weights lack. The objective is therefore a smooth
inverted area, ``Σ (√(a² + ε²) − a)/2`` over signed areas a; ε decreases from the mean area to a thousandth of it.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from scipy.optimize import linprog
from scipy.sparse import csc_array, csr_array, eye_array
from scipy.sparse.linalg import splu

from quasiharmonic import Problem
from quasiharmonic.energies.deformation import signed_areas
from quasiharmonic.geometry.exact.certificate import inverted_triangles
from quasiharmonic.geometry.mesh.topology import edges
from quasiharmonic.util.arrays import ComplexArray, FloatArray, IntArray

SHARPENING = (1.0, 0.1, 0.01, 0.001)


class Found(NamedTuple):
    """Inverted triangles at the end, and the number of factorisations."""

    flips: int
    iterations: int


class Means:
    """The maps of a problem in which interior vertices are means of their neighbours.

    Parameters
    ----------
    problem : Problem
    symmetric : bool
        Whether both directions of an edge have the same weight.
    """

    def __init__(self, problem: Problem, symmetric: bool) -> None:
        self.problem = problem
        self.inner = np.setdiff1d(np.arange(problem.n), problem.fixed)
        found = edges(problem.F, problem.n)
        both = np.concatenate([found.interior, found.boundary])
        number = np.concatenate([np.arange(len(both))] * 2)
        tail, head = np.concatenate([both, both[:, ::-1]]).T
        row = np.full(problem.n, -1)
        row[self.inner] = np.arange(self.inner.size)
        used = row[tail] >= 0
        self.tail, self.head, self.row, self.column = tail[used], head[used], row[tail[used]], row[head[used]]
        number = number[used] if symmetric else np.arange(int(used.sum()))
        self.number = np.unique(number, return_inverse=True)[1]
        self.count = int(self.number.max()) + 1
        self._within = self.column >= 0
        self._boundary = np.zeros(problem.n, dtype=np.complex128)
        self._boundary[problem.fixed] = problem.frame.inward(problem.target)

    def matrix(self, theta: FloatArray) -> tuple[csr_array, FloatArray]:
        """Return ``λ`` on interior vertices, (i, i), and all weights, from their logarithms up to a factor."""
        weight = np.exp(np.clip(theta, -30, 30))[self.number]
        weight /= np.bincount(self.row, weight)[self.row]
        at, n = self._within, self.inner.size
        return csr_array((weight[at], (self.row[at], self.column[at])), shape=(n, n)), weight

    def evaluate(self, theta: FloatArray, sharp: float) -> tuple[ComplexArray, FloatArray]:
        """Return the map, and the gradient of the smooth inverted area; ε is ``sharp`` times the mean area."""
        matrix, weight = self.matrix(theta)
        solver = splu(csc_array(eye_array(self.inner.size) - matrix))
        w, outer = self._boundary.copy(), ~self._within
        load = np.zeros(self.inner.size, dtype=np.complex128)
        np.add.at(load, self.row[outer], weight[outer] * w[self.head[outer]])
        w[self.inner] = solver.solve(load.real) + 1j * solver.solve(load.imag)
        pull = area_gradient(self.problem.F, w, sharp)[self.inner]
        adjoint = solver.solve(pull.real, trans="T") + 1j * solver.solve(pull.imag, trans="T")
        by_weight = (np.conj(adjoint[self.row]) * (w[self.head] - w[self.tail])).real
        return w, np.bincount(self.number, weight * by_weight, minlength=self.count)

    def descend(self, iterations: int = 150, length: float = 0.1) -> Found:
        """Run Adam over the logarithms from equal weights, ``iterations`` steps for every ε."""
        theta, mean, square = (np.zeros(self.count) for _ in range(3))
        done, fewest = 0, len(self.problem.F)
        for sharp in np.repeat(SHARPENING, iterations):
            w, slope = self.evaluate(theta, float(sharp))
            done += 1
            fewest = min(fewest, inverted_triangles(self.problem.F, self.problem.positions(w)).size)
            if fewest == 0:
                break
            mean = 0.9 * mean + 0.1 * slope
            square = 0.99 * square + 0.01 * slope**2
            theta -= length * np.divide(mean, np.sqrt(square), out=np.zeros_like(mean), where=square > 0)
        return Found(fewest, done)


def area_gradient(F: IntArray, w: ComplexArray, sharp: float) -> ComplexArray:
    """Return the derivative of ``Σ (√(a² + ε²) − a)/2`` by positions, ε in mean areas; (n,) complex128."""
    area = signed_areas(F, w)
    width = sharp * float(np.abs(area).mean())
    by_area = 0.5 * (area / np.sqrt(area**2 + width**2) - 1)
    out = np.zeros(w.size, dtype=np.complex128)
    for k in range(3):
        # The area grows if a corner moves away from the opposite side.
        np.add.at(out, F[:, k], 0.5j * by_area * (w[F[:, (k + 2) % 3]] - w[F[:, (k + 1) % 3]]))
    return out


def mean_values(problem: Problem, uv: FloatArray) -> float:
    """Return the error with which a map's mean-value weights reproduce it, in its frame; for small meshes only."""
    means = Means(problem, symmetric=False)
    w = problem.frame.inward(uv)
    weight = np.zeros((problem.n, problem.n))
    for k in range(3):
        i, j, last = (problem.F[:, (k + m) % 3] for m in range(3))
        tangent = np.tan(np.abs(np.angle((w[last] - w[i]) / (w[j] - w[i]))) / 2)
        np.add.at(weight, (i, j), tangent / np.abs(w[j] - w[i]))
        np.add.at(weight, (i, last), tangent / np.abs(w[last] - w[i]))
    value = weight[means.tail, means.head]
    total = np.bincount(means.row, value)[means.row]
    middle = np.zeros(means.inner.size, dtype=np.complex128)
    np.add.at(middle, means.row, value / total * w[means.head])
    return float(np.abs(middle - w[means.inner]).max())


def has_symmetric(problem: Problem, uv: FloatArray) -> bool:
    """Whether a map has positive symmetric weights: an equilibrium stress of all edges, by linear programming."""
    means = Means(problem, symmetric=True)
    w = problem.frame.inward(uv)
    side = w[means.head] - w[means.tail]
    n = means.inner.size
    rows = np.concatenate([means.row, n + means.row])
    # Scale by the mean length of each vertex's edges, and maximise the smallest weight.
    scale = (np.bincount(means.row, np.abs(side)) / np.bincount(means.row))[means.row]
    values = np.concatenate([side.real / scale, side.imag / scale])
    equal = csr_array((values, (rows, np.concatenate([means.number] * 2))), shape=(2 * n, means.count + 1))
    least = csr_array(
        (
            np.concatenate([-np.ones(means.count), np.ones(means.count)]),
            (
                np.tile(np.arange(means.count), 2),
                np.concatenate([np.arange(means.count), np.full(means.count, means.count)]),
            ),
        )
    )
    cost = np.zeros(means.count + 1)
    cost[-1] = -1
    bounds = [(0, 1)] * means.count + [(0, 1)]
    found = linprog(cost, A_ub=least, b_ub=np.zeros(means.count), A_eq=equal, b_eq=np.zeros(2 * n), bounds=bounds)
    return bool(found.status == 0 and -found.fun > 1e-9)
