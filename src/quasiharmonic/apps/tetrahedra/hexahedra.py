"""Corners of hexahedra."""

from __future__ import annotations

import numpy as np

from quasiharmonic.apps.tetrahedra.signs import tetrahedron_signs
from quasiharmonic.util.arrays import FloatArray, IntArray

# Each corner with its three neighbours, right-handed, in the order of Gmsh and VTK.
_CORNERS = np.array(
    [(0, 1, 3, 4), (1, 2, 0, 5), (2, 3, 1, 6), (3, 0, 2, 7), (4, 7, 5, 0), (5, 4, 6, 1), (6, 5, 7, 2), (7, 6, 4, 3)]
)


def find_bad_corners(H: IntArray, X: FloatArray) -> IntArray:
    """Return the hexahedra (h, 8) with a corner whose tetrahedron is not positive, exactly; ascending.

    Positive corners are necessary for a valid trilinear map, but not sufficient.
    """
    sign, _ = tetrahedron_signs(H[:, _CORNERS].reshape(-1, 4), X)
    return np.flatnonzero((sign.reshape(-1, 8) <= 0).any(axis=1))
