"""Almost isometric maps of large surfaces that are almost developable, such as rolled sheets.

A coarse mesh determines how far each part of a sheet turns, but not the shape of thin triangles, which shorten the
steps of Newton's method. A *rigid step* rotates each rest triangle as the map does, and returns the map closest to the
rotated triangles. Neither thin nor inverted triangles shorten it, and all steps share one factor with one unknown per
vertex. About five steps suffice from a coarse mesh with a fiftieth of the vertices. Vertices of the last inverted
triangles are relocated.

::

    coarse map ──▶ prolong ──▶ rotations of triangles ──▶ closest map ──▶ almost isometric?
                                        ▲                                       │ no
                                        └───────────────────────────────────────┘
"""

from __future__ import annotations

from collections.abc import Sequence
from copy import copy
from typing import NamedTuple

import numpy as np

from quasiharmonic.apps.flattening.multilevel import (
    COARSEST,
    Hierarchy,
    flatten_level,
)
from quasiharmonic.apps.flattening.worst_triangles import mark_around, thick_energy
from quasiharmonic.energies.deformation import DeformationEnergy
from quasiharmonic.energies.energies import Deformation, SymmetricDirichlet
from quasiharmonic.energies.newton.line_search import RotationPath
from quasiharmonic.energies.newton.map_model import in_units
from quasiharmonic.geometry.coarsening import has_marked_corner
from quasiharmonic.geometry.exact.certificate import is_injective
from quasiharmonic.geometry.mesh.reference import rest_shapes
from quasiharmonic.geometry.mesh.topology import find_pairs
from quasiharmonic.linsolve import NotPositiveDefinite
from quasiharmonic.solver.methods.relocation import relocate
from quasiharmonic.util.arrays import ComplexArray, FloatArray, IntArray, mark, sum_at, to_points


class RigidTuning(NamedTuple):
    """Numbers that tune rigid steps."""

    # Maximum ratio between the vertex counts of the surface and of the coarse mesh.
    ratio: float = 50.0
    # Rigid steps are tried if the coarse map's mean energy is at most this. Coarse maps of sheets have 0.05 to 0.3, due
    # to thin coarse triangles.
    max_coarse_energy: float = 0.5
    # Maximum mean energy of their result.
    max_energy: float = 1.0
    max_steps: int = 10
    # Steps continue as long as they lower the energy to at most this fraction.
    useful: float = 0.5
    # Up to this number of inverted triangles, their vertices inside the surface are moved to make them positive.
    few_inverted: int = 100
    # Triangles with a larger ratio between their singular values do not determine their rotations, their neighbours do.
    sheared: float = 4.0
    # Height of ears, as in `Hierarchy.prolong`.
    height: float = 0.3


_TUNING = RigidTuning()
#: Number of triangles from which `find_almost_isometry` saves time.
ALMOST_FROM = 30_000


class AlmostIsometry(NamedTuple):
    """An injective map (n, 2) whose boundary may overlap itself, and the rotations of its surface."""

    uv: FloatArray
    rotations: RotationPath


def find_almost_isometry(
    V: FloatArray, measure: DeformationEnergy, loops: Sequence[IntArray], linear_solver: str
) -> AlmostIsometry | None:
    """Return an almost isometric map of a surface, or None if a few steps find none.

    ``V`` (n, 3) is of about unit size. ``measure`` is any energy of the surface, which is connected, without handles
    and weights.
    """
    w = _prolong_coarse_map(V, measure.F, loops, linear_solver)
    if w is None:
        return None
    energy = copy(measure)
    energy.energy = SymmetricDirichlet()
    rotations = RotationPath.of(energy.F, energy.g, len(V), np.zeros(1, dtype=np.int64), linear_solver)
    if rotations is None:
        return None
    found = _take_rigid_steps(V, energy, rotations, w, np.concatenate(loops))
    return None if found is None else AlmostIsometry(found, rotations)


def _prolong_coarse_map(
    V: FloatArray, F: IntArray, loops: Sequence[IntArray], linear_solver: str
) -> ComplexArray | None:
    """Return the map (n,) of a coarse mesh, prolonged to the surface; None if the coarse map is not almost isometric.

    Triangles may be inverted.
    """
    hierarchy = Hierarchy(V, F, list(loops), COARSEST)
    coarse = hierarchy.coarsest(len(V) / _TUNING.ratio)
    found = flatten_level(hierarchy, coarse, linear_solver)
    if found is None:
        return None
    level, uv = found
    if thick_energy(level.V, level.F).value(in_units(uv, 0)) > _TUNING.max_coarse_energy:
        return None
    w = np.zeros(len(V), dtype=np.complex128)
    w[level.vertices] = in_units(uv, 0)
    return hierarchy.prolong(w, coarse, 0, np.zeros(len(V), dtype=bool), _TUNING.height)


def _take_rigid_steps(
    V: FloatArray, energy: DeformationEnergy, rotations: RotationPath, w: ComplexArray, rim: IntArray
) -> FloatArray | None:
    """Return the best injective map of several rigid steps if it is almost an isometry, or None.

    ``rim`` (k,) are the boundary vertices.
    """
    found, least, d = None, np.inf, energy.deform(w)
    for _ in range(_TUNING.max_steps):
        with np.errstate(all="ignore"):
            try:
                w = rotations.turn(w, d, _rotations(V, energy.F, d))
            except NotPositiveDefinite:
                break
            d = energy.deform(w)
            inverted = int(np.count_nonzero(~(np.abs(d.p) > np.abs(d.q))))
            if 0 < inverted <= _TUNING.few_inverted and (moved := relocate(energy.F, w, rim)) is not None:
                w, d, inverted = moved, energy.deform(moved), 0
            value = energy.value_of(d)
        if not inverted and is_injective(energy.F, to_points(w)):
            useful = value <= _TUNING.useful * least
            if value < least:
                found, least = w, value
            if not useful:
                break
    return to_points(found) if found is not None and least < _TUNING.max_energy else None


def _rotations(V: FloatArray, F: IntArray, d: Deformation) -> ComplexArray:
    """Rotations (f,) of triangles; sheared ones, and some rings around inverted ones, follow their neighbours."""
    p, q = np.abs(d.p), np.abs(d.q)
    turned = np.where(p > 0, d.p / p, 1)
    bad = ~(p + q < _TUNING.sheared * (p - q))
    if not bad.any():
        return turned
    bad |= has_marked_corner(F, mark_around(F, ~(p > q), len(V)))
    around = np.flatnonzero(has_marked_corner(F, mark(len(V), F[bad])))
    sides = rest_shapes(V, F[around]).sides.T.ravel()
    here, there = find_pairs(F[around])
    here, there = np.concatenate([here, there]), np.concatenate([there, here])
    follows, own = bad[around], turned[around]
    while (use := follows[here // 3] & ~follows[there // 3]).any():
        # Both triangles map the edge between them to the same vector, in opposite directions.
        vector = -own[there[use] // 3] * sides[there[use]]
        total = sum_at(here[use] // 3, vector * sides[here[use]].conj(), around.size)
        size = np.abs(total)
        own[size > 0] = total[size > 0] / size[size > 0]
        follows[here[use] // 3] = False
    turned[around] = own
    return turned
