"""Charts of a large surface from those of a coarse mesh: their seams, and initial maps close to the final ones.

The seams of all charts of the coarse mesh are carried to the surface and shortened there. A vertex in the interior of a
coarse chart keeps its position in that chart's map. The other vertices of a chart of the surface get the harmonic
extension. Then every triangle is rotated as this map rotates it, and the map is fitted to the rotated triangles [1]_,
which is repeated. All systems have one unknown per vertex and the same matrix.

References
----------
.. [1] L. Liu, L. Zhang, Y. Xu, C. Gotsman, S. J. Gortler, A local/global approach to mesh parameterization. Computer
   Graphics Forum 27 (2008).
"""

from __future__ import annotations

import numpy as np

from quasiharmonic.apps.unwrapping.chart_maps import WorkingChart
from quasiharmonic.apps.unwrapping.chart_search import Workers, search_charts
from quasiharmonic.energies.energies import SymmetricDirichlet
from quasiharmonic.geometry.exact.certificate import is_injective
from quasiharmonic.geometry.mesh.fans import split_parts
from quasiharmonic.geometry.mesh.reference import surface_area
from quasiharmonic.linsolve import NotPositiveDefinite
from quasiharmonic.linsolve.laplacian import Laplacian
from quasiharmonic.targets.cuts.graph import EdgeGraph, edge_graph
from quasiharmonic.util.arrays import BoolArray, ComplexArray, FloatArray, IntArray, sum_at, to_complex, to_points

# Numbers of fits after which a map without inverted triangles is used, and after which the search for one ends.
_FITS, _MOST_FITS = 4, 16


class CoarseSearch:
    """A search for charts on the coarse mesh of a surface with ``n`` vertices; ``names`` (m,) are those of its part."""

    def __init__(self, bound: float, workers: Workers, n: int, names: IntArray) -> None:
        self._bound, self._workers, self._names = bound, workers, names
        self._chart, self._place = np.full(n, -1), np.zeros(n, dtype=np.complex128)
        self._count = 0

    def __call__(self, graph: EdgeGraph, cut: BoolArray, vertices: IntArray) -> BoolArray:
        """Return the seams (e,) of the charts of a coarse mesh, given cuts that make disks."""
        F, names = graph.F, self._names[vertices]
        cost = (graph.cost / edge_graph(graph.V, F).cost)[graph.side].T
        parts = split_parts(F, np.arange(len(F)), graph.ends[cut], graph.n)
        found = search_charts(
            [WorkingChart(rows, origin, graph.V[origin], own, cost[rows]) for rows, own, origin in parts],
            self._bound,
            max_charts=None,
            total_area=surface_area(graph.V, F),
            joinable=True,
            workers=self._workers,
            keep=lambda charts: None,
        )
        seams = np.zeros(len(graph.ends), dtype=bool)
        for chart in found:
            assert chart.uv is not None
            self._chart[names[chart.vertices]] = self._count
            self._place[names[chart.vertices]] = to_complex(chart.uv)
            self._count += 1
            for loop in chart.piece.loops:
                seams[graph.numbers(*chart.vertices[np.stack([loop, np.roll(loop, -1)])])] = True
        self._chart[names[graph.mark_vertices(seams)]] = -1
        return seams & ~graph.rim

    def start(self, charts: list[WorkingChart]) -> None:
        """Give initial maps to charts of the surface, where the coarse ones give an injective map."""
        self._workers.map("start", self._start, charts)

    def _start(self, chart: WorkingChart) -> None:
        of = self._chart[chart.vertices]
        _, copy, times = np.unique(chart.vertices, return_inverse=True, return_counts=True)
        of[times[copy] > 1] = -1
        count = np.bincount(of[of >= 0], minlength=1)
        known = of == int(np.argmax(count))
        if not known.any():
            return
        g = chart.piece.energy(SymmetricDirichlet(), None).g
        try:
            chart.start = _fit(chart.F, g, self._place[chart.vertices], known, self._workers)
        except NotPositiveDefinite:
            return


def _fit(F: IntArray, g: ComplexArray, w: ComplexArray, known: BoolArray, workers: Workers) -> FloatArray | None:
    """Return an injective map (n, 2) close to the positions w (n,) of some vertices; None if none was found.

    ``g`` (3, f) is as in `NewtonSystem`.
    """
    corners = np.ascontiguousarray(F.T)
    area = 1 / np.abs((g[1].conj() * g[2]).imag)
    stiffness = 2 * area * (g * g[(1, 2, 0), :].conj()).real
    w = Laplacian(F, len(w), np.flatnonzero(known)).factor(stiffness).extend(w)
    fitted = Laplacian(F, len(w), np.array([0])).factor(stiffness)
    for k in range(_MOST_FITS):
        workers.check_wanted()
        at = w[corners]
        p, q = (g.conj() * at).sum(axis=0), (g * at).sum(axis=0)
        if k >= _FITS and (np.abs(p) > np.abs(q)).all():
            break
        turned = p / np.maximum(np.abs(p), np.finfo(np.float64).tiny)
        load = area * ((turned - p) * g - q * g.conj())
        w = w + fitted.respond(sum_at(corners.ravel(), load.ravel(), w.size))
    uv = to_points(w)
    return uv if is_injective(F, uv) else None
