"""Deformation energies of a map, per triangle (§11): density, gradient, projected second derivatives.

On a triangle a map is affine: ``w = p z + q z̄ + const`` in complex numbers, with the Wirtinger derivatives p and q.
Its singular values are ``σ₁ = |p| + |q|`` and ``σ₂ = |p| − |q|``. On an inverted triangle σ₂ is negative. The
determinant is ``det J = |p|² − |q|²``. An *isotropic* energy does not change when the triangle or its image is rotated.
It is a function ``φ(a, b)`` of ``a = |p|²`` and ``b = |q|²``. In (p, q) its second derivative decouples into two
scalars and one 2×2 matrix::

    across p (turning it)      2 φ_a
    across q (turning it)      2 φ_b                                               ┐ four numbers, no
    along p and q              ⎡ 2 φ_a + 4a φ_aa      4 √(ab) φ_ab    ⎤            │ eigensolver
                               ⎣ 4 √(ab) φ_ab         2 φ_b + 4b φ_bb ⎦            ┘ needed

====================  ===================  ============================  ===========
energy                in singular values   φ, with D = det J = a − b     paper
====================  ===================  ============================  ===========
`MIPS`                σ₁/σ₂ + σ₂/σ₁ − 2    4b / D                        §10
`SymmetricDirichlet`  Σ σᵢ² + σᵢ⁻² − 4     2 (D − 1)²/D + 4b (1 + D⁻²)   §3
`ARAP`                Σ (σᵢ − 1)²          2 (√a − 1)² + 2b              E₁, §11.1.1
`AreaPreserving`      (σ₁σ₂ − 1)²          (D − 1)²                      E₂, §11.1.2
`AreaBarrier`         σ₁σ₂ + 1/(σ₁σ₂) − 2  (D − 1)²/D                    E_a, §10.2
`MassSpring`          lengths of sides     in `springs`                  E₃, §11.1.3
====================  ===================  ============================  ===========

All energies are nonnegative and vanish at isometries; MIPS also vanishes at similarities. All but MIPS compare lengths
or areas, so the map must first be scaled to the surface's area. `DeformationEnergy` does this if it is given ``area``.

To add an energy, derive from `Isotropic` (three short functions of a and b) or from `Energy`. Verify its derivatives
with `quasiharmonic.energies.derivatives.check_energy`.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import numpy as np

from quasiharmonic.util.arrays import ComplexArray, FloatArray


@dataclass(frozen=True)
class Deformation:
    """The Jacobian of a map on every triangle, the input of the energies.

    Attributes
    ----------
    p, q : (f,) complex128
        ``∂w/∂z`` and ``∂w/∂z̄``.
    det : (f,) float64
        ``|p|² − |q|²``, as accurately as the caller can compute it. On thin triangles, image area over rest area keeps
        digits that the difference of squares loses.
    """

    p: ComplexArray
    q: ComplexArray
    det: FloatArray

    @classmethod
    def of(cls, p: ComplexArray, q: ComplexArray) -> Deformation:
        """Deformation with determinants computed from p and q."""
        return cls(p, q, (np.abs(p) - np.abs(q)) * (np.abs(p) + np.abs(q)))

    @cached_property
    def a(self) -> FloatArray:
        """``|p|²``."""
        return self.p.real**2 + self.p.imag**2

    @cached_property
    def b(self) -> FloatArray:
        """``|q|²``."""
        return self.q.real**2 + self.q.imag**2


class QuadraticForm(NamedTuple):
    """A quadratic form in (dp, dq) on every triangle, stored as the ten coefficients of a form on ℝ⁴.

    ::

        pp |dp|² + qq |dq|² + Re(p2 dp² + q2 dq² + pq dp dq + pq̄ dp conj(dq))

    Attributes
    ----------
    pp, qq : (f,) float64
    p2, q2, pq, pqc : (f,) complex128
    """

    pp: FloatArray
    qq: FloatArray
    p2: ComplexArray
    q2: ComplexArray
    pq: ComplexArray
    pqc: ComplexArray

    def apply(self, dp: ComplexArray, dq: ComplexArray) -> tuple[ComplexArray, ComplexArray]:
        """Return the form's matrix times (dp, dq), where a complex number stands for a pair of reals."""
        along_p = self.pp * dp + np.conj(self.p2 * dp) + 0.5 * (np.conj(self.pq * dq) + np.conj(self.pqc) * dq)
        along_q = self.qq * dq + np.conj(self.q2 * dq) + 0.5 * (np.conj(self.pq * dp) + self.pqc * dp)
        return along_p, along_q

    def scaled(self, factor: FloatArray) -> QuadraticForm:
        """Return the form multiplied by one factor per triangle, (f,) float64."""
        pp, qq, p2, q2, pq, pqc = self
        return QuadraticForm(factor * pp, factor * qq, factor * p2, factor * q2, factor * pq, factor * pqc)

    def matrices(self) -> FloatArray:
        """Symmetric matrices (f, 4, 4) float64 in the coordinates Re p, Im p, Re q, Im q."""
        columns = []
        for dp, dq in ((1, 0), (1j, 0), (0, 1), (0, 1j)):
            along_p, along_q = self.apply(np.full(self.p2.shape, dp + 0j), np.full(self.p2.shape, dq + 0j))
            columns.append([along_p.real, along_p.imag, along_q.real, along_q.imag])
        return np.moveaxis(np.array(columns), 2, 0)


