"""Exact search for overlapping triangles in the plane."""

from __future__ import annotations

import numpy as np

from quasiharmonic.geometry.exact.predicates import box_pairs, orientation
from quasiharmonic.util.arrays import BoolArray, FloatArray, IntArray
from quasiharmonic.util.progress import heartbeat


def lying_on_others(F: IntArray, uv: FloatArray) -> IntArray:
    """Find the triangles that overlap another one with positive area.

    Two convex sets have no common area if and only if a line separates them. For two triangles a side of one of them
    then does.

    Parameters
    ----------
    Triangles, all counterclockwise.
        Triangles, every one of them counterclockwise.
    uv : (n, 2) float64

    Returns
    -------
    (k,) int64
        Ascending indices. Triangles that only touch do not count.

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
    """Whether the second triangle of each pair (k, 3, 2) lies to the right of a side of the first, or on it."""
    tail, head = one[:, :, None], one[:, (1, 2, 0), None]
    right = np.asarray(orientation(tail, head, other[:, None]) <= 0)
    return np.asarray(np.any(np.all(right, axis=2), axis=1))
