"""Second derivatives of a deformation energy in vertex positions: assembly, factorisation, solve.

The matrix has the pattern of the mesh's edges in 2×2 blocks. The pattern never changes, so it is computed and analysed
once. Assembly converts the triangles' quadratic forms to blocks and sums these into the matrix values.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import cached_property
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from quasiharmonic.energies.energies import QuadraticForm
from quasiharmonic.linsolve import LinearSolver, NotPositiveDefinite, make_solver
from quasiharmonic.linsolve.laplacian import stiffness_pattern
from quasiharmonic.util.arrays import ComplexArray, FloatArray, IntArray, invert_indices, list_others, repeat_each, work
from quasiharmonic.util.kernels import compiled
from quasiharmonic.util.progress import heartbeat

if TYPE_CHECKING:
    from scipy.sparse import csr_array

# Triangles per chunk; intermediate results of a chunk stay in the cache.
_CHUNK = 8192


class NewtonSystem:
    """The matrix of ``Σⱼ formⱼ(dp, dq)`` in the positions of the free vertices.

    Unknowns alternate between x and y of the free vertices, in ascending order.

    Parameters
    ----------
    F : (f, 3) int64
    g : (3, f) complex128
        Half the gradients of the hat functions: ``dp = Σ conj(gᵢ) dwᵢ`` and ``dq = Σ gᵢ dwᵢ``.
    n : int
        Number of vertices.
    fixed : (k,) int
    linear_solver : str
        A name of `quasiharmonic.linsolve`, or ``"auto"``.

    Attributes
    ----------
    free : (n - k,) int64
        The free vertices, ascending.
    diagonal : (2 (n - k),) float64
        Diagonal of the assembled matrix.
    """

    def __init__(self, F: IntArray, g: ComplexArray, n: int, fixed: IntArray, linear_solver: str = "auto") -> None:
        self.free = list_others(n, fixed)
        place = invert_indices(n, self.free).astype(np.int32)
        self.take_gradients(g)
        self._pattern(F, place)
        self._linear_solver = linear_solver
        heartbeat()

    @cached_property
    def solver(self) -> LinearSolver:
        """The solver, which is made when it is used first."""
        return make_solver(self._indptr, self._indices, name=self._linear_solver)

    def __getstate__(self) -> dict[str, Any]:
        # Factors belong to a process.
        return {name: value for name, value in vars(self).items() if name != "solver"}

    @property
    def _values(self) -> FloatArray:
        """The values of the assembled matrix, a view."""
        return self._sums[:-2]

    def take_gradients(self, g: ComplexArray) -> None:
        """Set new gradients (3, f) of the hat functions on the same triangles, for example for another scale."""
        self._g = np.ascontiguousarray(g, dtype=np.complex128)

    def _pattern(self, F: IntArray, place: NDArray[np.int32]) -> None:
        """Compute the sparsity pattern and the slots of the blocks."""
        size = self.free.size
        edges = stiffness_pattern(F, place, size)
        row, column = edges.row, edges.column
        # Row 2i has xx and xy of the diagonal block and then of the others, row 2i + 1 has yy and then yx, yy.
        degree = np.bincount(row, minlength=size)
        upper = np.append(0, np.cumsum(4 * degree + 3))
        lower = upper[:-1] + 2 * degree + 2
        nth = np.arange(row.size) - np.append(0, np.cumsum(degree))[row]
        self._corner_slots = np.stack([upper[:-1], upper[:-1] + 1, lower])
        xx, yx = upper[row] + 2 + 2 * nth, lower[row] + 1 + 2 * nth
        self._side_slots = np.stack([xx, xx + 1, yx, yx + 1]).astype(np.int32)
        self._indptr = np.append(np.stack([upper[:-1], lower], axis=1).ravel(), upper[-1]).astype(np.int32)
        self._indices = np.empty(upper[-1], dtype=np.int32)
        own = 2 * np.arange(size)
        self._indices[self._corner_slots] = own, own + 1, own + 1
        self._indices[self._side_slots] = 2 * column, 2 * column + 1, 2 * column, 2 * column + 1
        self._first = self._indptr[:-1]

        # By triangle: the first entries of both rows of the blocks of its sides, from lower to higher free vertex, and
        # of its corners. Blocks of fixed vertices go to unused entries behind the matrix.
        self._sums = np.empty(upper[-1] + 2)
        corner = place[F.T]
        self._turns = np.where(corner <= corner[(1, 2, 0), :], 1.0, -1.0)
        self._slots = np.full((2, 2, *corner.shape), upper[-1], dtype=np.int32)
        of_sides, of_corners = self._slots.reshape(2, 2, -1)
        nth_side = repeat_each(np.arange(row.size), np.diff(edges.offsets))
        of_sides[0, edges.halves], of_sides[1, edges.halves] = xx[nth_side], yx[nth_side]
        free = np.flatnonzero(corner.ravel() >= 0)
        of = corner.ravel()[free]
        of_corners[0, free], of_corners[1, free] = upper[of], lower[of] - 1

    def assemble(self, form: QuadraticForm) -> None:
        """Sum the triangles' quadratic forms, multiplied by their areas and weights, into the matrix."""
        heartbeat()
        pp, qq = (np.ascontiguousarray(field, dtype=np.float64) for field in (form.pp, form.qq))
        rest = form.p2, form.q2, form.pq, form.pqc
        p2, q2, pq, pqc = (np.ascontiguousarray(field, dtype=np.complex128) for field in rest)
        add_up(pp, qq, p2, q2, pq, pqc, self._g, self._slots, self._turns, self._sums)
        self.diagonal = self._values[self._first]

    def add_blocks(self, xx: FloatArray, xy: FloatArray, yy: FloatArray) -> None:
        """Add a symmetric 2×2 block at every free vertex to the assembled matrix; (n - k,) float64 each."""
        for slot, part in zip(self._corner_slots, (xx, xy, yy), strict=True):
            self._values[slot] += part
        self.diagonal = self._values[self._first]

    def matrix(self) -> csr_array:
        """The full symmetric matrix as assembled, for inspection and tests."""
        from scipy.sparse import csr_array, triu

        size = self._first.size
        upper = csr_array((self._values.copy(), self._indices, self._indptr), shape=(size, size))
        return csr_array(upper + triu(upper, k=1).T)

    def factor(self, shift: float = 0.0) -> None:
        """Factor the assembled matrix, its diagonal increased by the factor ``1 + shift``.

        Because the shift is relative, its effect does not depend on triangle size. Raise `NotPositiveDefinite` if the
        rounded matrix is not positive definite.
        """
        diagonal = self.diagonal * (1 + shift)
        # Where the triangles give no stiffness, use 1 on the diagonal.
        self._values[self._first] = np.where(diagonal > 0, diagonal, 1)
        self.solver.factor(self._values)

    def solve(self, load: ComplexArray) -> ComplexArray:
        """Solve for the displacements of the free vertices under a load on them; (n - k,) complex128.

        Raises
        ------
        quasiharmonic.linsolve.NotPositiveDefinite
            When the solution has no correct digits.
        """
        return self.solver.solve(np.ascontiguousarray(load).view(np.float64)).view(np.complex128)

    def descent(
        self,
        gradient: ComplexArray,
        shifts: Sequence[float],
        solve: Callable[[ComplexArray], ComplexArray] | None = None,
    ) -> tuple[ComplexArray, float, int] | None:
        """Newton's direction for the assembled matrix, with the diagonal raised as far as the factorisation requires.

        Parameters
        ----------
        gradient : (n - k,) complex128
            With respect to the free vertices' positions.
        shifts : sequence of float
            Relative increases of the diagonal, tried in turn.
        solve : callable, optional
            Maps a load to displacements, with the factored matrix; `solve` by default.

        Returns
        -------
        direction, expected_decrease, number : (n - k,) complex128, float, int
            The direction, the rate of decrease along it (the squared Newton decrement, not negative), and the index of
            the successful shift. None if no shift gives a positive definite matrix.
        """
        for number, shift in enumerate(shifts):
            try:
                self.factor(shift)
                direction = (solve or self.solve)(-gradient)
            except NotPositiveDefinite:
                continue
            expected_decrease = -work(gradient, direction)
            if expected_decrease >= 0:
                return direction, expected_decrease, number
        return None

    def iterate(
        self,
        load: ComplexArray,
        precondition: Callable[[ComplexArray], ComplexArray],
        steps: int,
        *,
        residual: float,
        negligible: float = 0.0,
    ) -> tuple[ComplexArray, bool]:
        """Solve with the assembled matrix by at most ``steps`` preconditioned conjugate gradients.

        Return the displacements (n - k,) complex128, and whether the work that the remaining load could do is at most
        ``residual`` times theirs, or at most ``negligible``.
        """
        from scipy.sparse import csr_array

        upper = csr_array((self._values, self._indices, self._indptr), shape=2 * (self._first.size,))
        lower, x, rest = upper.T, np.zeros(load.size, dtype=np.complex128), load.copy()
        along, part, before, done = np.zeros_like(x), np.empty_like(x), 1.0, 0.0
        flat, flat_part = along.view(np.float64), part.view(np.float64)
        for _ in range(steps):
            heartbeat()
            better = precondition(rest)
            gain = work(rest, better)
            if gain <= max(residual * done, negligible):
                return x, True
            along *= gain / before
            along += better
            product = upper @ flat
            product += lower @ flat
            product -= np.multiply(self.diagonal, flat, out=flat_part)
            image = product.view(np.complex128)
            length = gain / work(along, image)
            x += np.multiply(along, length, out=part)
            rest -= np.multiply(image, length, out=part)
            before, done = gain, done + length * gain
        return x, False

    def solve_diagonal(self, load: ComplexArray) -> ComplexArray:
        """Divide the load by the matrix's diagonal, as a fallback if no factorisation exists."""
        diagonal = np.where(self.diagonal > 0, self.diagonal, 1)
        return (np.ascontiguousarray(load).view(np.float64) / diagonal).view(np.complex128)


