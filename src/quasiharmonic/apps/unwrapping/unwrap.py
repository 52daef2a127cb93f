"""Texture coordinates for any model in one call: `unwrap`."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from functools import partial
from typing import TypedDict, Unpack

import numpy as np
from numpy.typing import ArrayLike

from quasiharmonic.apps.atlas.packing.bitmap_search import BITMAPS, MANY, Textures
from quasiharmonic.apps.unwrapping.chart import Chart, number_kinds
from quasiharmonic.apps.unwrapping.chart_fitting import divide_fragile, divide_long_charts, mend_charts
from quasiharmonic.apps.unwrapping.chart_verdict import certify_charts
from quasiharmonic.apps.unwrapping.charts import find_charts
from quasiharmonic.apps.unwrapping.cleaning import CleanedMesh, clean
from quasiharmonic.apps.unwrapping.draft import Draft, expect_charts
from quasiharmonic.apps.unwrapping.layout import (
    ChartLayout,
    LayoutChoice,
    find_seams,
    join_charts,
)
from quasiharmonic.apps.unwrapping.model_files import reads_hard_edges
from quasiharmonic.apps.unwrapping.placing import check_placing, number_tiles, place_charts
from quasiharmonic.apps.unwrapping.result import Miss, Stretch, UnwrapResult, UnwrapStep, find_status
from quasiharmonic.apps.unwrapping.scenes import accepts_scene
from quasiharmonic.apps.unwrapping.seam_rules import Rules, find_rules
from quasiharmonic.apps.unwrapping.selection import keep_charts, read_faces, select
from quasiharmonic.apps.unwrapping.straightening import Strip, straighten_strips
from quasiharmonic.apps.unwrapping.symmetry import check_symmetry
from quasiharmonic.energies.measures import distortion
from quasiharmonic.io.accepts_mesh import accepts_mesh
from quasiharmonic.problem.run import run_until
from quasiharmonic.targets.cuts.find import side_costs
from quasiharmonic.util.arrays import (
    FloatArray,
    IntArray,
    find_exponent,
    mark,
    real_array,
    triangle_array,
    vertex_array,
)
from quasiharmonic.util.options import UnwrapOptions, takes
from quasiharmonic.util.progress import reports_progress

# After a time limit, charts are completed and certified in about this multiple of the time of the preparation.
_RESERVED = 2.0
# Then so many charts are packed by their shapes, and further ones as boxes.
_PACKED_CLOSELY = MANY
# Seconds in which a chart is packed, by its shape and as a box. At most this share of the limit is reserved for that.
_SECONDS_BY_SHAPE, _SECONDS_AS_BOX, _MOST_RESERVED = 1.5e-2, 4e-4, 0.5


class UnwrapKeywords(TypedDict, total=False):
    """Types of the options of `unwrap`."""

    max_stretch: float
    max_charts: int | None
    resolution: int | tuple[int, int]
    padding: float
    texels_per_unit: float | None
    tiles: int
    tile_by: ArrayLike | str | None
    lightmap: bool
    rotate: bool
    stack: bool | str
    outward: bool
    weld: bool | float
    meshes: ArrayLike | None
    instances: str
    weights: Mapping[str, float] | Sequence[float] | None
    hard_edges: float | str | ArrayLike | None
    symmetry: str | None
    up: str | None
    packing_loss: float
    divide_for_packing: bool
    straighten: bool
    edge_costs: ArrayLike | None
    seams: ArrayLike | None
    no_seams: ArrayLike | None
    labels: ArrayLike | None
    uv: ArrayLike | None
    faces: ArrayLike | None
    seed: int
    time_limit: float | None
    callback: Callable[[UnwrapStep], object] | None
    jobs: int | None


@accepts_scene
@reads_hard_edges
@accepts_mesh
@reports_progress
@takes(UnwrapOptions, UnwrapKeywords)
def unwrap(V: ArrayLike, F: ArrayLike, **options: Unpack[UnwrapKeywords]) -> UnwrapResult:
    """Compute texture coordinates for any model: charts with little stretch, packed into a texture, certified.

    Parameters
    ----------
    V : (n, 2) or (n, 3) array, or a mesh in place of ``V`` and ``F``
        Positions. A list of meshes or of pairs (V, F), or a scene of trimesh, is unwrapped into one texture, and the
        result is a `SceneResult`; transformations of the scene scale the texel density.
    F : (f, 3) array of int
        Any triangles. Degenerate and repeated triangles get the texture coordinates of a neighbour. Surfaces are cut at
        edges of three or more triangles and where they cannot be oriented; see `clean`.
    max_stretch : float
        Bound on the stretch max(σ₁, 1/σ₂) at 99 % of the surface, at least 1. No triangle may be stretched by more than
        3, except triangles with an angle below 1°. Lower values need more seams. `UnwrapResult.misses` lists the charts
        that exceed the bound.
    max_charts : int, optional
        Maximum number of charts. It is exceeded only by connected parts, by parts between seams that you demand, and by
        parts that have no bijective map otherwise.
    resolution : int or (int, int)
        Side of the texture in texels, or width and height.
    padding : float
        Minimum distance between two charts in texels.
    texels_per_unit : float, optional
        Texels per unit of length of the model. Default: the largest value at which all charts fit.
    tiles : int
        Number of tiles (UDIM). Tile k is the unit square whose lower left corner is ``(k % 10, k // 10)``. Charts too
        long for a tile are divided, so more tiles give more charts.
    tile_by : (f,) array of int or "material", optional
        The triangles with the same number get a tile of their own, in ascending order of the numbers, all tiles at one
        density. With ``"material"``, the numbers are those of the materials of a file, a `MeshData`, or of the meshes
        of trimesh in a list or a scene.
    lightmap : bool
        Whether the texture is a lightmap: boxes of charts begin at even texels, sides of rectangular charts lie between
        texels, which changes their length by at most half a texel, and no chart is shorter than two texels. Edges of
        more than 60° are seams, unless ``hard_edges`` is given. Instances have places of their own. The padding is at
        least four texels; then no bilinear filter mixes charts, at the resolution or at half of it.
        `UnwrapResult.stretch` includes the change of the lengths.
    rotate : bool
        Whether charts may be rotated to fit better.
    stack : bool or str
        Whether identical components share their texture coordinates; mirrored components, too. With ``"mirrored"``,
        only the mirror images of a symmetric model do; see ``symmetry``.
    outward : bool
        Whether closed components that are inside out are treated as turned outward. Their texture is then mirrored
        relative to the triangles of the input.
    weld : bool or float
        Whether vertices at equal positions count as one, or a distance relative to the diagonal of the bounding box
        within which they do; see `clean`. The result has the numbering of the input.
    meshes : (n,) array of int, optional
        Mesh of each vertex, if ``V`` and ``F`` are several meshes. Vertices of different meshes are not welded.
    instances : str
        For a mesh that occurs several times in the list or the scene: with ``"share"``, all occurrences share their
        texture coordinates, at the density of the largest; with ``"own"``, each occurrence has its own.
    weights : sequence or mapping of float, optional
        Factors on the texel density: one for each mesh of a list, or by names of the meshes of a scene.
    hard_edges : float, (k, 2) array of int, or "file", optional
        All edges with a larger angle between the normals, in degrees, become seams, as baked normal maps need it; or
        the listed edges. For a `MeshData` or a file, ``"file"`` means the edges with split normals or, without normals,
        between smoothing groups. Edges in ``no_seams`` are left out.
    symmetry : str or None
        Axis normal to the plane of symmetry, ``"x"``, ``"y"`` or ``"z"``; ``"auto"`` takes the first one that fits.
        Seams and charts are mirrored if every vertex has a mirror image, to 1e-6 of the diagonal of the model's box,
        and every triangle. Curved parts are not mirrored if their triangles cross the plane, or if their seams would
        be much longer. `UnwrapResult.symmetry` says what was done. No effect if ``uv`` is given; ``"auto"`` also with
        ``edge_costs``, ``seams``, ``no_seams`` or ``labels``.
    up : str, optional
        Direction that points up: ``"x"``, ``"y"``, ``"z"``, ``"-x"``, ``"-y"`` or ``"-z"``. Seams then cost a tenth
        less where the surface faces down, and a tenth less in concave edges. By default visibility has no influence.
    packing_loss : float
        Flat and developable parts are joined across edges, for fewer charts and shorter seams, as long as the estimated
        share of the texture that they use falls by at most this value below the best one.
    divide_for_packing : bool
        Whether flat and developable parts are also divided where this saves texture. By default, they are divided only
        where they are longer than the texture's side.
    straighten : bool
        Whether strips become rectangles: curved parts that are regular grids of quadrilaterals, or tubes of these, each
        quadrilateral made of two triangles. A strip ends at edges of the surface, at creases or at demanded seams.
        A strip stays unchanged if a triangle of it would be stretched beyond the bound (`UnwrapResult.strips`).
    edge_costs : (f, 3) array, optional
        Positive factor on the cost of a seam at each side of each triangle, from corner 0 to 1, 1 to 2 and 2 to 0.
        Large values keep seams away from visible parts. Values of at least 1,000 keep two triangles together where
        possible, such as the triangles of a polygon.
    seams : (k, 2) array of int, optional
        Edges that become seams, by vertices, such as `UnwrapResult.seams`. Where they end inside a flat or developable
        part, they are extended to its border or to another seam. A single edge elsewhere is extended by one edge.
        Boundary edges have no effect.
    no_seams : (k, 2) array of int, optional
        Edges that must not become seams.
    labels : (f,) array of int, optional
        Part of the model to which each triangle belongs, such as a material. Seams between parts cost almost nothing,
        and charts are joined across them last.
    uv : (n, 2) or (f, 3, 2) array, optional
        Texture coordinates of each vertex, or of each corner, whose seams are kept. Further seams are made only in
        closed parts, in parts with handles, and where the bound requires it. By default all seams are new.
    faces : (k,) array of int or (f,) array of bool, optional
        Only these triangles are unwrapped. All others keep their texture coordinates ``uv``, which is required, bit for
        bit. New charts are placed into free space of the texture, by default at the mean texel density of the others.
        Edges between both become seams.
    seed : int
        Seed of random choices. Equal input and seed give equal results, unless the time limit ends the search.
    time_limit : float, optional
        Wall time in seconds after which the best charts so far are returned, with status ``TIME_LIMIT``. Where the
        search has no bijective charts within the bound yet, the charts are grown by normals: these are more, and
        `UnwrapResult.unfinished` lists them. Cleaning, packing and verification always run to their end.
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
        The message names the elements. Also if pairs in ``seams`` or ``no_seams`` are no edges of the mesh, are in both
        lists, or cannot be kept. If the texture is too small for the padding of all charts, the message states the
        smallest sufficient resolution, or with ``faces`` a sufficient texel density.

    See Also
    --------
    flatten : One surface with a boundary, without a texture.
    bake : The look of the model for the new texture coordinates.
    clean : The surfaces that a model with defects forms.
    quasiharmonic.atlas.pack_charts : Places charts that exist.

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
    wanted, size = check_placing(UnwrapOptions(**options))
    tile = None if wanted.tile_by is None else number_tiles(wanted.tile_by, len(F))
    corner_uv = None if wanted.uv is None else _corner_positions(wanted.uv, F, len(V))
    if corner_uv is not None and np.isnan(corner_uv).all():
        corner_uv = None
    costs = None if wanted.edge_costs is None else side_costs(wanted.edge_costs, len(F))

    def report(phase: str, done: int = 0, total: int = 1) -> None:
        if wanted.callback is not None:
            wanted.callback(UnwrapStep(phase, done, total))

    report("clean")
    whole = clean(V, F, wanted.outward, weld=wanted.weld, meshes=wanted.meshes)
    # In this unit, powers of lengths neither overflow nor underflow.
    exponent = find_exponent(whole.V)
    cleaned, kept = whole, None
    if wanted.faces is not None:
        if corner_uv is None:
            raise ValueError("faces needs uv: pass the texture coordinates that the other triangles keep")
        kept = keep_charts(whole, read_faces(wanted.faces, len(F)), corner_uv)
        cleaned = select(whole, kept.replaced)
    if tile is not None:
        cleaned = select(whole, np.ones(len(F), dtype=np.bool_), tile)
    points = np.pad(np.ldexp(cleaned.V, -exponent), [(0, 0), (0, 3 - V.shape[1])])
    rules = find_rules(points, cleaned, F, costs, corner_uv if kept is None else None, wanted)
    bound, padding, density = float(wanted.max_stretch), float(wanted.padding), wanted.texels_per_unit
    if density is None and kept is not None:
        density = kept.find_density(V, F, size)
    density = None if density is None else float(np.ldexp(density, exponent))
    # Beside kept charts, there is no telling how long charts may be.
    given = density if kept is None else None
    draft, grown = Draft(), np.zeros(len(cleaned.F), dtype=bool)
    left = None
    if wanted.time_limit is not None:
        spent = time.perf_counter() - began
        count = expect_charts(points, cleaned.F, rules.cost, rules.uv_cuts, bound)
        packing_time = _SECONDS_BY_SHAPE * min(count, _PACKED_CLOSELY) + _SECONDS_AS_BOX * count
        reserved = _RESERVED * spent + min(packing_time, _MOST_RESERVED * wanted.time_limit)
        left = wanted.time_limit - reserved - (time.perf_counter() - began)
    made = run_until(left, lambda: _make_charts(points, cleaned, rules, wanted, size, given, draft, report))
    ended = made is None
    if made is None:
        charts, grown = draft.complete(points, cleaned.F, rules.cost, rules.uv_cuts, bound)
        charts = divide_fragile(charts, points, rules.cost, bound=bound)
    else:
        charts = made
    while True:
        report("pack")
        packing = place_charts(
            charts,
            None if tile is None else tile[cleaned.triangles],
            wanted,
            size,
            density,
            exponent,
            kinds=number_kinds(charts, wanted.stack, rules.mirror, points, cleaned.F),
            closely=_PACKED_CLOSELY if ended else BITMAPS,
            occupied=None if kept is None or not kept.count else (kept.layout.uv, kept.layout.rows),
        )
        report("certify")
        layout = join_charts(charts, packing, len(cleaned.F))
        certificate = certify_charts(layout, cleaned.triangles, size=size, padding=padding, stacked=bool(wanted.stack))
        assert certificate.disjoint, "packed charts keep a distance larger than the rounding"
        faulty = np.flatnonzero(~certificate.bijective_charts)
        if not faulty.size:
            break
        scale = packing.texels_per_unit / max(size)
        charts = mend_charts(charts, layout, faulty, scale=scale, V=points, cost=rules.cost, bound=bound)
    joined = layout
    if kept is not None:
        joined = kept.join(layout, whole)
        certificate = kept.certify(joined, whole, size=size, padding=padding, stacked=wanted.stack)
    seams = find_seams(whole, joined)
    rules.wanted.check(cleaned, seams)
    uv, rows = joined.uv, whole.restore_corners(joined.rows)
    if kept is not None:
        uv, rows = kept.restore(uv, rows)
    # Rows of texture coordinates are ordered by vertex, then by chart.
    key, indices = np.unique(F * len(uv) + rows, return_inverse=True)
    vmapping, row = np.divmod(key, len(uv))
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
        uvs=uv[row],
        charts=whole.restore_corners(np.repeat(joined.chart[:, None], 3, axis=1))[:, 0],
        seams=seams,
        certificate=certificate,
        triangle_stretch=every,
        stretch=_summarise(stretch, area),
        misses=tuple(misses),
        utilisation=packing.utilisation + (0.0 if kept is None else kept.area / wanted.tiles),
        cleaned=whole,
        status=find_status(certificate, misses, ended),
        resolution=size,
        texels_per_unit=float(np.ldexp(packing.texels_per_unit, -exponent)),
        V=V,
        kept_charts=np.arange(len(certificate.bijective_charts)) >= len(charts),
        strips=tuple(strip._replace(triangle=int(cleaned.triangles[strip.triangle])) for strip in draft.strips),
        symmetry=check_symmetry(rules.symmetry, rules.mirror, layout.chart),
        seconds=time.perf_counter() - began,
        unfinished=np.unique(layout.chart[grown]),
    )


