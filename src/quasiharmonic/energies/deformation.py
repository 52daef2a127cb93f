"""A deformation energy integrated over a surface, as a function of the map (§11).

The value is the mean density, weighted by area and optionally by triangle, after scaling the map to the surface's area:
``E(w) = Σⱼ cⱼ mⱼ φ(pⱼ, qⱼ) / Σⱼ mⱼ``.
"""

from __future__ import annotations

from copy import copy
from functools import cache

import numpy as np
from numpy.typing import ArrayLike, NDArray

from quasiharmonic.energies.energies import (
    ARAP,
    MIPS,
    AreaBarrier,
    Combination,
    Deformation,
    Energy,
    Hardened,
    Isotropic,
    QuadraticForm,
    SymmetricDirichlet,
)
from quasiharmonic.geometry.mesh.reference import blocks, rest_shapes
from quasiharmonic.util.arrays import (
    ComplexArray,
    FloatArray,
    IntArray,
    check_range,
    names_of,
    own_triangles,
    real_array,
    reject,
)
from quasiharmonic.util.kernels import compiled

# For singular values between this and its inverse, no energy should overflow.
_EXTREME_STRETCH = 1e20
# Energies with a relative difference of at most this are equal.
_EQUAL = 1e-6


class DeformationEnergy:
    """A deformation energy on a mesh.

    Parameters
    ----------
    V : (n, 2) or (n, 3) array
        Rest positions. The rest shapes have no sign: a planar mesh is treated as a surface seen from the side on which
        its triangles are counterclockwise.
    F : (f, 3) array of int
        Triangles.
    energy : Energy
    area : float, optional
        Area of the maps to be measured. p and q are multiplied by ``√(Σ m / area)``, which scales maps to the surface's
        area as in the paper. The area is constant while the boundary is fixed. By default maps are not scaled.
    weights : (f,) array, optional
        Nonnegative factor for each triangle's energy; 1 by default.
    rest_F : (f, 3) array of int, optional
        Rows of ``V`` that give the rest position of each triangle; by default ``F``. Rest triangles need not fit
        together.

    Raises
    ------
    ValueError
        When a rest triangle has no area, so that its distortion is undefined; when weights have the wrong shape or are
        negative or not finite; when ``area`` is not positive.

    Attributes
    ----------
    g : (3, f) complex128
        Half the gradients of the hat functions, scaled: ``p = Σ conj(gᵢ) wᵢ`` and ``q = Σ gᵢ wᵢ``.
    share : (f,) float64
        ``cⱼ mⱼ / Σ m``.
    """

    def __init__(
        self,
        V: ArrayLike,
        F: ArrayLike,
        energy: Energy,
        *,
        area: float | None = None,
        weights: ArrayLike | None = None,
        rest_F: ArrayLike | None = None,
    ) -> None:
        self.energy = energy
        self.F = own_triangles(F)
        self._vertex_count = int(self.F.max(initial=-1)) + 1
        check_range("F", self.F, self._vertex_count)
        shapes = rest_shapes(V, self.F if rest_F is None else np.asarray(rest_F, dtype=np.int64))
        shapes.check_areas("distortion is undefined there")
        if area is not None and not 0 < area < np.inf:
            raise ValueError(f"the area of the map must be positive, not {area}")
        total = float(shapes.m.sum())
        scale = 1 / shapes.unit if area is None else float(np.sqrt(total / area))
        self.g: ComplexArray = scale * shapes.half_gradients()
        self.share: FloatArray = shapes.m / total
        if weights is not None:
            array = _weight_array(weights, len(self.F))
            bad = ~((array >= 0) & (array < np.inf))
            reject(bad, "triangle", "triangles", "the weight is negative or not finite at {}")
            self.share = self.share * array
        self._det_per_area = scale**2 / shapes.m

    def with_density(self, energy: Energy) -> DeformationEnergy:
        """Return an energy of the same triangles with the same weights and another density."""
        other = copy(self)
        other.energy = energy
        return other

    def with_references(
        self, energy: Energy, s: ComplexArray, c: ComplexArray, det: FloatArray, share: FloatArray
    ) -> DeformationEnergy:
        """Return an energy of the same triangles with weights ``share`` (f,), measured against other rest shapes.

        The new rest shape of each triangle is the image of the old one under ``s z + c z̄``, s and c (f,) complex128.
        It has ``det`` (f,) times the old area.
        """
        other = self.with_density(energy)
        other.share = share
        other.g = (s * self.g - c * self.g.conj()) / det
        other._det_per_area = self._det_per_area / det
        return other

    def restrict(self, triangles: IntArray, F: IntArray, energy: Energy) -> DeformationEnergy:
        """Return the energy of some triangles (k,) with other vertex numbers ``F`` (k, 3) and another density.

        Their weights do not change, so values of both energies with the same density differ by the other triangles.
        """
        part = self.with_density(energy)
        part.F, part._vertex_count = own_triangles(F), int(F.max(initial=-1)) + 1
        part.g, part.share = np.ascontiguousarray(self.g[:, triangles]), self.share[triangles]
        part._det_per_area = self._det_per_area[triangles]
        return part

    def deform(self, w: ComplexArray) -> Deformation:
        """Jacobian of a map ``w = u + i v`` (n,) complex128 on every triangle.

        Determinants are computed from the areas of the images. If an area is not larger than its rounding error, it is
        replaced by that error. The determinant is then positive and a barrier energy is huge; the caller must certify
        the map.
        """
        self._check_positions(w.size)
        f = len(self.F)
        p, q, det = np.empty(f, dtype=np.complex128), np.empty(f, dtype=np.complex128), np.empty(f)
        jacobians(w, self.F, self.g, self._det_per_area, p, q, det)
        return Deformation(p, q, det)

    def value(self, w: ComplexArray) -> float:
        """Mean energy of a map; ``inf`` where the energy is a barrier and a triangle is inverted."""
        return self.value_of(self.deform(w))

    def value_of(self, d: Deformation) -> float:
        """Mean energy of a given deformation."""
        mixture = mixture_of(self.energy, "density")
        if mixture is None:
            return float(np.sum(self.share * self.energy.density(d)))
        return mixed_energy(mixture, d.p, d.q, d.det, self.share)

    def is_scale_free(self, w: ComplexArray) -> bool:
        """Whether the energy of a map (n,) does not depend on its scale."""
        here, doubled = self.value(w), self.value(2 * w)
        return abs(doubled - here) <= _EQUAL * here

    def gradient(self, w: ComplexArray) -> ComplexArray:
        """Derivative with respect to the positions, ``∂E/∂u + i ∂E/∂v`` at every vertex; (n,) complex128."""
        return self.gradient_of(self.deform(w), w.size)

    def gradient_of(self, d: Deformation, n: int) -> ComplexArray:
        """Derivative with respect to ``n`` positions, for a given deformation."""
        mixture = mixture_of(self.energy, "density_gradient", "gradient")
        if mixture is None:
            slopes = (np.broadcast_to(by, d.p.shape) for by in self.energy.gradient(d))
            by_p, by_q = (np.ascontiguousarray(by, dtype=np.complex128) for by in slopes)
        else:
            by_p, by_q = np.empty_like(d.p), np.empty_like(d.q)
            mixed_slopes(mixture, d.p, d.q, d.det, by_p, by_q)
        self._check_positions(n)
        gradient = np.empty(n, dtype=np.complex128)
        pulls(by_p, by_q, self.share, self.F, self.g, gradient)
        return gradient

    def curvature_of(self, d: Deformation, *, negative: float = 0.0) -> QuadraticForm:
        """Second derivatives by (p, q) on every triangle, weighted; ``negative`` as in `Energy.curvature`."""
        mixture = mixture_of(self.energy, "density_gradient", "density_hessian", "curvature")
        if mixture is None:
            return self.energy.curvature(d, negative=negative).scaled(self.share)
        return curvature_of_mixture(mixture, d, self.share, negative)

    def check_numbers(self, d: Deformation, *, second: bool = True) -> None:
        """Raise a ValueError if the energy or a derivative is NaN or infinite on triangles without extreme stretch.

        The message names the quantity and the triangles. Second derivatives are checked if ``second``.
        """
        larger, det = np.abs(d.p) + np.abs(d.q), d.det if self.energy.barrier else np.abs(d.det)
        ordinary = (larger < _EXTREME_STRETCH) & (larger > 1 / _EXTREME_STRETCH) & (det > larger / _EXTREME_STRETCH)
        with np.errstate(all="ignore"):
            found = {"energy": (self.energy.density(d),), "first derivative": self.energy.gradient(d)}
            if second:
                found["second derivative"] = self.energy.curvature(d, negative=1.0)
        for what, parts in found.items():
            wrong, not_a_number = np.zeros((2, len(self.F)), dtype=bool)
            for part in parts:
                wrong |= ~np.isfinite(part)
                not_a_number |= np.isnan(part)
            bad = np.flatnonzero(wrong & ordinary)
            if bad.size:
                where = names_of("triangle", "triangles", bad)
                kind = "NaN" if not_a_number[bad[0]] else "infinite"
                raise ValueError(
                    f"{type(self.energy).__name__}: the {what} is {kind} at {where}, "
                    f"where |p| = {abs(d.p[bad[0]]):.6g} and |q| = {abs(d.q[bad[0]]):.6g} at the first; "
                    "check an energy with quasiharmonic.energies.derivatives.check_energy"
                )

    def steps_to_collapse(self, w: ComplexArray, direction: ComplexArray) -> FloatArray:
        """Smallest positive step along a direction at which each triangle's area vanishes; (f,) float64.

        The area of ``w + t · direction`` is a quadratic in t. Its first positive root is computed with the form of the
        quadratic formula that avoids cancellation. The step is ``inf`` where the area never vanishes, and where the
        computed area of ``w`` is not positive because of rounding. In the latter case only the exact test detects an
        inversion.
        """
        self._check_positions(min(w.size, direction.size))
        first = np.empty(len(self.F))
        collapses(w, direction, self.F, first)
        return first

    def _check_positions(self, n: int) -> None:
        """Raise a ValueError unless ``n`` positions cover all vertices of the triangles."""
        if n < self._vertex_count:
            raise ValueError(
                f"the triangles refer to vertex {self._vertex_count - 1}, but there are only {n} positions"
            )


