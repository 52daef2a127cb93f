"""Exact test of which polygons are convex in the plane."""

from __future__ import annotations

import numpy as np

from quasiharmonic.geometry.exact.predicates import orientation_or_nonfinite
from quasiharmonic.geometry.mesh.polygons import Polygons
from quasiharmonic.util.arrays import FloatArray, IntArray, repeat_each


def find_concave(polygons: Polygons, F: IntArray, uv: FloatArray) -> IntArray:
    """Find polygons that are not strictly convex or not counterclockwise, (k,) int64 ascending.

    A polygon is strictly convex and winds once if and only if two conditions hold. It turns left at every corner, and
    every edge lies to the left as seen from the first corner. The second condition excludes polygons that wind several
    times. Then all triangulations of the polygon have only positive triangles.
    """
    ring = F.ravel()[polygons.corners]
    face = repeat_each(np.arange(len(polygons)), polygons.sizes)
    first, last = polygons.starts[:-1][face], polygons.starts[1:][face] - 1
    at = np.arange(len(ring))
    ahead = np.where(at == last, first, at + 1)
    behind = np.where(at == first, last, at - 1)
    turns = orientation_or_nonfinite(uv[ring[behind]], uv[ring], uv[ring[ahead]])[0] > 0
    # Fan triangles from the first corner. The two that contain it twice are no triangles and count as positive.
    fan = orientation_or_nonfinite(uv[ring[first]], uv[ring], uv[ring[ahead]])[0] > 0
    fan |= (at == first) | (at == last)
    return np.unique(face[~(turns & fan)])


def find_inverted_fans(polygons: Polygons, F: IntArray, uv: FloatArray) -> IntArray:
    """Find polygons that get an inverted or degenerate triangle if they are split at their first corner, ascending.

    A triangle is inverted if its orientation differs from that of the polygon's own triangles.
    """
    ring = F.ravel()[polygons.corners]
    face = repeat_each(np.arange(len(polygons)), polygons.sizes)
    inner = np.ones(len(ring), dtype=bool)
    inner[polygons.starts[:-1]] = inner[polygons.starts[1:] - 1] = False
    at = np.flatnonzero(inner)
    own = np.zeros(len(polygons), dtype=np.int64)
    own[polygons.of_triangle] = orientation_or_nonfinite(*uv[F].swapaxes(0, 1))[0]
    fan = orientation_or_nonfinite(uv[ring[polygons.starts[:-1]][face[at]]], uv[ring[at]], uv[ring[at + 1]])[0]
    return np.unique(face[at[fan != own[face[at]]]])
