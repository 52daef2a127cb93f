"""Texture coordinates for any model in one call: `unwrap`."""

from __future__ import annotations

import time
from collections.abc import Callable
from functools import partial
from numbers import Real

import numpy as np
from numpy.typing import ArrayLike

from quasiharmonic.apps.atlas.packing.pack import check_texture, pack_charts
from quasiharmonic.apps.unwrapping.chart_verdict import certify_charts
from quasiharmonic.apps.unwrapping.charts import MAX_STRETCH, find_charts
from quasiharmonic.apps.unwrapping.cleaning import CleanedMesh, clean
from quasiharmonic.apps.unwrapping.hinges import keep_flat_faces
from quasiharmonic.apps.unwrapping.layout import ChartLayout, choose_packed, find_differing_sides, find_seams, join_charts
from quasiharmonic.apps.unwrapping.long_charts import divide_long_charts
from quasiharmonic.apps.unwrapping.mending import mend_charts
from quasiharmonic.apps.unwrapping.result import Miss, Stretch, UnwrapResult, UnwrapStatus, UnwrapStep
from quasiharmonic.apps.unwrapping.symmetry import Symmetry, find_mirror
from quasiharmonic.energies.measures import distortion
from quasiharmonic.io.adapters.accepts_mesh import accepts_mesh
from quasiharmonic.targets.cuts.find import side_costs
from quasiharmonic.util.arrays import (
    FloatArray,
    IntArray,
    check_bool,
    check_callback,
    check_integer,
    find_exponent,
    real_array,
    triangle_array,
    vertex_array,
)
from quasiharmonic.util.progress import reports_progress

# XX
_LOSS = 0.02
# Positions beyond this power of two, or all below its reciprocal, are scaled.
_MAX_EXPONENT = 300


