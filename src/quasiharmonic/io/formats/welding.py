"""Merge vertices at equal positions, for files that store triangles without shared vertices."""

from __future__ import annotations

import numpy as np

from quasiharmonic.util.arrays import FloatArray, IntArray


def weld(points: FloatArray) -> tuple[FloatArray, IntArray]:
    """Return the distinct points of (k, d), in the order of their first occurrence, and the row of each point (k,)."""
    _, first, which = np.unique(points + 0.0, axis=0, return_index=True, return_inverse=True)
    order = np.argsort(first)
    return points[first[order]], np.argsort(order)[which.ravel()]
