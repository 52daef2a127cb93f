"""Falloff of a drag: the share of the motion for the boundary vertices around the dragged vertex."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from quasiharmonic.util.arrays import FloatArray, IntArray

#: Reach of the falloff around a vertex that is not a corner, as a share of the loop's length.
REACH = 0.08


def drag_weights(
    vertex: int, fixed: IntArray, target: FloatArray, loops: Sequence[IntArray], corners: Sequence[int]
) -> FloatArray:
    """Return the share of the pointer's motion for every fixed vertex, (k,) from 0 to 1, 1 at the dragged vertex.

    A pin moves alone. A corner moves its two adjacent sides linearly, so that straight sides stay straight. Any other
    boundary vertex bends its side smoothly, at most up to the ends of the side. Sides end at ``corners``. ``target``
    (k, 2) are the positions of ``fixed``. ValueError if the vertex is not fixed.
    """
    row = np.flatnonzero(fixed == vertex)
    if not row.size:
        raise ValueError(f"vertex {vertex} is not fixed: pin it first")
    share = np.zeros(len(fixed))
    share[row] = 1.0
    loop = next((loop for loop in loops if vertex in loop), None)
    if loop is None:
        return share
    loop = np.roll(loop, -int(np.flatnonzero(loop == vertex)[0]))
    rows = np.empty(int(fixed.max()) + 1, dtype=np.int64)
    rows[fixed] = np.arange(len(fixed))
    points = target[rows[loop]]
    lengths = np.hypot(*(np.roll(points, -1, axis=0) - points).T)
    ahead = np.concatenate([[0.0], np.cumsum(lengths)])
    loop_length, ahead = ahead[-1], ahead[:-1]
    others = np.flatnonzero(np.isin(loop, [c for c in corners if c != vertex]))
    is_corner = vertex in corners
    for way, last in ((ahead, others[:1]), (loop_length - ahead, others[-1:])):
        end = float(way[last[0]]) if last.size else (0.25 if is_corner else 1.0) * loop_length
        if not is_corner:
            end = min(end, REACH * loop_length)
        if end <= 0:
            continue
        t = np.minimum(way / end, 1.0)
        share[rows[loop]] = np.maximum(share[rows[loop]], 1 - t if is_corner else (1 - t**2) ** 2)
    share[row] = 1.0
    return share
