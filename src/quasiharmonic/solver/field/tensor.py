"""Tensor fields: from one complex number per triangle to an elliptic tensor of determinant one, with derivatives (§8).

    ξ ──r──▶ μ = r(|ξ|) ξ/|ξ|  ──eq. 33──▶  𝒜 = c·I − [[Re w, Im w], [Im w, −Re w]]

with ``c = (1 + |μ|²)/(1 − |μ|²)`` and ``w = 2μ/(1 − |μ|²)``. Every ξ gives a positive definite tensor, so the search
over ξ is unconstrained.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import ArrayLike

from quasiharmonic.util.arrays import ComplexArray, FloatArray, convert_array, reject

# Replaces a divisor of zero whose dividend is zero too, to avoid NaN.
_TINY = 1e-300
# Largest |ξ| of the parameterisation tanh; above it the rounded tensor is not positive definite.
TANH_BOUND = 8.8


@dataclass(frozen=True)
class Parameterisation:
    """The sigmoid ``r`` that maps ξ to the Beltrami coefficient μ (§8.2).

    Attributes
    ----------
    name : str
        Name in the user interface.
    number : int
        Number in the kernels: its index in `PARAMETERISATIONS`.
    bound : float
        Largest ``|ξ|`` at which the tensor, rounded to doubles, is still safely positive definite.
    radial : callable
        ``ρ ↦ (r/ρ, 1 − r², r')`` elementwise, with limits at ρ = 0.
    inverse : callable
        ``r ↦ ρ`` elementwise.
    second_derivative : callable
        ``ρ ↦ r''`` elementwise.
    """

    name: str
    number: int
    bound: float
    radial: Callable[[FloatArray], tuple[FloatArray, FloatArray, FloatArray]]
    inverse: Callable[[FloatArray], FloatArray]
    second_derivative: Callable[[FloatArray], FloatArray]

    def field(self, xi: ComplexArray) -> TensorField:
        """Return the tensor field of ξ (f,) complex128."""
        return TensorField(xi, self)

    def invert(self, mu: ComplexArray) -> ComplexArray:
        """Return the ξ of Beltrami coefficients (f,) complex128, clipped where ``|μ| ≥ 1`` or ξ exceeds the bound."""
        modulus = np.sqrt(mu.real**2 + mu.imag**2)
        safe = np.where(modulus > 0, modulus, 1.0)
        rho = self.inverse(np.minimum(modulus, np.nextafter(1.0, 0.0)))
        return np.minimum(rho, self.bound) / safe * mu


@dataclass(frozen=True)
class TensorField:
    """The tensor 𝒜 of every triangle, and the quantities for its derivatives, computed on demand.

    Attributes
    ----------
    xi, mu : (f,) complex128
        The variable and the Beltrami coefficient.
    rho, ratio, defect, slope : (f,) float64
        ``|ξ|``, ``r/ρ``, ``1 − |μ|²`` (accurate even if ``|μ|`` rounds to 1) and ``r'``.
    """

    xi: ComplexArray
    parameterisation: Parameterisation

    def __getitem__(self, part: slice) -> TensorField:
        """Return the field on a range of triangles."""
        return TensorField(self.xi[part], self.parameterisation)

    @cached_property
    def _square(self) -> FloatArray:
        return self.xi.real**2 + self.xi.imag**2

    @cached_property
    def rho(self) -> FloatArray:
        return np.sqrt(self._square)

    @cached_property
    def _radial(self) -> tuple[FloatArray, FloatArray, FloatArray]:
        return self.parameterisation.radial(self.rho)

    @property
    def ratio(self) -> FloatArray:
        return self._radial[0]

    @property
    def defect(self) -> FloatArray:
        return self._radial[1]

    @property
    def slope(self) -> FloatArray:
        return self._radial[2]

    @cached_property
    def mu(self) -> ComplexArray:
        return self.ratio * self.xi

    def entries(self) -> FloatArray:
        """Return the tensors (eq. 33) without the area factor: rows a11, a12, a22 of (3, f) float64."""
        a = np.empty((3, self.mu.size))
        double = 2.0 / self.defect
        real = double * self.mu.real
        np.subtract(double, 1.0, out=a[2])
        np.subtract(a[2], real, out=a[0])
        a[2] += real
        np.multiply(double, -self.mu.imag, out=a[1])
        return a

    def pull_twist(self, by_c: FloatArray, by_w: ComplexArray) -> ComplexArray:
        """Return the gradient in μ from the derivatives by c and w: apply the transpose of d(c, w)/dμ.

        All are (f,); gradients in complex numbers are ``∂/∂Re + i ∂/∂Im``.
        """
        # c = 2/D − 1 and w = 2μ/D with D = 1 − |μ|², so dD = −2 Re(μ̄ dμ).
        double = 2.0 / self.defect
        inner = by_c + (np.conj(self.mu) * by_w).real
        return double * (by_w + double * inner * self.mu)

    def pull(self, gradient: ComplexArray) -> ComplexArray:
        """Return the gradient in ξ from the gradient in μ: apply the transpose of dμ/dξ, which is symmetric."""
        # If ρ² is zero, only the division needs protection: the dividend is zero too.
        radial = (self.slope - self.ratio) / np.maximum(self._square, _TINY)
        radial *= (self.xi.conj() * gradient).real
        out: ComplexArray = self.ratio * gradient
        out += radial * self.xi
        return out


def beltrami_coefficients(mu: ArrayLike | None, f: int) -> ComplexArray:
    """Check the Beltrami coefficients of ``f`` tensors and return them as complex128; zeros for None.

    Raises
    ------
    ValueError
        If the shape is wrong, the values are not numbers, or a modulus is not below 1; names the first triangles.
    """
    coefficients = np.zeros(f) if mu is None else convert_array("mu", mu)
    if coefficients.shape != (f,) or coefficients.dtype.kind not in "iufc":
        raise ValueError(f"mu must contain {f} numbers, one for each triangle, not an array of {coefficients.shape}")
    reject(~(np.abs(coefficients) < 1), "triangle", "triangles", "mu is not below 1 in modulus at {}")
    return coefficients.astype(np.complex128)


def own_tensor(p: ComplexArray, q: ComplexArray) -> ComplexArray:
    """Return the μ (f,) that minimises V₃ for a fixed map with the derivatives p, q (f,) (eq. 39).

    The energy ``2m |q − μp|² / (1 − |μ|²)`` of a triangle is least at its own Beltrami coefficient ``μ = q/p`` if it is
    positive, and at ``conj(p/q)`` if it is inverted. The minima are 0 and twice the inverted area. The modulus is 1 for
    degenerate triangles. μ is 0 if the image is a point, or too small to divide by.
    """
    inverted = np.abs(q) > np.abs(p)
    small, large = np.where(inverted, p.conj(), q), np.where(inverted, q.conj(), p)
    return np.divide(small, large, out=np.zeros_like(p), where=np.abs(large) >= np.finfo(np.float64).tiny)


def _radial_tanh(rho: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
    decay = np.exp(-2.0 * rho)
    defect = 4.0 * decay
    decay += 1.0
    decay *= decay
    defect /= decay
    rho = np.maximum(rho, _TINY)
    return np.tanh(rho) / rho, defect, defect


def _radial_si_log(rho: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
    log = np.log1p(rho)
    omega = 1.0 / (1.0 + log)
    ratio = np.where(rho > 0, log * omega / np.maximum(rho, _TINY), 1.0)
    return ratio, omega * (2.0 - omega), omega**2 / (1.0 + rho)


def _second_derivative_tanh(rho: FloatArray) -> FloatArray:
    return -2.0 * np.tanh(rho) * _radial_tanh(rho)[1]


def _second_derivative_si_log(rho: FloatArray) -> FloatArray:
    omega = 1.0 / (1.0 + np.log1p(rho))
    return -((omega / (1.0 + rho)) ** 2) * (1.0 + 2.0 * omega)


def _invert_si_log(r: FloatArray) -> FloatArray:
    # The largest double r below 1 would give ρ = e^(2⁵³).
    with np.errstate(over="ignore"):
        return np.expm1(r / (1.0 - r))


# For tanh the eigenvalues of 𝒜 are e^{±2ρ}, and its entries have rounding errors of e^{2ρ} · 1e-16. Beyond ρ = 9 the
# smaller eigenvalue is lost. For si-log the bound keeps |ξ|² finite and corresponds to |μ| = 0.997; maps with more
# distortion need tanh.
TANH = Parameterisation("tanh", 0, TANH_BOUND, _radial_tanh, np.arctanh, _second_derivative_tanh)
SI_LOG = Parameterisation("si-log", 1, 1e150, _radial_si_log, _invert_si_log, _second_derivative_si_log)
PARAMETERISATIONS = {p.name: p for p in (TANH, SI_LOG)}


def parameterisation_of(number: int) -> Parameterisation:
    """Return the parameterisation with this number."""
    return (TANH, SI_LOG)[number]