class Energy(ABC):
    """A deformation energy per unit of rest area.

    Attributes
    ----------
    barrier : bool
        Whether the energy tends to infinity as a triangle collapses. Barrier energies are infinite and have no
        derivatives where ``det J ≤ 0``. Other energies are finite on inverted triangles too.

    See Also
    --------
    polish : Takes an energy.
    harmonise : Takes an energy.
    flatten : Takes an energy.
    quasiharmonic.energies.energies : The energies with a name.

    Examples
    --------
    >>> from quasiharmonic import flatten
    >>> from quasiharmonic.energies.energies import conformal_area_blend
    >>> from quasiharmonic.surfaces import disk
    >>> flatten(*disk(4), energy=conformal_area_blend(0.5)).success
    True
    """

    barrier: bool = False

    @abstractmethod
    def density(self, d: Deformation) -> FloatArray:
        """Energy per unit of rest area.

        Parameters
        ----------
        d : Deformation
            Jacobians of f triangles, as p = ∂w/∂z and q = ∂w/∂z̄.

        Returns
        -------
        (f,) float64
            Dimensionless; ``inf`` outside the energy's domain.
        """

    @abstractmethod
    def gradient(self, d: Deformation) -> tuple[ComplexArray, ComplexArray]:
        """Derivatives of the density with respect to p and q.

        Parameters
        ----------
        d : Deformation

        Returns
        -------
        by_p, by_q : (f,) complex128
            ``∂/∂Re + i ∂/∂Im`` of each.
        """

    def curvature(self, d: Deformation, *, negative: float = 0.0) -> QuadraticForm:
        """Second derivative of the density as a quadratic form in (dp, dq).

        Parameters
        ----------
        d : Deformation
        negative : float
            Factor for negative eigenvalues. 0 clamps them, which makes the form positive semidefinite. -1 takes
            absolute values, which is more robust while the energy is far from quadratic. 1 keeps the second derivative
            unchanged.

        Returns
        -------
        QuadraticForm
            One for each triangle.

        Raises
        ------
        NotImplementedError
            From energies without second derivatives. Use `harmonise` for these; `polish` rejects them.
        """
        raise NotImplementedError(f"{type(self).__name__} has no second derivatives")


