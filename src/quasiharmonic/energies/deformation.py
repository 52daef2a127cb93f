"""A deformation energy integrated over a surface, as a function of the map (§11).

The mean density, weighted by area (and by triangle, if asked), with the map brought to the surface's
scale:  ``E(w) = Σⱼ cⱼ mⱼ φ(pⱼ, qⱼ) / Σⱼ mⱼ``.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from quasiharmonic.energies.energies import Deformation, Energy, QuadraticForm
from quasiharmonic.energies.mixtures import curvature_of_mixture, mixed_energy, mixed_slopes, mixture_of
from quasiharmonic.geometry.mesh.reference import blocks
from quasiharmonic.geometry.mesh.shapes import rest_shapes
from quasiharmonic.util.arrays import ComplexArray, FloatArray, IntArray, check_range, named, own_triangles, real_array
from quasiharmonic.util.kernels import compiled

# Singular values between this and its inverse are out of the reach of overflow, in whatever an energy makes of them.
_ORDINARY = 1e20


class DeformationEnergy:
    """An energy on a mesh.

    Parameters
    ----------
    V : (n, 2) or (n, 3) array
        Rest positions. A planar mesh is taken as a surface seen from the side on which its triangles
        are counterclockwise: the rest shapes have no sign.
    F : (f, 3) array of int
        Triangles.
    energy : Energy
    area : float, optional
        Area of the maps to come, which scales them to the surface's area as the paper does: p and q are
        multiplied by ``√(Σ m / area)``. It does not change while the boundary is fixed. By default maps
        are measured as they are.
    weights : (f,) array, optional
        A factor for each triangle's energy, not negative; 1 by default.
    rest_F : (f, 3) array of int, optional
        Rows of ``V`` between which each triangle lies at rest, where it is not those of ``F``: rest triangles
        need not fit together.

    Raises
    ------
    ValueError
        When rest triangles have no area, which leaves their distortion undefined; when weights have the
        wrong shape or are negative or not finite; when ``area`` is not positive.

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
        self._least_places = int(self.F.max(initial=-1)) + 1
        check_range("F", self.F, self._least_places)
        shapes = rest_shapes(V, self.F if rest_F is None else np.asarray(rest_F, dtype=np.int64))
        if shapes.flat.size:
            raise ValueError(
                f"{named('triangle', 'triangles', shapes.flat)} of zero area in the rest mesh: "
                "distortion is undefined there"
            )
        if area is not None and not 0 < area < np.inf:
            raise ValueError(f"the area of the map must be positive, not {area}")
        total = float(shapes.m.sum())
        scale = 1 / shapes.unit if area is None else float(np.sqrt(total / area))
        self.g: ComplexArray = scale * shapes.half_gradients()
        self.share: FloatArray = shapes.m / total
        if weights is not None:
            self.share = self.share * _weights(weights, len(self.F))
        self._det_per_area = scale**2 / shapes.m

    def deform(self, w: ComplexArray) -> Deformation:
        """The Jacobian of a map ``w = u + i v`` (n,) complex128 on every triangle.

        Determinants come from the images' areas. An area too small to be told from its own rounding is
        taken to be that rounding: it is positive if the map has been certified, and the energy huge.
        """
        self._check_places(w.size)
        f = len(self.F)
        p, q, det = np.empty(f, dtype=np.complex128), np.empty(f, dtype=np.complex128), np.empty(f)
        jacobians(w, self.F, self.g, self._det_per_area, p, q, det)
        return Deformation(p, q, det)

    def value(self, w: ComplexArray) -> float:
        """The mean energy of a map; ``inf`` where the energy is a barrier and a triangle is inverted."""
        return self.value_of(self.deform(w))

    def value_of(self, d: Deformation) -> float:
        """The mean energy of a deformation at hand."""
        mixture = mixture_of(self.energy, "density")
        if mixture is None:
            return float(np.sum(self.share * self.energy.density(d)))
        return mixed_energy(mixture, d.p, d.q, d.det, self.share)

    def gradient(self, w: ComplexArray) -> ComplexArray:
        """Its derivative by the positions, ``∂E/∂u + i ∂E/∂v`` at every vertex; (n,) complex128."""
        return self.gradient_of(self.deform(w), w.size)

    def gradient_of(self, d: Deformation, n: int) -> ComplexArray:
        """The derivative by ``n`` positions for a deformation at hand."""
        mixture = mixture_of(self.energy, "density_gradient", "gradient")
        if mixture is None:
            slopes = (np.broadcast_to(by, d.p.shape) for by in self.energy.gradient(d))
            by_p, by_q = (np.ascontiguousarray(by, dtype=np.complex128) for by in slopes)
        else:
            by_p, by_q = np.empty_like(d.p), np.empty_like(d.q)
            mixed_slopes(mixture, d.p, d.q, d.det, by_p, by_q)
        self._check_places(n)
        gradient = np.empty(n, dtype=np.complex128)
        pulls(by_p, by_q, self.share, self.F, self.g, gradient)
        return gradient

    def curvature_of(self, d: Deformation, *, negative: float = 0.0) -> QuadraticForm:
        """Second derivatives by (p, q) on every triangle, weights and areas included.

        Parameters
        ----------
        d : Deformation
        negative : float
            What negative eigenvalues are multiplied by; see `Energy.curvature`.
        """
        mixture = mixture_of(self.energy, "density_gradient", "density_hessian", "curvature")
        if mixture is None:
            return self.energy.curvature(d, negative=negative).scaled(self.share)
        return curvature_of_mixture(mixture, d, self.share, negative)

    def check_numbers(self, d: Deformation) -> None:
        """Raise a ValueError if the energy or its derivatives are NaN where no overflow can be the reason.

        Raises
        ------
        ValueError
            Which of them, and at which triangles.
        """
        larger = np.abs(d.p) + np.abs(d.q)
        ordinary = (larger < _ORDINARY) & (d.det > larger / _ORDINARY)
        with np.errstate(all="ignore"):
            form = self.energy.curvature(d, negative=1.0)
            found = {
                "energy": (self.energy.density(d),),
                "first derivative": self.energy.gradient(d),
                "second derivative": (form.pp, form.qq, form.p2, form.q2, form.pq, form.pqc),
            }
        for what, parts in found.items():
            wrong = np.zeros(len(self.F), dtype=bool)
            for part in parts:
                wrong |= np.isnan(part)
            bad = np.flatnonzero(wrong & ordinary)
            if bad.size:
                where = named("triangle", "triangles", bad)
                raise ValueError(
                    f"{type(self.energy).__name__}: the {what} is NaN at {where}, "
                    f"where |p| = {abs(d.p[bad[0]]):.6g} and |q| = {abs(d.q[bad[0]]):.6g} at the first; "
                    "check an energy with quasiharmonic.energies.derivatives.check_energy"
                )

    def steps_to_collapse(self, w: ComplexArray, direction: ComplexArray) -> FloatArray:
        """How far along a direction each triangle's area first vanishes.

        The area of ``w + t · direction`` is a quadratic in t; its first positive zero is taken from
        whichever form of the formula adds numbers of one sign.

        Returns
        -------
        (f,) float64
            Positive; ``inf`` where it never does, and where the area of ``w`` itself is lost in rounding, so
            that only the exact test can say.
        """
        self._check_places(min(w.size, direction.size))
        first = np.empty(len(self.F))
        collapses(w, direction, self.F, first)
        return first

    def _check_places(self, n: int) -> None:
        """Raise a ValueError unless there are places for all vertices of the triangles."""
        if n < self._least_places:
            raise ValueError(
                f"the triangles refer to vertex {self._least_places - 1}, but there are only {n} positions"
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
    """Fill in what `DeformationEnergy.deform` says of a map (n,)."""
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
    """Fill in derivatives by the positions (n,) of a sum whose terms have these derivatives by p and q, times share."""
    x, y = np.empty((2, *g.shape))
    for part in blocks(len(F)):
        along_p, along_q, here = share[part] * by_p[part], share[part] * by_q[part], g[:, part]
        pull = along_p * here + along_q * here.conj()
        x[:, part], y[:, part] = pull.real, pull.imag
    at, n = F.T.ravel(), gradient.size
    gradient.real, gradient.imag = np.bincount(at, x.ravel(), minlength=n), np.bincount(at, y.ravel(), minlength=n)


@compiled
def collapses(w: ComplexArray, direction: ComplexArray, F: IntArray, first: FloatArray) -> None:
    """Fill in what `DeformationEnergy.steps_to_collapse` says, (f,)."""
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
    """Signed areas of the images of triangles (f, 3) under a map (n,) complex128; (f,) float64."""
    d1, d2 = _edges(F.T, w)
    return 0.5 * (d1.real * d2.imag - d1.imag * d2.real)


def _edges(corners: NDArray[np.integer], w: ComplexArray) -> tuple[ComplexArray, ComplexArray]:
    w0 = w[corners[0]]
    return w[corners[1]] - w0, w[corners[2]] - w0


def _weights(weights: ArrayLike, f: int) -> FloatArray:
    array = real_array("weights", weights)
    if array.shape != (f,):
        raise ValueError(f"weights must have shape ({f},), one for each triangle, not {array.shape}")
    bad = np.flatnonzero(~((array >= 0) & (array < np.inf)))
    if bad.size:
        raise ValueError(f"the weight is negative or not finite at {named('triangle', 'triangles', bad)}")
    return array


def positive_weights(weights: ArrayLike, f: int) -> FloatArray:
    """Weights of ``f`` triangles, each positive, as (f,) float64; a copy.

    Raises
    ------
    ValueError
        When they are not; names the first triangles.
    """
    array = real_array("weights", weights)
    if array.shape != (f,):
        raise ValueError(f"weights must have shape ({f},), one for each triangle, not {array.shape}")
    bad = np.flatnonzero(~(array > 0))
    if bad.size:
        raise ValueError(f"the weight is not positive at {named('triangle', 'triangles', bad)}")
    return array
