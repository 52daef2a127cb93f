"""The anisotropic Laplacian ``Gᵀ A G`` and the map it determines, A ↦ (u, v): §6.2, equation 12.

The pattern of ``Sᵀ Gᵀ A G S`` is that of the mesh's edges and never changes, so it is found and
analysed once. An assembly is then one gather of the triangles' edge stiffnesses into the values that
the factorisation reads.
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

# From this many unknowns on they are numbered by dissection. Minimum degree is as good for fewer (10k unknowns: 17 ms
# to order and analyse, 7 to factor, for both), and there is nothing to do in parallel yet.
DISSECT_FROM = 30_000


class Laplacian:
    """The pattern of ``Gᵀ A G`` restricted to the free vertices, analysed once for any number of tensor fields A.

    Threads may share it: each gets the answers for its own tensors, though they refactor in turn.

    Parameters
    ----------
    F : (f, 3) int64
        Triangles.
    n : int
        Number of vertices.
    fixed : (k,) int
        Vertices whose positions are given; the others are solved for.
    linear_solver : str
        A name of `quasiharmonic.linsolve`, or ``"auto"``.
    points : (n, d) float64, optional
        Positions of the vertices, by which the free vertices of a large mesh are ordered for the factorisation. They
        have no other part in it.

    Attributes
    ----------
    free : (n - k,) int64
        The other vertices in the order of the unknowns: the columns of the paper's ``S``.
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
        # Whose the one factor is may be asked only while nobody can overwrite it before the solve.
        self._lock = Lock()
        self._factored: FactoredLaplacian | None = None
        self._F = F

    def _place(self) -> NDArray[np.int32]:
        """Number of the unknown at each vertex, -1 at fixed ones; (n,)."""
        place = np.full(self.n, -1, dtype=np.int32)
        place[self.free] = np.arange(self.free.size, dtype=np.int32)
        return place

    @cached_property
    def _rim(self) -> tuple[IntArray, IntArray, IntArray]:
        """Half-edges with a fixed vertex, and their tails and heads."""
        corner = np.ascontiguousarray(self._F.T)
        tail, head = corner.ravel(), corner[(1, 2, 0), :].ravel()
        held = self._place() < 0
        rim = np.flatnonzero(held[tail] | held[head])
        return rim, tail[rim], head[rim]

    def factor(self, stiffness: FloatArray) -> FactoredLaplacian:
        """Assemble and factor.

        Parameters
        ----------
        stiffness : (3, f) float64
            Off-diagonal entries of every triangle's ``Gᵀ A G``, from `ReferenceMesh.edge_stiffness`.

        Returns
        -------
        FactoredLaplacian
            For these tensors, whatever is factored after them.

        Raises
        ------
        quasiharmonic.linsolve.NotPositiveDefinite
            When rounding leaves no positive definite matrix.
        """
        if stiffness.size != self._F.size:
            raise ValueError(f"stiffness must have shape (3, {len(self._F)}), not {stiffness.shape}")
        made = FactoredLaplacian(self, stiffness.ravel())
        with self._lock:
            self._refactor(made)
        return made

    def _refactor(self, operator: FactoredLaplacian) -> None:
        """Make the solver's one factor that of an operator; with the lock held."""
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
        """One solve for both coordinates (2, n - k) with an operator's factor, into the free vertices of a map."""
        with self._lock:
            if self._factored is not operator:
                self._refactor(operator)
            solution = self.solver.solve(load.T)
        put_at(np.ascontiguousarray(solution.T), self.free, out)


class FactoredLaplacian:
    """``Gᵀ A G`` for one A, made by `Laplacian.factor`.

    A solver holds one factor at a time. An operator whose factor has been overwritten by a later one's makes it anew
    when it is asked to solve, which costs time and changes no answer.

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
        """The quasi-harmonic map with ``w``'s values at the fixed vertices (eq. 12).

        Parameters
        ----------
        w : (n,) complex128
            ``u + i v``; only the fixed vertices' values are read.

        Returns
        -------
        (n,) complex128
            Equal to ``w`` at the fixed vertices, to the last bit.
        """
        of, pattern, out = self.pattern, self.pattern._pattern, w.copy()
        if w.shape != (of.n,):
            raise ValueError(f"w must have shape ({of.n},), one position for each vertex, not {w.shape}")
        load = np.empty((2, of.free.size))
        boundary_load(self.stiffness, pattern.border, pattern.border_row, pattern.border_fixed, w, load)
        of._solve(self, load, out)
        return out

    def respond(self, load: ComplexArray) -> ComplexArray:
        """Solve ``Sᵀ Gᵀ A G S x = Sᵀ load``: the response to a load, zero at the fixed vertices.

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
        """``Gᵀ A G w`` at the fixed vertices, the discrete Neumann data (§6.2), and zero elsewhere.

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
    """Fill in the values of the upper triangle from the half-edges' stiffness (3 f,), by a `StiffnessPattern`."""
    above, size = np.add.reduceat(stiffness[halves], offsets[:-1]), indptr.size - 1
    # Rows of Gᵀ A G sum to zero, so each half-edge is taken off the diagonal at both of its ends.
    # Where no two free vertices are neighbours, `above` is empty, and bincount of an empty array gives integers.
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
    """Fill in both coordinates of the right-hand side (2, n - k), which half-edges to fixed vertices make."""
    pull = -stiffness[border] * w[border_fixed]
    for coordinate, some in zip(load, (pull.real, pull.imag), strict=True):
        coordinate[:] = np.bincount(border_row, some, load.shape[1])


@compiled
def put_at(solution: FloatArray, free: IntArray, out: ComplexArray) -> None:
    """Put both coordinates (2, k) in their places in a map."""
    out.real[free], out.imag[free] = solution
