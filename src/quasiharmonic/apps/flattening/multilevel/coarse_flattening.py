"""Initial maps from coarse meshes: flatten a coarse mesh, then prolong the map to finer meshes.

A limb of a thousand triangles, which a map into a disk shrinks to a millionth, has about ten triangles on the coarse
mesh. So steps on the coarse mesh replace steps on the whole mesh, also to resolve overlaps.

Before Newton steps, a prolonged map is smoothed, and its worst triangles are improved locally: most vertices already
have good positions. The remaining one percent would cost many steps on the whole mesh, but local steps on patches
around them are cheap.
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import islice

import numpy as np
from scipy.sparse import csr_array
from scipy.sparse.csgraph import connected_components

from quasiharmonic.apps.flattening.contacts import Rim
from quasiharmonic.apps.flattening.disk_start import map_to_disk
from quasiharmonic.apps.flattening.multilevel.hierarchy import LOWEST, Hierarchy, Level
from quasiharmonic.apps.flattening.patches import descend_on_patches
from quasiharmonic.apps.flattening.surface_descent import SurfaceDescent, descend
from quasiharmonic.energies.deformation import DeformationEnergy
from quasiharmonic.energies.energies import SymmetricDirichlet
from quasiharmonic.energies.newton.map_model import in_units
from quasiharmonic.energies.newton.reweighted import ReweightedDirichlet
from quasiharmonic.geometry.coarsening import has_marked_corner
from quasiharmonic.geometry.exact.certificate import is_injective
from quasiharmonic.geometry.mesh.reference import rest_frames, rest_shapes
from quasiharmonic.geometry.prolongation import are_positive
from quasiharmonic.util.arrays import ComplexArray, FloatArray, IntArray, mark, to_points

# Fraction of the way to the weighted mean of its neighbours that a vertex moves.
_STEP = 0.8
_SWEEPS = 4
# Minimum weight of a neighbour.
_MIN_WEIGHT = 0.02
# A triangle is bad if its density is this factor times the 75 % quantile.
_BAD = 20.0
# If their patches are too large, only triangles beyond this quantile of the density are bad.
_WORST = 0.99
# Below this mean energy a map has little distortion.
_LITTLE = 1.0
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
    opened = _descend_on_patches(start, energy, linear_solver)
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
        weight += 2 * [np.maximum((one.conj() * other).real / twice_area, _MIN_WEIGHT)]
    graph = csr_array((np.concatenate(weight), (np.concatenate(tail), np.concatenate(head))), shape=(n, n))
    total = graph @ np.ones(n)
    inner = ~mark(n, np.concatenate(loops))
    for _ in range(_SWEEPS):
        new = np.where(inner, w + _STEP * ((graph @ w) / total - w), w)
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


def _descend_on_patches(uv: FloatArray, energy: DeformationEnergy, linear_solver: str) -> FloatArray:
    """Descend on patches around the worst triangles, with all other vertices fixed; the boundary may overlap itself."""
    with np.errstate(all="ignore"):
        density = energy.energy.density(energy.deform(in_units(uv, 0)))
    for bad in _BAD * np.quantile(density, 0.75), np.quantile(density, _WORST):
        moved = descend_on_patches(energy, SymmetricDirichlet(), uv, density > bad, linear_solver)
        if moved is not None:
            return moved
    return uv


def flatten_coarse(
    V: FloatArray, F: IntArray, loops: Sequence[IntArray], linear_solver: str = "auto", *, guarded: bool = False
) -> FloatArray | None:
    """Flatten a coarse mesh, and prolong its map to the surface.

    ``V`` (n, 3) is of about unit size, and the surface is connected and has no handles. With ``guarded`` the boundary
    is guarded against overlaps from the beginning, otherwise where it overlaps itself. Return a bijective map (n, 2)
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
    fine: ComplexArray | None = None
    for height in _HEIGHTS:
        fine = hierarchy.prolong(w, here.stop, there.stop, kept_inside, height, fine)
        uv = to_points(fine[there.vertices])
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
    """Lower the symmetric Dirichlet energy of a level's bijective map, if ``guarded`` with a guard from the beginning.

    Return the map, and whether finer levels need a guard from the beginning: where a map with little distortion
    overlaps itself, only the coarse boundary does so.
    """
    rim = Rim(level.loops)
    energy = thick_energy(V, level.F)

    def lower(rim: Rim | None) -> FloatArray:
        descent = SurfaceDescent(energy, uv, linear_solver, rim=rim, iterate=True)
        for _ in islice(descend(descent, SymmetricDirichlet(), _TOLERANCE), steps):
            pass
        return descent.uv

    if not guarded:
        free = lower(None)
        apart = rim.pull_apart(level.F, free) if rim.meets_itself(free) else free
        if apart is not None:
            return apart, False
        guarded = energy.value(in_units(free, 0)) > _LITTLE
    energy.energy = SymmetricDirichlet()
    return lower(rim), guarded
