"""The anisotropic Laplacian ``Gᵀ A G`` and the map it determines, A ↦ (u, v): §6.2, equation 12.

The pattern of ``Sᵀ Gᵀ A G S`` is that of the mesh's edges. It does not change, so it is computed and
analysed once. An assembly then gathers the edge stiffnesses of the triangles into the values of the factorisation.
"""

from __future__ import annotations

from functools import cached_property
from threading import Lock
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from quasiharmonic.geometry.mesh.reference import ReferenceMesh
from quasiharmonic.geometry.mesh.topology import edge_keys
from quasiharmonic.linsolve import make_solver, takes_order
from quasiharmonic.linsolve.dissection import nested_dissection
from quasiharmonic.util.arrays import (
    ComplexArray,
    FloatArray,
    IntArray,
    as_offsets,
    check_range,
    invert_indices,
    list_others,
    own_triangles,
)
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
        self.free = list_others(n, fixed)
        order = None
        if points is not None and self.free.size >= DISSECT_FROM and takes_order(linear_solver):
            # Half-edge e·f + t is edge e of triangle t, the layout of ReferenceMesh.edge_stiffness.
            tail = self._find_unknowns()[F.T]
            tail, head = tail.ravel(), tail[(1, 2, 0), :].ravel()
            once = np.flatnonzero((tail >= 0) & (tail < head))
            order = nested_dissection(points[self.free], tail[once], head[once])
        if order is not None:
            self.free = self.free[order]
        self._pattern = pattern = stiffness_pattern(F, self._find_unknowns(), self.free.size)
        self._values = np.empty(pattern.indices.size)
        self.solver = make_solver(pattern.indptr, pattern.indices, name=linear_solver, ordered=order is not None)
        # The lock prevents another thread from replacing the factor between its check and the solve.
        self._lock = Lock()
        self._factored: FactoredLaplacian | None = None
        self._F = F

    def _find_unknowns(self) -> NDArray[np.int32]:
        """Index of the unknown of each vertex, -1 at fixed vertices; (n,)."""
        return invert_indices(self.n, self.free).astype(np.int32)

    @cached_property
    def _border(self) -> tuple[IntArray, IntArray, IntArray]:
        """Half-edges with at least one fixed end, and their tails and heads."""
        corner = np.ascontiguousarray(self._F.T)
        tail, head = corner.ravel(), corner[(1, 2, 0), :].ravel()
        is_fixed = self._find_unknowns() < 0
        border = np.flatnonzero(is_fixed[tail] | is_fixed[head])
        return border, tail[border], head[border]

    def factor(self, stiffness: FloatArray) -> FactoredLaplacian:
        """Assemble and factor the Laplacian for one tensor field.

        ``stiffness`` (3, f) comes from `ReferenceMesh.edge_stiffness`. The result stays valid when other tensors are
        factored later. Raises NotPositiveDefinite if the matrix is not positive definite because of rounding.
        """
        if stiffness.size != self._F.size:
            raise ValueError(f"stiffness must have shape (3, {len(self._F)}), not {stiffness.shape}")
        operator = FactoredLaplacian(self, stiffness.ravel())
        with self._lock:
            self._refactor(operator)
        return operator

    def _refactor(self, operator: FactoredLaplacian) -> None:
        """Make the solver's factor that of ``operator``. The caller holds the lock."""
        self._factored = None
        # All fields except the indices and the fixed ends.
        assemble(operator.stiffness, self._pattern.indptr, *self._pattern[2:8], self._values)
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
    """``Gᵀ A G`` for one A, made by `Laplacian.factor`; ``stiffness`` (3 f,) is half-edge by half-edge.

    A solver holds one factor at a time. If a later operator has replaced the factor, the next solve factors again. This
    costs time and does not change the result.
    """

    def __init__(self, laplacian: Laplacian, stiffness: FloatArray) -> None:
        self.laplacian = laplacian
        self.stiffness = stiffness

    def extend(self, w: ComplexArray) -> ComplexArray:
        """Compute the quasi-harmonic map that equals ``w`` (n,) at the fixed vertices in every bit (eq. 12)."""
        laplacian, pattern, out = self.laplacian, self.laplacian._pattern, w.copy()
        if w.shape != (laplacian.n,):
            raise ValueError(f"w must have shape ({laplacian.n},), one position for each vertex, not {w.shape}")
        load = np.empty((2, laplacian.free.size))
        boundary_load(self.stiffness, pattern.border, pattern.border_row, pattern.border_fixed, w, load)
        laplacian._solve(self, load, out)
        return out

    def respond(self, load: ComplexArray) -> ComplexArray:
        """Solve ``Sᵀ Gᵀ A G S x = Sᵀ load``; the solution (n,) is zero at the fixed vertices."""
        laplacian, out = self.laplacian, np.zeros(load.shape, dtype=np.complex128)
        given = load[laplacian.free]
        laplacian._solve(self, np.stack([given.real, given.imag]), out)
        return out

    def flux(self, w: ComplexArray) -> ComplexArray:
        """Compute ``Gᵀ A G w`` at the fixed vertices, the discrete Neumann data (§6.2); zero elsewhere."""
        laplacian = self.laplacian
        border, tail, head = laplacian._border
        # Rows sum to zero, so an off-diagonal entry k of edge (i, j) adds k (wⱼ − wᵢ) to row i.
        pull = self.stiffness[border] * (w[head] - w[tail])
        out = np.zeros(laplacian.n, dtype=np.complex128)
        np.add.at(out, tail, pull)
        np.subtract.at(out, head, pull)
        out[laplacian.free] = 0
        return out


