"""Local improvement of a map: smoothing, and descents on patches around its worst triangles with the others fixed.

A few triangles, such as slivers, often have most of the energy of a map. They need many steps, since straight steps
rotate a sliver only a little without distortion. Steps on patches around them are cheap, and afterwards few steps on
the whole surface remain. After prolongation from a coarse mesh, most vertices already have good positions, and patches
contain the remaining one percent.
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import islice

import numpy as np
from scipy.sparse import csr_array
from scipy.sparse.csgraph import connected_components

from quasiharmonic.apps.flattening.contacts import Rim
from quasiharmonic.apps.flattening.surface_descent import NEAR_ENERGY, SurfaceDescent, descend
from quasiharmonic.energies.deformation import DeformationEnergy
from quasiharmonic.energies.energies import Energy, SymmetricDirichlet
from quasiharmonic.energies.newton.distant_starts import ReweightedDirichlet
from quasiharmonic.energies.newton.map_model import in_units
from quasiharmonic.geometry.coarsening.levels import has_marked_corner
from quasiharmonic.geometry.coarsening.prolongation import are_positive
from quasiharmonic.geometry.mesh.reference import rest_frames, rest_shapes
from quasiharmonic.util.arrays import BoolArray, ComplexArray, FloatArray, IntArray, mark, to_points

#: Minimum height of a coarse mesh's triangles, relative to their longest side.
LOWEST = 0.05

# If patches cover more than this fraction of the surface, a step on the whole surface is better.
_MAX_SHARE = 0.5
# Rings of triangles around bad triangles that belong to a patch.
_RINGS = 2
_MAX_STEPS = 20
_MOVE_TOLERANCE = 1e-1
# Triangles with more than this multiple of the mean energy density get patches, if they have most of the energy and the
# mean energy of the others is at most the last number. If the patches are too large, the next multiple is tried.
_ABOVE_MEAN, _DISTANT = (10.0, 30.0), 1.0
# Patches are used as long as they lower the energy to at most the first fraction, and at once again after the second.
_USEFUL, _AGAIN = 0.999, 0.8


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
    if not 0 < triangles.size < _MAX_SHARE * len(F):
        return None
    vertices, corners = np.unique(F[triangles], return_inverse=True)
    part = energy.restrict(triangles, corners.reshape(-1, 3), density)
    if not part.value(in_units(uv[vertices], 0)) < NEAR_ENERGY * part.share.sum():
        part.energy = ReweightedDirichlet()
    descent = SurfaceDescent(part, uv[vertices], linear_solver, np.flatnonzero(~loose[vertices]), iterate=True)
    for _ in islice(descend(descent, density, _MOVE_TOLERANCE), _MAX_STEPS):
        pass
    moved = uv.copy()
    moved[vertices] = descent.uv
    return moved


def mark_around(F: IntArray, triangles: BoolArray, n: int) -> BoolArray:
    """Return a mask (n,) of the vertices of some triangles (f,), and of some rings of triangles around them."""
    loose = mark(n, F[triangles])
    for _ in range(_RINGS):
        loose[F[has_marked_corner(F, loose)]] = True
    return loose


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
            self._useful, again = after < _USEFUL * before, after < _AGAIN * before
            if self._useful:
                better = uv = moved
        return better

    def _descend(self, uv: FloatArray) -> FloatArray | None:
        energy = self._energy
        with np.errstate(all="ignore"):
            density = energy.energy.density(energy.deform(in_units(uv, 0)))
            each = energy.share * density
        for above in _ABOVE_MEAN:
            bad = density > above * each.sum() / energy.share.sum()
            worst, others = float(each[bad].sum()), float(each[~bad].sum())
            if worst > others and others <= _DISTANT * energy.share[~bad].sum():
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
