"""Fits of a chart's map to targets of its triangles: rotations, or the nearest derivatives with little stretch.

A fit minimises ``Σ area (|p − P|² + |q − Q|²)`` for the complex derivatives p and q of the map in each triangle and
targets P and Q. This is the global step of ARAP [1]_. All fits of a chart have one unknown per vertex and the same
matrix, the cotangent Laplacian, which is factored once. A fit does not prevent inverted triangles.

References
----------
.. [1] L. Liu, L. Zhang, Y. Xu, C. Gotsman, S. J. Gortler, A local/global approach to mesh parameterization. Computer
   Graphics Forum 27 (2008).
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from quasiharmonic.linsolve.laplacian import Laplacian
from quasiharmonic.util.arrays import ComplexArray, FloatArray, IntArray, sum_at


class FitTuning(NamedTuple):
    """Numbers that tune successive fits of a map."""

    # Largest number of fits.
    most_fits: int = 16
    # The aim counts as reached if at most this part of the free share exceeds it: repairs may stretch a little more.
    enough: float = 0.5


FIT_TUNING = FitTuning()


class Fits:
    """The system of all fits of one chart.

    Parameters
    ----------
    F : (f, 3) int64
        Triangles of a connected surface.
    g : (3, f) complex128
        As in `NewtonSystem`.

    Raises
    ------
    quasiharmonic.linsolve.NotPositiveDefinite
        If the matrix is not positive definite after rounding.
    """

    def __init__(self, F: IntArray, g: ComplexArray) -> None:
        self._corners, self._g, self._n = np.ascontiguousarray(F.T), g, int(F.max()) + 1
        # Up to a factor, which all terms have.
        self.area: FloatArray = 1 / np.abs((g[1].conj() * g[2]).imag)
        self._total = float(self.area.sum())
        stiffness = 2 * self.area * (g * g[(1, 2, 0), :].conj()).real
        self._factored = Laplacian(F, self._n, np.array([0])).factor(stiffness)

    def derivatives(self, w: ComplexArray) -> tuple[ComplexArray, ComplexArray]:
        """Complex derivatives p and q (f,) of a map (n,)."""
        at = w[self._corners]
        return (self._g.conj() * at).sum(axis=0), (self._g * at).sum(axis=0)

    def share_over(self, p: ComplexArray, q: ComplexArray, aim: float) -> float:
        """Share of the area that is inverted or stretched beyond the aim, after scaling the map to the area."""
        larger, smaller = singular_values(p, q)
        with np.errstate(all="ignore"):
            scale = np.sqrt(self._total / (self.area * larger * smaller).sum())
            good = (larger * scale < aim) & (smaller * scale * aim > 1)
        return float(self.area[~good].sum() / self._total)

    def place(self, p: ComplexArray, q: ComplexArray) -> ComplexArray:
        """Return the map (n,) whose derivatives fit p and q (f,) best; vertex 0 is at 0."""
        load = self.area * (p * self._g + q * self._g.conj())
        return self._factored.respond(sum_at(self._corners.ravel(), load.ravel(), self._n))


def singular_values(p: ComplexArray, q: ComplexArray) -> tuple[FloatArray, FloatArray]:
    """Larger and smaller singular value (f,); the smaller one of an inverted triangle is negative."""
    first, second = np.abs(p), np.abs(q)
    return first + second, first - second


def limit_stretch(p: ComplexArray, q: ComplexArray, most: float) -> tuple[ComplexArray, ComplexArray]:
    """Return the nearest derivatives with singular values from ``1 / most`` to ``most``; with 1, the rotations."""
    larger, smaller = (np.clip(values, 1 / most, most) for values in singular_values(p, q))
    return 0.5 * (larger + smaller) * direction(p), 0.5 * (larger - smaller) * direction(q)


def direction(p: ComplexArray) -> ComplexArray:
    """Return ``p / |p|``, or 0."""
    return p / np.maximum(np.abs(p), np.finfo(np.float64).tiny)
