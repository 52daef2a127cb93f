"""The anisotropic Laplacian ``Gᵀ A G`` and the map it determines, A ↦ (u, v): §6.2, equation 12.

The pattern of ``Sᵀ Gᵀ A G S`` is that of the mesh's edges. It does not change, so it is computed and
analysed once. An assembly then gathers the edge stiffnesses of the triangles into the values of the factorisation.
"""

from __future__ import annotations

from functools import cached_property
from threading import Lock

import numpy as np
from numpy.typing import NDArray

from quasiharmonic.linsolve import make_solver, takes_order
from quasiharmonic.linsolve.dissection import nested_dissection
from quasiharmonic.linsolve.pattern import stiffness_pattern
from quasiharmonic.util.arrays import ComplexArray, FloatArray, IntArray, own_triangles
from quasiharmonic.util.kernels import compiled

# Number of unknowns from which dissection is used. For fewer unknowns minimum degree is equally good (10,000 unknowns:
# 17 ms to order and analyse and 7 ms to factor, for both), and parallel work does not pay.
DISSECT_FROM = 30_000


class Laplacian:
    """The pattern of ``Gᵀ A G`` restricted to the free vertices, analysed once for any number of tensor fields A.

    Threads may share it. Each gets correct results for its own tensors, but they factor one after another.

    Parameters
    ----------
    F : (f, 3) int64
        Triangles.
    n : int
        Number of vertices.
    fixed : (k,) int
        Fixed vertices; the positions of the others are unknowns.
    linear_solver : str
        A name of `quasiharmonic.linsolve`, or ``"auto"``.
    points : (n, d) float64, optional
        Positions of the vertices. They determine the elimination order of a large mesh and do not affect the
        result otherwise.

    Attributes
    ----------
    free : (n - k,) int64
        Free vertices in the order of the unknowns: the columns of the paper's ``S``.
    """

    def __init__(
        self,
        F: IntArray,
        n: int,
        fixed: IntArray,
        linear_solver: str = "auto",
        points: FloatArray | None = None,
    ) -> None:
        self.n = n
        F = own_triangles(F)
        is_free = np.ones(n, dtype=bool)
        is_free[fixed] = False
        self.free = np.flatnonzero(is_free)
        order = None
        if points is not None and self.free.size >= DISSECT_FROM and takes_order(linear_solver):
            # Half-edge e·f + t is edge e of triangle t, the layout of ReferenceMesh.edge_stiffness.
            tail = self._place()[F.T]
            tail, head = tail.ravel(), tail[(1, 2, 0), :].ravel()
            once = np.flatnonzero((tail >= 0) & (tail < head))
            order = nested_dissection(points[self.free], tail[once], head[once])
        if order is not None:
            self.free = self.free[order]
        self._pattern = pattern = stiffness_pattern(F, self._place(), self.free.size)
        self._values = np.empty(pattern.indices.size)
        self.solver = make_solver(pattern.indptr, pattern.indices, name=linear_solver, ordered=order is not None)
        # The lock prevents another thread from replacing the factor between its check and the solve.
        self._lock = Lock()
        self._factored: FactoredLaplacian | None = None
        self._F = F

    def _place(self) -> NDArray[np.int32]:
        """Index of the unknown of each vertex, -1 at fixed vertices; (n,)."""
        place = np.full(self.n, -1, dtype=np.int32)
        place[self.free] = np.arange(self.free.size, dtype=np.int32)
        return place

    @cached_property
    def _rim(self) -> tuple[IntArray, IntArray, IntArray]:
        """Half-edges with at least one fixed end, and their tails and heads."""
        corner = np.ascontiguousarray(self._F.T)
        tail, head = corner.ravel(), corner[(1, 2, 0), :].ravel()
        held = self._place() < 0
        rim = np.flatnonzero(held[tail] | held[head])
        return rim, tail[rim], head[rim]

    def factor(self, stiffness: FloatArray) -> FactoredLaplacian:
        """Assemble and factor the Laplacian for one tensor field.

        Parameters
        ----------
        stiffness : (3, f) float64
            Off-diagonal entries of every triangle's ``Gᵀ A G``, from `ReferenceMesh.edge_stiffness`.

        Returns
        -------
        FactoredLaplacian
            Operator for these tensors; it stays valid when other tensors are factored later.

        Raises
        ------
        quasiharmonic.linsolve.NotPositiveDefinite
            If the matrix is not positive definite because of rounding.
        """
        if stiffness.size != self._F.size:
            raise ValueError(f"stiffness must have shape (3, {len(self._F)}), not {stiffness.shape}")
        made = FactoredLaplacian(self, stiffness.ravel())
        with self._lock:
            self._refactor(made)
        return made

    def _refactor(self, operator: FactoredLaplacian) -> None:
        """Make the solver's factor that of ``operator``. The caller holds the lock."""
        self._factored = None
        of = self._pattern
        assemble(
            operator.stiffness,
            of.indptr,
            of.row,
            of.column,
            of.halves,
            of.offsets,
            of.border,
            of.border_row,
            self._values,
        )
        self.solver.factor(self._values)
        self._factored = operator

    def _solve(self, operator: FactoredLaplacian, load: FloatArray, out: ComplexArray) -> None:
        """Solve for both coordinates (2, n - k) with an operator's factor, and write the free vertices of ``out``."""
        with self._lock:
            if self._factored is not operator:
                self._refactor(operator)
            solution = self.solver.solve(load.T)
        put_at(np.ascontiguousarray(solution.T), self.free, out)


