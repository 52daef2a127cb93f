"""Initial maps from coarse meshes: flatten a coarse mesh, then carry the map to finer meshes.

A limb of a thousand triangles, which a map into a disk shrinks to a millionth, has about ten triangles on the coarse
mesh. So steps on the coarse mesh replace steps on the whole mesh, also to resolve overlaps.
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import islice

import numpy as np

from quasiharmonic.apps.flattening.contacts import Rim
from quasiharmonic.apps.flattening.descent import FreeDescent, GuardedDescent, descend
from quasiharmonic.apps.flattening.multilevel.hierarchy import Hierarchy, Level
from quasiharmonic.apps.flattening.multilevel.smoothing import thick_energy, touched_up
from quasiharmonic.apps.flattening.start import disk_start
from quasiharmonic.energies.energies import SymmetricDirichlet
from quasiharmonic.energies.newton.newton_descent import in_units
from quasiharmonic.geometry.exact.certificate import is_injective
from quasiharmonic.util.arrays import FloatArray, IntArray

#: Number of vertices of the coarsest mesh, and minimum ratio between the vertex counts of successive meshes.
COARSEST, RATIO = 150, 4.0
# Tolerance on coarse meshes, whose maps are only starts. Maximum numbers of steps on the coarsest mesh and on others.
_TOLERANCE, STEPS = 1e-1, (300, 40)
# Heights of ears above their edges, relative to the edges; tried in turn until the map is bijective.
_HEIGHTS = tuple(0.3 * 4.0**-k for k in range(18))
# From this height on, all boundary vertices are placed inside the coarse image, not only those at intersections.
_LATE = 1e-3


def coarse_start(
    V: FloatArray, F: IntArray, loops: Sequence[IntArray], linear_solver: str = "auto", *, guarded: bool = False
) -> FloatArray | None:
    """Flatten a coarse mesh, and carry its map to the surface.

    Parameters
    ----------
    V : (n, 3) float64
        Rest positions, of about unit size.
    F : (f, 3) int64
        Triangles of a connected surface without handles.
    loops : sequence of (l,) int64
        Boundary loops of the surface.
    linear_solver : str
    guarded : bool
        Guard the boundary against overlaps from the beginning. Otherwise it is guarded after the first overlap.

    Returns
    -------
    (n, 2) float64 or None
        A bijective map with moderate distortion; None if rounding prevents one.
    """
    hierarchy = Hierarchy(V, F, list(loops), COARSEST)
    return climbed(hierarchy, hierarchy.stations(RATIO), linear_solver, guarded=guarded)


def climbed(
    hierarchy: Hierarchy, stops: Sequence[int], linear_solver: str = "auto", *, guarded: bool = False
) -> FloatArray | None:
    """Flatten the coarsest of several meshes, and carry its map to each finer one, with descents on all but the last.

    Parameters
    ----------
    hierarchy : Hierarchy
    stops : sequence of int
        Some of the hierarchy's stops, coarsest first.
    linear_solver, guarded
        As for `coarse_start`.

    Returns
    -------
    (m, 2) float64 or None
        A bijective map of the last mesh; None if rounding prevents one.
    """
    here: Level | None = None
    uv: FloatArray | None = None
    for stop in stops:
        level = hierarchy.level(stop)
        if here is None:
            uv = disk_start(hierarchy.V[level.vertices], level.F, level.loops, linear_solver)
        else:
            assert uv is not None
            uv = carried(hierarchy, here, level, uv, linear_solver)
        if uv is None or stop == stops[-1]:
            return uv
        uv, guarded = settled(hierarchy.V[level.vertices], level, uv, linear_solver, guarded, STEPS[here is not None])
        here = level
    return uv


def carried(
    hierarchy: Hierarchy, here: Level, there: Level, uv: FloatArray, linear_solver: str = "auto"
) -> FloatArray | None:
    """Carry a bijective map of one level to a finer one, and smooth it; None if no bijective map was found."""
    w = np.zeros(len(hierarchy.V), dtype=np.complex128)
    w[here.vertices] = in_units(uv, 0)
    rim = Rim(there.loops)
    wary = np.zeros(w.size, dtype=bool)
    for height in _HEIGHTS:
        uv = hierarchy.prolong(w, here.stop, there.stop, wary, height)[there.vertices].view(np.float64).reshape(-1, 2)
        met = rim.meetings(uv)
        if not met.size and is_injective(there.F, uv):
            return touched_up(hierarchy.V[there.vertices], there.F, there.loops, uv, linear_solver)
        # Boundary vertices at intersections are placed inside the coarse image, and from _LATE on all of them.
        late = height < _LATE
        wary[there.vertices if late else there.vertices[met]] = True
    return None


def settled(
    V: FloatArray, level: Level, uv: FloatArray, linear_solver: str, guarded: bool, steps: int
) -> tuple[FloatArray, bool]:
    """Lower the symmetric Dirichlet energy of a level's bijective map; return it and whether a guard was needed."""
    rim = Rim(level.loops)
    energy = thick_energy(V, level.F)
    if not guarded:
        free = FreeDescent(energy, uv, linear_solver)
        for _ in islice(descend(free, SymmetricDirichlet(), _TOLERANCE), steps):
            pass
        if not rim.meets_itself(free.uv):
            return free.uv, False
    energy.energy = SymmetricDirichlet()
    descent = GuardedDescent(energy, uv, linear_solver, rim)
    for _ in islice(descend(descent, SymmetricDirichlet(), _TOLERANCE), steps):
        pass
    return descent.uv, True
