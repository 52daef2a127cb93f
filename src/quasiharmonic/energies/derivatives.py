"""Derivative checks for functions and energies, for authors of user-defined energies.

A derivative is compared with central differences over a range of step widths. Wide steps show the function's higher
derivatives; narrow steps show rounding errors. At the best width a correct derivative agrees to about eight digits, a
wrong one to hardly one.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from quasiharmonic.energies.energies import Deformation, Energy
from quasiharmonic.util.arrays import ComplexArray

Array = NDArray[np.inexact]


def derivative_error(
    function: Callable[[Array], ArrayLike], derivative: Callable[[Array, Array], ArrayLike], x: Array, seed: int = 0
) -> float:
    """Compare a derivative with differences of the function along random directions.

    Parameters
    ----------
    function : callable
        Takes an array like ``x`` and returns a number or an array.
    derivative : callable
        Takes ``x`` and a direction like ``x`` and returns the directional derivative of the function. For a gradient
        ``g`` of a real function: ``lambda x, d: np.sum(g(x) * d)``. If complex numbers stand for pairs of reals:
        ``np.sum(np.conj(g(x)) * d).real``.
    x : array, real or complex
        Point of evaluation.
    seed : int
        Seed of the random directions.

    Returns
    -------
    float
        The largest difference relative to the largest derivative, at the best step width, for the worst of three
        directions. Below 1e-6 for a correct derivative of a function that is smooth at ``x``.

    Examples
    --------
    >>> x = np.array([1.0, 2.0])
    >>> derivative_error(lambda x: np.sum(x**3), lambda x, d: np.sum(3 * x**2 * d), x) < 1e-8
    True
    >>> derivative_error(lambda x: np.sum(x**3), lambda x, d: np.sum(2 * x**2 * d), x) > 0.1
    True
    """
    # Step widths, relative to the size of ``x``.
    widths = 10.0 ** np.arange(-2, -9, -1)
    rng = np.random.default_rng(seed)
    size = max(float(np.abs(x).max(initial=0)), np.finfo(np.float64).tiny)
    worst = 0.0
    for _ in range(3):
        d = rng.standard_normal(x.shape) * size
        direction = d + 1j * rng.standard_normal(x.shape) * size if np.iscomplexobj(x) else d
        claimed = np.asarray(derivative(x, direction))
        errors = []
        for h in widths:
            # The widest steps may leave the function's domain; the best width decides.
            with np.errstate(invalid="ignore"):
                change = np.asarray(function(x + h * direction)) - np.asarray(function(x - h * direction))
            found = change / (2 * h)
            errors.append(np.abs(found - claimed).max(initial=0) / max(np.abs(claimed).max(initial=0), 1e-300))
        worst = max(worst, float(np.nanmin([*errors, np.inf])))
    return worst


@dataclass(frozen=True)
class EnergyCheck:
    """Result of `check_energy`.

    Attributes
    ----------
    gradient : float
        Relative error of the gradient against differences of the density.
    curvature : float
        Relative error of the curvature (with ``negative=1``) against differences of the gradient; NaN for an energy
        without curvature.
    indefinite : float
        Minus the least eigenvalue of the clamped curvature, relative to the largest. Newton's method needs a
        semidefinite form, for which this is at most 0 up to rounding. NaN for an energy without curvature.
    """

    gradient: float
    curvature: float
    indefinite: float

    @property
    def passed(self) -> bool:
        """Whether all derivatives that the energy has are correct."""
        return self.gradient < 1e-6 and not (self.curvature >= 1e-6 or self.indefinite >= 1e-12)


def check_energy(energy: Energy, d: Deformation | None = None) -> EnergyCheck:
    """Compare an energy's derivatives with differences, and check that its clamped curvature is semidefinite.

    Parameters
    ----------
    energy : Energy
    d : Deformation, optional
        Jacobians for the check. By default 100 triangles, rotated, stretched and sheared at random, without inversions.
        An energy tied to a mesh needs as many triangles as the mesh has.

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

    def gradient_along(x: Array, dx: Array) -> ArrayLike:
        return np.sum((np.conj(gradient(x)) * dx).real, axis=0)

    def gradient(x: Array) -> ComplexArray:
        return np.stack(energy.gradient(Deformation.of(x[0], x[1])))

    def curvature_along(x: Array, dx: Array) -> ArrayLike:
        return np.stack(energy.curvature(Deformation.of(x[0], x[1]), negative=1.0).apply(dx[0], dx[1]))

    by_gradient = derivative_error(density, gradient_along, x)
    try:
        by_curvature = derivative_error(gradient, curvature_along, x)
        eigenvalues = np.linalg.eigvalsh(energy.curvature(at).matrices())
    except NotImplementedError:
        return EnergyCheck(by_gradient, np.nan, np.nan)
    indefinite = float(np.max(-eigenvalues[:, 0] / np.maximum(eigenvalues[:, 3], np.finfo(np.float64).tiny)))
    return EnergyCheck(by_gradient, by_curvature, indefinite)


def random_deformation(f: int, seed: int = 0) -> Deformation:
    """Draw random Jacobians of ``f`` triangles, with positive determinants and singular values around 1."""
    rng = np.random.default_rng(seed)
    turns = np.exp(2j * np.pi * rng.random((2, f)))
    p = np.exp(0.4 * rng.standard_normal(f))
    q = 0.9 * p * rng.random(f)
    return Deformation.of(p * turns[0], q * turns[1])