@accepts_mesh
@reports_progress
def unwrap(
    V: ArrayLike,
    F: ArrayLike,
    *,
    max_stretch: float = MAX_STRETCH,
    max_charts: int | None = None,
    resolution: int | tuple[int, int] = 2048,
    padding: float = 4,
    texels_per_unit: float | None = None,
    tiles: int = 1,
    rotate: bool = True,
    stack: bool = False,
    outward: bool = False,
    weld: bool | float = True,
    edge_costs: ArrayLike | None = None,
    uv: ArrayLike | None = None,
    seed: int = 0,
    callback: Callable[[UnwrapStep], object] | None = None,
    jobs: int | None = None,
) -> UnwrapResult:
    """Compute texture coordinates for any model: charts with little stretch, packed into a texture, certified.

    Parameters
    ----------
    V : (n, 2) or (n, 3) array, or a mesh in place of ``V`` and ``F``
        Positions.
    F : (f, 3) array of int
        Any triangles. Degenerate and repeated triangles get the texture coordinates of a neighbour. Surfaces are cut at
        edges of three or more triangles and where they cannot be oriented; see `clean`.
    max_stretch : float
        Bound on the stretch max(σ₁, 1/σ₂), at least 1. 99 % of the surface keep it. No triangle is stretched by more
        than 3, except triangles with an angle below 1°. Lower values need more seams.
    max_charts : int, optional
        Maximum number of charts. It is exceeded only by connected parts, and by parts that have no bijective map
        otherwise.
    resolution : int or (int, int)
        Side of the texture in texels, or width and height.
    padding : float
        Minimum distance between two charts in texels.
    texels_per_unit : float, optional
        Texels per unit of length of the model. Default: the largest value at which all charts fit.
    tiles : int
        Number of tiles (UDIM). Tile k is the unit square whose lower left corner is ``(k % 10, k // 10)``.
    rotate : bool
        Whether charts may be rotated to fit better.
    stack : bool
        Whether identical components share their texture coordinates; mirrored components, too.
    outward : bool
        Whether closed components that are inside out are treated as turned outward. Their texture is then mirrored
        relative to the triangles of the input.
    weld : bool or float
        Whether vertices at equal positions count as one, or a distance relative to the diagonal of the bounding box
        within which they do; see `clean`. The result has the numbering of the input.
    edge_costs : (f, 3) array, optional
        Positive factor on the cost of a seam at each side of each triangle, from corner 0 to 1, 1 to 2 and 2 to 0.
        Large values keep seams away from visible parts. Values of at least 1,000 keep two triangles together where
        possible, such as the triangles of a polygon.
    uv : (n, 2) or (f, 3, 2) array, optional
        Texture coordinates of each vertex, or of each corner, whose seams are kept. Further seams are made only in
        closed parts, in parts with handles, and where the bound requires it. By default all seams are new.
    seed : int
        Seed of random choices. Equal input and seed give equal results.
    callback : callable, optional
        Called with an `UnwrapStep`, at least every half second. Exceptions propagate.
    jobs : int, optional
        Number of threads. Default: all cores. The result does not depend on it.

    Returns
    -------
    UnwrapResult
        Iterates as ``vmapping, indices, uvs``, the arrays of ``xatlas.parametrize``. All charts are bijective. If the
        bound is not kept, the result lists the charts (`UnwrapResult.misses`).

    Raises
    ------
    ValueError
        If an array has the wrong shape, a position is not finite, an index is out of range, or no triangle has an area.
        The message names the elements. If the texture is too small for the padding of all charts, the message states
        the smallest sufficient resolution.

    Examples
    --------
    >>> from quasiharmonic.surfaces import starfish
    >>> V, F = starfish(3, 12)
    >>> result = unwrap(V, F)
    >>> vmapping, indices, uvs = result
    >>> bool((V[vmapping][indices] == V[F]).all()), result.certificate.bijective
    (True, True)
    """
    began = time.perf_counter()
    V = vertex_array(V)
    F = triangle_array(F, len(V))
    size = check_texture(resolution, padding, texels_per_unit, tiles, rotate, stack)
    _check_options(max_stretch, max_charts, seed, jobs)
    check_bool("outward", outward)
    check_callback(callback)
    corner_uv = None if uv is None else _corner_positions(uv, F, len(V))
    costs = None if edge_costs is None else side_costs(edge_costs, len(F))

    def report(phase: str, done: int = 0, total: int = 1) -> None:
        if callback is not None:
            callback(UnwrapStep(phase, done, total))

    report("clean")
    cleaned = clean(V, F, outward, weld=weld)
    # In this unit, areas neither overflow nor underflow.
    exponent = find_exponent(cleaned.V)
    exponent = exponent if abs(exponent) > _MAX_EXPONENT else 0
    points = np.pad(np.ldexp(cleaned.V, -exponent), [(0, 0), (0, 3 - V.shape[1])])
    cost = np.ones(cleaned.F.shape) if costs is None else _turn_sides(costs, cleaned)
    kept_uv = None if corner_uv is None else _turn_corners(corner_uv, cleaned)
    mirror, symmetry = None, Symmetry(None, 0.0, False, "")
    if kept_uv is None:
        mirror, symmetry = find_mirror(points, cleaned.F, "auto")
        cost = keep_flat_faces(points, cleaned.F, cost)
    charts = find_charts(
        points,
        cleaned.F,
        max_stretch=float(max_stretch),
        max_charts=max_charts,
        edge_costs=cost,
        uv_cuts=None if kept_uv is None else _find_uv_cuts(kept_uv, cleaned),
        uv=kept_uv,
        mirror=mirror,
        choose=partial(choose_packed, size=size, padding=float(padding), tiles=tiles, rotate=rotate, loss=_LOSS),
        seed=seed,
        callback=report,
        jobs=jobs,
    )
    if corner_uv is None:
        charts = divide_long_charts(
            charts, points, cost, bound=float(max_stretch), size=size, tiles=tiles, max_charts=max_charts
        )
    while True:
        report("pack")
        packing = pack_charts(
            [(chart.uv, chart.F) for chart in charts],
            resolution=size,
            padding=float(padding),
            texels_per_unit=None if texels_per_unit is None else float(np.ldexp(texels_per_unit, exponent)),
            tiles=tiles,
            rotate=rotate,
            stack=stack,
        )
        report("certify")
        layout = join_charts(charts, packing, len(cleaned.F))
        certificate = certify_charts(layout, cleaned.triangles, size=size, padding=float(padding), stacked=stack)
        assert certificate.disjoint, "packed charts keep a distance larger than the rounding"
        faulty = np.flatnonzero(~certificate.bijective_charts)
        if not faulty.size:
            break
        scale = packing.texels_per_unit / max(size)
        charts = mend_charts(charts, layout, faulty, scale=scale, V=points, cost=cost, bound=float(max_stretch))
    # Rows of texture coordinates are ordered by vertex, then by chart.
    key, indices = np.unique(F * len(layout.uv) + cleaned.restore_corners(layout.rows), return_inverse=True)
    vmapping, row = np.divmod(key, len(layout.uv))
    stretch, area = _measure(points, cleaned, layout, size)
    misses = [
        Miss(k, _summarise(stretch[chart.triangles], area[chart.triangles]), chart.misses)
        for k, chart in enumerate(charts)
        if chart.misses > 0 and not cleaned.widened[chart.triangles].all()
    ]
    misses.sort(key=lambda miss: -miss.excess)
    every = np.full(len(F), np.nan)
    every[cleaned.triangles] = stretch
    return UnwrapResult(
        vmapping=vmapping,
        indices=indices.reshape(-1, 3),
        uvs=layout.uv[row],
        charts=cleaned.restore_corners(np.repeat(layout.chart[:, None], 3, axis=1))[:, 0],
        seams=find_seams(cleaned, layout),
        certificate=certificate,
        triangle_stretch=every,
        stretch=_summarise(stretch, area),
        misses=tuple(misses),
        utilisation=packing.utilisation,
        cleaned=cleaned,
        status=UnwrapStatus.STRETCHED if misses else UnwrapStatus.UNWRAPPED,
        resolution=size,
        texels_per_unit=float(np.ldexp(packing.texels_per_unit, -exponent)),
        V=V,
        seconds=time.perf_counter() - began,
    )