@compiled
def jacobians(
    w: ComplexArray,
    F: IntArray,
    g: ComplexArray,
    det_per_area: FloatArray,
    p: ComplexArray,
    q: ComplexArray,
    det: FloatArray,
) -> None:
    """Fill ``p``, ``q`` and ``det`` for a map ``w`` (n,); see `DeformationEnergy.deform`."""
    for part in blocks(len(F)):
        d1, d2 = _edges(F[part].T, w)
        left, right = d1.real * d2.imag, d1.imag * d2.real
        area, noise = left - right, 2.0**-51 * (np.abs(left) + np.abs(right))
        area = 0.5 * np.where(np.abs(area) <= noise, noise, area)
        g1, g2 = g[1:, part]
        p[part] = d1 * g1.conj() + d2 * g2.conj()
        q[part] = d1 * g1 + d2 * g2
        det[part] = area * det_per_area[part]


@compiled
def pulls(
    by_p: ComplexArray, by_q: ComplexArray, share: FloatArray, F: IntArray, g: ComplexArray, gradient: ComplexArray
) -> None:
    """Fill ``gradient`` (n,) with the derivative by the positions of a sum over triangles.

    The terms have the derivatives ``by_p`` and ``by_q``, multiplied by ``share``.
    """
    x, y = np.empty((2, *g.shape))
    for part in blocks(len(F)):
        along_p, along_q, here = share[part] * by_p[part], share[part] * by_q[part], g[:, part]
        pull = along_p * here + along_q * here.conj()
        x[:, part], y[:, part] = pull.real, pull.imag
    at, n = F.T.ravel(), gradient.size
    gradient.real, gradient.imag = np.bincount(at, x.ravel(), minlength=n), np.bincount(at, y.ravel(), minlength=n)


