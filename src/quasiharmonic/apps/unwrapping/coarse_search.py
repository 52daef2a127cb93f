"""Charts of a large surface from those of a coarse mesh: their seams, and initial maps close to the final ones.

Coarse charts that are too long for the texture are divided. The seams of all charts are then carried to the surface and
shortened there. A vertex in the interior of a coarse chart keeps its position in that chart's map, and so do vertices
that are inserted between such vertices. They give the rotations of their triangles. The triangles near seams get theirs
by unfolding from their neighbours. The map is fitted to the rotated triangles [1]_, then to the nearest ones that are
stretched little, which is repeated. All systems have one unknown per vertex and the same matrix. Triangles that
collapse or invert meanwhile are rotated again, as their neighbours unfold. The surroundings of the few triangles that
stay inverted are mapped by `injective_map`. A map whose boundary meets itself at more than a few places is not used.

The coarse mesh of a huge surface is large, and searched in the same way on a coarser one.

References
----------
.. [1] L. Liu, L. Zhang, Y. Xu, C. Gotsman, S. J. Gortler, A local/global approach to mesh parameterization. Computer
   Graphics Forum 27 (2008).
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from quasiharmonic.apps.flattening.worst_triangles import mark_around
from quasiharmonic.apps.unwrapping.chart import Chart, finish_chart
from quasiharmonic.apps.unwrapping.chart_maps import FREE_SHARE, WorkingChart
from quasiharmonic.apps.unwrapping.chart_search import AIM_OF_CARRIED, Workers, search_charts
from quasiharmonic.apps.unwrapping.chart_starts import repair_map
from quasiharmonic.energies.energies import SymmetricDirichlet
from quasiharmonic.geometry.coarsening import Removal, has_marked_corner
from quasiharmonic.geometry.exact.loops import check_loops
from quasiharmonic.geometry.mesh.reference import surface_area
from quasiharmonic.geometry.mesh.splitting import NO_CUT, split_parts
from quasiharmonic.geometry.mesh.topology import boundary_edges, find_pairs
from quasiharmonic.linsolve import NotPositiveDefinite
from quasiharmonic.linsolve.laplacian import Laplacian, weigh_edges
from quasiharmonic.targets.cuts.find import find_cuts_by
from quasiharmonic.targets.cuts.graph import EdgeGraph, edge_graph
from quasiharmonic.util.arrays import BoolArray, ComplexArray, FloatArray, IntArray, sum_at, to_complex, to_points


class FitTuning(NamedTuple):
    """Numbers that tune the fits of maps to rotated triangles."""

    # Number of further fits to rotated triangles, after the first one. Later fits permit some stretch.
    rotated_fits: int = 3
    # Least number of further fits, after which they stop when the aim is reached.
    least_fits: int = 5
    # The aim counts as reached if at most this part of the free share exceeds it: repairs may stretch a little more.
    enough: float = 0.5
    # Largest number of further fits.
    most_fits: int = 16
    # A later fit permits this share of the stretch that the aim permits.
    permitted: float = 0.5
    # A triangle whose singular values have a smaller ratio gets a new rotation.
    least_ratio: float = 0.15
    # Maps with more crossings of their boundary than this share of its edges are not used.
    few_crossings: float = 0.01
    # A coarse mesh with a larger share of the vertices is cut without a coarser one.
    largest_share: float = 0.5


_TUNING = FitTuning()


#: Divides long charts of a coarse mesh, given its positions (m, 3), its costs (k, 3), and its unit of length.
DivideCoarse = Callable[[list[Chart], FloatArray, FloatArray, float], list[Chart]]


class CoarseSearch:
    """A search for charts on the coarse mesh of a surface with vertices ``V`` (n, 3).

    `find_cuts_by` calls it for the coarse mesh of each large part of the surface, for the seams there. When it has
    carried the seams to the surface, `start` gives the charts between them the maps of the coarse charts.
    """

    def __init__(self, bound: float, min_gain: float, workers: Workers, V: FloatArray, divide: DivideCoarse) -> None:
        self._bound, self._min_gain, self._workers, self._V, self._divide = bound, min_gain, workers, V, divide
        # The coarse chart of each vertex, -1 where it is unknown, as on seams, and the vertex's position there.
        self._chart, self._place = np.full(len(V), -1), np.zeros(len(V), dtype=np.complex128)
        # Number of coarse charts of all calls.
        self._count = 0

    def __call__(self, graph: EdgeGraph, vertices: IntArray, rounds: list[list[Removal]]) -> BoolArray:
        """Return the seams (e,) of the charts of a coarse mesh."""
        F = graph.F
        # The factors on the costs of the sides: the costs, over what they would be without factors.
        cost = (graph.cost / edge_graph(graph.V, F).cost)[graph.side].T
        unit = float(np.sqrt(surface_area(self._V[vertices], F)))
        coarser = None
        if graph.n <= _TUNING.largest_share * len(self._V):

            def divide(charts: list[Chart], V: FloatArray, cost: FloatArray, part: float) -> list[Chart]:
                return self._divide(charts, V, cost, unit * part)

            coarser = CoarseSearch(self._bound, self._min_gain, self._workers, graph.V, divide)
        found = search_charts(
            cut_into_charts(graph.V, F, NO_CUT, cost, self._min_gain, coarser),
            self._bound,
            max_charts=None,
            total_area=surface_area(graph.V, F),
            joinable=True,
            workers=self._workers,
            keep=lambda charts: None,
        )
        seams = np.zeros(len(graph.ends), dtype=bool)
        for chart in self._divide([finish_chart(chart, 0.0) for chart in found], graph.V, cost, unit):
            self._chart[vertices[chart.vertices]] = self._count
            self._place[vertices[chart.vertices]] = to_complex(chart.uv)
            self._count += 1
            seams[graph.numbers(*chart.vertices[boundary_edges(chart.F, len(chart.uv))].T)] = True
        self._chart[vertices[graph.mark_vertices(seams)]] = -1
        self._prolong(rounds)
        return seams & ~graph.rim

    def start(self, charts: list[WorkingChart]) -> None:
        """Give initial maps to charts of the surface, where the coarse ones give an injective map."""
        self._workers.map("start", self._start, charts, sum(len(chart.F) for chart in charts))

    def _prolong(self, rounds: list[list[Removal]]) -> None:
        """Place vertices that the coarse mesh lacks, round after round, if their ring is in a chart."""
        for removals in reversed(rounds):
            for vertices, rings in removals:
                of = self._chart[rings]
                inside = (of[:, 0] >= 0) & (of == of[:, :1]).all(axis=1)
                vertices, rings = vertices[inside], rings[inside]
                distance = np.linalg.norm(self._V[rings] - self._V[vertices][:, None], axis=2)
                weight = 1 / np.maximum(distance, np.finfo(np.float64).tiny)
                weight /= weight.sum(axis=1, keepdims=True)
                self._place[vertices] = (weight * self._place[rings]).sum(axis=1)
                self._chart[vertices] = of[inside, 0]

    def _start(self, chart: WorkingChart) -> None:
        of = self._chart[chart.vertices]
        # At copies of a vertex, the chart meets itself, and each copy would need another position.
        _, copy, times = np.unique(chart.vertices, return_inverse=True, return_counts=True)
        of[times[copy] > 1] = -1
        # Seams have moved since, so that the chart may have parts of other coarse charts, which have other frames.
        count = np.bincount(of[of >= 0], minlength=1)
        known = of == int(np.argmax(count))
        if not known.any():
            return
        g = chart.piece.energy(SymmetricDirichlet(), None).g
        aim = 1 + AIM_OF_CARRIED * (self._bound - 1)
        try:
            chart.start = _fit(chart, g, self._place[chart.vertices], known, aim, self._workers)
        except NotPositiveDefinite:
            return


def cut_into_charts(
    V: FloatArray, F: IntArray, given: IntArray, cost: FloatArray, min_gain: float, coarse: CoarseSearch | None
) -> list[WorkingChart]:
    """Cut a surface into disks, or with ``coarse`` a large one into charts, which get initial maps where possible.

    The ``given`` cuts (l, 2) are demanded.
    """
    cut = find_cuts_by(V, F, given, cost, min_gain, coarse)
    parts = split_parts(F, np.arange(len(F)), cut, len(V))
    charts = [WorkingChart(rows, origin, V[origin], own, cost[rows]) for rows, own, origin in parts]
    if coarse is not None:
        coarse.start(charts)
    return charts


def _fit(
    chart: WorkingChart, g: ComplexArray, w: ComplexArray, known: BoolArray, aim: float, workers: Workers
) -> FloatArray | None:
    """Return an injective map (n, 2) close to the positions w (n,) of some vertices; None if none was found.

    ``g`` (3, f) is as in `NewtonSystem`, and ``aim`` the stretch at which the fits end. With the derivatives p and q of
    the map in each triangle, and targets P and Q, each fit minimises ``Σ area (|p − P|² + |q − Q|²)``: ARAP's global
    step, with one factorisation of the Laplacian for all fits (Liu et al. 2008). First, Q is 0 and P a rotation.
    """
    F, n = chart.F, len(w)
    corners = np.ascontiguousarray(F.T)
    unfolding = _Unfolding(F, g)
    p, q = _derivatives(g, w[corners])
    turned = unfolding.carry(_direction(p), known[F].all(axis=1) & (np.abs(p) > np.abs(q)))
    if turned is None:
        return None
    # Up to a factor, which all terms have.
    area = 1 / np.abs((g[1].conj() * g[2]).imag)
    fitted = Laplacian(F, n, np.array([0])).factor(weigh_edges(g, area))
    w = fitted.respond(sum_at(corners.ravel(), (area * turned * g).ravel(), n))
    most = 1 + _TUNING.permitted * (aim - 1)
    for k in range(_TUNING.most_fits + 1):
        workers.check_wanted()
        p, q = _derivatives(g, w[corners])
        larger, smaller = np.abs(p) + np.abs(q), np.abs(p) - np.abs(q)
        with np.errstate(all="ignore"):
            scale = np.sqrt(area.sum() / (area * larger * smaller).sum())
        good = (larger * scale < aim) & (smaller * scale * aim > 1)
        enough = area[~good].sum() <= _TUNING.enough * FREE_SHARE * area.sum()
        if k == _TUNING.most_fits or (k >= _TUNING.least_fits and enough):
            break
        # At first the targets are rotations, then the nearest matrices with little stretch.
        less = 1.0 if k < _TUNING.rotated_fits else most
        rotation, collapsed = _direction(p), smaller <= _TUNING.least_ratio * larger
        larger, smaller = np.clip(larger, 1 / less, less), np.clip(smaller, 1 / less, less)
        if collapsed.any():
            # The boundary would stay folded where the rotations of these triangles are wrong.
            near = has_marked_corner(F, mark_around(F, collapsed, n))
            carried = unfolding.carry(rotation, ~near)
            if carried is not None:
                rotation = carried
                larger[near] = smaller[near] = 1.0
        target = 0.5 * (larger + smaller) * rotation - p, 0.5 * (larger - smaller) * _direction(q) - q
        load = area * (target[0] * g + target[1] * g.conj())
        w = w + fitted.respond(sum_at(corners.ravel(), load.ravel(), n))
    if not np.isfinite(w).all():
        return None
    rim = sum(map(len, chart.piece.loops))
    if len(check_loops(chart.piece.loops, to_points(w))[0]) > _TUNING.few_crossings * rim:
        return None
    return repair_map(chart.piece, to_points(w))


def _derivatives(g: ComplexArray, at: ComplexArray) -> tuple[ComplexArray, ComplexArray]:
    """Complex derivatives p and q (f,) of a map with positions ``at`` (3, f) of the corners."""
    return (g.conj() * at).sum(axis=0), (g * at).sum(axis=0)


def _direction(p: ComplexArray) -> ComplexArray:
    """Return ``p / |p|``, or 0."""
    return p / np.maximum(np.abs(p), np.finfo(np.float64).tiny)


class _Unfolding:
    """Rotations of triangles (f, 3) as they unfold from their neighbours; ``g`` (3, f) is as in `NewtonSystem`."""

    def __init__(self, F: IntArray, g: ComplexArray) -> None:
        one, other = find_pairs(F)
        # Side k of a triangle is orthogonal to the gradient at its opposite corner.
        side = np.ascontiguousarray(g[(2, 0, 1), :].T).ravel()
        turn = -side[one] / side[other]
        turn /= np.abs(turn)
        self._source, self._there = np.concatenate([one, other]) // 3, np.concatenate([other, one]) // 3
        self._turn = np.concatenate([turn, turn.conj()])

    def carry(self, rotation: ComplexArray, known: BoolArray) -> ComplexArray | None:
        """Return rotations (f,) with those of known triangles (f,) carried on to the others.

        None if no triangle is known.
        """
        if not known.any():
            return None
        turned, done = rotation.copy(), known.copy()
        left = ~done[self._there]
        source, there, turn = self._source[left], self._there[left], self._turn[left]
        while True:
            reached = done[source]
            if not reached.any():
                return turned
            new = there[reached]
            total = sum_at(new, turned[source[reached]] * turn[reached], len(done))
            turned[new] = _direction(total[new])
            done[new] = True
            left = ~done[there]
            source, there, turn = source[left], there[left], turn[left]
