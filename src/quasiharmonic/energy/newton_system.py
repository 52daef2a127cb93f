"""Second derivatives of a deformation energy in vertex positions: assembly, factorisation, solve.

The pattern of the matrix is that of the mesh's edges in 2×2 blocks and never changes, so it is found and
analysed once. An assembly turns the triangles' quadratic forms into blocks and adds these up into the
values that the factorisation reads.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np
from scipy.sparse import csr_array, triu

from quasiharmonic.arrays import ComplexArray, FloatArray, IntArray, work
from quasiharmonic.energy.energies import QuadraticForm
from quasiharmonic.hearing import still_at_it
from quasiharmonic.linsolve import NotPositiveDefinite, make_solver
from quasiharmonic.mesh.topology import edge_keys

# Triangles whose blocks are formed at a time, so that what is in between stays in the cache.
_CHUNK = 8192


class NewtonSystem:
    """The matrix of ``Σⱼ formⱼ(dp, dq)`` by the positions of the free vertices.

    Unknowns alternate between the x and the y of the free vertices, in ascending order.

    Parameters
    ----------
    F : (f, 3) int64
        Triangles.
    g : (3, f) complex128
        Half the gradients of the hat functions: ``dp = Σ conj(gᵢ) dwᵢ`` and ``dq = Σ gᵢ dwᵢ``.
    n : int
        Number of vertices.
    fixed : (k,) int
        Vertices that do not move.
    linear_solver : str
        A name of `quasiharmonic.linsolve`, or ``"auto"``.

    Attributes
    ----------
    free : (n - k,) int64
        The vertices that do, ascending.
    """

    def __init__(self, F: IntArray, g: ComplexArray, n: int, fixed: IntArray, linear_solver: str = "auto") -> None:
        is_free = np.ones(n, dtype=bool)
        is_free[fixed] = False
        self.free = np.flatnonzero(is_free)
        size = self.free.size
        place = np.full(n, -1, dtype=np.int64)
        place[self.free] = np.arange(size)
        self._corner = corner = place[F.T]
        self.take_gradients(g)
        self._pattern(corner, size)
        self.solver = make_solver(self._indptr, self._indices, name=linear_solver)

    def take_gradients(self, g: ComplexArray) -> None:
        """Have other gradients (3, f) of the hat functions on the same triangles, as another scale gives them."""
        # Their products over the sides, from lower to higher free vertex, and at the corners.
        first, second = self._corner, self._corner[(1, 2, 0), :]
        g1, g2 = g, g[(1, 2, 0), :]
        upward = first <= second
        low, high = np.where(upward, g1, g2), np.where(upward, g2, g1)
        self._side_products = _parts(low, high)
        self._corner_products = _parts(g, g)
        self._work = np.empty(self._side_products.shape)

    def _pattern(self, corner: IntArray, size: int) -> None:
        """Where the blocks go."""
        tail, head = corner.ravel(), corner[(1, 2, 0), :].ravel()
        count = tail.size
        inner = np.flatnonzero((tail >= 0) & (head >= 0))
        key = edge_keys(tail[inner], head[inner], size)
        order = np.argsort(key, kind="stable")
        inner, key = inner[order], key[order]
        first = np.flatnonzero(np.diff(key, prepend=-1))
        row, column = np.divmod(key[first], max(size, 1))
        self._sum_sides = _summation(inner, np.append(first, inner.size), count)
        at = np.flatnonzero(tail >= 0)
        at = at[np.argsort(tail[at], kind="stable")]
        self._sum_corners = _summation(at, np.append(0, np.cumsum(np.bincount(tail[at], minlength=size))), count)

        # Row 2i holds xx and xy of the diagonal block and then of the others, row 2i + 1 yy and then yx, yy.
        degree = np.bincount(row, minlength=size)
        upper = np.append(0, np.cumsum(4 * degree + 3))
        lower = upper[:-1] + 2 * degree + 2
        nth = np.arange(row.size) - np.append(0, np.cumsum(degree))[row]
        self._corner_slots = np.stack([upper[:-1], upper[:-1] + 1, lower])
        xx, yx = upper[row] + 2 + 2 * nth, lower[row] + 1 + 2 * nth
        self._side_slots = np.stack([xx, xx + 1, yx, yx + 1])
        self._indptr = np.append(np.stack([upper[:-1], lower], axis=1).ravel(), upper[-1]).astype(np.int32)
        self._indices = np.empty(upper[-1], dtype=np.int32)
        own = 2 * np.arange(size)
        self._indices[self._corner_slots] = own, own + 1, own + 1
        self._indices[self._side_slots] = 2 * column, 2 * column + 1, 2 * column, 2 * column + 1
        self._first = self._indptr[:-1]
        self._values = np.empty(upper[-1])

    def assemble(self, form: QuadraticForm) -> None:
        """Add up the triangles' quadratic forms.

        Parameters
        ----------
        form : QuadraticForm
            On every triangle, with its area and weight in it.
        """
        still_at_it()
        for slot, part in zip(self._side_slots, _blocks(form, self._side_products, self._work), strict=True):
            self._values[slot] = self._sum_sides @ part.ravel()
        xx, xy, _, yy = _blocks(form, self._corner_products, self._work)
        for slot, part in zip(self._corner_slots, (xx, xy, yy), strict=True):
            self._values[slot] = self._sum_corners @ part.ravel()
        self._diagonal = self._values[self._first]

    def add_blocks(self, xx: FloatArray, xy: FloatArray, yy: FloatArray) -> None:
        """Add a symmetric 2×2 block at every free vertex to the assembled matrix; (n - k,) float64 each."""
        for slot, part in zip(self._corner_slots, (xx, xy, yy), strict=True):
            self._values[slot] += part
        self._diagonal = self._values[self._first]

    @property
    def diagonal(self) -> FloatArray:
        """The assembled matrix's, (2 (n - k),) float64."""
        return self._diagonal

    def matrix(self) -> csr_array:
        """The assembled matrix, both of its triangles; for study and tests."""
        size = self._first.size
        upper = csr_array((self._values.copy(), self._indices, self._indptr), shape=(size, size))
        return csr_array(upper + triu(upper, k=1).T)

    def factor(self, shift: float = 0.0) -> None:
        """Factor the assembled matrix.

        Parameters
        ----------
        shift : float
            Fraction by which the diagonal is raised. Measured on the diagonal, it means the same to
            triangles of any size.

        Raises
        ------
        quasiharmonic.linsolve.NotPositiveDefinite
            When the matrix, as rounded, is not positive definite.
        """
        diagonal = self._diagonal * (1 + shift)
        # A vertex whose triangles leave it free to move gets a one of its own.
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
        """Newton's direction by the assembled matrix, its diagonal raised as much as a factorisation needs.

        Parameters
        ----------
        gradient : (n - k,) complex128
            By the free vertices' positions.
        shifts : sequence of float
            Fractions by which the diagonal is raised, tried in turn.
        solve : callable, optional
            From a load to the displacements under it, with the matrix factored; `solve` by default.

        Returns
        -------
        direction : (n - k,) complex128
        promise : float
            The rate at which the energy falls along it (the squared decrement); not negative.
        number : int
            Of the shift that did. Instead of all three, None where no shift leaves a positive definite matrix.
        """
        for number, shift in enumerate(shifts):
            try:
                self.factor(shift)
                direction = (solve or self.solve)(-gradient)
            except NotPositiveDefinite:
                continue
            promise = -work(gradient, direction)
            if promise >= 0:
                return direction, promise, number
        return None

    def solve_diagonal(self, load: ComplexArray) -> ComplexArray:
        """The load divided by the matrix's diagonal: what is left when no factorisation exists."""
        diagonal = np.where(self._diagonal > 0, self._diagonal, 1)
        return (np.ascontiguousarray(load).view(np.float64) / diagonal).view(np.complex128)