def embed_tutte(
    F: IntArray,
    w: ComplexArray,
    fixed: IntArray,
    weights: FloatArray | float = 1.0,
    *,
    linear_solver: str = "auto",
) -> ComplexArray:
    """Place every free vertex of w (n,) at the weighted mean of its neighbours; only fixed positions are read.

    ``fixed`` (k,) has at least one vertex on every component of the mesh. ``weights`` (f,) are positive; the weight of
    an edge is the sum over its triangles.

    Raises
    ------
    quasiharmonic.linsolve.NotPositiveDefinite
        If the system is not positive definite after rounding.
    """
    if len(np.unique(fixed)) == len(w):
        return w
    identity = np.broadcast_to(np.array([[1.0], [0.0], [1.0]]), (3, len(F)))
    stiffness = ReferenceMesh(np.zeros((len(w), 2)), F, "equilateral").edge_stiffness(identity * weights)
    return Laplacian(F, len(w), fixed, linear_solver).factor(stiffness).extend(w)


def weigh_edges(g: ComplexArray, weight: FloatArray) -> FloatArray:
    """Return the stiffness (3, f) of the half-edges where the tensor of each triangle is a multiple of the identity.

    ``g`` (3, f) are the gradients at the corners, up to a factor, and ``weight`` (f,) the multiples times the areas.
    """
    return np.asarray(2 * weight * (g * g[(1, 2, 0), :].conj()).real)


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
    above, size = np.add.reduceat(stiffness[halves], as_offsets(offsets[:-1])), indptr.size - 1
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
    for coordinate, part in zip(load, (pull.real, pull.imag), strict=True):
        coordinate[:] = np.bincount(border_row, part, load.shape[1])


@compiled
def put_at(solution: FloatArray, free: IntArray, out: ComplexArray) -> None:
    """Write both coordinates (2, k) to the free vertices of a map."""
    out.real[free], out.imag[free] = solution


