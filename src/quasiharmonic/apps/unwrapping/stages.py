"""The stages of `unwrap`: preparation, the search of charts, their layout in the texture, and the result."""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property, partial
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from quasiharmonic.apps.atlas.packing.bitmap_search import BITMAPS, MANY, Textures
from quasiharmonic.apps.atlas.packing.pack import Packing
from quasiharmonic.apps.unwrapping.chart import Chart, find_textures, measure_fullest, number_kinds
from quasiharmonic.apps.unwrapping.chart_fitting import divide_fragile, divide_long_charts, mend_charts
from quasiharmonic.apps.unwrapping.chart_maps import THIN_ANGLE, WORST_STRETCH, smallest_angles
from quasiharmonic.apps.unwrapping.chart_verdict import UnwrapCertificate, certify_charts
from quasiharmonic.apps.unwrapping.charts import find_charts
from quasiharmonic.apps.unwrapping.cleaning import CleanedMesh, clean
from quasiharmonic.apps.unwrapping.draft import Draft, expect_charts
from quasiharmonic.apps.unwrapping.layout import (
    ChartLayout,
    Divide,
    LayoutChoice,
    find_seams,
    join_charts,
)
from quasiharmonic.apps.unwrapping.placing import check_placing, number_tiles, place_charts
from quasiharmonic.apps.unwrapping.result import Miss, Stretch, UnwrapResult, UnwrapStep, find_status
from quasiharmonic.apps.unwrapping.seam_rules import Rules, find_rules
from quasiharmonic.apps.unwrapping.selection import KeptCharts, keep_charts, read_faces, select
from quasiharmonic.apps.unwrapping.straightening import Strip, straighten_strips
from quasiharmonic.apps.unwrapping.symmetry import check_symmetry
from quasiharmonic.energies.measures import distortion
from quasiharmonic.geometry.mesh.reference import rest_shapes
from quasiharmonic.problem.run import run_until
from quasiharmonic.targets.cuts.find import side_costs
from quasiharmonic.util.arrays import (
    BoolArray,
    FloatArray,
    IntArray,
    find_exponent,
    mark,
    real_array,
    triangle_array,
    vertex_array,
)
from quasiharmonic.util.options import UnwrapOptions

# After a time limit, charts are completed and certified in about this multiple of the time of the preparation.
_RESERVED = 2.0
# Then so many charts are packed by their shapes, and further ones as boxes.
_PACKED_CLOSELY = MANY
# Seconds in which a chart is packed, by its shape and as a box. At most this share of the limit is reserved for that.
_SECONDS_BY_SHAPE, _SECONDS_AS_BOX, _MOST_RESERVED = 1.5e-2, 4e-4, 0.5

# Rounding of texture coordinates stretches charts by less than this relative difference.
_EQUAL_STRETCH = 1e-3


@dataclass(frozen=True, eq=False)
class Task:
    """A model that is prepared for the search of charts.

    Attributes
    ----------
    V : (n, 2) or (n, 3) float64
    F : (f, 3) int64
        The model as given.
    wanted : UnwrapOptions
    size : (int, int)
        Width and height of the texture in texels.
    whole : CleanedMesh
    kept : KeptCharts or None
        Charts that stay, with ``faces``.
    cleaned : CleanedMesh
        The part of ``whole`` that is unwrapped.
    tile : (f,) int64 or None
        Tile of each triangle of the model, with ``tile_by``.
    exponent : int
        Charts are computed in the unit ``2 ** exponent``, in which powers of lengths neither overflow nor underflow.
    points : (n', 3) float64
        Positions of ``cleaned`` in this unit.
    rules : Rules
        Where seams are demanded, forbidden, cheap or costly.
    density : float or None
        Texels per this unit, if they are given.
    """

    V: FloatArray
    F: IntArray
    wanted: UnwrapOptions
    size: tuple[int, int]
    whole: CleanedMesh
    kept: KeptCharts | None
    cleaned: CleanedMesh
    tile: IntArray | None
    exponent: int
    points: FloatArray
    rules: Rules
    density: float | None

    @property
    def cleaned_tile(self) -> IntArray | None:
        """Tile (f',) of each triangle of the cleaned mesh, with ``tile_by``."""
        return None if self.tile is None else self.tile[self.cleaned.triangles]

    @cached_property
    def texture(self) -> IntArray:
        """Texture (f',) of each triangle of the cleaned mesh; see `find_textures`."""
        return find_textures(self.cleaned_tile, self.wanted.stack, self.rules.mirror, self.points, self.cleaned.F)

    @property
    def into(self) -> Textures:
        """The texture, or several, that the charts share, or each of those with ``tile_by``."""
        return Textures(self.size, float(self.wanted.padding), self.wanted.tiles, self.wanted.rotate)

    @property
    def bound(self) -> float:
        """Bound on the stretch."""
        return float(self.wanted.max_stretch)

    def report(self, phase: str, done: int = 0, total: int = 1) -> None:
        """Call the user's callback."""
        _report(self.wanted, phase, done, total)


