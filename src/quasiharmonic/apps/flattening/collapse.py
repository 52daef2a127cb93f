"""Whether a map has collapsed: it stretches triangles far more than its surface asks for.

A descent can come to a stand where it should not: triangles shrunk to rounding, or a boundary so near to itself that
no step is short enough. The map is bijective all the same, and of no use. How much stretch a surface asks for is read
from the surface itself, and from a map of it whose boundary may overlap itself, if there is one: that has less to mind,
and is seldom stretched much less than the best bijective map.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from quasiharmonic.energies.measures import distortion
from quasiharmonic.util.arrays import FloatArray, IntArray

# A map has collapsed that is stretched so many times as much at worst as is asked for. Maps that had to give way to
# their own boundary have four times at most, collapsed ones ten to a million million.
_TIMES = 10.0


def worst_stretch(V: FloatArray, F: IntArray, uv: FloatArray, *, angles_alone: bool) -> float:
    """How much a map of the surface's area stretches or shrinks at worst; or how unevenly, where angles alone count."""
    measured = distortion(V, F, uv)
    return float(np.max(measured.conformal if angles_alone else measured.isometric))


def stretch_of_boundary(V: FloatArray, loops: Sequence[IntArray], area: float) -> float:
    """How much longer the boundary must become, 1 at least, to go around the surface's area in the plane."""
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
    """Whether a map at which a descent has ended is stretched far more than its surface asks for.

    Parameters
    ----------
    V : (n, 3) float64
        Rest positions, of about unit size.
    F : (f, 3) int64
    loops : sequence of (l,) int64
        The boundary.
    area : float
        The surface's.
    uv : (n, 2) float64
        The map.
    overlapping : (n, 2) float64 or None
        Where a descent has ended that let the boundary overlap itself.
    angles_alone : bool
        Whether the energy that was lowered takes no notice of size.
    """
    asked = 1.0 if angles_alone else stretch_of_boundary(V, loops, area)
    if overlapping is not None:
        asked = max(asked, worst_stretch(V, F, overlapping, angles_alone=angles_alone))
    return worst_stretch(V, F, uv, angles_alone=angles_alone) > _TIMES * asked
