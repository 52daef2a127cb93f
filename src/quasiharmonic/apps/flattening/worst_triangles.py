"""The worst triangles of a map: local improvement around them, and whether the map has collapsed there.

A few triangles, such as slivers, often have most of the energy of a map. They need many steps, since straight steps
rotate a sliver only a little without distortion. Steps on *patches* around them, with all other vertices fixed, are
cheap, and afterwards few steps on the whole surface remain. After prolongation from a coarse mesh and smoothing, most
vertices already have good positions, and patches contain the remaining one percent.

A descent can also stall at triangles that have shrunk to rounding, or at a boundary so close to itself that no step is
short enough. The map is then bijective but useless: it has *collapsed* and stretches triangles far more than their
surface requires. The required stretch is estimated from the surface. If there is a map whose boundary overlaps itself,
it is also estimated from that map, as this has fewer constraints and is seldom stretched much less than the best
bijective map.
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import islice
from typing import NamedTuple

import numpy as np
from scipy.sparse import csr_array
from scipy.sparse.csgraph import connected_components

from quasiharmonic.apps.flattening.contacts import Rim
from quasiharmonic.apps.flattening.surface_descent import NEAR_ENERGY, SurfaceDescent, descend
from quasiharmonic.energies.deformation import DeformationEnergy, signed_areas
from quasiharmonic.energies.energies import Energy, SymmetricDirichlet
from quasiharmonic.energies.measures import distortion
from quasiharmonic.energies.newton.distant_starts import ReweightedDirichlet
from quasiharmonic.energies.newton.map_model import in_units
from quasiharmonic.geometry.coarsening import has_marked_corner, mark_rings
from quasiharmonic.geometry.mesh.reference import loop_lengths, rest_frames, rest_shapes
from quasiharmonic.geometry.prolongation import are_positive
from quasiharmonic.util.arrays import BoolArray, ComplexArray, FloatArray, IntArray, mark, to_points

#: Minimum height of a coarse mesh's triangles, relative to their longest side.
LOWEST = 0.05
# A triangle whose longest side is so many times its height: rounding of its corners changes its stretch by one or more.
_MAX_ASPECT = 2.0**52


class BadTriangleTuning(NamedTuple):
    """Numbers that tune the descents on patches."""

    # If patches cover more than this fraction of the surface, a step on the whole surface is better.
    max_share: float = 0.5
    # Rings of triangles around bad triangles that belong to a patch.
    rings: int = 2
    max_steps: int = 20
    move_tolerance: float = 1e-1
    # Triangles with more than this multiple of the mean energy density get patches, if they have most of the energy and
    # the mean energy of the others is at most `distant`. If the patches are too large, the next multiple is tried.
    above_mean: tuple[float, ...] = (10.0, 30.0)
    distant: float = 1.0
    # Patches are used as long as they lower the energy to at most the first fraction, and at once again after the
    # second.
    useful: float = 0.999
    again: float = 0.8


_PATCH = BadTriangleTuning()


def descend_on_patches(
    energy: DeformationEnergy, density: Energy, uv: FloatArray, bad: BoolArray, linear_solver: str
) -> FloatArray | None:
    """Lower the energy of a map (n, 2) on patches around the ``bad`` triangles (f,).

    ``density`` is the one to minimise. Return the new map, whose boundary may overlap itself, or None if there are no
    patches or they are too large.
    """
    F = energy.F
    loose = mark_around(F, bad, len(uv))
    triangles = np.flatnonzero(has_marked_corner(F, loose))
    if not 0 < triangles.size < _PATCH.max_share * len(F):
        return None
    vertices, corners = np.unique(F[triangles], return_inverse=True)
    part = energy.restrict(triangles, corners.reshape(-1, 3), density)
    if not part.value(in_units(uv[vertices], 0)) < NEAR_ENERGY * part.share.sum():
        part.energy = ReweightedDirichlet()
    descent = SurfaceDescent(part, uv[vertices], linear_solver, np.flatnonzero(~loose[vertices]), iterate=True)
    for _ in islice(descend(descent, density, _PATCH.move_tolerance), _PATCH.max_steps):
        pass
    moved = uv.copy()
    moved[vertices] = descent.uv
    return moved


def mark_around(F: IntArray, triangles: BoolArray, n: int) -> BoolArray:
    """Return a mask (n,) of the vertices of some triangles (f,), and of some rings of triangles around them."""
    return mark_rings(F, mark(n, F[triangles]), _PATCH.rings)


class PatchDescents:
    """Descents on patches before the steps of a `SurfaceDescent`, as long as few triangles have most of the energy."""

    def __init__(self, energy: DeformationEnergy, linear_solver: str) -> None:
        self._energy, self._linear_solver, self._useful = energy, linear_solver, True

    def improve(self, uv: FloatArray) -> FloatArray | None:
        """Return a map (n, 2) with less energy, or None if patches do not help."""
        better, again = None, self._useful
        after = self._energy.value(in_units(uv, 0)) if again else 0.0
        while again:
            before, moved = after, self._descend(uv)
            if moved is None:
                break
            after = self._energy.value(in_units(moved, 0))
            self._useful, again = after < _PATCH.useful * before, after < _PATCH.again * before
            if self._useful:
                better = uv = moved
        return better

    def _descend(self, uv: FloatArray) -> FloatArray | None:
        energy = self._energy
        with np.errstate(all="ignore"):
            density = energy.energy.density(energy.deform(in_units(uv, 0)))
            each = energy.share * density
        for above in _PATCH.above_mean:
            bad = density > above * each.sum() / energy.share.sum()
            worst, others = float(each[bad].sum()), float(each[~bad].sum())
            if worst > others and others <= _PATCH.distant * energy.share[~bad].sum():
                moved = descend_on_patches(energy, energy.energy, uv, bad, self._linear_solver)
                if moved is not None:
                    return moved
        return None


def smooth_map(
    V: FloatArray, F: IntArray, loops: Sequence[IntArray], uv: FloatArray, linear_solver: str = "auto"
) -> FloatArray:
    """Lower the distortion of a bijective map (n, 2) at low cost; the result is bijective."""
    energy = thick_energy(V, F)
    before = in_units(uv, 0)
    after = _smooth_interior(V, F, loops, before)
    with np.errstate(all="ignore"):
        better = energy.value(after) < energy.value(before)
    start = (after if better else before).view(np.float64).reshape(-1, 2)
    opened = _descend_on_worst(start, energy, linear_solver)
    return _undo_overlaps(F, Rim(loops), start, opened)


def thick_energy(V: FloatArray, F: IntArray) -> DeformationEnergy:
    """The symmetric Dirichlet energy with the thinnest rest triangles thickened, for maps far from the minimum."""
    shapes = rest_shapes(V, F, lowest=LOWEST)
    layout = np.zeros((len(F), 3), dtype=np.complex128)
    layout[:, 1], layout[:, 2] = shapes.unit * shapes.sides[0], -shapes.unit * shapes.sides[2]
    corners = np.arange(F.size).reshape(-1, 3)
    return DeformationEnergy(to_points(layout), F, ReweightedDirichlet(), rest_F=corners)


def _smooth_interior(V: FloatArray, F: IntArray, loops: Sequence[IntArray], w: ComplexArray) -> ComplexArray:
    """Move interior vertices towards the Laplacian mean of their neighbours, without inverting triangles."""
    # Fraction of the way to the weighted mean of its neighbours that a vertex moves, and the minimum weight of one.
    fraction, min_weight, sweeps = 0.8, 0.02, 4
    n = len(V)
    z1, z2 = rest_frames(V, F)
    corners = np.stack([np.zeros(z2.shape), z1, z2])
    twice_area = np.maximum(z1 * z2.imag, np.finfo(np.float64).tiny)
    tail, head, weight = [], [], []
    for k in range(3):
        after, before = (k + 1) % 3, (k + 2) % 3
        one, other = corners[after] - corners[k], corners[before] - corners[k]
        tail += [F[:, after], F[:, before]]
        head += [F[:, before], F[:, after]]
        weight += 2 * [np.maximum((one.conj() * other).real / twice_area, min_weight)]
    graph = csr_array((np.concatenate(weight), (np.concatenate(tail), np.concatenate(head))), shape=(n, n))
    total = graph @ np.ones(n)
    inner = ~mark(n, np.concatenate(loops))
    for _ in range(sweeps):
        new = np.where(inner, w + fraction * ((graph @ w) / total - w), w)
        back = np.zeros(n, dtype=bool)
        inverted = F.compress(~are_positive(new, F), axis=0)
        while len(inverted) and not back[inverted].all():
            back[inverted] = True
            new[inverted] = w[inverted]
            touched = F.compress(has_marked_corner(F, back), axis=0)
            inverted = touched.compress(~are_positive(new, touched), axis=0)
        w = new
    return w


def _undo_overlaps(F: IntArray, rim: Rim, start: FloatArray, opened: FloatArray) -> FloatArray:
    """Return patches of a map whose boundary meets itself to their positions in a bijective map."""
    opened, moved = opened.copy(), (opened != start).any(axis=1)
    tail, head = F.ravel(), np.roll(F, -1, axis=1).ravel()
    joined = moved[tail] & moved[head]
    graph = csr_array((np.ones(joined.sum()), (tail[joined], head[joined])), shape=(len(moved), len(moved)))
    patch = connected_components(graph, directed=False)[1]
    while (met := rim.meetings(opened)).size:
        back = moved & mark(len(moved), patch[met[moved[met]]])[patch]
        opened[back], moved[back] = start[back], False
    return start if rim.meets_itself(opened) else opened


def _descend_on_worst(uv: FloatArray, energy: DeformationEnergy, linear_solver: str) -> FloatArray:
    """Descend on patches around the worst triangles, with all other vertices fixed; the boundary may overlap itself."""
    # A triangle is bad if its density is this factor times the 75 % quantile. If the patches are then too large, only
    # triangles beyond the second quantile are bad.
    bad_factor, worst = 20.0, 0.99
    with np.errstate(all="ignore"):
        density = energy.energy.density(energy.deform(in_units(uv, 0)))
    for bad in bad_factor * np.quantile(density, 0.75), np.quantile(density, worst):
        moved = descend_on_patches(energy, SymmetricDirichlet(), uv, density > bad, linear_solver)
        if moved is not None:
            return moved
    return uv


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
    length = sum(float(loop_lengths(V, loop).sum()) for loop in loops)
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
    # Measured: at most 4 times the required stretch for maps limited by their own boundary, 10 to 10¹² times for
    # collapsed maps.
    times = 10.0
    asked = 1.0 if angles_alone else stretch_of_boundary(V, loops, area)
    if overlapping is not None:
        asked = max(asked, worst_stretch(V, F, overlapping, angles_alone=angles_alone))
    return worst_stretch(V, F, uv, angles_alone=angles_alone) > times * asked
