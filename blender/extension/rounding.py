"""Rounding of positions to Blender's single precision without inverting triangles, where that is possible.

If a triangle is narrower than the spacing of single precision, rounding its vertices to the nearest numbers may invert
it. Each of its vertices then tries the numbers nearby and takes those with the fewest wrong triangles around it.
"""

from __future__ import annotations

import itertools

import numpy as np

from quasiharmonic.apps.atlas.atlas_verdict import is_mirrored
from quasiharmonic.geometry.exact.certificate import inverted_triangles
from quasiharmonic.geometry.exact.predicates import orientation
from quasiharmonic.io.seamed_mesh import SeamedMesh
from quasiharmonic.util.arrays import FloatArray, IntArray

# Numbers tried on each side in each coordinate, and passes over the vertices of wrong triangles.
_REACH, _ROUNDS = 3, 20
# If an island has more wrong triangles, it is too fine for single precision and is left unchanged.
_MOST = 500

_STEPS = sorted(itertools.product(range(-_REACH, _REACH + 1), repeat=2), key=lambda step: step[0] ** 2 + step[1] ** 2)


def in_single_precision(mesh: SeamedMesh) -> SeamedMesh:
    """Round a map's positions to single precision, and avoid inverting triangles where nearby numbers allow it.

    Parameters
    ----------
    mesh : SeamedMesh
        A map with finite positions.

    Returns
    -------
    SeamedMesh
        The rounded map. Use `quasiharmonic.atlas.certify` to find triangles that rounding has inverted.
    """
    return mesh.with_places([_rounded(island.F, island.uv) for island in mesh.islands])


def _rounded(F: IntArray, uv: FloatArray) -> FloatArray:
    """Return the positions of an island (m, 2) as float64 values that are representable in single precision."""
    mirrored = is_mirrored(F, uv)
    F = F[:, ::-1] if mirrored else F
    before = inverted_triangles(F, uv)
    near = uv.astype(np.float32).astype(np.float64)
    for _ in range(_ROUNDS):
        wrong = np.setdiff1d(inverted_triangles(F, near), before)
        if not 0 < wrong.size <= _MOST:
            break
        moved = [_settled(F, near, vertex) for vertex in np.unique(F[wrong]).tolist()]
        if not any(moved):
            break
    return near


def _settled(F: IntArray, near: FloatArray, vertex: int) -> bool:
    """Move a vertex to the nearest numbers with fewer wrong triangles around it; return whether it moved."""
    star = F[(vertex == F).any(axis=1)]
    steps = np.array(_STEPS, dtype=np.float64)
    tried = near[vertex] + steps * np.spacing(np.abs(near[vertex]).astype(np.float32)).astype(np.float64)
    tried = tried.astype(np.float32).astype(np.float64)
    corners = np.broadcast_to(near[star], (len(tried), *star.shape, 2)).copy()
    corners[:, star == vertex] = tried[:, None]
    wrong = np.count_nonzero(orientation(*np.moveaxis(corners, 2, 0)) <= 0, axis=1)
    best = int(np.argmin(wrong))
    near[vertex] = tried[best]
    return bool(wrong[best] < wrong[0])
