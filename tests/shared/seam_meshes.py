"""Meshes with seams."""

from __future__ import annotations

import numpy as np

from quasiharmonic.atlas import SeamedMesh
from quasiharmonic.surfaces import grid
from shared.meshes import bend, lift


def islands(F, uv, FT=None):
    """The islands of a map; the positions on the surface are irrelevant."""
    return list(SeamedMesh(np.zeros((np.max(F) + 1, 2)), F, FT, uv).islands)


def strips(cells=12):
    """A curved square whose map is cut into three disjoint strips of different shapes.

    Returns V, F, UV positions, their indices by corner, and the strip of each triangle.
    """
    plane, F = grid(3 * cells, cells)
    strip = np.minimum((plane[F, 0].mean(axis=1) * 3).astype(int), 2)
    places, FT = [], np.empty_like(F)
    for k in range(3):
        used, local = np.unique(F[strip == k], return_inverse=True)
        FT[strip == k] = local.reshape(-1, 3) + sum(map(len, places))
        own = (plane[used] - [k / 3, 0]) * [3, 1]
        places.append((own, bend(own), own @ [[0.0, 1.5], [-1.5, 0.0]])[k] + [3 * k, 0])
    return lift(plane), F, np.concatenate(places), FT, strip