@compiled
def collapses(w: ComplexArray, direction: ComplexArray, F: IntArray, first: FloatArray) -> None:
    """Fill ``first`` (f,) with the steps of `DeformationEnergy.steps_to_collapse`."""
    for part in blocks(len(F)):
        corners = F[part].T
        d1, d2 = _edges(corners, w)
        e1, e2 = _edges(corners, direction)
        c0 = d1.real * d2.imag - d1.imag * d2.real
        c1 = d1.real * e2.imag - d1.imag * e2.real + e1.real * d2.imag - e1.imag * d2.real
        c2 = e1.real * e2.imag - e1.imag * e2.real
        root = np.sqrt(np.maximum(c1**2 - 4 * c0 * c2, 0))
        real = (c0 > 0) & (c1**2 >= 4 * c0 * c2)
        falls = real & (c1 < 0)
        rises = real & (c1 >= 0) & (c2 < 0)
        here = first[part]
        here[:] = np.inf
        here[falls] = 2 * c0[falls] / (root - c1)[falls]
        here[rises] = (c1 + root)[rises] / (-2 * c2[rises])


def signed_areas(F: NDArray[np.integer], w: ComplexArray) -> FloatArray:
    """Signed areas (f,) float64 of the images of triangles (f, 3) under a map (n,) complex128."""
    d1, d2 = _edges(F.T, w)
    return 0.5 * (d1.real * d2.imag - d1.imag * d2.real)


def _edges(corners: NDArray[np.integer], w: ComplexArray) -> tuple[ComplexArray, ComplexArray]:
    w0 = w[corners[0]]
    return w[corners[1]] - w0, w[corners[2]] - w0


def _weight_array(weights: ArrayLike, f: int) -> FloatArray:
    """Convert weights of ``f`` triangles to a new (f,) float64 array, or raise a ValueError for another shape."""
    array = real_array("weights", weights)
    if array.shape != (f,):
        raise ValueError(f"weights must have shape ({f},), one for each triangle, not {array.shape}")
    return array


