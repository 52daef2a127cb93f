"""Separate boundary parts of a chart that overlap a little.

A boundary vertex that lies behind a crossed boundary edge, inside the surface, is pushed back across this edge. The
penalty on its depth is quadratic, with constant direction during a few Newton steps. This resolves overlaps of about an
edge length. An exact test decides whether the boundary still meets itself.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from scipy.spatial import KDTree

from quasiharmonic.apps.unwrapping.chart_maps import EvenStretch, WorkingChart
from quasiharmonic.energies.newton.map_model import Coordinates, MapModel, in_units
from quasiharmonic.energies.newton.newton_descent import NewtonDescent
from quasiharmonic.energies.newton.newton_system import NewtonSystem
from quasiharmonic.geometry.exact.loops import check_loops, winding
from quasiharmonic.util.arrays import ComplexArray, FloatArray, IntArray, mark, sum_at


class SeparationTuning(NamedTuple):
    """Numbers that tune the separation of overlaps."""

    # Distance that a vertex must have from the edge, relative to the edge's length.
    gap: float = 0.1
    # Weight of a penalty, relative to a triangle's share of the area.
    weight: float = 30.0
    # Maximum number of updates of the pairs, and of Newton steps between them.
    max_updates: int = 12
    steps: int = 2
    tolerance: float = 1e-2
    # The search stops after this number of successive updates without fewer crossings.
    max_stalls: int = 4
    # In larger charts, only some vertices move, at least and at most so many: those at most twice as far from a
    # crossing as crossings are from each other.
    fewest_free: int = 1_000
    most_free: int = 5_000


_TUNING = SeparationTuning()


class Penetrations:
    """Pairs of a boundary vertex and a boundary edge, with a penalty on vertices behind their edge; see `MapModel`.

    Attributes
    ----------
    corners : (3, c) int64
        Vertex, and start and end of the edge.
    """

    def __init__(self, weight: float) -> None:
        self._weight = weight
        self.corners: IntArray = np.empty((3, 0), dtype=np.int64)
        self._normal: ComplexArray = np.empty(0, dtype=np.complex128)
        self._shares: FloatArray = np.empty((3, 0))
        self._length: FloatArray = np.empty(0)

    def add(self, crossings: IntArray, w: ComplexArray) -> None:
        """Add the pairs at crossing edges (c, 4) of a map (n,), and update the directions of all pairs."""
        a, b, c, d = crossings.T
        found = np.concatenate([np.stack(rows) for rows in ((a, c, d), (b, c, d), (c, a, b), (d, a, b))], axis=1)
        found = found[:, (found[0] != found[1]) & (found[0] != found[2])]
        v, start, end = w[found]
        found = found[:, ((end - start).conj() * (v - start)).imag > 0]
        self.corners = np.unique(np.concatenate([self.corners, found], axis=1), axis=1)
        v, start, end = w[self.corners]
        along = end - start
        self._length = np.maximum(np.abs(along), np.finfo(np.float64).tiny)
        self._normal = -1j * along / self._length
        s = np.clip(((v - start) * along.conj()).real / self._length**2, 0, 1)
        self._shares = np.stack([np.ones(s.size), s - 1, -s])

    def _depth(self, w: ComplexArray) -> FloatArray:
        """How much the distance from the edge is too small, relative to its length; 0 where it is large enough."""
        ahead = (self._normal.conj() * (self._shares * w[self.corners]).sum(axis=0)).real
        return np.maximum(_TUNING.gap - ahead / self._length, 0)

    def value(self, w: ComplexArray) -> float:
        """Value at a map (n,)."""
        return self._weight * float(np.sum(self._depth(w) ** 2))

    def gradient(self, w: ComplexArray) -> ComplexArray:
        """Derivative with respect to the positions, (n,)."""
        pull = -2 * self._weight * self._depth(w) / self._length * self._normal
        parts = (self._shares * pull).ravel()
        at = self.corners.ravel()
        return sum_at(at, parts, w.size)

    def add_to(self, system: NewtonSystem, w: ComplexArray) -> None:
        """Add a bound of the second derivatives that does not couple vertices."""
        stiffness = 6 * self._weight * (self._depth(w) > 0) / self._length**2
        bound = (stiffness * self._shares**2).ravel()
        x, y = np.tile(self._normal.real, 3), np.tile(self._normal.imag, 3)
        at = self.corners.ravel()
        blocks = (np.bincount(at, bound * part, minlength=w.size) for part in (x * x, x * y, y * y))
        system.add_blocks(*(np.asarray(part, dtype=np.float64)[system.free] for part in blocks))


def separate(chart: WorkingChart, bound: float, check_wanted: Callable[[], object]) -> bool:
    """Move overlapping boundary parts of a chart apart; return whether the map is then bijective."""
    assert chart.uv is not None
    energy = chart.piece.energy(EvenStretch(bound), None)
    fixed = _find_far_vertices(chart)
    pairs = Penetrations(_TUNING.weight / len(chart.F))
    system = NewtonSystem(energy.F, energy.g, len(chart.uv), fixed, chart.linear_solver)
    coordinates = Coordinates.of(chart.uv, fixed, 0)
    model = MapModel(energy, coordinates, system, [pairs])
    w, crossings = in_units(chart.uv, 0), chart.crossings
    fewest, stalls = len(crossings), 0
    for _ in range(_TUNING.max_updates):
        pairs.add(crossings, w)
        descent = NewtonDescent(model, model.evaluate(w))
        for _ in range(_TUNING.steps):
            check_wanted()
            with np.errstate(all="ignore"):
                if descent.step(_TUNING.tolerance) is not None:
                    break
        w = descent.w
        crossings, reasons = check_loops(chart.piece.loops, coordinates.positions(w))
        if not reasons:
            chart.use(coordinates.positions(w))
            return True
        fewer = len(crossings) < fewest
        fewest, stalls = min(fewest, len(crossings)), 0 if fewer else stalls + 1
        if not len(crossings) or stalls == _TUNING.max_stalls:
            break
    return False


def _find_far_vertices(chart: WorkingChart) -> IntArray:
    """Vertices that stay where they are: at least one, and in a large chart all that are far from its crossings.

    A chart that overlaps itself has no crossings if one of its loops lies on the wrong side of another.
    """
    assert chart.uv is not None
    if len(chart.uv) <= _TUNING.fewest_free or not len(chart.crossings):
        return np.array([int(chart.piece.loops[0][0])])
    crossed = chart.uv[np.unique(chart.crossings)]
    distance, _ = KDTree(crossed).query(chart.uv)
    near = np.count_nonzero(distance <= 2 * np.linalg.norm(np.ptp(crossed, axis=0)))
    order = np.argsort(distance, kind="stable")
    return np.sort(order[min(max(near, _TUNING.fewest_free), _TUNING.most_free, len(order) - 1) :])


def overlapping_share(chart: WorkingChart) -> float:
    """Share of the area of the triangles at the boundary whose centres are covered more than once."""
    assert chart.uv is not None
    loops = chart.piece.loops
    rim = mark(len(chart.V), np.concatenate(loops))
    near = np.flatnonzero(rim[chart.F].any(axis=1))
    tails, heads = np.concatenate(loops), np.concatenate([np.roll(loop, -1) for loop in loops])
    turns, _ = winding(chart.uv[chart.F[near]].mean(axis=1), chart.uv[tails], chart.uv[heads])
    return float(chart.area[near[turns != 1]].sum())