class Isotropic(Energy):
    """Base class of energies ``φ(a, b)`` of ``a = |p|²`` and ``b = |q|²``, given by φ and its derivatives.

    Singular values enter as ``σ₁² + σ₂² = 2 (a + b)`` and ``σ₁σ₂ = det = a − b``.

    Examples
    --------
    A neo-Hookean energy, ``σ₁² + σ₂² − 2 − 2 log σ₁σ₂``, which `quasiharmonic.polish` can lower:

    >>> class NeoHookean(Isotropic):
    ...     barrier = True
    ...     def density(self, d):
    ...         return np.where(d.det > 0, 2 * (d.a + d.b - 1 - np.log(np.abs(d.det))), np.inf)
    ...     def density_gradient(self, d):
    ...         return 2 - 2 / d.det, 2 + 2 / d.det
    ...     def density_hessian(self, d):
    ...         return 2 / d.det**2, -2 / d.det**2, 2 / d.det**2
    >>> from quasiharmonic.energies.derivatives import check_energy
    >>> check_energy(NeoHookean()).passed
    True
    """

    @abstractmethod
    def density_gradient(self, d: Deformation) -> tuple[FloatArray, FloatArray]:
        """First derivatives ``φ_a, φ_b``, each (f,) float64."""

    @abstractmethod
    def density_hessian(self, d: Deformation) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Second derivatives ``φ_aa, φ_ab, φ_bb``, each (f,) float64."""

    def gradient(self, d: Deformation) -> tuple[ComplexArray, ComplexArray]:
        """Derivatives of the density with respect to p and q."""
        slope_a, slope_b = self.density_gradient(d)
        return 2 * slope_a * d.p, 2 * slope_b * d.q

    def curvature(self, d: Deformation, *, negative: float = 0.0) -> QuadraticForm:
        """Second derivative of the density as a quadratic form in (dp, dq)."""
        slope_a, slope_b = self.density_gradient(d)
        phi_aa, phi_ab, phi_bb = self.density_hessian(d)
        turn_p, turn_q = 2 * slope_a, 2 * slope_b
        along_p, along_q = turn_p + 4 * d.a * phi_aa, turn_q + 4 * d.b * phi_bb
        turn_p, turn_q = damp(turn_p, negative), damp(turn_q, negative)
        along_p, factor, along_q = _damp_matrices(along_p, 4 * np.sqrt(d.a * d.b) * phi_ab, along_q, negative)
        mixed = 4 * factor * phi_ab
        # Where p or q vanishes, the two eigenvalues are equal, so its direction does not matter.
        to_p: ComplexArray = np.conj(d.p)
        to_q: ComplexArray = np.conj(d.q)
        return QuadraticForm(
            pp=0.5 * (along_p + turn_p),
            qq=0.5 * (along_q + turn_q),
            p2=0.5 * (along_p - turn_p) * inverse(d.a) * to_p**2,
            q2=0.5 * (along_q - turn_q) * inverse(d.b) * to_q**2,
            pq=mixed * to_p * to_q,
            pqc=mixed * to_p * d.q,
        )


def damp(eigenvalue: FloatArray, negative: float) -> FloatArray:
    """Multiply the negative eigenvalues by ``negative``."""
    return np.where(eigenvalue < 0, negative * eigenvalue, eigenvalue)


def _damp_matrices(
    xx: FloatArray, xy: FloatArray, yy: FloatArray, negative: float
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Multiply the negative eigenvalues of symmetric 2×2 matrices by ``negative``.

    Return the first diagonal entry, the factor of the off-diagonal entry, and the second diagonal entry.
    """
    mean, half = 0.5 * (xx + yy), 0.5 * (xx - yy)
    radius = np.sqrt(half**2 + xy**2)
    # Eigenvalues mean ± radius, projectors ½ (1 ± K/radius) with K the traceless part.
    upper, lower = damp(mean + radius, negative), damp(mean - radius, negative)
    centre = 0.5 * (upper + lower)
    off_diagonal = 0.5 * (upper - lower) * inverse(radius)
    return centre + off_diagonal * half, off_diagonal, centre - off_diagonal * half


class MIPS(Isotropic):
    """``σ₁/σ₂ + σ₂/σ₁ − 2``: conformal and scale-invariant (Hormann and Greiner 2000; §10)."""

    barrier = True

    def density(self, d: Deformation) -> FloatArray:
        """``4 b / D``, ``inf`` where D ≤ 0."""
        return _where_positive(d.det, 4 * d.b / _nan_unless_positive(d.det))

    def density_gradient(self, d: Deformation) -> tuple[FloatArray, FloatArray]:
        """``−4b/D², 4a/D²``."""
        scale = 4 / _nan_unless_positive(d.det) ** 2
        return -scale * d.b, scale * d.a

    def density_hessian(self, d: Deformation) -> tuple[FloatArray, FloatArray, FloatArray]:
        """``8b/D³, −4(a + b)/D³, 8a/D³``."""
        scale = 8 / _nan_unless_positive(d.det) ** 3
        return scale * d.b, -0.5 * scale * (d.a + d.b), scale * d.a


class SymmetricDirichlet(Isotropic):
    """``σ₁² + σ₂² + 1/σ₁² + 1/σ₂² − 4``: isometric; shrinking and stretching cost the same."""

    barrier = True

    def density(self, d: Deformation) -> FloatArray:
        """``2 (D − 1)²/D + 4b (1 + D⁻²)``, ``inf`` where D ≤ 0."""
        det = _nan_unless_positive(d.det)
        return _where_positive(d.det, 2 * (det - 1) ** 2 / det + 4 * d.b * (1 + det**-2))

    def density_gradient(self, d: Deformation) -> tuple[FloatArray, FloatArray]:
        """``2 − 2/D² − 8b/D³`` and ``2 + 6/D² + 8b/D³``."""
        det = _nan_unless_positive(d.det)
        shear = 8 * d.b / det**3
        return 2 - 2 / det**2 - shear, 2 + 6 / det**2 + shear

    def density_hessian(self, d: Deformation) -> tuple[FloatArray, FloatArray, FloatArray]:
        """``4/D³ + 24b/D⁴, −12/D³ − 24b/D⁴, 20/D³ + 24b/D⁴``."""
        det = _nan_unless_positive(d.det)
        cubic = 4 / det**3
        shear = 24 * d.b / det**4
        return cubic + shear, -3 * cubic - shear, 5 * cubic + shear


