"""Mirror images of charts, and pairs of charts that are mirror images."""

from __future__ import annotations

import numpy as np

from quasiharmonic.apps.unwrapping.chart import Chart
from quasiharmonic.apps.unwrapping.symmetry import Mirror
from quasiharmonic.util.arrays import IntArray


def mirror_charts(F: IntArray, charts: list[Chart], mirror: Mirror) -> list[Chart]:
    """Return charts of one side of the plane of symmetry, and their images."""
    return [*charts, *(_mirror(F, chart, mirror) for chart in charts)]


def pair_charts(charts: list[Chart], mirror: Mirror | None) -> list[int]:
    """Return a number for each chart that it shares with its mirror image only; charts without one have their own."""
    owner = {chart.triangles.tobytes(): k for k, chart in enumerate(charts)}
    if mirror is None:
        return list(range(len(charts)))
    images = [owner.get(np.sort(mirror.triangle[chart.triangles]).tobytes(), k) for k, chart in enumerate(charts)]
    return [min(k, image) for k, image in enumerate(images)]


def _mirror(F: IntArray, chart: Chart, mirror: Mirror) -> Chart:
    """Return the mirror image of a chart."""
    rows = mirror.triangle[chart.triangles]
    # The corner of the original for each corner of its image.
    original = mirror.vertex[F[chart.triangles]]
    corner = np.argmax(F[rows][:, :, None] == original[:, None, :], axis=2)
    own = np.take_along_axis(chart.F, corner, axis=1)
    order = np.argsort(rows)
    return Chart(
        rows[order], own[order], mirror.vertex[chart.vertices], chart.uv * [-1, 1], chart.stretch[order], chart.misses
    )