class FactoredLaplacian:
    """``Gᵀ A G`` for one A, made by `Laplacian.factor`.

    A solver holds one factor at a time. If a later operator has replaced the factor, the next solve factors again. This
    costs time and does not change the result.

    Parameters
    ----------
    pattern : Laplacian
    stiffness : (3 f,) float64
        Off-diagonal entries of every triangle's ``Gᵀ A G``, half-edge by half-edge.
    """

    def __init__(self, pattern: Laplacian, stiffness: FloatArray) -> None:
        self.pattern = pattern
        self.stiffness = stiffness

    def extend(self, w: ComplexArray) -> ComplexArray:
        """Compute the quasi-harmonic map that equals ``w`` at the fixed vertices (eq. 12).

        Parameters
        ----------
        w : (n,) complex128
            ``u + i v``; only the values at the fixed vertices are used.

        Returns
        -------
        (n,) complex128
            Equal to ``w`` at the fixed vertices in every bit.
        """
        of, pattern, out = self.pattern, self.pattern._pattern, w.copy()
        if w.shape != (of.n,):
            raise ValueError(f"w must have shape ({of.n},), one position for each vertex, not {w.shape}")
        load = np.empty((2, of.free.size))
        boundary_load(self.stiffness, pattern.border, pattern.border_row, pattern.border_fixed, w, load)
        of._solve(self, load, out)
        return out

    def respond(self, load: ComplexArray) -> ComplexArray:
        """Solve ``Sᵀ Gᵀ A G S x = Sᵀ load``; the solution is zero at the fixed vertices.

        Parameters
        ----------
        load : (n,) complex128

        Returns
        -------
        (n,) complex128
        """
        of, out = self.pattern, np.zeros(load.shape, dtype=np.complex128)
        given = load[of.free]
        of._solve(self, np.stack([given.real, given.imag]), out)
        return out

    def flux(self, w: ComplexArray) -> ComplexArray:
        """Compute ``Gᵀ A G w`` at the fixed vertices, the discrete Neumann data (§6.2); zero elsewhere.

        Parameters
        ----------
        w : (n,) complex128

        Returns
        -------
        (n,) complex128
        """
        of = self.pattern
        rim, tail, head = of._rim
        # Rows sum to zero, so an off-diagonal entry k of edge (i, j) adds k (wⱼ − wᵢ) to row i.
        pull = self.stiffness[rim] * (w[head] - w[tail])
        out = np.zeros(of.n, dtype=np.complex128)
        np.add.at(out, tail, pull)
        np.subtract.at(out, head, pull)
        out[of.free] = 0
        return out


@compiled
def assemble(
    stiffness: FloatArray,
    indptr: NDArray[np.int32],
    row: IntArray,
    column: IntArray,
    halves: NDArray[np.int32],
    offsets: NDArray[np.int32],
    border: IntArray,
    border_row: IntArray,
    values: FloatArray,
) -> None:
    """Fill in the upper triangle from the stiffness (3 f,) of the half-edges, by a `StiffnessPattern`."""
    above, size = np.add.reduceat(stiffness[halves], offsets[:-1]), indptr.size - 1
    # Rows of Gᵀ A G sum to zero, so each half-edge is subtracted from the diagonal at both of its ends.
    # If no two free vertices are neighbours, `above` is empty, and bincount of an empty array gives integers.
    on = np.bincount(row, above, size).astype(np.float64, copy=False)
    on += np.bincount(column, above, size)
    on += np.bincount(border_row, stiffness[border], size)
    values[indptr[:-1]] = -on
    values[np.arange(row.size) + row + 1] = above


@compiled
def boundary_load(
    stiffness: FloatArray,
    border: IntArray,
    border_row: IntArray,
    border_fixed: IntArray,
    w: ComplexArray,
    load: FloatArray,
) -> None:
    """Fill in both coordinates of the right-hand side (2, n - k), the load from half-edges to fixed vertices."""
    pull = -stiffness[border] * w[border_fixed]
    for coordinate, some in zip(load, (pull.real, pull.imag), strict=True):
        coordinate[:] = np.bincount(border_row, some, load.shape[1])


@compiled
def put_at(solution: FloatArray, free: IntArray, out: ComplexArray) -> None:
    """Write both coordinates (2, k) to the free vertices of a map."""
    out.real[free], out.imag[free] = solution