class ARAP(Isotropic):
    """``(σ₁ − 1)² + (σ₂ − 1)²``, as rigid as possible (E₁, §11.1.1).

    The energy uses the signed ``σ₂``, the distance to the nearest *rotation* (Sorkine and Alexa 2007), so inversion
    costs energy. On maps without inverted triangles it equals the paper's E₁ (`UnsignedARAP`).
    """

    def density(self, d: Deformation) -> FloatArray:
        """``2 (√a − 1)² + 2b``."""
        return 2 * (np.sqrt(d.a) - 1) ** 2 + 2 * d.b

    def density_gradient(self, d: Deformation) -> tuple[FloatArray, FloatArray]:
        """``2 − 2/√a, 2``. At p = 0, where the energy has a kink, the first derivative is 2 (``1/√a`` is replaced by
        0).
        """
        return 2 - 2 * inverse(np.sqrt(d.a)), np.full(d.b.shape, 2.0)

    def density_hessian(self, d: Deformation) -> tuple[FloatArray, FloatArray, FloatArray]:
        """``a^(−3/2), 0, 0``."""
        zero = np.zeros(d.b.shape)
        return inverse(np.sqrt(d.a)) ** 3, zero, zero


class UnsignedARAP(Isotropic):
    """``(σ₁ − 1)² + (σ₂ − 1)²`` with ``σ₂ ≥ 0``: E₁ as in §11.1.1.

    The energy is the distance to the nearest orthogonal matrix, reflections included, so a mirrored triangle costs no
    energy. On maps without inverted triangles it equals `ARAP`.
    """

    def density(self, d: Deformation) -> FloatArray:
        """``2 (√c − 1)² + 2e`` with c = max(a, b) and e = min(a, b)."""
        return 2 * (np.sqrt(np.maximum(d.a, d.b)) - 1) ** 2 + 2 * np.minimum(d.a, d.b)

    def density_gradient(self, d: Deformation) -> tuple[FloatArray, FloatArray]:
        """``2 − 2/√c`` by the larger of a and b, and 2 by the smaller. At a = b, a counts as the larger."""
        a_is_larger = d.a >= d.b
        slope = 2 - 2 * inverse(np.sqrt(np.maximum(d.a, d.b)))
        return np.where(a_is_larger, slope, 2.0), np.where(a_is_larger, 2.0, slope)

    def density_hessian(self, d: Deformation) -> tuple[FloatArray, FloatArray, FloatArray]:
        """``c^(−3/2)`` by the larger of a and b, otherwise zeros."""
        a_is_larger = d.a >= d.b
        second = inverse(np.sqrt(np.maximum(d.a, d.b))) ** 3
        return np.where(a_is_larger, second, 0.0), np.zeros(d.b.shape), np.where(a_is_larger, 0.0, second)


class AreaPreserving(Isotropic):
    """``(σ₁σ₂ − 1)²`` (E₂, §11.1.2)."""

    def density(self, d: Deformation) -> FloatArray:
        """``(D − 1)²``."""
        return (d.det - 1) ** 2

    def density_gradient(self, d: Deformation) -> tuple[FloatArray, FloatArray]:
        """``2 (D − 1), −2 (D − 1)``."""
        slope = 2 * (d.det - 1)
        return slope, -slope

    def density_hessian(self, d: Deformation) -> tuple[FloatArray, FloatArray, FloatArray]:
        """``2, −2, 2``."""
        two = np.full(d.det.shape, 2.0)
        return two, -two, two


class AreaBarrier(Isotropic):
    """``det J + 1/det J − 2``: area-preserving, infinite at collapse (E_a of Garanzha et al. 2021; §10.2)."""

    barrier = True

    def density(self, d: Deformation) -> FloatArray:
        """``(D − 1)²/D``, ``inf`` where D ≤ 0."""
        det = _nan_unless_positive(d.det)
        return _where_positive(d.det, (det - 1) ** 2 / det)

    def density_gradient(self, d: Deformation) -> tuple[FloatArray, FloatArray]:
        """``1 − 1/D²`` and its negative."""
        slope = 1 - _nan_unless_positive(d.det) ** -2.0
        return slope, -slope

    def density_hessian(self, d: Deformation) -> tuple[FloatArray, FloatArray, FloatArray]:
        """``2/D³, −2/D³, 2/D³``."""
        second = 2 * _nan_unless_positive(d.det) ** -3.0
        return second, -second, second


