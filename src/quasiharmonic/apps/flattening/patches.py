"""Descents on patches around the worst triangles of a map, with all other vertices fixed.

A few triangles, such as slivers, often have most of the energy of a map. They need many steps, since straight steps
rotate a sliver only a little without distortion. Steps on patches around them are cheap, and afterwards few steps on
the whole surface remain.
"""

from __future__ import annotations

from itertools import islice

import numpy as np

from quasiharmonic.apps.flattening.surface_descent import NEAR_ENERGY, SurfaceDescent, descend
from quasiharmonic.energies.deformation import DeformationEnergy
from quasiharmonic.energies.energies import Energy
from quasiharmonic.energies.newton.map_model import in_units
from quasiharmonic.energies.newton.reweighted import ReweightedDirichlet
from quasiharmonic.geometry.coarsening import has_marked_corner
from quasiharmonic.util.arrays import BoolArray, FloatArray, IntArray, mark

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