@compiled
def add_up(
    pp: FloatArray,
    qq: FloatArray,
    p2: ComplexArray,
    q2: ComplexArray,
    pq: ComplexArray,
    pqc: ComplexArray,
    g: ComplexArray,
    slots: NDArray[np.int32],
    turns: FloatArray,
    values: FloatArray,
) -> None:
    """Fill in the matrix values with the sum of the triangles' quadratic forms.

    Parameters
    ----------
    pp, qq, p2, q2, pq, pqc : (f,)
        The forms.
    g : (3, f) complex128
        Half the gradients of the hat functions.
    slots : (2, 2, 3, f) int32
        First entries in ``values`` of the upper and lower rows of blocks, for the sides and the corners of triangles.
    turns : (3, f) float64
        1 for each side, or -1 if it runs from the higher vertex to the lower, so that the block is transposed.
    values : float64
        Matrix values. In the lower rows of corners, the first entries are below the diagonal and not stored.
    """
    # With dp and dq written out, the form is the real part of Σ Mᵢⱼ conj(dwᵢ) dwⱼ + Nᵢⱼ dwᵢ dwⱼ.
    values[:] = 0
    for start in range(0, pp.size, _CHUNK):
        part = slice(start, start + _CHUNK)
        mean, turn = pp[part] + qq[part], turns[:, part] * (pp[part] - qq[part])
        total, rest, twice, turned = p2[part] + q2[part], p2[part] - q2[part], pq[part], pqc[part]
        here = g[:, part]
        for (upper, lower), there in zip(slots[..., part], (here[(1, 2, 0), :], here), strict=True):
            square, product = here * there.conj(), here * there
            even = mean * square.real + turned.real * product.real + turned.imag * product.imag
            odd = twice.real * square.real + total.real * product.real + rest.imag * product.imag
            cross = rest.real * product.imag - total.imag * product.real - twice.imag * square.real
            np.add.at(values, upper.ravel(), (even + odd).ravel())
            np.add.at(values, lower.ravel() + 1, (even - odd).ravel())
            if there is here:
                np.add.at(values, upper.ravel() + 1, cross.ravel())
            else:
                twist = turn * square.imag
                np.add.at(values, upper.ravel() + 1, (cross - twist).ravel())
                np.add.at(values, lower.ravel(), (cross + twist).ravel())
