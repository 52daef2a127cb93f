"""Close slits: cuts inside a chart whose two sides lie at the same place, as in parts that unfold without stretch."""

from __future__ import annotations

import numpy as np

from quasiharmonic.apps.unwrapping.chart_maps import WorkingChart
from quasiharmonic.apps.unwrapping.hinges import DEMANDED_COST
from quasiharmonic.geometry.exact.certificate import is_injective
from quasiharmonic.geometry.mesh.fans import fans, renumber
from quasiharmonic.geometry.mesh.topology import edge_keys
from quasiharmonic.util.arrays import mark

# Two sides of a cut lie at the same place if their ends are at most this fraction of their length apart.
_SAME = 0.01


def close_slits(chart: WorkingChart) -> WorkingChart | None:
    """Join a chart to itself at boundary edges that are one edge of the surface and lie at the same place.

    The chart may have more holes afterwards. Return None if there are no such edges, or if the joined chart has no
    injective map.
    """
    assert chart.uv is not None
    size = len(chart.V)
    tail, head = chart.F.ravel(), chart.F[:, (1, 2, 0)].ravel()
    rim = np.flatnonzero(~np.isin(tail * size + head, head * size + tail))
    edge = edge_keys(chart.vertices[tail[rim]], chart.vertices[head[rim]], int(chart.vertices.max()) + 1)
    order = np.argsort(edge, kind="stable")
    first = np.flatnonzero(np.diff(edge[order]) == 0)
    one, other = rim[order[first]], rim[order[first + 1]]
    z = chart.uv[:, 0] + 1j * chart.uv[:, 1]
    apart = np.maximum(np.abs(z[tail[one]] - z[head[other]]), np.abs(z[head[one]] - z[tail[other]]))
    same = (apart <= _SAME * np.abs(z[tail[one]] - z[head[one]])) & (chart.cost.ravel()[one] > DEMANDED_COST)
    if not same.any():
        return None
    cut = mark(chart.F.size, np.setdiff1d(rim, np.concatenate([one[same], other[same]])))
    on_surface = chart.vertices[chart.F]
    own, corner = renumber(fans(on_surface, cut.reshape(-1, 3))[0], on_surface)
    count = np.bincount(own.ravel())
    uv = np.stack([np.bincount(own.ravel(), chart.uv[chart.F, k].ravel()) / count for k in range(2)], axis=1)
    origin = chart.F.ravel()[corner]
    try:
        closed = WorkingChart(chart.triangles, chart.vertices[origin], chart.V[origin], own, chart.cost)
    except ValueError:
        # The surface would have a handle.
        return None
    uv = np.ldexp(uv, chart.piece.exponent - closed.piece.exponent)
    if not is_injective(own, uv):
        return None
    closed.use(uv)
    return closed