def _make_charts(
    points: FloatArray,
    cleaned: CleanedMesh,
    rules: Rules,
    wanted: UnwrapOptions,
    size: tuple[int, int],
    density: float | None,
    draft: Draft,
    report: Callable[[str, int, int], object],
) -> list[Chart]:
    """Return the charts of a cleaned mesh that keep the bound, and fit into the texture."""
    bound, most = float(wanted.max_stretch), wanted.max_charts
    straight, strips = list[Chart](), list[Strip]()
    if wanted.straighten:
        straight, strips = straighten_strips(points, cleaned.F, rules.cost, rules.uv_cuts, bound, most)
    rest = ~mark(len(cleaned.F), *(chart.triangles for chart in straight))
    draft.rows, draft.others, draft.strips = np.flatnonzero(rest), straight, strips
    divide = partial(divide_long_charts, wanted=wanted, size=size, density=density)
    textures = Textures(size, float(wanted.padding), wanted.tiles, wanted.rotate)
    charts = find_charts(
        points,
        cleaned.F[rest],
        max_stretch=bound,
        max_charts=None if most is None else most - len(straight),
        edge_costs=rules.cost[rest],
        uv_cuts=rules.uv_cuts,
        uv=None if rules.uv is None else rules.uv[rest],
        mirror=None if rules.mirror is None else rules.mirror.select(np.flatnonzero(rest)),
        draft=draft,
        choose=LayoutChoice(divide, textures, float(wanted.packing_loss)),
        callback=report,
        jobs=wanted.jobs,
    )
    if straight:
        # Other charts stay, because they know their shapes.
        charts = [*straight, *(replace(chart, triangles=np.flatnonzero(rest)[chart.triangles]) for chart in charts)]
    if rules.uv is not None:
        return sorted(charts, key=lambda chart: int(chart.triangles[0]))
    return divide(charts, points, rules.cost)


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
