"""Maps of large surfaces that a map of a coarse mesh determines: almost isometric ones, and ones that keep distances.

Almost isometric maps exist of surfaces that are almost developable, such as rolled sheets. A coarse mesh determines how
far each part of a sheet turns, but not the shape of thin triangles, which shorten the steps of Newton's method. A
*rigid step* rotates each rest triangle as the map does, and returns the map closest to the rotated triangles. Neither
thin nor inverted triangles shorten it, and all steps share one factor with one unknown per vertex. About five steps
suffice from a coarse mesh with a fiftieth of the vertices. Vertices of the last inverted triangles are relocated.

::

    coarse map ──▶ prolong ──▶ rotations of triangles ──▶ closest map ──▶ almost isometric?
                                        ▲                                       │ no
                                        └───────────────────────────────────────┘

A map that keeps distances is smooth at the scale of the rings, so a coarse mesh suffices. Distances between vertices of
the coarse mesh are measured along a mesh about twice as fine. One ring of the coarse mesh is as long as several rings
of the surface. The map is prolonged to the surface; it is then bijective, and its triangles are smoothed and improved
like those of other maps from coarse meshes.

On a cortex of 298,464 triangles with pairs up to 20 rings apart, this takes a seventh of the time of a descent on the
whole mesh. The mean error is 12.7 % (root mean square 20.2 %), compared with 12.6 % (23.2 %). Distances on coarse
meshes have errors of 1 to 2 %. If a map can nearly keep distances, a descent on the whole mesh is better.
"""

from __future__ import annotations

from collections.abc import Sequence
from copy import copy
from typing import NamedTuple

import numpy as np

from quasiharmonic.apps.flattening.distance_descent import choose_sampling, lower_errors, make_descent
from quasiharmonic.apps.flattening.multilevel import COARSEST, Hierarchy, Level, flatten_level, prolong_map
from quasiharmonic.apps.flattening.piece import Piece, to_given_unit
from quasiharmonic.apps.flattening.worst_triangles import LOWEST, mark_around, smooth_map, thick_energy
from quasiharmonic.energies.deformation import DeformationEnergy
from quasiharmonic.energies.distances import SurfaceDistances, sample_distances
from quasiharmonic.energies.energies import Deformation, SymmetricDirichlet
from quasiharmonic.energies.newton.line_search import RotationPath
from quasiharmonic.energies.newton.map_model import in_units
from quasiharmonic.geometry.coarsening import has_marked_corner
from quasiharmonic.geometry.exact.certificate import is_injective
from quasiharmonic.geometry.mesh.reference import rest_shapes
from quasiharmonic.geometry.mesh.topology import find_pairs
from quasiharmonic.linsolve import NotPositiveDefinite
from quasiharmonic.problem.result import MapResult, Snapshot
from quasiharmonic.problem.run import Run
from quasiharmonic.solver.methods.relocation import relocate
from quasiharmonic.util.arrays import ComplexArray, FloatArray, IntArray, mark, sum_at, to_points
from quasiharmonic.util.options import DistanceOptions

# Minimum length of the requested rings, in rings of the coarse mesh.
_RINGS = 3.0
# Distances are measured along the next finer mesh, which follows more of the folds, unless the rings are more than this
# number of its rings.
_MAX_RINGS = 20


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


def lower_coarse_distance_error(piece: Piece, options: DistanceOptions, *, least: int = 9000) -> MapResult | None:
    """Keep distances on a coarse mesh of at least ``least`` vertices, and prolong its map to the surface.

    The options are those of `lower_distance_error`. ``rings`` counts the surface's edges, and steps are counted on
    the coarse mesh; ``path`` gets the final map only. Return a bijective map in the piece's unit, or None if there is
    no coarser mesh, or rounding prevents a map. Ctrl-C outside the distance descent raises KeyboardInterrupt; there it
    only ends the descent.
    """
    run, rings = Run(options.callback), options.rings
    n, solver = len(piece.V), options.linear_solver
    hierarchy = Hierarchy(piece.V, piece.F, piece.loops, COARSEST)
    stop = hierarchy.coarsest(max(least, n * (_RINGS / rings) ** 2))
    coarse = flatten_level(hierarchy, stop, solver) if stop else None
    if coarse is None:
        return None
    level, uv = coarse
    barrier = thick_energy(level.V, level.F)
    barrier.energy = SymmetricDirichlet()
    value = barrier.value(in_units(uv, 0))
    run.add_stage("start, coarse", energy=(value, value))

    distances = _measure_distances(hierarchy, level, rings)
    descent = make_descent(distances, barrier, uv, level.loops, solver)
    status = lower_errors(run, "guarded descent, distances, coarse", descent, options)
    found = prolong_map(hierarchy, level, hierarchy.level(0), descent.uv, solver)
    if found is None:
        return None
    # Smooth once more than other maps; on a cortex this lowers the mean error by 1 %.
    found = smooth_map(piece.V, piece.F, piece.loops, found, solver)
    if options.record_every:
        # An interrupt may have come before the first step was recorded.
        run.path.append(Snapshot(max(len(run.history) - 1, 0), to_given_unit(found, piece.exponent)))
    return run.result(found, piece.F, status, loops=piece.loops, linear_solver=descent.linear_solver)


def _measure_distances(hierarchy: Hierarchy, level: Level, rings: int) -> SurfaceDistances:
    """Distances between vertices of a level up to this number of the surface's rings, along the next finer mesh."""

    def count_rings(along: Level) -> float:
        """The same distance in rings of a level."""
        return float(rings * np.sqrt(along.vertices.size / len(hierarchy.V)))

    finer = hierarchy.level(hierarchy.finer(level.stop))
    if count_rings(finer) > _MAX_RINGS:
        finer = level
    found = sample_distances(
        finer.V,
        finer.F,
        choose_sampling(round(count_rings(finer))),
        among=np.searchsorted(finer.vertices, level.vertices),
        lowest=LOWEST,
    )
    number = np.searchsorted(level.vertices, finer.vertices)
    return SurfaceDistances(number[found.source], number[found.target], found.length, found.sampling)
