"""Cuts that go where they save distortion, weighed against their length.

What is made small is a *price*: the energy of the map that cuts let be, as `shrinking` tells it, and so much for each
unit of their length. An end inside counts like some length, too, since nobody wants to sew a hundred nicks.

Whether a cut is worth its length shows when it is made: the scale is largest at the tip of a limb, a cut goes there
from the others, and stays if the price falls (Gu, Gortler and Hoppe [1]_ cut to where a map stretches most, whatever it
costs). Then stretches are exchanged for shorter ones, as far as the price falls by that, and limbs that have been
reached otherwise in the meantime lose their cuts. Each of these makes room for the others, so there are some rounds.

References
----------
.. [1] X. Gu, S. Gortler, H. Hoppe, Geometry images. ACM Trans. Graph. 21 (2002).
"""

from __future__ import annotations

import numpy as np

from quasiharmonic.targets.cuts.graph import EdgeGraph
from quasiharmonic.targets.cuts.shortening import shortened, stretches
from quasiharmonic.targets.cuts.shrinking import Shrinking
from quasiharmonic.util.arrays import BoolArray, FloatArray, IntArray

# A loose end costs as much as a cut of this length, the surface having area 1.
_END = 0.1
# So many places one after another to which no cut is worth its length, and no more are tried. Once one is not, neither
# are those nearer to it than this part of the way to the cuts.
_FAILURES, _NEAR = 6, 0.5
# Lengths that change by less than this part need no cut, and places this near to the most shrunk one are as good.
_EVEN, _TIES = 1e-3, 1e-6
_ROUNDS = 3


def reached(graph: EdgeGraph, cut: BoolArray, min_gain: float) -> BoolArray:
    """Lead cuts to what sticks out as far as it is worth their length, and shorten them.

    Parameters
    ----------
    graph : EdgeGraph
        Of a connected surface.
    cut : (e,) bool
        Edges whose cutting makes it a disk.
    min_gain : float
        What a unit of length costs, the surface having area 1, in units of the mean energy.

    Returns
    -------
    (e,) bool
        Edges whose cutting makes it a disk.
    """
    balance = _Balance(graph, min_gain)
    if not balance.shrinking.area.any():
        return cut
    for _ in range(_ROUNDS):
        tried = balance.pruned(shortened(graph, balance.extended(cut), balance.price))
        if not balance.price(tried) < balance.price(cut):
            break
        cut = tried
    return cut


class _Balance:
    """Energy and length of cuts weighed against each other."""

    def __init__(self, graph: EdgeGraph, min_gain: float) -> None:
        self.graph = graph
        self.min_gain = min_gain
        self.shrinking = Shrinking(graph)
        self._rim = graph.rim_vertices
        self._prices: dict[bytes, float] = {}

    def price(self, cut: BoolArray) -> float:
        """What cuts cost, their length and the energy of the map that they let be."""
        key = np.packbits(cut).tobytes()
        if key not in self._prices:
            self._weigh(cut)
        return self._prices[key]

    def _weigh(self, cut: BoolArray) -> FloatArray:
        """The scale w under cuts, whose price is known from then on."""
        w = self.shrinking.of(self._rim | self.graph.touched(cut))
        length = float(self.graph.length[cut].sum()) + _END * int(self._loose(cut).sum())
        self._prices[np.packbits(cut).tobytes()] = self.shrinking.energy(w) + self.min_gain * length
        return w

    def _loose(self, cut: BoolArray) -> BoolArray:
        """Which vertices are loose ends of cuts; (n,)."""
        return (np.bincount(self.graph.ends[cut].ravel(), minlength=self.graph.n) == 1) & ~self._rim

    def extended(self, cut: BoolArray) -> BoolArray:
        """Cuts, and more of them to where the scale is most, while that lowers the price."""
        w = self._weigh(cut)
        given_up = np.zeros(self.graph.n, dtype=bool)
        failures = 0
        while failures < _FAILURES:
            height = np.where(given_up, 0.0, np.abs(w))
            if not height.max() > _EVEN:
                break
            # The first of those that differ by rounding.
            tip = int(np.argmax(height >= (1 - _TIES) * height.max()))
            opened = np.flatnonzero(self._rim | self.graph.touched(cut))
            distance, before = self.graph.distances(opened, self.graph.cost)
            longer = cut.copy()
            longer[self.graph.way_back(before, tip)] = True
            w_then = self._weigh(longer)
            if self.price(longer) < self.price(cut):
                cut, w, failures = longer, w_then, 0
            else:
                around, _ = self.graph.distances(np.array([tip]), self.graph.cost, limit=_NEAR * distance[tip])
                given_up |= np.isfinite(around)
                failures += 1
        return cut

    def pruned(self, cut: BoolArray) -> BoolArray:
        """Cuts without stretches to loose ends that raise the price, the shortest tried first."""
        kept = set[bytes]()
        while fresh := [way for way in self._twigs(cut) if way.tobytes() not in kept]:
            way = min(fresh, key=lambda way: (self.graph.length[way].sum(), way[0]))
            kept.add(way.tobytes())
            shorter = cut.copy()
            shorter[way] = False
            if (shorter.any() or self._rim.any()) and self.price(shorter) < self.price(cut):
                cut = shorter
        return cut

    def _twigs(self, cut: BoolArray) -> list[IntArray]:
        """The stretches with a loose end."""
        loose = self._loose(cut)
        ways = stretches(self.graph, cut)
        return [way for way in ways if loose[self.graph.ends[way[[0, -1]]]].any()]
