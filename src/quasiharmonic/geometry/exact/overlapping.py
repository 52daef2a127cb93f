"""Which triangles lie on each other in the plane, exactly."""

from __future__ import annotations

import numpy as np

from quasiharmonic.geometry.exact.predicates import box_pairs, orientation
from quasiharmonic.util.arrays import BoolArray, FloatArray, IntArray
from quasiharmonic.util.progress import heartbeat


def lying_on_others(F: IntArray, uv: FloatArray) -> IntArray:
    """Find the triangles that share area with another one.

    Two convex sets share none if and only if a line parts them, and of two triangles a side of one of them then does.

    Parameters
    ----------
    F : (f, 3) int64
        Triangles, every one of them counterclockwise.
    uv : (n, 2) float64

    Returns
    -------
    (k,) int64
        Ascending. Triangles that merely touch are none of them.

    Examples
    --------
    >>> uv = np.array([[0.0, 0.0], [1.0, 0.0], [0.0, 1.0], [0.3, 0.3], [1.0, 1.0]])
    >>> lying_on_others(np.array([[0, 1, 2], [1, 4, 2], [3, 4, 2]]), uv)
    array([0, 1, 2])
    """
    found = np.zeros(len(F), dtype=np.bool_)
    corners = uv[F]
    for i, j in box_pairs(corners.min(axis=1), corners.max(axis=1)):
        heartbeat()
        one, other = corners[i], corners[j]
        apart = _parted_by_a_side(one, other)
        apart[~apart] = _parted_by_a_side(other[~apart], one[~apart])
        found[i[~apart]] = found[j[~apart]] = True
    return np.flatnonzero(found)


def _parted_by_a_side(one: FloatArray, other: FloatArray) -> BoolArray:
    """Whether, of pairs of triangles (k, 3, 2), all of the other is to the right of a side of the first."""
    tail, head = one[:, :, None], one[:, (1, 2, 0), None]
    right = np.asarray(orientation(tail, head, other[:, None]) <= 0)
    return np.asarray(np.any(np.all(right, axis=2), axis=1))
