"""The charts that a search has so far, in case that a time limit ends it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from quasiharmonic.apps.unwrapping.chart import Chart, finish_chart, mirror_charts
from quasiharmonic.apps.unwrapping.chart_maps import WorkingChart, keeps_bound
from quasiharmonic.apps.unwrapping.grown_charts import grow_charts
from quasiharmonic.apps.unwrapping.hinges import DEMANDED_COST
from quasiharmonic.apps.unwrapping.symmetry import Mirror
from quasiharmonic.geometry.mesh.topology import mark_sides
from quasiharmonic.util.arrays import BoolArray, FloatArray, IntArray


@dataclass(eq=False)
class Draft:
    """Charts of a search that may end early.

    Attributes
    ----------
    charts : sequence of Chart
        Charts that are finished.
    working : sequence of WorkingChart
        Further charts, with and without maps.
    mirror : Mirror or None
        Mirror images, if ``working`` has charts of one side only.
    rows : (k,) int64 or None
        The triangles that are searched, if not all are. The charts above refer to these.
    others : sequence of Chart
        Charts of other triangles.
    """

    charts: Sequence[Chart] = ()
    working: Sequence[WorkingChart] = ()
    mirror: Mirror | None = None
    rows: IntArray | None = None
    others: Sequence[Chart] = ()

    def keep(self, working: Sequence[WorkingChart]) -> None:
        """Replace the charts that are not finished."""
        self.working = working

    def complete(
        self, V: FloatArray, F: IntArray, cost: FloatArray, cuts: IntArray | None, bound: float
    ) -> tuple[list[Chart], BoolArray]:
        """Return all bijective charts that keep the bound, and charts grown by normals of all other triangles.

        Parameters
        ----------
        V : (n, 3) float64
        F : (f, 3) int64
        cost : (f, 3) float64
            Factor on the cost of a seam at each side; see `find_charts`.
        cuts : (l, 2) int64, optional
            Edges that must be seams.
        bound : float
            Bound on the stretch.

        Returns
        -------
        charts : list of Chart
            Ordered by first triangle.
        grown : (f,) bool
            The triangles of charts that were grown by normals.
        """
        good = [finish_chart(chart, 0.0) for chart in self.working if chart.bijective and keeps_bound(chart, bound)]
        rows = np.arange(len(F)) if self.rows is None else self.rows
        found = [*self.charts, *(good if self.mirror is None else mirror_charts(F[rows], good, self.mirror))]
        found = [*self.others, *(replace(chart, triangles=rows[chart.triangles]) for chart in found)]
        grown = np.ones(len(F), dtype=bool)
        for chart in found:
            grown[chart.triangles] = False
        cut = cost <= DEMANDED_COST
        if cuts is not None:
            cut |= mark_sides(F, cuts, len(V))
        found += grow_charts(V, F, np.flatnonzero(grown), cost, cut, bound)
        return sorted(found, key=lambda chart: int(chart.triangles[0])), grown