def _check_options(max_stretch: float, max_charts: int | None, seed: int, jobs: int | None) -> None:
    """Check the numbers that do not concern the texture."""
    if not isinstance(max_stretch, Real) or isinstance(max_stretch, bool) or not 1 <= float(max_stretch) < np.inf:
        raise ValueError(f"max_stretch must be a finite number of at least 1, not {max_stretch!r}")
    check_integer("seed", seed, minimum=0)
    for name, count in (("max_charts", max_charts), ("jobs", jobs)):
        if count is not None:
            check_integer(name, count, minimum=1)


def _corner_positions(uv: ArrayLike, F: IntArray, n: int) -> FloatArray:
    """Return given texture coordinates for every corner, (f, 3, 2); NaN where there are none."""
    array = real_array("uv", getattr(uv, "uv", uv))
    infinite = np.argwhere(np.isinf(array))
    if len(infinite):
        raise ValueError(f"uv has infinite values, the first at index {tuple(infinite[0].tolist())}")
    if array.shape == (n, 2):
        return array[F]
    if array.shape != (*F.shape, 2):
        raise ValueError(f"uv must have shape ({n}, 2) or ({len(F)}, 3, 2), not {array.shape}")
    return array


def _turn_sides(costs: FloatArray, cleaned: CleanedMesh) -> FloatArray:
    """Return the costs of the sides of the cleaned triangles."""
    turned = costs[cleaned.triangles]
    # Reversing a triangle exchanges its first and last side.
    turned[cleaned.flipped] = turned[cleaned.flipped][:, ::-1]
    return turned


def _turn_corners(corner_uv: FloatArray, cleaned: CleanedMesh) -> FloatArray:
    """Return the texture coordinates of the corners of the cleaned triangles."""
    position = corner_uv[cleaned.triangles]
    # Reversing a triangle exchanges its last two corners.
    position[cleaned.flipped] = position[cleaned.flipped][:, (0, 2, 1)]
    return position


def _find_uv_cuts(corner_uv: FloatArray, cleaned: CleanedMesh) -> IntArray:
    """Return the edges (k, 2) of the cleaned mesh at which texture coordinates (f', 3, 2) differ."""
    # Corners without coordinates count as one position.
    position = np.nan_to_num(corner_uv, nan=np.finfo(np.float64).max) + 0.0
    rows = np.unique(position.reshape(-1, 2), axis=0, return_inverse=True)[1]
    side = find_differing_sides(cleaned.F, rows.reshape(-1, 3), len(cleaned.V))
    return np.stack([cleaned.F.ravel()[side], cleaned.F[:, (1, 2, 0)].ravel()[side]], axis=1)


def _measure(
    points: FloatArray, cleaned: CleanedMesh, layout: ChartLayout, size: tuple[int, int]
) -> tuple[FloatArray, FloatArray]:
    """Return stretch and share of the area (f',) of the cleaned triangles; NaN and 0 for those without area.

    ``points`` (n', 3) are the positions in any unit.
    """
    V, texels = np.empty((len(layout.uv), 3)), layout.uv * size
    V[layout.rows] = points[cleaned.F]
    # The orientation of a mirrored chart does not matter for its stretch.
    texels[layout.rows[layout.mirrored], 0] *= -1
    measured = distortion(V, layout.rows, texels)
    flat = cleaned.widened
    return np.where(flat, np.nan, measured.isometric), np.where(flat, 0.0, measured.share)


def _summarise(stretch: FloatArray, area: FloatArray) -> Stretch:
    """Return median, 99 % and maximum of values, weighted by area. NaN is ignored, unless there is nothing else."""
    order = np.argsort(stretch, kind="stable")[: np.count_nonzero(~np.isnan(stretch))]
    if not order.size:
        return Stretch(np.nan, np.nan, np.nan)
    below = np.cumsum(area[order])
    at = np.minimum(np.searchsorted(below, np.array([0.5, 0.99]) * below[-1]), len(order) - 1)
    median, p99 = stretch[order[at]].tolist()
    return Stretch(median, p99, float(stretch[order[-1]]))