def _parts(g1: ComplexArray, g2: ComplexArray) -> FloatArray:
    """Real and imaginary parts of ``g₁ conj(g₂)`` and of ``g₁ g₂``, (4, 3, f) float64."""
    turned, product = g1 * g2.conj(), g1 * g2
    return np.stack([turned.real, turned.imag, product.real, product.imag])


def _blocks(form: QuadraticForm, products: FloatArray, out: FloatArray) -> FloatArray:
    """Entries xx, xy, yx, yy of the blocks between pairs of corners i, j; (4, 3, f) float64.

    With dp and dq written out, the form is the real part of ``Σ Mᵢⱼ conj(dwᵢ) dwⱼ + Nᵢⱼ dwᵢ dwⱼ``.
    """
    for start in range(0, form.pp.size, _CHUNK):
        part = slice(start, start + _CHUNK)
        cr, ci, sr, si = products[:, :, part]
        p2, q2, pq, pqc = form.p2[part], form.q2[part], form.pq[part], form.pqc[part]
        m_real = (form.pp[part] + form.qq[part]) * cr + (pqc.real * sr + pqc.imag * si)
        m_imag = (form.pp[part] - form.qq[part]) * ci
        n_real = (p2.real + q2.real) * sr + (p2.imag - q2.imag) * si + pq.real * cr
        n_imag = (p2.imag + q2.imag) * sr + (q2.real - p2.real) * si + pq.imag * cr
        out[0, :, part] = m_real + n_real
        out[1, :, part] = -m_imag - n_imag
        out[2, :, part] = m_imag - n_imag
        out[3, :, part] = m_real - n_real
    return out


def _summation(members: IntArray, offsets: IntArray, count: int) -> csr_array:
    """Sums of some of ``count`` numbers: row i adds up ``members[offsets[i]:offsets[i + 1]]``."""
    return csr_array(
        (np.ones(members.size), members.astype(np.int32), offsets.astype(np.int32)), shape=(offsets.size - 1, count)
    )
