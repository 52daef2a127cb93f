"""Move triangles between charts: small charts join a neighbour, and teeth move into the notch across a seam.

A division that removes an overlap often cuts off a few triangles. They fit to another chart, or to another edge. Teeth
are triangles with two sides on a seam, which then takes the third side, which is shorter. The triangle's corners are
vertices of the other chart already, so its map only has to be free of overlaps there.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from heapq import heapify, heappop, heappush

import numpy as np

from quasiharmonic.apps.unwrapping.chart_maps import WorkingChart
from quasiharmonic.apps.unwrapping.hinges import DEMANDED_COST, UNDIVIDED_COST
from quasiharmonic.geometry.exact.certificate import is_injective
from quasiharmonic.geometry.mesh.reference import rest_shapes
from quasiharmonic.geometry.mesh.topology import ahead
from quasiharmonic.targets.cuts.graph import edge_graph, triangles_near
from quasiharmonic.util.arrays import ComplexArray, IntArray, invert_indices, mark, to_complex, to_points

# Charts of at most this number of triangles, with at most this share of the area, are joined to others.
_SMALL, _SHARE = 32, 0.003
# Maximum number of edges of a chart that are tried, longest first.
_TRIES = 12
# The seam must become shorter by this share of the two sides.
_SAVES = 0.02
# Only triangles within this many rings around the seams move.
_RINGS = 3
# No vertex of an outline may lie in a notch, or this close to it, relative to its height.
_CLOSE = 0.05


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
    return to_complex(np.ldexp(chart.uv, chart.piece.exponent))


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
    uv = np.ldexp(to_points(np.concatenate([z, w[new]])), -joined.piece.exponent)
    if not is_injective(joined.F, uv):
        return None
    joined.use(uv)
    return joined if joined.bijective else None


def move_teeth(charts: Sequence[WorkingChart], bound: float) -> list[WorkingChart]:
    """Move triangles between charts, and across slits, where this shortens the seams.

    Parameters
    ----------
    charts : sequence of WorkingChart
        With bijective maps.
    bound : float
        Largest stretch of a triangle that moves.

    Returns
    -------
    list of WorkingChart
        All have bijective maps.
    """
    if not charts:
        return []
    layout = _SeamedCharts(charts)
    layout.move(bound)
    changed = [k for k in range(len(charts)) if layout.changed[k]]
    done = list(charts)
    for k in changed:
        done[k] = layout.take(k)
    good = all(done[k].bijective and not (done[k].too_long.any() and not charts[k].too_long.any()) for k in changed)
    return done if good else list(charts)


class _SeamedCharts:
    """Triangles of several charts, by vertices of all charts."""

    def __init__(self, charts: Sequence[WorkingChart]) -> None:
        start = np.cumsum([0, *(len(chart.V) for chart in charts)])
        self.triangles = np.concatenate([chart.triangles for chart in charts])
        self.F = np.concatenate([chart.F + first for chart, first in zip(charts, start, strict=False)])
        self.V = np.concatenate([chart.V for chart in charts])
        self.vertices = np.concatenate([chart.vertices for chart in charts])
        self.chart = np.repeat(np.arange(len(charts)), [len(chart.F) for chart in charts])
        self.cost = np.concatenate([chart.cost for chart in charts])
        self.changed = np.zeros(len(charts), dtype=bool)
        self.z = np.concatenate([_positions(chart) for chart in charts])
        self.rims = [np.concatenate(chart.piece.loops) + first for chart, first in zip(charts, start, strict=False)]
        self.ahead = ahead(np.arange(self.F.size))
        shapes = rest_shapes(self.V, self.F)
        self.sides = shapes.unit * shapes.sides
        self._pair_sides()
        self.fixed = (self.cost <= DEMANDED_COST) | (self.cost >= UNDIVIDED_COST)

    def _pair_sides(self) -> None:
        """Find the price (f, 3) of each side and the other side (3 f,) of its edge, -1 far from all seams."""
        n = int(self.vertices.max()) + 1
        present = np.flatnonzero(mark(n, self.vertices))
        own = invert_indices(n, present)[self.vertices]
        points = np.empty((present.size, 3))
        points[own] = self.V
        # The mesh of all charts without seams.
        T = own[self.F]
        near = np.flatnonzero(triangles_near(T, mark(present.size, *(own[rim] for rim in self.rims)), _RINGS))
        # Sides at the border of these triangles have no other side, so their prices do not matter.
        graph = edge_graph(points, T[near], self.cost[near])
        self.price = np.zeros(T.shape)
        self.price[near] = graph.cost[graph.side.T]
        side, opposite = (3 * near[:, None] + np.arange(3)).ravel(), graph.half_edges[0]
        self.partner = np.full(T.size, -1)
        self.partner[side] = np.where(opposite < 0, -1, side[opposite])

    def _is_seam(self, side: int) -> bool:
        """Whether a side is on a seam between two triangles."""
        other = int(self.partner[side])
        if other < 0:
            return False
        F, ahead = self.F.ravel(), self.ahead
        return bool(F[side] != F[ahead[other]] or F[ahead[side]] != F[other])

    def _find_tooth(self, t: int) -> tuple[float, int] | None:
        """Return what moving a triangle saves, and its tip's corner; None if it is no tooth, or must stay."""
        seams = [self._is_seam(3 * t + k) for k in range(3)]
        if sum(seams) != 2:
            return None
        base = seams.index(False)
        tip = (base + 2) % 3
        if self.partner[3 * t + base] < 0 or self.fixed[t].any():
            return None
        before, after = self.partner[3 * t + (tip + 2) % 3], self.partner[3 * t + tip]
        if self.F.ravel()[before] != self.F.ravel()[self.ahead[after]]:
            return None
        left = self.price[t, tip] + self.price[t, (tip + 2) % 3]
        saved = float(left - self.price[t, base])
        return (saved, tip) if saved > _SAVES * left else None

    def move(self, bound: float) -> None:
        """Move all teeth, the greatest saving first."""
        one = np.flatnonzero(self.partner >= 0)
        F, other = self.F.ravel(), self.partner[one]
        seam = (F[one] != F[self.ahead[other]]) | (F[self.ahead[one]] != F[other])
        twice = np.flatnonzero(np.bincount(one[seam] // 3, minlength=len(self.F)) == 2).tolist()
        queue = [(-found[0], t) for t in twice if (found := self._find_tooth(t)) is not None]
        heapify(queue)
        while queue:
            _, t = heappop(queue)
            found = self._find_tooth(t)
            if found is None or not self._move(t, found[1], bound):
                continue
            for near in self.partner[3 * t : 3 * t + 3].tolist():
                if near >= 0 and (more := self._find_tooth(near // 3)) is not None:
                    heappush(queue, (-more[0], near // 3))

    def _move(self, t: int, tip: int, bound: float) -> bool:
        """Move a tooth into its notch, if it fits."""
        before, after = (int(self.partner[3 * t + (tip + shift) % 3]) for shift in (2, 0))
        F = self.F.ravel()
        corners = np.empty(3, dtype=np.int64)
        corners[tip], corners[(tip + 1) % 3], corners[(tip + 2) % 3] = F[before], F[after], F[self.ahead[before]]
        z = self.z[corners]
        goal = int(self.chart[before // 3])
        if len(set(corners.tolist())) < 3 or not self._keeps(t, z, bound) or self._is_occupied(t, goal, corners):
            return False
        self.changed[[self.chart[t], goal]] = True
        rim = self.rims[self.chart[t]]
        self.rims[self.chart[t]] = rim[rim != self.F[t, tip]]
        self.F[t], self.chart[t] = corners, goal
        return True

    def _keeps(self, t: int, z: ComplexArray, bound: float) -> bool:
        """Whether a triangle with corners (3,) complex128 in the plane is positive and keeps the bound."""
        a, b = self.sides[0, t], -self.sides[2, t]
        u, v = z[1] - z[0], z[2] - z[0]
        # u = p a + q conj(a), v = p b + q conj(b)
        det = a * b.conjugate() - a.conjugate() * b
        p, q = (u * b.conjugate() - v * a.conjugate()) / det, (a * v - b * u) / det
        high, low = abs(p) + abs(q), abs(p) - abs(q)
        return bool(low > 0 and max(high, 1 / low) <= bound)

    def _is_occupied(self, t: int, goal: int, corners: IntArray) -> bool:
        """Whether a vertex of a chart's outline lies in a notch."""
        rim = self.rims[goal]
        others = self.z[rim[~np.isin(rim, [*corners, *self.F[t]])]]
        z = self.z[corners]
        inside = np.ones(others.size, dtype=bool)
        for k in range(3):
            along = z[(k + 1) % 3] - z[k]
            height = ((z[(k + 2) % 3] - z[k]) / along).imag
            inside &= ((others - z[k]) / along).imag > -_CLOSE * height
        return bool(inside.any())

    def take(self, k: int) -> WorkingChart:
        """Return a chart with its map."""
        rows = np.flatnonzero(self.chart == k)
        rows = rows[np.argsort(self.triangles[rows])]
        names, own = np.unique(self.F[rows], return_inverse=True)
        chart = WorkingChart(
            self.triangles[rows], self.vertices[names], self.V[names], own.reshape(-1, 3), self.cost[rows]
        )
        chart.use(np.ldexp(to_points(self.z[names]), -chart.piece.exponent))
        return chart