class FoundCharts(NamedTuple):
    """Charts of a model."""

    charts: list[Chart]
    # Whether the time limit ended the search, and the triangles (f',) whose charts were then grown by normals.
    ended: bool
    grown: BoolArray
    # Strips that became rectangles, and those that could not.
    strips: Sequence[Strip]


class PlacedCharts(NamedTuple):
    """Charts in the texture. Those that were not bijective there have been divided."""

    charts: list[Chart]
    packing: Packing
    layout: ChartLayout
    certificate: UnwrapCertificate


def _report(wanted: UnwrapOptions, phase: str, done: int = 0, total: int = 1) -> None:
    """Call the callback of the options."""
    if wanted.callback is not None:
        wanted.callback(UnwrapStep(phase, done, total))


def prepare(V: ArrayLike, F: ArrayLike, options: UnwrapOptions) -> Task:
    """Check the arguments of `unwrap`, clean the model, and find the rules for its seams."""
    V = vertex_array(V)
    F = triangle_array(F, len(V))
    wanted, size = check_placing(options)
    tile = None if wanted.tile_by is None else number_tiles(wanted.tile_by, len(F))
    corner_uv = None if wanted.uv is None else _corner_positions(wanted.uv, F, len(V))
    if corner_uv is not None and np.isnan(corner_uv).all():
        corner_uv = None
    costs = None if wanted.edge_costs is None else side_costs(wanted.edge_costs, len(F))
    _report(wanted, "clean")
    whole = clean(V, F, wanted.outward, weld=wanted.weld, meshes=wanted.meshes)
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
    density = wanted.texels_per_unit
    if density is None and kept is not None:
        density = kept.find_density(V, F, size)
    density = None if density is None else float(np.ldexp(density, exponent))
    return Task(V, F, wanted, size, whole, kept, cleaned, tile, exponent, points, rules, density)


def find_charts_in_time(task: Task, began: float) -> FoundCharts:
    """Find charts until the time limit, counted from ``began``; then complete those that the search has so far."""
    cleaned, cost, cuts = task.cleaned, task.rules.cost, task.rules.uv_cuts
    draft = Draft()
    charts = run_until(_find_time_left(task, began), lambda: _find_charts(task, draft))
    if charts is not None:
        return FoundCharts(charts, False, np.zeros(len(cleaned.F), dtype=np.bool_), draft.strips)
    charts, grown = draft.complete(task.points, cleaned.F, cost, cuts, task.bound)
    return FoundCharts(divide_fragile(charts, task.points, cost, bound=task.bound), True, grown, draft.strips)


def _find_time_left(task: Task, began: float) -> float | None:
    """Return the seconds left for the search, so that the other stages end within the limit; None without a limit."""
    limit = task.wanted.time_limit
    if limit is None:
        return None
    spent = time.perf_counter() - began
    count = expect_charts(task.points, task.cleaned.F, task.rules.cost, task.rules.uv_cuts, task.bound)
    packing = _SECONDS_BY_SHAPE * min(count, _PACKED_CLOSELY) + _SECONDS_AS_BOX * count
    reserved = _RESERVED * spent + min(packing, _MOST_RESERVED * limit)
    return limit - reserved - (time.perf_counter() - began)


