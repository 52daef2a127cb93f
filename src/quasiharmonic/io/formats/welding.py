"""Surfaces of files that do not say how triangles are joined, which equal positions tell."""

from __future__ import annotations

import numpy as np

from quasiharmonic.util.arrays import FloatArray, IntArray


def welded(points: FloatArray) -> tuple[FloatArray, IntArray]:
    """Make one of points that are equal.

    Parameters
    ----------
    points : (k, d) float64

    Returns
    -------
    unique : (n, d) float64
        In the order in which they come first.
    which : (k,) int64
        For each point its row of ``unique``.
    """
    _, first, which = np.unique(points + 0.0, axis=0, return_index=True, return_inverse=True)
    order = np.argsort(first)
    return points[first[order]], np.argsort(order)[which.ravel()]
