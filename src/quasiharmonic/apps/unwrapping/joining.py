"""Join small charts to their neighbours at one edge, where this causes no overlap.

A division that removes an overlap often cuts off a few triangles. They fit to another chart, or to another edge.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np

from quasiharmonic.apps.unwrapping.chart_maps import WorkingChart
from quasiharmonic.apps.unwrapping.hinges import DEMANDED_COST
from quasiharmonic.geometry.exact.certificate import is_injective
from quasiharmonic.util.arrays import ComplexArray, FloatArray, IntArray

# Charts of at most this number of triangles, with at most this share of the area, are joined to others.
_SMALL, _SHARE = 32, 0.003
# Maximum number of edges of a chart that are tried, longest first.
_TRIES = 12


def join_small_charts(
    charts: Sequence[WorkingChart], bound: float, total_area: float, check_wanted: Callable[[], object]
) -> list[WorkingChart]:
    """Join small charts to neighbours at one edge each.

    Parameters
    ----------
    charts : sequence of WorkingChart
        With bijective maps.
    bound : float
        Largest stretch of a triangle of a chart that is joined to another one.
    total_area : float
        Area of the surface.
    check_wanted : callable
        Called before each chart; may raise an exception.

    Returns
    -------
    list of WorkingChart
        All have bijective maps.
    """
    small = [k for k, chart in enumerate(charts) if _is_small(chart, total_area)]
    if not small:
        return list(charts)
    owner = {side: k for k, chart in enumerate(charts) for side in _mesh_sides(chart)}
    present: dict[int, WorkingChart] = dict(enumerate(charts))
    for k in sorted(small, key=lambda k: len(charts[k].F)):
        check_wanted()
        chart = present[k]
        if not _is_small(chart, total_area):
            continue
        tail, head = _sides(chart)
        wanted = _find_demanded(chart)
        length = np.linalg.norm(chart.V[tail] - chart.V[head], axis=1)
        tries = 0
        for i in np.argsort(-length, kind="stable").tolist():
            if (int(tail[i]), int(head[i])) in wanted:
                continue
            other = owner.get((int(chart.vertices[head[i]]), int(chart.vertices[tail[i]])), k)
            if other == k:
                continue
            joined = _join(present[other], chart, int(tail[i]), int(head[i]), bound)
            if joined is not None:
                present[other] = joined
                del present[k]
                owner.update((side, other) for side in _mesh_sides(chart))
                break
            tries += 1
            if tries == _TRIES:
                break
    return list(present.values())


def _is_small(chart: WorkingChart, total_area: float) -> bool:
    return len(chart.F) <= _SMALL and chart.surface_area <= _SHARE * total_area


def _find_demanded(chart: WorkingChart) -> set[tuple[int, int]]:
    """Return the sides of triangles that must be seams, by their ends."""
    demanded = chart.cost <= DEMANDED_COST
    return set(zip(chart.F[demanded].tolist(), chart.F[:, (1, 2, 0)][demanded].tolist(), strict=True))


def _sides(chart: WorkingChart) -> tuple[IntArray, IntArray]:
    """Return the start and end vertices (k,) of the boundary edges, in the direction of the triangles."""
    loops = chart.piece.loops
    return np.concatenate(loops), np.concatenate([np.roll(loop, -1) for loop in loops])


def _mesh_sides(chart: WorkingChart) -> list[tuple[int, int]]:
    """Return the boundary edges as pairs of vertices of the mesh."""
    tail, head = _sides(chart)
    return list(zip(chart.vertices[tail].tolist(), chart.vertices[head].tolist(), strict=True))


def _positions(chart: WorkingChart) -> ComplexArray:
    """Return the map (m,) of a chart, as complex numbers in the surface's unit of length."""
    assert chart.uv is not None
    uv: FloatArray = np.ldexp(chart.uv, chart.piece.exponent)
    return uv[:, 0] + 1j * uv[:, 1]


def _join(large: WorkingChart, small: WorkingChart, i: int, j: int, bound: float) -> WorkingChart | None:
    """Join a chart at its edge from i to j to another one; None if that stretches it too much, or causes an overlap."""
    tail, head = _sides(large)
    match = (large.vertices[tail] == small.vertices[j]) & (large.vertices[head] == small.vertices[i])
    if not match.any():
        return None
    at = int(np.flatnonzero(match)[0])
    z, w = _positions(large), _positions(small)
    factor = (z[tail[at]] - z[head[at]]) / (w[j] - w[i])
    scale = abs(factor)
    if not max(scale, 1 / scale) * small.stretch.max() <= bound:
        return None
    w = z[head[at]] + factor * (w - w[i])
    # Of the smaller chart, all vertices but the two ends of the edge are new.
    number = np.empty(len(w), dtype=np.int64)
    new = np.delete(np.arange(len(w)), [i, j])
    number[new] = len(z) + np.arange(len(new))
    number[i], number[j] = head[at], tail[at]
    triangles = np.concatenate([large.triangles, small.triangles])
    order = np.argsort(triangles)
    joined = WorkingChart(
        triangles[order],
        np.concatenate([large.vertices, small.vertices[new]]),
        np.concatenate([large.V, small.V[new]]),
        np.concatenate([large.F, number[small.F]])[order],
        np.concatenate([large.cost, small.cost])[order],
    )
    z = np.ldexp(np.concatenate([z, w[new]]).view(np.float64), -joined.piece.exponent).view(np.complex128)
    uv = np.column_stack([z.real, z.imag])
    if not is_injective(joined.F, uv):
        return None
    joined.use(uv)
    return joined if joined.bijective else None