class Combination(Isotropic):
    """A weighted sum of isotropic energies, with the second derivative of the sum projected as a whole.

    Parameters
    ----------
    *terms : (float, Isotropic)
        Positive factors and energies.
    """

    def __init__(self, *terms: tuple[float, Isotropic]) -> None:
        self.terms = terms
        self.barrier = any(energy.barrier for _, energy in terms)

    def density(self, d: Deformation) -> FloatArray:
        """Weighted sum of the densities."""
        return np.sum([factor * energy.density(d) for factor, energy in self.terms], axis=0)

    def density_gradient(self, d: Deformation) -> tuple[FloatArray, FloatArray]:
        """Weighted sums of the first derivatives."""
        a, b = np.sum([factor * np.stack(energy.density_gradient(d)) for factor, energy in self.terms], axis=0)
        return a, b

    def density_hessian(self, d: Deformation) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Weighted sums of the second derivatives."""
        aa, ab, bb = np.sum([factor * np.stack(energy.density_hessian(d)) for factor, energy in self.terms], axis=0)
        return aa, ab, bb


class Hardened(Isotropic):
    """``E + k E³`` of an energy E: few triangles with a large energy are worse than many.

    Parameters
    ----------
    base : Isotropic
        The energy E, not negative.
    k : float
        At least 0.
    linear_from : float
        Where E exceeds this positive value, the energy is continued by its tangent as a function of E. A few triangles
        that cannot get better then matter less.
    """

    def __init__(self, base: Isotropic, k: float, linear_from: float = np.inf) -> None:
        self.base, self.k, self.linear_from = base, k, linear_from
        self.barrier = base.barrier

    def density(self, d: Deformation) -> FloatArray:
        """``E + k E³``, or its tangent."""
        e = self.base.density(d)
        least = np.minimum(e, self.linear_from)
        hardened = e + self.k * (least * least * least)
        if self.linear_from < np.inf:
            hardened = hardened + 3 * self.k * self.linear_from**2 * np.maximum(e - self.linear_from, 0)
        return hardened

    def density_gradient(self, d: Deformation) -> tuple[FloatArray, FloatArray]:
        """``(1 + 3k E²) dE``."""
        by_a, by_b = self.base.density_gradient(d)
        factor = 1 + 3 * self.k * np.minimum(self.base.density(d), self.linear_from) ** 2
        return factor * by_a, factor * by_b

    def density_hessian(self, d: Deformation) -> tuple[FloatArray, FloatArray, FloatArray]:
        """``(1 + 3k E²) d²E + 6k E dE²``."""
        e, (by_a, by_b) = self.base.density(d), self.base.density_gradient(d)
        aa, ab, bb = self.base.density_hessian(d)
        factor = 1 + 3 * self.k * np.minimum(e, self.linear_from) ** 2
        # Squares of large slopes overflow, so the slopes are dropped where the energy is linear in E.
        linear = e > self.linear_from
        by_a, by_b, square = (np.where(linear, 0.0, part) for part in (by_a, by_b, 6 * self.k * e))
        return factor * aa + square * by_a**2, factor * ab + square * by_a * by_b, factor * bb + square * by_b**2


def conformal_area_blend(theta: float = 1 / 128) -> Combination:
    """``(1 − θ) MIPS + θ E_a``: the energy of Garanzha et al. (§10.2), by default with their θ.

    MIPS alone does not bound the scale of the map. The small area term does.

    Parameters
    ----------
    theta : float
        Weight θ of the area term ``E_a = D + 1/D − 2``, from 0 to 1.

    Returns
    -------
    Combination

    Raises
    ------
    ValueError
        When θ is not in [0, 1].
    """
    if not 0 <= theta <= 1:
        raise ValueError(f"theta must be between 0 and 1, not {theta}")
    return Combination((1 - theta, MIPS()), (theta, AreaBarrier()))


def _nan_unless_positive(det: FloatArray) -> FloatArray:
    """Return the determinants, with NaN where they are not positive."""
    return np.where(det > 0, det, np.nan)


def _where_positive(det: FloatArray, value: FloatArray) -> FloatArray:
    return np.where(det > 0, value, np.inf)


def inverse(x: FloatArray) -> FloatArray:
    """``1/x`` where x is positive, otherwise 0."""
    return np.where(x > 0, 1 / np.where(x > 0, x, 1), 0.0)
