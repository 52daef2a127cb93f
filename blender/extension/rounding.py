"""Places in single precision, which is what Blender has: rounded such that no triangle flips, wherever that can be.

A triangle narrower than the spacing of single precision may flip when its corners go to the nearest such numbers. Its
corners then try the numbers nearby, and take those at which fewest of the triangles around them are wrong.
"""

from __future__ import annotations

import itertools

import numpy as np

from quasiharmonic.apps.atlas.verdict import is_mirrored
from quasiharmonic.geometry.exact.certificate import inverted_triangles
from quasiharmonic.geometry.exact.predicates import orientation
from quasiharmonic.geometry.mesh.seams import SeamedMesh
from quasiharmonic.util.arrays import FloatArray, IntArray

# How many numbers away in each coordinate, and how often all corners of wrong triangles try.
_REACH, _ROUNDS = 3, 20
# An island with more wrong triangles is too fine for single precision, and is left as it is.
_MOST = 500

_STEPS = sorted(itertools.product(range(-_REACH, _REACH + 1), repeat=2), key=lambda step: step[0] ** 2 + step[1] ** 2)


def in_single_precision(mesh: SeamedMesh) -> SeamedMesh:
    """Round a map's places to numbers of single precision, keeping triangles from flipping where nearby ones allow it.

    Parameters
    ----------
    mesh : SeamedMesh
        Its places finite.

    Returns
    -------
    SeamedMesh
        What rounding has inverted after all is for `quasiharmonic.atlas.certify` to say.
    """
    return mesh.with_places([_rounded(island.F, island.uv) for island in mesh.islands])


def _rounded(F: IntArray, uv: FloatArray) -> FloatArray:
    """The places of an island (m, 2), as float64 that are numbers of single precision."""
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
    """Move a vertex to the nearest numbers at which fewer triangles around it are wrong; whether there were any."""
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
