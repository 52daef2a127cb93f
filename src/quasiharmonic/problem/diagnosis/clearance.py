"""Check whether many segments avoid walls."""

from __future__ import annotations

import numpy as np

from quasiharmonic.geometry.exact.predicates import SegmentRelation, box_pairs_between, segment_relation
from quasiharmonic.util.arrays import BoolArray, FloatArray, IntArray, morton_order
from quasiharmonic.util.progress import heartbeat

# Number of segments per batch.
_SEGMENTS = 1 << 14


def clear(
    p: FloatArray, q: FloatArray, ends: IntArray, walls: IntArray, positions: FloatArray, max_pairs: int
) -> BoolArray:
    """Return which segments p–q (k, 2) provably meet no wall, except walls that share an end with them; (k,) bool.

    True is exact. False may also mean that the segment was not checked. ``ends`` (k, 2) are the indices of the
    segments' ends in ``positions`` (n, 2), -1 for other points. ``walls`` (m, 2) are pairs of points. ``max_pairs`` is
    an approximate limit on the pairs of a segment and a nearby wall to check.
    """
    result = np.zeros(len(p), dtype=bool)
    if not len(p):
        return result
    # Sort along a space-filling curve, so that few boxes overlap.
    order = morton_order(p / 2 + q / 2)
    walls = walls[morton_order(positions[walls[:, 0]] / 2 + positions[walls[:, 1]] / 2)]
    r, s = positions[walls.T]
    tail, head = walls.T
    low, high = np.minimum(r, s), np.maximum(r, s)
    spent = 0
    for start in range(0, len(p), _SEGMENTS):
        part = order[start : start + _SEGMENTS]
        a, b, (first, last) = p[part], q[part], ends[part].T
        blocked = np.zeros(len(part), dtype=bool)
        heartbeat()
        for i, j in box_pairs_between(np.minimum(a, b), np.maximum(a, b), low, high):
            spent += i.size
            if spent > max_pairs:
                return result
            apart = (first[i] != tail[j]) & (first[i] != head[j]) & (last[i] != tail[j]) & (last[i] != head[j])
            apart &= ~blocked[i]
            i, j = i[apart], j[apart]
            relation = segment_relation(a.take(i, 0), b.take(i, 0), r.take(j, 0), s.take(j, 0))
            blocked[i[relation != SegmentRelation.DISJOINT]] = True
        result[part] = ~blocked
    return result