def positive_weights(weights: ArrayLike, f: int) -> FloatArray:
    """Return positive weights of ``f`` triangles as a new (f,) float64 array.

    Raise a ValueError if the shape is wrong or a weight is not positive; the message names the first triangles.
    """
    array = _weight_array(weights, f)
    reject(~(array > 0), "triangle", "triangles", "the weight is not positive at {}")
    return array


#: The energies of a mixture, in the order of its first factors.
TERMS: tuple[Isotropic, ...] = MIPS(), SymmetricDirichlet(), ARAP(), AreaBarrier()


def mixture_of(energy: Energy, *parts: str) -> FloatArray | None:
    """The numbers (6,) float64 that express an energy, or None if there are none.

    The first four are the factors of the sum of `TERMS`. The others are ``k`` and ``linear_from`` if the sum is
    `Hardened`, otherwise 0. ``parts`` are the methods that the caller uses. A subclass that does not override them
    counts as the class that has them.
    """
    if isinstance(energy, Hardened) and _keeps(type(energy), Hardened, parts):
        base = mixture_of(energy.base, *parts)
        hardness = [energy.k, energy.linear_from] if energy.k else [0.0, 0.0]
        return None if base is None or base[-2] else np.append(base[:-2], hardness)
    if type(energy) is not Combination:
        return _factors(type(energy), parts)
    factors = np.zeros(len(TERMS) + 2)
    for factor, term in energy.terms:
        part = mixture_of(term, *parts)
        if part is None or part[-2]:
            return None
        factors += factor * part
    return factors


@cache
def _factors(kind: type[Energy], parts: tuple[str, ...]) -> FloatArray | None:
    for energy, factors in zip(TERMS, np.eye(len(TERMS), len(TERMS) + 2), strict=True):
        if _keeps(kind, type(energy), parts):
            return factors
    return None


def _keeps(kind: type[Energy], base: type[Energy], parts: tuple[str, ...]) -> bool:
    """Whether a class is ``base``, or a subclass that does not override some methods."""
    return issubclass(kind, base) and all(getattr(kind, part) is getattr(base, part) for part in parts)


def energy_of(mixture: FloatArray) -> Isotropic:
    """The energy with the numbers ``mixture``; the inverse of `mixture_of`."""
    *factors, k, linear_from = mixture.tolist()
    terms = [(factor, energy) for factor, energy in zip(factors, TERMS, strict=True) if factor]
    base = terms[0][1] if len(terms) == 1 and terms[0][0] == 1 else Combination(*terms)
    return Hardened(base, k, linear_from) if k else base


@compiled
def mixed_energy(mixture: FloatArray, p: ComplexArray, q: ComplexArray, det: FloatArray, share: FloatArray) -> float:
    """Return the sum of the densities times ``share``; ``p``, ``q``, ``det`` and ``share`` are (f,)."""
    return float(np.sum(share * energy_of(mixture).density(Deformation(p, q, det))))


@compiled
def mixed_slopes(
    mixture: FloatArray, p: ComplexArray, q: ComplexArray, det: FloatArray, by_p: ComplexArray, by_q: ComplexArray
) -> None:
    """Fill ``by_p`` and ``by_q`` with the derivatives of the densities with respect to p and q."""
    energy = energy_of(mixture)
    for part in blocks(det.size):
        by_p[part], by_q[part] = energy.gradient(Deformation(p[part], q[part], det[part]))


@compiled
def mixed_curvature(
    mixture: FloatArray,
    p: ComplexArray,
    q: ComplexArray,
    det: FloatArray,
    share: FloatArray,
    negative: float,
    pp: FloatArray,
    qq: FloatArray,
    p2: ComplexArray,
    q2: ComplexArray,
    pq: ComplexArray,
    pqc: ComplexArray,
) -> None:
    """Fill the fields of the second derivatives (see `Energy.curvature`), each multiplied by ``share``."""
    energy = energy_of(mixture)
    for part in blocks(det.size):
        form = energy.curvature(Deformation(p[part], q[part], det[part]), negative=negative).scaled(share[part])
        for whole, values in zip((pp, qq, p2, q2, pq, pqc), form, strict=True):
            whole[part] = values


def curvature_of_mixture(mixture: FloatArray, d: Deformation, share: FloatArray, negative: float) -> QuadraticForm:
    """Second derivatives of the densities times ``share``, as a quadratic form per triangle."""
    f = d.det.size
    reals, complexes = np.empty((2, f)), np.empty((4, f), dtype=np.complex128)
    mixed_curvature(mixture, d.p, d.q, d.det, share, negative, *reals, *complexes)
    return QuadraticForm(*reals, *complexes)
