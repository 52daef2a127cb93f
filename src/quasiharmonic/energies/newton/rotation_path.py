"""Steps along which triangles turn as they go, for maps that have far to turn.

A strip that rolls up hardly strains its triangles but turns them by whole turns. Along a straight line a triangle that
turns by θ grows by ``√(1 + θ²)``, so the energy lets a step turn it by little, and hundreds of steps are taken in full
that lower the energy by a hundredth each. With ``θ = Im dp/p`` the angular velocity of a triangle along a direction::

    p(t) = e^{iθt} (p + t (dp − iθp)),    q(t) = e^{iθt} (q + t (dq − iθq))

begins as the straight line does and turns it as far as one likes without strain. Triangles that turn by themselves do
not fit together; the map whose derivatives are nearest these, by areas at rest, is one solve with a Laplacian that
does not change. What fits already stays as it is, so the path has the line's direction at its start, and a step along
it is promised what Newton's step is.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from quasiharmonic.linsolve import NotPositiveDefinite
from quasiharmonic.linsolve.laplacian import Laplacian
from quasiharmonic.util.arrays import ComplexArray, FloatArray, IntArray


def rates(F: IntArray, g: ComplexArray, w: ComplexArray, direction: ComplexArray) -> ComplexArray:
    """``dp/p``: how every triangle (f,) of a map (n,) begins to grow along a direction, and ``i`` times its turning."""
    corners = F.T
    rate: ComplexArray = np.sum(g.conj() * direction[corners], axis=0) / np.sum(g.conj() * w[corners], axis=0)
    return rate


class Turning:
    """Paths for maps of one mesh.

    Parameters
    ----------
    F : (f, 3) int64
        Triangles, each vertex in one at least.
    g : (3, f) complex128
        Half the gradients of the hat functions, as `NewtonSystem` has them.
    n : int
        Number of vertices.
    fixed : (k,) int
        Vertices that do not move; one in each component at least.
    linear_solver : str

    Raises
    ------
    quasiharmonic.linsolve.NotPositiveDefinite
        As `of` knows it.
    """

    def __init__(self, F: IntArray, g: ComplexArray, n: int, fixed: IntArray, linear_solver: str = "auto") -> None:
        self._F, self._corners = F, np.ascontiguousarray(F.T)
        self._g = g
        # The gradients' cross product says how large the triangle is, up to a factor that all have in common.
        self._area: FloatArray = 1 / np.abs((g[1].conj() * g[2]).imag)
        stiffness = 2 * self._area * (g * g[(1, 2, 0), :].conj()).real
        self._laplacian = Laplacian(F, n, fixed, linear_solver).factor(stiffness)

    @classmethod
    def of(cls, F: IntArray, g: ComplexArray, n: int, fixed: IntArray, linear_solver: str = "auto") -> Turning | None:
        """Make one; None where rest triangles differ so much that rounding leaves no positive definite Laplacian."""
        try:
            return cls(F, g, n, fixed, linear_solver)
        except NotPositiveDefinite:
            return None

    def path(self, w: ComplexArray, direction: ComplexArray) -> Callable[[float], ComplexArray]:
        """Lay a path through a map (n,) complex128 along a direction (n,), which is zero at the fixed vertices.

        Returns
        -------
        callable
            From a length t to the map there, in first order ``w + t · direction``. It may raise
            `quasiharmonic.linsolve.NotPositiveDefinite` where rounding leaves no digit of it.
        """
        (p, q), (dp, dq) = self._derivatives(w), self._derivatives(direction)
        angle = rates(self._F, self._g, w, direction).imag
        strain_p, strain_q = dp - 1j * angle * p, dq - 1j * angle * q

        def at(t: float) -> ComplexArray:
            turned = np.exp(1j * t * angle)
            beyond_p = turned * (p + t * strain_p) - (p + t * dp)
            beyond_q = turned * (q + t * strain_q) - (q + t * dq)
            load = self._area * (beyond_p * self._g + beyond_q * self._g.conj())
            return w + t * direction + self._laplacian.respond(self._gathered(load, w.size))

        return at

    def _derivatives(self, w: ComplexArray) -> tuple[ComplexArray, ComplexArray]:
        """``∂w/∂z`` and ``∂w/∂z̄`` on every triangle, (f,) complex128 each."""
        corners = w[self._corners]
        return np.sum(self._g.conj() * corners, axis=0), np.sum(self._g * corners, axis=0)

    def _gathered(self, load: ComplexArray, n: int) -> ComplexArray:
        """Sum up at every vertex (n,) what its corners have, (3, f)."""
        at, load = self._corners.ravel(), load.ravel()
        return np.bincount(at, load.real, minlength=n) + 1j * np.bincount(at, load.imag, minlength=n)
