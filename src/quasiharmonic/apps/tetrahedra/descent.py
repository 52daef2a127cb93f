"""An isotropic energy of tetrahedral meshes, finite at inverted tetrahedra if regularised, and its descent.

Let J be the Jacobian matrix of the map from a rest tetrahedron, D its determinant and t the sum of its squared entries.
The density is [1]_ ::

    ψ = (1 − θ) t / (3 χ^(2/3)) + θ (D² + 1) / (2 χ),    χ(D, ε) = (D + √(ε² + D²)) / 2

The first term measures shape, the second volume; ψ = 1 at a rotation. For ε = 0 the density is a barrier: χ = D where D
is positive, and ψ is infinite elsewhere. For ε > 0 it is finite everywhere.

For ε = 0, ψ is a convex function of J and D together. So its second derivatives without the term with the second
derivatives of D(J) are a positive semidefinite matrix. Newton's method uses this matrix, for ε > 0 with the second
derivative in D raised where it would be indefinite.

Conjugate gradients with the diagonal blocks as preconditioner solve the systems, because a factorisation of a mesh in
space fills in. Untangling lowers the regularised energy until no tetrahedron is inverted. It lowers the regularisation
parameter between steps, but not while steps lower the energy quickly. Polishing lowers the energy without
regularisation, which is infinite at inverted tetrahedra.

References
----------
.. [1] V. Garanzha, I. Kaporin, L. Kudryavtseva, F. Protais, N. Ray, D. Sokolov, Foldover-free maps in 50 lines of code.
   ACM Transactions on Graphics 40 (2021).
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from quasiharmonic.energies.newton.line_search import backtrack
from quasiharmonic.util.arrays import FloatArray, IntArray, invert_indices
from quasiharmonic.util.progress import heartbeat

if TYPE_CHECKING:
    from scipy.sparse import bsr_array

# Pairs of vertices of a tetrahedron whose blocks are computed; the others are their transposes.
VERTEX_PAIRS = tuple((i, j) for i in range(4) for j in range(i, 4))


class BlockMatrix:
    """Assembles blocks of pairs of vertices into a sparse matrix of the free coordinates.

    ``free`` (k,) are the free vertices; unknown ``3 i + a`` is coordinate a of vertex ``free[i]``.
    """

    def __init__(self, T: IntArray, n: int, free: IntArray) -> None:
        number = invert_indices(n, free)
        own = number[T]
        rows = np.concatenate([own[:, i] for i, _ in VERTEX_PAIRS] + [own[:, j] for i, j in VERTEX_PAIRS if i != j])
        columns = np.concatenate([own[:, j] for _, j in VERTEX_PAIRS] + [own[:, i] for i, j in VERTEX_PAIRS if i != j])
        inside = (rows >= 0) & (columns >= 0)
        key = np.where(inside, rows * free.size + columns, -1)
        entries, place = np.unique(key, return_inverse=True)
        outside = int(entries.size > 0 and entries[0] < 0)
        self._place = place.ravel() - outside
        self._size = free.size
        self._count = entries.size - outside
        row, self._indices = np.divmod(entries[outside:], max(free.size, 1))
        self._indptr = np.searchsorted(row, np.arange(free.size + 1))
        self.diagonal = np.flatnonzero(row == self._indices)

    def assemble(self, blocks: FloatArray) -> FloatArray:
        """Return the blocks (m, 3, 3) of the matrix of blocks (10, 3, 3, t)."""
        off = [k for k, (i, j) in enumerate(VERTEX_PAIRS) if i != j]
        data = np.empty((self._count, 3, 3))
        place = self._place + 1
        for a in range(3):
            for b in range(3):
                weights = np.concatenate([blocks[:, a, b].ravel(), blocks[off, b, a].ravel()])
                data[:, a, b] = np.bincount(place, weights, minlength=self._count + 1)[1:]
        return data

    def matrix(self, data: FloatArray) -> bsr_array[np.float64]:
        """Return the sparse matrix of assembled blocks."""
        from scipy.sparse import bsr_array

        size = 3 * self._size
        return bsr_array((data, self._indices, self._indptr), shape=(size, size))


class TetrahedraDescentTuning(NamedTuple):
    """Numbers that tune the energy of tetrahedra and its descent."""

    # Share of the volume term in the density.
    volume_share: float = 0.5
    # Residual at which conjugate gradients end, relative to the initial one, both in the norm of the preconditioner.
    residual: float = 0.05
    # Maximum number of iterations of conjugate gradients per Newton step.
    max_conjugate_steps: int = 250
    # The regularisation parameter is kept after a quick step, which lowers the energy by at least this share.
    quick_decrease: float = 0.1
    # Maximum number of successive quick steps after which the parameter is kept; it is lowered after the next step.
    max_repeated: int = 10
    # Least regularisation parameter; determinants are about 1.
    min_epsilon: float = 1e-14


_TUNING = TetrahedraDescentTuning()


class _Density(NamedTuple):
    """The density and its derivatives in t and D, (t,) each."""

    value: FloatArray
    by_t: FloatArray
    by_d: FloatArray
    by_t_d: FloatArray
    by_d_d: FloatArray


def regularise(D: FloatArray, epsilon: float) -> FloatArray:
    """Return χ(D, ε), without cancellation where D is negative."""
    root = np.hypot(D, epsilon)
    if epsilon == 0:
        return np.maximum(D, 0.0)
    return np.where(D > 0, 0.5 * (D + root), 0.5 * epsilon * (epsilon / (root - np.minimum(D, 0.0))))


def reduce_epsilon(epsilon: float, min_determinant: float, ratio: float) -> float:
    """Return the next regularisation parameter after a step that multiplied the energy by ``ratio``.

    The rule of Garanzha et al. lowers χ of the least determinant by the factor by which the step lowered the energy, at
    least by a tenth. If each step lowers the energy sufficiently, a mesh without inverted tetrahedra is reached after
    finitely many steps.
    """
    share = max(1.0 - ratio, 0.1)
    mu = (1.0 - share) * float(regularise(np.array(min_determinant), epsilon))
    if min_determinant < mu:
        return 2.0 * float(np.sqrt(mu) * np.sqrt(mu - min_determinant))
    return 0.0


class ShapeEnergy:
    """The energy of meshes with tetrahedra ``T`` (t, 4), relative to rest positions (n, 3) with positive tetrahedra.

    The energy is the mean of the densities, so that small tetrahedra count as much as large ones. In χ, D is replaced
    by ``D − floor``, so that determinants stay above ``floor``. Methods take positions (n, 3).
    """

    def __init__(self, T: IntArray, rest: FloatArray, floor: float = 0.0) -> None:
        self.T, self.n, self.floor = T, len(rest), floor
        u, v, w = (np.ascontiguousarray((rest[T[:, k]] - rest[T[:, 0]]).T) for k in (1, 2, 3))
        # Six times the volumes at rest, (t,).
        self.six_volumes = dot(u, cross(v, w))
        one, two, three = (normal / self.six_volumes for normal in (cross(v, w), cross(w, u), cross(u, v)))
        # Gradients of the four linear basis functions, (4, 3, t).
        self.gradients = np.stack([-(one + two + three), one, two, three])

    def jacobians(self, X: FloatArray) -> FloatArray:
        """Return the Jacobian matrices, (3, 3, t)."""
        x = X.T
        J = np.zeros((3, 3, len(self.T)))
        first = [axis.take(self.T[:, 0]) for axis in x]
        for k in (1, 2, 3):
            vertex = self.T[:, k]
            for a in range(3):
                edge = x[a].take(vertex) - first[a]
                for b in range(3):
                    J[a, b] += edge * self.gradients[k, b]
        return J

    def determinants(self, X: FloatArray) -> FloatArray:
        """Return the determinants (t,) of the Jacobian matrices."""
        J = self.jacobians(X)
        return dot(J[0], cross(J[1], J[2]))

    def count_inverted(self, X: FloatArray) -> int:
        """Return the number of tetrahedra whose determinant is not positive."""
        return int(np.count_nonzero(~(self.determinants(X) > 0)))

    def value(self, X: FloatArray, epsilon: float) -> float:
        """Return the energy per tetrahedron; infinite if ε is 0 and a determinant is not above the floor."""
        J = self.jacobians(X)
        D = dot(J[0], cross(J[1], J[2]))
        if epsilon == 0 and not D.min() > self.floor:
            return np.inf
        chi = regularise(D - self.floor, epsilon)
        t = np.einsum("abt,abt->t", J, J)
        density = (1 - _TUNING.volume_share) / 3 * t * np.cbrt(chi) ** -2 + _TUNING.volume_share / 2 * (D * D + 1) / chi
        value = float(density.mean())
        return value if np.isfinite(value) else np.inf

    def densities(self, X: FloatArray) -> FloatArray:
        """Return the densities (t,) with ε = 0; infinite where the determinant is not above the floor."""
        J = self.jacobians(X)
        D = dot(J[0], cross(J[1], J[2]))
        with np.errstate(divide="ignore", invalid="ignore"):
            return np.where(D > 0, self._density(J, D, 0.0).value, np.inf)

    def _density(self, J: FloatArray, D: FloatArray, epsilon: float) -> _Density:
        t = np.einsum("abt,abt->t", J, J)
        chi = regularise(D - self.floor, epsilon)
        root = np.hypot(D - self.floor, epsilon)
        a, b = (1 - _TUNING.volume_share) / 3, _TUNING.volume_share / 2
        shape = a * np.cbrt(chi) ** -2
        g = b * (D * D + 1) / chi
        # First and second derivative of χ, relative to χ. The first derivative is χ / root.
        slope = chi / root / chi
        bend = 0.5 * (epsilon / root) ** 2 / root / chi
        by_d_d = (
            shape * t * (10 / 9 * slope**2 - 2 / 3 * bend)
            + 2 * b / chi
            - 4 * b * D / chi * slope
            + g * (2 * slope**2 - bend)
        )
        return _Density(
            value=shape * t + g,
            by_t=shape,
            by_d=-2 / 3 * shape * t * slope + 2 * b * D / chi - g * slope,
            by_t_d=-2 / 3 * shape * slope,
            # The least value with positive semidefinite second derivatives in J and D; larger ones are exact.
            by_d_d=np.maximum(by_d_d, 8 / 9 * shape * t * slope**2),
        )

    def derivatives(self, X: FloatArray, epsilon: float) -> tuple[float, FloatArray, FloatArray]:
        """Return the energy per tetrahedron, its gradient (n, 3), and blocks of its approximate second derivatives.

        The blocks (10, 3, 3, t) belong to the pairs (i, j), i ≤ j, of vertices of every tetrahedron.
        """
        J, count, G = self.jacobians(X), len(self.T), self.gradients
        cofactors = np.stack([cross(J[1], J[2]), cross(J[2], J[0]), cross(J[0], J[1])])
        d = self._density(J, dot(J[0], cofactors[0]), epsilon)
        along, across = (np.einsum("abt,ibt->iat", matrix, G) for matrix in (J, cofactors))
        blocks = np.empty((len(VERTEX_PAIRS), 3, 3, count))
        mixed = 2 * d.by_t_d / count * along + 0.5 * d.by_d_d / count * across
        for k, (i, j) in enumerate(VERTEX_PAIRS):
            diagonal = 2 * d.by_t / count * dot(G[i], G[j])
            for a in range(3):
                for b in range(3):
                    np.multiply(mixed[i, a], across[j, b], out=blocks[k, a, b])
                    blocks[k, a, b] += across[i, a] * mixed[j, b]
                blocks[k, a, a] += diagonal
        force, vertex = (2 * d.by_t * along + d.by_d * across) / count, self.T.T.ravel()
        gradient = [np.bincount(vertex, force[:, a].ravel(), minlength=self.n) for a in range(3)]
        return float(d.value.mean()), np.stack(gradient, axis=1), blocks


def cross(a: FloatArray, b: FloatArray) -> FloatArray:
    """Cross products of vectors (3, …)."""
    return np.stack([a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]])


def dot(a: FloatArray, b: FloatArray) -> FloatArray:
    """Inner products of vectors (3, …)."""
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


def project(projections: FloatArray | None, x: FloatArray) -> FloatArray:
    """Project directions (k, 3) to those in which the vertices move; None restricts nothing."""
    return x if projections is None else np.asarray(np.einsum("iab,ib->ia", projections, x))


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
        """Lower the regularised energy; yield after each step how far the least determinant is above the floor.

        The value is negative if the least determinant is below the floor. The descent ends when it is positive.
        """
        # Determinants are about 1, so this parameter smooths the energy strongly.
        epsilon, repeated = 1.0, 0
        for _ in range(max_steps):
            before = self._value(self.X, epsilon)
            after = self._step(epsilon)
            least = float(self.energy.determinants(self.X).min()) - self.energy.floor
            yield least
            if least > 0 or (after is None and epsilon <= _TUNING.min_epsilon):
                return
            ratio = 1.0 if after is None else after / before
            # While the energy falls quickly, keep the parameter. Lowering it too early leads to worse local minima.
            repeated += 1
            if ratio > 1.0 - _TUNING.quick_decrease or repeated > _TUNING.max_repeated:
                epsilon, repeated = max(reduce_epsilon(epsilon, least, ratio), _TUNING.min_epsilon), 0

    def make_valid(self, max_steps: int, after_step: Callable[[], object] = lambda: None) -> bool:
        """Untangle the mesh if necessary; return whether all determinants are above the floor."""
        if not self.is_valid():
            for _ in self.untangle(max_steps):
                after_step()
        return self.is_valid()

    def is_valid(self) -> bool:
        """Return whether all determinants are above the floor."""
        return bool(self.energy.determinants(self.X).min() > self.energy.floor)

    def polish(self, max_steps: int, tol: float) -> Iterator[float]:
        """Lower the energy with ε = 0 of a valid mesh; yield it after each step, and end when it has converged."""
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

        def evaluate_step(t: float, bound: float) -> tuple[float, FloatArray | None]:
            X = self.X.copy()
            X[self.free] += t * direction
            found = self._value(X, epsilon)
            return found, X if found < bound else None

        accepted = backtrack(evaluate_step, value, decrease, tries=30)
        if accepted is None:
            return None
        self.X = accepted.state
        return accepted.value

    def _direction(self, data: FloatArray, g: FloatArray) -> FloatArray:
        """Solve the Newton system approximately by preconditioned conjugate gradients."""
        matrix = self._blocks.matrix(data)
        diagonal = data[self._blocks.diagonal]
        scale = np.trace(diagonal, axis1=1, axis2=2)
        # This shift makes every block invertible, also one that is singular after rounding or underflow.
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
        for _ in range(_TUNING.max_conjugate_steps):
            if not rz > _TUNING.residual**2 * first:
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
