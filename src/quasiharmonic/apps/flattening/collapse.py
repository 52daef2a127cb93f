"""Whether a map has collapsed: it stretches triangles far more than its surface asks for.

A descent can come to a stand where it should not: triangles shrunk to rounding, or a boundary so near to itself that
no step is short enough. The map is bijective all the same, and of no use. How much stretch a surface asks for is read
from the surface itself, and from a map of it whose boundary may overlap itself, if there is one: that has less to mind,
and is seldom stretched much less than the best bijective map.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from quasiharmonic.energies.deformation import signed_areas
from quasiharmonic.energies.measures import distortion
from quasiharmonic.energies.newton.newton_descent import in_units
from quasiharmonic.geometry.mesh.reference import rest_frames
from quasiharmonic.util.arrays import BoolArray, ComplexArray, FloatArray, IntArray

# A map has collapsed that is stretched so many times as much at worst as is asked for. Maps that had to give way to
# their own boundary have four times at most, collapsed ones ten to a million million.
_TIMES = 10.0
# A triangle whose longest side is so many times its height: rounding of its corners changes its stretch by one or more.
_THIN = 2.0**52


def worst_stretch(V: FloatArray, F: IntArray, uv: FloatArray, *, angles_alone: bool) -> float:
    """How much a map of the surface's area stretches or shrinks at worst; or how unevenly, where angles alone count."""
    measured = distortion(V, F, uv)
    stretch = measured.conformal if angles_alone else measured.isometric
    thin = thin_triangles(V, F)
    if thin.any():
        stretch = np.where(thin, _stretch_of_sides(V, F, uv, angles_alone=angles_alone), stretch)
    return float(np.max(stretch))


def thin_triangles(V: FloatArray, F: IntArray) -> BoolArray:
    """Which triangles (f,) are so thin at rest that doubles cannot express their stretch."""
    z1, z2 = rest_frames(V, F)
    with np.errstate(all="ignore"):
        return _sides(z1, z2).max(axis=0) ** 2 >= _THIN * z1 * np.abs(z2.imag)


def _stretch_of_sides(V: FloatArray, F: IntArray, uv: FloatArray, *, angles_alone: bool) -> FloatArray:
    """How much, or how unevenly, a map of the surface's area stretches the sides of each triangle; (f,).

    Never more than the stretch of the triangle, and right to rounding however thin it is.
    """
    z1, z2 = rest_frames(V, F)
    w = in_units(uv, 0)
    w1, w2 = w[F[:, 1]] - w[F[:, 0]], w[F[:, 2]] - w[F[:, 0]]
    with np.errstate(all="ignore"):
        ratio = _sides(w1, w2) / _sides(z1, z2)
        most, least = ratio.max(axis=0), ratio.min(axis=0)
        if angles_alone:
            return most / least
        scale = np.sqrt(0.5 * np.sum(z1 * np.abs(z2.imag)) / signed_areas(F, w).sum())
        return np.maximum(scale * most, 1 / (scale * least))


def _sides(first: FloatArray | ComplexArray, second: ComplexArray) -> FloatArray:
    """Lengths (3, f) of the sides of triangles with a corner at the origin."""
    return np.abs([first, second, second - first])


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
