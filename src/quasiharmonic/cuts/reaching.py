"""Cuts that reach what sticks out, one after another while they are worth their length."""

from __future__ import annotations

import numpy as np

from quasiharmonic.arrays import BoolArray
from quasiharmonic.cuts.graph import EdgeGraph
from quasiharmonic.cuts.shrinking import Shrinking

_FAILURES = 6


def reached(graph: EdgeGraph, cut: BoolArray, least_gain: float, log=None) -> BoolArray:
    cut = cut.copy()
    shrinking = Shrinking(graph)
    if not shrinking.area.sum() > 0:
        return cut
    open_at = graph.touched(cut) | graph.rim_vertices
    w = shrinking.of(open_at)
    energy = shrinking.energy(w)
    tried = np.zeros(graph.n, dtype=bool)
    failures = 0
    while failures < _FAILURES:
        height = np.where(tried, 0.0, np.abs(w))
        top = float(height.max())
        if top < 1e-3:
            break
        tip = int(np.argmax(height >= (1 - 1e-6) * top))
        distance, before = graph.distances(np.flatnonzero(open_at), graph.cost)
        path = graph.way_back(before, tip)
        there = open_at.copy()
        there[graph.ends[path]] = True
        w_new = shrinking.of(there)
        e_new = shrinking.energy(w_new)
        length = graph.length[path].sum()
        if log is not None:
            log.append((tip, length, w[tip], energy, e_new, (energy - e_new) / length))
        if energy - e_new > least_gain * length:
            cut[path] = True
            open_at, w, energy = there, w_new, e_new
            failures = 0
        else:
            away, _ = graph.distances(np.array([tip]), graph.cost, limit=0.5 * distance[tip])
            tried |= np.isfinite(away)
            failures += 1
    return cut
