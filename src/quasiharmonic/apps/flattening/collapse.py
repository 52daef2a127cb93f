"""Detect collapsed maps, which stretch triangles far more than their surface requires.

A descent can stall at triangles that have shrunk to rounding, or at a boundary so close to itself that no step is short
enough. The map is then bijective but useless. The required stretch is estimated from the surface. If there is a map
whose boundary overlaps itself, it is also estimated from that map, as this has fewer constraints and is seldom
stretched much less than the best bijective map.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from quasiharmonic.energies.measures import distortion
from quasiharmonic.util.arrays import FloatArray, IntArray

# A map has collapsed if its worst stretch is this many times the required one. Measured: at most 4 for maps limited by
# their own boundary, 10 to 10¹² for collapsed maps.
_TIMES = 10.0


def worst_stretch(V: FloatArray, F: IntArray, uv: FloatArray, *, angles_alone: bool) -> float:
    """The worst isometric distortion of a map of the surface's area; with ``angles_alone`` the conformal one."""
    measured = distortion(V, F, uv)
    return float(np.max(measured.conformal if angles_alone else measured.isometric))


def stretch_of_boundary(V: FloatArray, loops: Sequence[IntArray], area: float) -> float:
    """The factor, at least 1, by which the boundary must lengthen to enclose the surface's area in the plane."""
    length = sum(float(np.linalg.norm(V[np.roll(loop, -1)] - V[loop], axis=1).sum()) for loop in loops)
    return max(float(np.sqrt(4 * np.pi * area)) / length, 1.0) if length > 0 else np.inf


def has_collapsed(
    V: FloatArray,
    F: IntArray,
    loops: Sequence[IntArray],
    area: float,
    uv: FloatArray,
    overlapping: FloatArray | None,
    *,
    angles_alone: bool,
) -> bool:
    """Whether the final map of a descent is stretched far more than its surface requires.

    Parameters
    ----------
    V : (n, 3) float64
        Rest positions, of about unit size.
    F : (f, 3) int64
    loops : sequence of (l,) int64
        Boundary loops.
    area : float
        Area of the surface.
    uv : (n, 2) float64
        The map.
    overlapping : (n, 2) float64 or None
        The final map of a descent in which the boundary may overlap itself.
    angles_alone : bool
        Whether the energy does not depend on the map's scale.
    """
    asked = 1.0 if angles_alone else stretch_of_boundary(V, loops, area)
    if overlapping is not None:
        asked = max(asked, worst_stretch(V, F, overlapping, angles_alone=angles_alone))
    return worst_stretch(V, F, uv, angles_alone=angles_alone) > _TIMES * asked