def _find_charts(task: Task, draft: Draft) -> list[Chart]:
    """Return the charts of a model that keep the bound, and fit into the texture. ``draft`` has those so far."""
    charts, density = _search(task, draft, None), task.density
    # With kept charts, it is unknown how long new ones may be.
    if density is None or task.kept is not None or task.rules.uv is not None:
        return charts
    if measure_fullest(charts, task.texture) * density**2 > task.into.texels:
        # Shorter charts would not fit either.
        return charts
    divided = _make_divide(task, density)(charts, task.points, task.rules.cost, task.texture)
    if len(divided) == len(charts) or _fit(task, charts):
        return charts
    return divided if _fit(task, divided) else _search(task, draft, density)


def _make_divide(task: Task, density: float | None) -> Divide:
    """Return a function that divides charts that are too long for the texture, at the density if one is given."""
    return partial(divide_long_charts, wanted=task.wanted, size=task.size, density=density)


def _fit(task: Task, charts: list[Chart]) -> bool:
    """Whether charts fit into the texture."""
    try:
        _pack(task, charts, closely=BITMAPS)
    except ValueError:
        return False
    return True


def _search(task: Task, draft: Draft, density: float | None) -> list[Chart]:
    """Return charts that are not too long for the texture, at the density if one is given; see `_find_charts`."""
    points, cleaned, rules, wanted = task.points, task.cleaned, task.rules, task.wanted
    most = wanted.max_charts
    straight, strips = list[Chart](), list[Strip]()
    if wanted.straighten:
        straight, strips = straighten_strips(
            points, cleaned.F, rules.hinges, rules.cost, rules.uv_cuts, task.bound, most
        )
    rest = ~mark(len(cleaned.F), *(chart.triangles for chart in straight))
    draft.rows, draft.others, draft.strips = np.flatnonzero(rest), straight, strips
    divide = _make_divide(task, density)
    charts = find_charts(
        points,
        cleaned.F[rest],
        max_stretch=task.bound,
        max_charts=None if most is None else most - len(straight),
        edge_costs=rules.cost[rest],
        uv_cuts=rules.uv_cuts,
        uv=None if rules.uv is None else rules.uv[rest],
        mirror=None if rules.mirror is None else rules.mirror.select(np.flatnonzero(rest)),
        hinges=None if straight else rules.hinges,
        draft=draft,
        choose=LayoutChoice(divide, task.into, float(wanted.packing_loss), task.texture[rest]),
        callback=task.report,
        jobs=wanted.jobs,
    )
    if straight:
        # Other charts stay, because they know their shapes.
        charts = [*straight, *(replace(chart, triangles=np.flatnonzero(rest)[chart.triangles]) for chart in charts)]
    if rules.uv is not None:
        return sorted(charts, key=lambda chart: int(chart.triangles[0]))
    return divide(charts, points, rules.cost, task.texture)


def place_and_certify(task: Task, found: FoundCharts) -> PlacedCharts:
    """Pack charts, and certify them where they are.

    Rounding in the texture can invert a very thin triangle. Its chart is divided, and all are packed again.
    """
    points, cleaned, rules, wanted = task.points, task.cleaned, task.rules, task.wanted
    charts = found.charts
    while True:
        task.report("pack")
        try:
            packing = _pack(task, charts, closely=_PACKED_CLOSELY if found.ended else BITMAPS)
        except ValueError as error:
            if not found.ended:
                raise
            raise ValueError(f"the search for charts ended early: {error}, or more time, which gives fewer") from error
        task.report("certify")
        layout = join_charts(charts, packing, len(cleaned.F))
        certificate = certify_charts(
            layout, cleaned.triangles, size=task.size, padding=float(wanted.padding), stacked=bool(wanted.stack)
        )
        assert certificate.disjoint, "packed charts keep a distance larger than the rounding"
        faulty = np.flatnonzero(~certificate.bijective_charts)
        if not faulty.size:
            return PlacedCharts(charts, packing, layout, certificate)
        scale = packing.texels_per_unit / max(task.size)
        charts = mend_charts(charts, layout, faulty, scale=scale, V=points, cost=rules.cost, bound=task.bound)


