"""Distortion of a map per triangle and summarised over the surface (§10, §11)."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike

from quasiharmonic.energies.distances import DistanceError, surface_distances
from quasiharmonic.energies.energies import ARAP, MIPS, Deformation, SymmetricDirichlet
from quasiharmonic.geometry.exact.predicates import orientation
from quasiharmonic.geometry.mesh.reference import rest_shapes
from quasiharmonic.io.accepts_mesh import accepts_mesh
from quasiharmonic.util.arrays import (
    ComplexArray,
    FloatArray,
    IntArray,
    check_choice,
    check_range,
    count_of,
    find_exponent,
    map_array,
    to_complex,
    triangle_array,
    triangle_rows,
    vertex_array,
)
from quasiharmonic.util.hints import make_dataframe
from quasiharmonic.util.outcome import Displayable, replace_nonfinite

if TYPE_CHECKING:
    from matplotlib.figure import Figure
    from pandas import DataFrame

#: Per-triangle measures of `Distortion`, in the order of reports.
MEASURES = (
    "sigma1",
    "sigma2",
    "mips",
    "conformal",
    "isometric",
    "symmetric_dirichlet",
    "arap",
    "area_ratio",
    "shear",
)


@dataclass(frozen=True)
class Statistics:
    """Statistics of one measure over the surface; mean and quantiles are weighted by rest area.

    Attributes
    ----------
    mean, median, p95 : float
        Mean, median and 95 % quantile.
    minimum, maximum : float
        Over all triangles, whatever their area.
    lowest, highest : int
        Triangles with the minimum and the maximum.

    See Also
    --------
    Distortion : Its method `statistics` returns them.

    Examples
    --------
    >>> from quasiharmonic import distortion
    >>> from quasiharmonic.surfaces import disk
    >>> V, F = disk(4)
    >>> statistics = distortion(V, F, V).statistics("conformal")
    >>> round(statistics.mean, 6), round(statistics.maximum, 6)
    (1.0, 1.0)
    """

    mean: float
    median: float
    p95: float
    minimum: float
    maximum: float
    lowest: int
    highest: int

    def to_dict(self) -> dict[str, Any]:
        """Return the statistics for JSON, with None for values that are not finite."""
        return {key: replace_nonfinite(value) for key, value in vars(self).items()}


@dataclass(frozen=True, eq=False, repr=False)
class Distortion(Displayable):
    """Distortion of a map on every triangle, as `distortion` returns it.

    The Jacobian is that of the affine map from the rest triangle to its image. The rest triangle is laid into the plane
    counterclockwise. The singular values are *signed*: ``σ₁ ≥ |σ₂|``, and ``σ₂`` has the sign of the image's
    orientation, computed exactly. So ``det J = σ₁ σ₂``. A triangle is inverted if ``σ₂ < 0`` and degenerate if
    ``σ₂ = 0``.

    ===================== ================================= ========= ==================================
    measure (f,) float64  formula                           scaled    where ``σ₂ ≤ 0``
    ===================== ================================= ========= ==================================
    `sigma1`, `sigma2`    singular values                   no        ``σ₂`` signed
    `mips`                σ₁/σ₂ + σ₂/σ₁ − 2  (§10)          invariant inf
    `conformal`           σ₁/σ₂                             invariant inf
    `isometric`           max(σ₁, 1/σ₂)                     yes       inf
    `symmetric_dirichlet` σ₁² + σ₂² + 1/σ₁² + 1/σ₂² − 4     yes       inf
    `arap`                (σ₁ − 1)² + (σ₂ − 1)²             yes       finite, with the signed ``σ₂``
    `area_ratio`          σ₁ σ₂                             yes       negative or 0
    `shear`               |μ| = (σ₁ − σ₂)/(σ₁ + σ₂)         invariant 1 or more; inf for a mirrored
                                                                      similarity, NaN for a point
    ===================== ================================= ========= ==================================

    *Scaled* measures compare lengths or areas. They are computed after scaling the whole map to the surface's area,
    which multiplies the singular values by `scale`. Their values at an isometry therefore hold for every similarity.

    Triangles without area in the rest mesh (`flat`) have no Jacobian. Their measures are NaN, and the summaries ignore
    them.

    Attributes
    ----------
    share : (f,) float64
        Rest areas divided by the surface's area.
    scale : float
        ``√(rest area / Σ |image areas|)``; 1 if one of the two is zero.
    sigma1, sigma2 : (f,) float64
        Singular values of the unscaled map.
    beltrami : (f,) complex128
        ``μ = q/p = (∂w/∂z̄)/(∂w/∂z)``, in the frame whose real axis points from vertex 0 to vertex 1 of the triangle;
        `shear` is its modulus.
    flat : (k,) int64
        Triangles without area in the rest mesh.
    inverted : (l,) int64
        Triangles with an inverted or degenerate image, except flat ones.
    V, F, uv : arrays
        The surface and the map.
    distances : DistanceError or None
        Error of the distances between vertices, if requested.

    See Also
    --------
    distortion : Makes it.

    Examples
    --------
    >>> from quasiharmonic import distortion
    >>> from quasiharmonic.surfaces import disk
    >>> V, F = disk(4)
    >>> found = distortion(V, F, 3 * V)
    >>> round(found.scale, 6), bool(found.conformal.max() < 1 + 1e-9)
    (0.333333, True)
    """

    share: FloatArray
    scale: float
    sigma1: FloatArray
    sigma2: FloatArray
    mips: FloatArray
    conformal: FloatArray
    isometric: FloatArray
    symmetric_dirichlet: FloatArray
    arap: FloatArray
    area_ratio: FloatArray
    shear: FloatArray
    beltrami: ComplexArray
    flat: IntArray
    inverted: IntArray
    V: FloatArray
    F: IntArray
    uv: FloatArray
    distances: DistanceError | None = None

    def per_triangle(self) -> dict[str, FloatArray]:
        """Every measure by name, each (f,) float64."""
        return {name: getattr(self, name) for name in MEASURES}

    def to_dataframe(self) -> DataFrame:
        """Return one row per triangle: its share of the rest area, and every measure; needs pandas.

        Write it with ``to_csv`` or ``to_parquet`` of the DataFrame.
        """
        return make_dataframe({"share": self.share, **self.per_triangle()}, "triangle")

    def statistics(self, measure: str) -> Statistics:
        """Return mean, quantiles and extremes of one measure.

        Parameters
        ----------
        measure : str
            One of `MEASURES`.

        Raises
        ------
        ValueError
            When the measure is unknown, or not defined on any triangle.
        """
        check_choice("measure", measure, MEASURES)
        values = self.per_triangle()[measure]
        defined = np.flatnonzero(~np.isnan(values))
        if not defined.size:
            raise ValueError(f"{measure} is defined on no triangle")
        value, share = values[defined], self.share[defined]
        order = np.argsort(value, kind="stable")
        below = np.cumsum(share[order])
        median, p95 = value[order[np.searchsorted(below, [0.5 * below[-1], 0.95 * below[-1]])]].tolist()
        with np.errstate(invalid="ignore"):  # values with infinities of both signs have no mean
            mean = float(np.sum(share / below[-1] * value))
        return Statistics(
            mean=mean,
            median=median,
            p95=p95,
            minimum=float(value[order[0]]),
            maximum=float(value[order[-1]]),
            lowest=int(defined[order[0]]),
            highest=int(defined[order[-1]]),
        )

    def summary(self) -> str:
        """Return a table of all measures as text, one line per measure."""
        lines = [f"{'':>19} {'median':>10} {'95 %':>10} {'max':>10}"]
        for name, values in self.per_triangle().items():
            if not np.isnan(values).all():
                one = self.statistics(name)
                lines.append(f"{name:>19} {one.median:>10.4g} {one.p95:>10.4g} {one.maximum:>10.4g}")
        for found, what in ((self.inverted, "inverted or degenerate"), (self.flat, "degenerate in the rest mesh")):
            if found.size:
                lines.append(f"{len(found):,} of {len(self.F):,} triangles {what}")
        return "\n".join(lines)

    def short_repr(self) -> str:
        triangles = count_of("triangle", "triangles", len(self.F))
        if self.inverted.size:
            return f"{triangles}, {self.inverted.size:,} inverted or degenerate"
        if np.isnan(self.isometric).all():
            return f"{triangles}, all degenerate in the rest mesh"
        one = self.statistics("isometric")
        return f"{triangles}, stretch max(σ₁, 1/σ₂) {one.median:.3g} in the median, {one.maximum:.3g} at most"

    def plot(self, measure: str = "isometric") -> Figure:
        """Draw surface and map coloured by a measure, and its histogram, with `quasiharmonic.plot.plot_distortion`."""
        return self._draw("distortion", measure=measure)

    def to_dict(self) -> dict[str, Any]:
        """Return counts and the summaries of all measures for JSON, with None for undefined summaries."""
        summaries = {
            name: None if np.isnan(values).all() else self.statistics(name).to_dict()
            for name, values in self.per_triangle().items()
        }
        return {
            "scale": replace_nonfinite(self.scale),
            "flat": int(self.flat.size),
            "inverted": int(self.inverted.size),
            **summaries,
            **({} if self.distances is None else {"distances": self.distances.to_dict()}),
        }


@accepts_mesh
def distortion(V: ArrayLike, F: ArrayLike, uv: ArrayLike, *, rings: int | None = None) -> Distortion:
    """Measure the distortion of a map on every triangle of a surface and, optionally, of longer distances.

    Parameters
    ----------
    V : (n, 2) or (n, 3) array, or a mesh in place of ``V`` and ``F``
        Rest positions. A planar mesh is treated as a surface seen from the side on which its triangles are
        counterclockwise.
    F : (f, 3) array of int
        Triangles. They need not form a surface.
    uv : (n, 2) array
        The map, injective or not.
    rings : int, optional
        Also compare distances along the surface with distances in the plane, between vertices at most this many edges
        apart. Distances are measured from up to 1,000 vertices, drawn at random with a fixed seed, to all others within
        reach. 20 is usual in brain mapping. To compare several maps on one sample, or to use a larger sample, see
        `quasiharmonic.energies.distances.surface_distances`.

    Returns
    -------
    Distortion
        Every measure per triangle; see `Distortion.statistics`, `Distortion.summary` and `Distortion.to_dataframe`.

    Raises
    ------
    ValueError
        When an array has the wrong shape, there are no triangles, an index is out of range, or a coordinate is not
        finite.

    See Also
    --------
    polish : Lowers the distortion.
    quasiharmonic.plot : Draws it.

    Examples
    --------
    A square of side 2 is stretched to a rectangle of 6 by 3. After scaling to the square's area, the stretches are √2
    and 1/√2.

    >>> V, F = [[0, 0], [2, 0], [2, 2], [0, 2]], [[0, 1, 2], [0, 2, 3]]
    >>> found = distortion(V, F, [[0, 0], [6, 0], [6, 3], [0, 3]])
    >>> found.sigma1.round(12).tolist(), found.sigma2.round(12).tolist()
    ([3.0, 3.0], [1.5, 1.5])
    >>> found.conformal.round(12).tolist(), found.mips.round(12).tolist()
    ([2.0, 2.0], [0.5, 0.5])
    >>> round(found.statistics("isometric").maximum, 6)
    1.414214
    """
    V = vertex_array(V)
    F, uv = triangle_array(F, len(V)), map_array("uv", uv, len(V))
    off = None if rings is None else surface_distances(V, F, rings=rings).error(uv)
    # In extreme maps, overflow and underflow give inf, 0 or NaN, as the formulas imply.
    with np.errstate(all="ignore"):
        return replace(_measure(V, F, uv), distances=off)


def mean_ratio(points: ArrayLike, F: ArrayLike) -> FloatArray:
    """Mean-ratio quality of planar triangles, ``4√3 · area / (a² + b² + c²)`` for edges a, b, c.

    Parameters
    ----------
    points : (n, 2) array
        Finite.
    F : (f, 3) array of int

    Returns
    -------
    (f,) float64
        1 for an equilateral triangle, 0 for a degenerate one, negative for a clockwise one. The sign is exact.

    Raises
    ------
    ValueError
        When an array has the wrong shape or dtype, an index in ``F`` is out of range, or a triangle's corner is not
        finite.
    """
    positions, triangles = map_array("points", points, finite=False), triangle_rows(F)
    check_range("F", triangles, len(positions))
    corners = positions[triangles]
    sign = orientation(*(corners[:, k] for k in range(3)))
    sides = corners - np.roll(corners, 1, axis=1)
    longest = np.abs(sides).max(axis=(1, 2), initial=0.0)
    # In units of the longest side, so that squares neither overflow nor underflow.
    a, b, c = (sides / np.where(longest > 0, longest, 1.0)[:, None, None]).transpose(1, 0, 2)
    squares = (a * a).sum(axis=1) + (b * b).sum(axis=1) + (c * c).sum(axis=1)
    area = np.maximum(np.abs(a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0]) / 2, np.finfo(float).tiny)
    return np.asarray(sign * 4 * np.sqrt(3) * area / np.where(squares > 0, squares, 1.0))


def _measure(V: FloatArray, F: IntArray, uv: FloatArray) -> Distortion:
    shapes = rest_shapes(V, F)
    exponent = find_exponent(uv) - 1
    unit = float(np.ldexp(1.0, exponent))
    w = to_complex(np.ldexp(uv, -exponent))
    w0 = w[F[:, 0]]
    d1, d2 = w[F[:, 1]] - w0, w[F[:, 2]] - w0
    left, right = d1.real * d2.imag, d1.imag * d2.real
    area, noise = 0.5 * (left - right), 2.0**-52 * (np.abs(left) + np.abs(right))
    # Where rounding may have changed the sign of the area, use the exact sign.
    sign = orientation(*(uv[F[:, k]] for k in range(3)))
    area = np.where(np.abs(area) <= noise, sign * noise, area)

    g = shapes.half_gradients()
    p, q = d1 * g[1].conj() + d2 * g[2].conj(), d1 * g[1] + d2 * g[2]
    defined = shapes.m > 0
    det = area / np.where(defined, shapes.m, np.nan)
    sigma1 = np.abs(p) + np.abs(q)
    sigma2 = np.where(sigma1 > 0, det / np.where(sigma1 > 0, sigma1, 1), sigma1)
    total, image = float(shapes.m.sum()), float(np.abs(area).sum())
    units = unit / shapes.unit
    # From internal units to the surface's area.
    scale = float(np.sqrt(total / image)) if image > 0 and total > 0 else units
    scaled = Deformation(scale * p, scale * q, scale * scale * det)
    scaled1, scaled2 = scale * sigma1, scale * sigma2
    beltrami = np.where(p != 0, q / np.where(p != 0, p, 1), np.where(q != 0, np.inf, np.nan))
    # Comparisons with NaN are false, so the barriers would return inf instead of NaN.
    undefined = np.where(defined, 0.0, np.nan)
    return Distortion(
        share=shapes.m / np.float64(total),
        scale=scale / units if units else np.inf,
        sigma1=sigma1 * units,
        sigma2=sigma2 * units,
        mips=MIPS().density(scaled) + undefined,
        conformal=_ratio(scaled1, scaled2) + undefined,
        isometric=np.maximum(scaled1, _ratio(1.0, scaled2)) + undefined,
        symmetric_dirichlet=SymmetricDirichlet().density(scaled) + undefined,
        arap=ARAP().density(scaled),
        area_ratio=scaled.det,
        shear=np.abs(beltrami) + undefined,
        beltrami=beltrami + undefined,
        flat=shapes.flat,
        inverted=np.flatnonzero(defined & (sign <= 0)),
        V=V,
        F=F,
        uv=uv,
    )


def _ratio(numerator: FloatArray | float, denominator: FloatArray) -> FloatArray:
    """The quotient, ``inf`` where the denominator is not positive."""
    positive = denominator > 0
    return np.where(positive, numerator / np.where(positive, denominator, 1), np.inf)
