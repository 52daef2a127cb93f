"""Which polygons are convex in the plane, exactly."""

from __future__ import annotations

import numpy as np

from quasiharmonic.geometry.exact.predicates import orientation_or_nonfinite
from quasiharmonic.geometry.mesh.polygons import Polygons
from quasiharmonic.util.arrays import FloatArray, IntArray


def not_convex(polygons: Polygons | None, F: IntArray, uv: FloatArray) -> IntArray:
    """Find polygons that are not strictly convex, or wound clockwise.

    A polygon turns left at every corner, and lies to the left of every line from its first corner to an edge, if and
    only if it is strictly convex and runs around once: the second rules out those that run around several times. Then
    all of its triangulations have positive triangles only.

    Parameters
    ----------
    polygons : Polygons or None
        Rings of corners of the triangles; None where all are triangles.
    F : (f, 3) int64
    uv : (n, 2) float64

    Returns
    -------
    (k,) int64
        Ascending.
    """
    if polygons is None:
        polygons = Polygons(np.arange(F.size), 3 * np.arange(len(F) + 1))
    ring = F.ravel()[polygons.corners]
    face = np.repeat(np.arange(len(polygons)), polygons.sizes)
    first, last = polygons.starts[:-1][face], polygons.starts[1:][face] - 1
    at = np.arange(len(ring))
    ahead = np.where(at == last, first, at + 1)
    behind = np.where(at == first, last, at - 1)
    turns = orientation_or_nonfinite(uv[ring[behind]], uv[ring], uv[ring[ahead]])[0] > 0
    # Triangles of the fan from the first corner; those that have it twice are none.
    fan = orientation_or_nonfinite(uv[ring[first]], uv[ring], uv[ring[ahead]])[0] > 0
    fan |= (at == first) | (at == last)
    return np.unique(face[~(turns & fan)])