class StiffnessPattern(NamedTuple):
    """The entries of a Laplacian among the free vertices, and the half-edges summed into each entry.

    Half-edge e·f + t is edge e of triangle t, the layout of `ReferenceMesh.edge_stiffness`.

    Attributes
    ----------
    indptr, indices : (size + 1,), (size + e,) int32
        The upper triangle in compressed sparse rows; each row has its diagonal entry first.
    row, column : (e,) int64
        The entries above the diagonal, row by row.
    halves, offsets : (m,), (e + 1,) int32
        Ascending half-edges of each entry above the diagonal, and the start of each list.
    border, border_row, border_fixed : (b,) int64
        Ascending half-edges between a free and a fixed vertex, the row of the free vertex, and the fixed vertex.
    """

    indptr: NDArray[np.int32]
    indices: NDArray[np.int32]
    row: IntArray
    column: IntArray
    halves: NDArray[np.int32]
    offsets: NDArray[np.int32]
    border: IntArray
    border_row: IntArray
    border_fixed: IntArray


def stiffness_pattern(F: IntArray, unknown: NDArray[np.int32], size: int) -> StiffnessPattern:
    """Find the pattern of the Laplacian of a mesh among its ``size`` free vertices.

    ``unknown`` (n,) int32 has the row of every free vertex, and -1 at fixed ones.
    """
    F = own_triangles(F)
    check_range("F", F, unknown.size)
    capacity = F.size
    pattern = StiffnessPattern(
        indptr=np.empty(size + 1, dtype=np.int32),
        indices=np.empty(size + capacity, dtype=np.int32),
        row=np.empty(capacity, dtype=np.int64),
        column=np.empty(capacity, dtype=np.int64),
        halves=np.empty(capacity, dtype=np.int32),
        offsets=np.empty(capacity + 1, dtype=np.int32),
        border=np.empty(capacity, dtype=np.int64),
        border_row=np.empty(capacity, dtype=np.int64),
        border_fixed=np.empty(capacity, dtype=np.int64),
    )
    sizes = np.empty(3, dtype=np.int64)
    find_pattern(F, unknown, *pattern, sizes)
    entries, inner, border = sizes.tolist()
    # Release the unused memory, which was never touched.
    lengths = size + 1, size + entries, entries, entries, inner, entries + 1, border, border, border
    arrays: list[NDArray[Any]] = list(pattern)
    for array, length in zip(arrays, lengths, strict=True):
        array.resize(length, refcheck=False)
    return pattern


@compiled
def find_pattern(
    F: IntArray,
    unknown: NDArray[np.int32],
    indptr: NDArray[np.int32],
    indices: NDArray[np.int32],
    row: IntArray,
    column: IntArray,
    halves: NDArray[np.int32],
    offsets: NDArray[np.int32],
    border: IntArray,
    border_row: IntArray,
    border_fixed: IntArray,
    sizes: IntArray,
) -> None:
    """Fill in a `StiffnessPattern`, in arrays of sufficient length, and the numbers e, m and b (3,)."""
    size = indptr.size - 1
    tail = unknown[F.T]
    tail, head = tail.ravel(), tail[(1, 2, 0), :].ravel()
    inner = np.flatnonzero((tail >= 0) & (head >= 0))
    key = edge_keys(tail[inner], head[inner], size)
    sorting = np.argsort(key, kind="stable")
    key = key[sorting]
    starts = np.ones(key.size, dtype=bool)
    np.not_equal(key[1:], key[:-1], out=starts[1:])
    first = np.flatnonzero(starts)
    e, m = first.size, inner.size
    halves[:m], offsets[:e], offsets[e] = inner[sorting], first, m
    np.divmod(key[first], max(size, 1), out=(row[:e], column[:e]))
    indptr[0] = 0
    np.cumsum(np.bincount(row[:e], minlength=size) + 1, out=indptr[1:])
    indices[indptr[:-1]] = np.arange(size)
    indices[np.arange(e) + row[:e] + 1] = column[:e]
    at = np.flatnonzero((tail >= 0) != (head >= 0))
    b = at.size
    border[:b], border_row[:b] = at, np.maximum(tail[at], head[at])
    edge, triangle = np.divmod(at, len(F))
    border_fixed[:b] = np.where(tail[at] < 0, F[triangle, edge], F[triangle, (edge + 1) % 3])
    sizes[:] = e, m, b
