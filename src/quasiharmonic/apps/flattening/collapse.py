"""Detect collapsed maps, which stretch triangles far more than their surface requires.

A descent can stall at triangles that have shrunk to rounding, or at a boundary so close to itself that no step is short
enough. The map is then bijective but useless. The required stretch is estimated from the surface. If there is a map
whose boundary overlaps itself, it is also estimated from that map, as this has fewer constraints and is seldom
stretched much less than the best bijective map.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from quasiharmonic.energies.deformation import signed_areas
from quasiharmonic.energies.measures import distortion
from quasiharmonic.energies.newton.map_model import in_units
from quasiharmonic.geometry.mesh.reference import rest_frames
from quasiharmonic.util.arrays import BoolArray, ComplexArray, FloatArray, IntArray

# A map has collapsed if its worst stretch is this many times the required one. Measured: at most 4 for maps limited by
# their own boundary, 10 to 10¹² for collapsed maps.
_TIMES = 10.0
# A triangle whose longest side is so many times its height: rounding of its corners changes its stretch by one or more.
_MAX_ASPECT = 2.0**52


def worst_stretch(V: FloatArray, F: IntArray, uv: FloatArray, *, angles_alone: bool) -> float:
    """The worst isometric distortion of a map of the surface's area; with ``angles_alone`` the conformal one."""
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
        return _sides(z1, z2).max(axis=0) ** 2 >= _MAX_ASPECT * z1 * np.abs(z2.imag)


def _stretch_of_sides(V: FloatArray, F: IntArray, uv: FloatArray, *, angles_alone: bool) -> FloatArray:
    """The maximum stretch (f,) of each triangle's sides by a map of the surface's area, or how uneven it is.

    It never exceeds the stretch of the triangle, and is accurate to rounding however thin the triangle is.
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

    ``V`` (n, 3) is of about unit size and ``area`` is the surface's. ``overlapping`` is the final map (n, 2) of a
    descent in which the boundary may overlap itself. ``angles_alone`` means that the energy does not depend on the
    map's scale.
    """
    asked = 1.0 if angles_alone else stretch_of_boundary(V, loops, area)
    if overlapping is not None:
        asked = max(asked, worst_stretch(V, F, overlapping, angles_alone=angles_alone))
    return worst_stretch(V, F, uv, angles_alone=angles_alone) > _TIMES * asked
