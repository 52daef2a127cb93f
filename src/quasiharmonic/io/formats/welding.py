"""Merge vertices at equal positions, for files that store triangles without shared vertices."""

from __future__ import annotations

import numpy as np

from quasiharmonic.util.arrays import FloatArray, IntArray


def welded(points: FloatArray) -> tuple[FloatArray, IntArray]:
    """Merge equal points.

    Parameters
    ----------
    points : (k, d) float64

    Returns
    -------
    unique : (n, d) float64
        The distinct points, in the order of their first occurrence.
    which : (k,) int64
        For each point its row of ``unique``.
    """
    _, first, which = np.unique(points + 0.0, axis=0, return_index=True, return_inverse=True)
    order = np.argsort(first)
    return points[first[order]], np.argsort(order)[which.ravel()]
