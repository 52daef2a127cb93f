"""Do a function and its derivative belong together? For everybody who writes an energy of their own.

A derivative is compared with central differences over a range of step widths. Too wide, and the function's
curvature shows; too narrow, and rounding does: in between lies a width that leaves about eight correct digits
if the derivative is right, and hardly one if it is not.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from quasiharmonic.energies.energies import Deformation, Energy
from quasiharmonic.util.arrays import ComplexArray

Array = NDArray[np.inexact]

# Step widths, relative to the size of what is varied.
_WIDTHS = 10.0 ** np.arange(-2, -9, -1)


def derivative_error(
    function: Callable[[Array], ArrayLike], derivative: Callable[[Array, Array], ArrayLike], x: Array, seed: int = 0
) -> float:
    """Compare a derivative with differences of the function along random directions.

    Parameters
    ----------
    function : callable
        From arrays like ``x`` to a number or an array.
    derivative : callable
        From ``x`` and a direction like it to the change of the function along it, to first order: for a
        gradient ``g`` of a real function ``lambda x, d: np.sum(g(x) * d)``, or
        ``np.sum(np.conj(g(x)) * d).real`` where complex numbers stand for pairs of reals.
    x : array, real or complex
        Where.
    seed : int
        Of the directions.

    Returns
    -------
    float
        The largest difference, relative to the largest change, at the best of several step widths; the
        worst of three directions. Below 1e-6 for a derivative that is right and a function that is smooth
        there.

    Examples
    --------
    >>> x = np.array([1.0, 2.0])
    >>> derivative_error(lambda x: np.sum(x**3), lambda x, d: np.sum(3 * x**2 * d), x) < 1e-8
    True
    >>> derivative_error(lambda x: np.sum(x**3), lambda x, d: np.sum(2 * x**2 * d), x) > 0.1
    True
    """
    rng = np.random.default_rng(seed)
    size = max(float(np.abs(x).max(initial=0)), np.finfo(np.float64).tiny)
    worst = 0.0
    for _ in range(3):
        d = rng.standard_normal(x.shape) * size
        direction = d + 1j * rng.standard_normal(x.shape) * size if np.iscomplexobj(x) else d
        claimed = np.asarray(derivative(x, direction))
        errors = []
        for h in _WIDTHS:
            # The widest steps may leave the function's domain; the best width decides.
            with np.errstate(invalid="ignore"):
                change = np.asarray(function(x + h * direction)) - np.asarray(function(x - h * direction))
            found = change / (2 * h)
            errors.append(np.abs(found - claimed).max(initial=0) / max(np.abs(claimed).max(initial=0), 1e-300))
        worst = max(worst, float(np.nanmin(errors)))
    return worst


@dataclass(frozen=True)
class EnergyCheck:
    """What `check_energy` found.

    Attributes
    ----------
    gradient : float
        Relative error of the gradient against differences of the density.
    curvature : float
        Relative error of the curvature (as it is, ``negative=1``) against differences of the gradient; NaN for
        an energy without.
    indefinite : float
        The most negative eigenvalue of the clamped curvature, relative to the largest: 0 up to rounding if
        it is semidefinite, as Newton's method needs it. NaN for an energy without curvature.
    """

    gradient: float
    curvature: float
    indefinite: float

    @property
    def passed(self) -> bool:
        """Whether everything that the energy has is right."""
        return self.gradient < 1e-6 and not (self.curvature >= 1e-6 or self.indefinite >= 1e-12)


def check_energy(energy: Energy, d: Deformation | None = None) -> EnergyCheck:
    """Check an energy's derivatives against differences, and its clamped curvature for being semidefinite.

    Parameters
    ----------
    energy : Energy
    d : Deformation, optional
        Where. By default 100 triangles, turned, stretched and sheared at random and none of them inverted; an
        energy that is tied to a mesh needs one with as many triangles as the mesh.

    Returns
    -------
    EnergyCheck

    Examples
    --------
    >>> from quasiharmonic.energies.energies import MIPS
    >>> check_energy(MIPS()).passed
    True
    """
    at = random_deformation(100) if d is None else d
    x = np.stack([at.p, at.q])

    def density(x: Array) -> ArrayLike:
        return energy.density(Deformation.of(x[0], x[1]))

    def slope(x: Array, dx: Array) -> ArrayLike:
        return np.sum((np.conj(gradient(x)) * dx).real, axis=0)

    def gradient(x: Array) -> ComplexArray:
        return np.stack(energy.gradient(Deformation.of(x[0], x[1])))

    def bend(x: Array, dx: Array) -> ArrayLike:
        return np.stack(energy.curvature(Deformation.of(x[0], x[1]), negative=1.0).apply(dx[0], dx[1]))

    by_gradient = derivative_error(density, slope, x)
    try:
        by_curvature = derivative_error(gradient, bend, x)
        eigenvalues = np.linalg.eigvalsh(energy.curvature(at).matrices())
    except NotImplementedError:
        return EnergyCheck(by_gradient, np.nan, np.nan)
    indefinite = float(np.max(-eigenvalues[:, 0] / np.maximum(eigenvalues[:, 3], np.finfo(np.float64).tiny)))
    return EnergyCheck(by_gradient, by_curvature, indefinite)


def random_deformation(f: int, seed: int = 0) -> Deformation:
    """Draw Jacobians with positive determinants, singular values around 1.

    Parameters
    ----------
    f : int
        How many triangles.
    seed : int
        The same seed, the same Jacobians.

    Returns
    -------
    Deformation
    """
    rng = np.random.default_rng(seed)
    turns = np.exp(2j * np.pi * rng.random((2, f)))
    p = np.exp(0.4 * rng.standard_normal(f))
    q = 0.9 * p * rng.random(f)
    return Deformation.of(p * turns[0], q * turns[1])
