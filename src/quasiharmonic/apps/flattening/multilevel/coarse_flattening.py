"""Initial maps from coarse meshes: flatten a coarse mesh, then prolong the map to finer meshes.

A limb of a thousand triangles, which a map into a disk shrinks to a millionth, has about ten triangles on the coarse
mesh. So steps on the coarse mesh replace steps on the whole mesh, also to resolve overlaps.
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import islice

import numpy as np

from quasiharmonic.apps.flattening.contacts import Rim
from quasiharmonic.apps.flattening.disk_start import map_to_disk
from quasiharmonic.apps.flattening.multilevel.hierarchy import Hierarchy, Level
from quasiharmonic.apps.flattening.multilevel.local_smoothing import smooth_map, thick_energy
from quasiharmonic.apps.flattening.surface_descent import SurfaceDescent, descend
from quasiharmonic.energies.energies import SymmetricDirichlet
from quasiharmonic.energies.newton.map_model import in_units
from quasiharmonic.geometry.exact.certificate import is_injective
from quasiharmonic.util.arrays import FloatArray, IntArray

#: Number of vertices of the coarsest mesh.
COARSEST = 150
#: Minimum ratio between the vertex counts of successive meshes.
RATIO = 4.0
# Tolerance on coarse meshes, whose maps are only starts.
_TOLERANCE = 1e-1
#: Maximum number of steps on the coarsest mesh, and on the others.
STEPS = (300, 40)
# Heights of ears above their edges, relative to the edges; tried in turn until the map is bijective.
_HEIGHTS = tuple(0.3 * 4.0**-k for k in range(18))
# From this height on, all boundary vertices are placed inside the coarse image, not only those at intersections.
_LATE = 1e-3


def flatten_coarse(
    V: FloatArray, F: IntArray, loops: Sequence[IntArray], linear_solver: str = "auto", *, guarded: bool = False
) -> FloatArray | None:
    """Flatten a coarse mesh, and prolong its map to the surface.

    ``V`` (n, 3) is of about unit size, and the surface is connected and has no handles. With ``guarded`` the boundary
    is guarded against overlaps from the beginning, otherwise after the first overlap. Return a bijective map (n, 2)
    with moderate distortion, or None if rounding prevents one.
    """
    hierarchy = Hierarchy(V, F, list(loops), COARSEST)
    return flatten_levels(hierarchy, hierarchy.select_stops(RATIO), linear_solver, guarded=guarded)


def flatten_levels(
    hierarchy: Hierarchy, stops: Sequence[int], linear_solver: str = "auto", *, guarded: bool = False
) -> FloatArray | None:
    """Flatten the coarsest of several meshes, and prolong its map to each finer one, with descents on all but the last.

    ``stops`` are some of the hierarchy's stops, coarsest first. Return a bijective map (m, 2) of the last mesh, or None
    if rounding prevents one.
    """
    here: Level | None = None
    uv: FloatArray | None = None
    for stop in stops:
        level = hierarchy.level(stop)
        if here is None:
            uv = map_to_disk(hierarchy.V[level.vertices], level.F, level.loops, linear_solver)
        else:
            assert uv is not None
            uv = prolong_map(hierarchy, here, level, uv, linear_solver)
        if uv is None or stop == stops[-1]:
            return uv
        uv, guarded = descend_level(
            hierarchy.V[level.vertices], level, uv, linear_solver, guarded, STEPS[here is not None]
        )
        here = level
    return uv


def prolong_map(
    hierarchy: Hierarchy, here: Level, there: Level, uv: FloatArray, linear_solver: str = "auto"
) -> FloatArray | None:
    """Prolong a bijective map of one level to a finer one, and smooth it; None if no bijective map was found."""
    w = np.zeros(len(hierarchy.V), dtype=np.complex128)
    w[here.vertices] = in_units(uv, 0)
    rim = Rim(there.loops)
    kept_inside = np.zeros(w.size, dtype=bool)
    for height in _HEIGHTS:
        uv = (
            hierarchy.prolong(w, here.stop, there.stop, kept_inside, height)[there.vertices]
            .view(np.float64)
            .reshape(-1, 2)
        )
        met = rim.meetings(uv)
        if not met.size and is_injective(there.F, uv):
            return smooth_map(hierarchy.V[there.vertices], there.F, there.loops, uv, linear_solver)
        # Boundary vertices at intersections are placed inside the coarse image, and from _LATE on all of them.
        late = height < _LATE
        kept_inside[there.vertices if late else there.vertices[met]] = True
    return None


def descend_level(
    V: FloatArray, level: Level, uv: FloatArray, linear_solver: str, guarded: bool, steps: int
) -> tuple[FloatArray, bool]:
    """Lower the symmetric Dirichlet energy of a level's bijective map; return it and whether a guard was needed."""
    rim = Rim(level.loops)
    energy = thick_energy(V, level.F)

    def lower(rim: Rim | None) -> FloatArray:
        descent = SurfaceDescent(energy, uv, linear_solver, rim=rim)
        for _ in islice(descend(descent, SymmetricDirichlet(), _TOLERANCE), steps):
            pass
        return descent.uv

    if not guarded and not rim.meets_itself(free := lower(None)):
        return free, False
    energy.energy = SymmetricDirichlet()
    return lower(rim), True