def _pack(task: Task, charts: list[Chart], *, closely: int) -> Packing:
    """Pack charts into the texture, beside kept ones; at most ``closely`` by their shapes, further ones as boxes."""
    kept = task.kept
    return place_charts(
        charts,
        task.cleaned_tile,
        task.wanted,
        task.size,
        task.density,
        task.exponent,
        kinds=number_kinds(charts, task.wanted.stack, task.rules.mirror, task.points, task.cleaned.F),
        closely=closely,
        occupied=None if kept is None or not kept.count else (kept.layout.uv, kept.layout.rows),
    )


def collect(task: Task, found: FoundCharts, placed: PlacedCharts, began: float) -> UnwrapResult:
    """Join new and kept charts, and return them for the vertices and triangles of the model, with all measures."""
    F, wanted, size, whole, cleaned, kept = task.F, task.wanted, task.size, task.whole, task.cleaned, task.kept
    charts, packing, layout, certificate = placed
    joined = layout
    if kept is not None:
        joined = kept.join(layout, whole)
        certificate = kept.certify(joined, whole, size=size, padding=float(wanted.padding), stacked=bool(wanted.stack))
    seams = find_seams(whole, joined)
    task.rules.wanted.check(cleaned, seams)
    uv, rows = joined.uv, whole.restore_corners(joined.rows)
    if kept is not None:
        uv, rows = kept.restore(uv, rows)
    # Rows of texture coordinates are ordered by vertex, then by chart.
    key, indices = np.unique(F * len(uv) + rows, return_inverse=True)
    vmapping, row = np.divmod(key, len(uv))
    stretch, area = _measure(task.points, cleaned, layout, size)
    excess = [chart.misses for chart in charts]
    if wanted.lightmap:
        excess = _find_excess(task, charts, stretch, area)
    misses = [
        Miss(k, _summarise(stretch[chart.triangles], area[chart.triangles]), excess[k])
        for k, chart in enumerate(charts)
        if excess[k] > 0 and not cleaned.widened[chart.triangles].all()
    ]
    misses.sort(key=lambda miss: -miss.excess)
    every = np.full(len(F), np.nan)
    every[cleaned.triangles] = stretch
    with np.errstate(over="ignore"):
        density = float(np.ldexp(packing.texels_per_unit, -task.exponent))
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
        status=find_status(certificate, misses, found.ended),
        resolution=size,
        texels_per_unit=density,
        V=task.V,
        kept_charts=np.arange(len(certificate.bijective_charts)) >= len(charts),
        strips=tuple(strip._replace(triangle=int(cleaned.triangles[strip.triangle])) for strip in found.strips),
        symmetry=check_symmetry(task.rules.symmetry, task.rules.mirror, layout.chart),
        seconds=time.perf_counter() - began,
        unfinished=np.unique(layout.chart[found.grown]),
    )


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


def _find_excess(task: Task, charts: list[Chart], stretch: FloatArray, area: FloatArray) -> list[float]:
    """Return by how much each chart of a lightmap exceeds the bound, given the results of `_measure`.

    Its sides are whole texels, at least two.
    """
    measured, most = ~np.isnan(stretch), (1 + _EQUAL_STRETCH) * task.bound
    kept = not measured.any() or _summarise(stretch, area).p99 <= most
    thin = smallest_angles(rest_shapes(task.points, task.cleaned.F).sides) < THIN_ANGLE
    worst = np.where(measured & ~thin, stretch, 0.0)
    found = []
    for chart in charts:
        rows = chart.triangles
        p99 = task.bound if kept else _summarise(stretch[rows], area[rows]).p99
        over = p99 - task.bound if p99 > most else 0.0
        found.append(max(chart.misses, over, float(worst[rows].max()) - WORST_STRETCH))
    return found


def _summarise(stretch: FloatArray, area: FloatArray) -> Stretch:
    """Return median, 99 % and maximum of values, weighted by area. NaN is ignored, unless there is nothing else."""
    order = np.argsort(stretch, kind="stable")[: np.count_nonzero(~np.isnan(stretch))]
    if not order.size:
        return Stretch(np.nan, np.nan, np.nan)
    below = np.cumsum(area[order])
    at = np.minimum(np.searchsorted(below, np.array([0.5, 0.99]) * below[-1]), len(order) - 1)
    median, p99 = stretch[order[at]].tolist()
    return Stretch(median, p99, float(stretch[order[-1]]))
