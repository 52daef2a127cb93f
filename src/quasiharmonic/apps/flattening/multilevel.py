"""Initial bijective maps: of a coarse mesh onto a disk, and prolonged from mesh to mesh to the surface.

A limb of a thousand triangles, which a map into a disk shrinks to a millionth, has about ten triangles on the coarse
mesh. So steps on the coarse mesh replace steps on the whole mesh, also to resolve overlaps.

Each boundary loop is filled by a fan around a new vertex, its *hub*. Boundary vertices then become interior vertices,
and `quasiharmonic.geometry.coarsening` can remove them like others. Hubs are kept, and get no new edges. Without
the hubs, a coarse mesh with coarse loops remains.

Prolongation lays the ring of each removed vertex out flat around it by its rest angles and lengths. The affine map that
fits the flat ring best to the ring's current positions also maps the vertex. If this inverts a triangle, the vertex
gets the position that gives its triangles the best shape, as in `quasiharmonic.geometry.prolongation`. This
position is inside its ring and the coarse image. A prolonged map is improved locally before Newton steps.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import islice
from typing import NamedTuple

import numpy as np

from quasiharmonic.apps.flattening.contacts import Rim
from quasiharmonic.apps.flattening.surface_descent import SurfaceDescent, descend
from quasiharmonic.apps.flattening.worst_triangles import LOWEST, smooth_map, thick_energy
from quasiharmonic.energies.energies import SymmetricDirichlet
from quasiharmonic.energies.newton.map_model import in_units
from quasiharmonic.geometry.coarsening import coarsen
from quasiharmonic.geometry.exact.certificate import is_injective
from quasiharmonic.geometry.mesh.reference import loop_lengths, surface_area
from quasiharmonic.geometry.mesh.splitting import make_fans
from quasiharmonic.geometry.mesh.topology import boundary_loops
from quasiharmonic.geometry.prolongation import reinsertion_positions
from quasiharmonic.problem import Problem
from quasiharmonic.problem.result import Status
from quasiharmonic.util.arrays import BoolArray, ComplexArray, FloatArray, IntArray, invert_indices, mark, to_points


class LevelTuning(NamedTuple):
    """Numbers that tune maps by way of coarse meshes."""

    # Weight that keeps the affine map close to a similarity.
    rigid: float = 1e-2
    # The affine position is used if every triangle has at least this fraction of its area in the flat layout.
    min_area_share: float = 0.05
    # Maximum sum of the angles around a boundary vertex when its ring is laid out.
    widest: float = 1.9 * np.pi
    # Below this mean energy a map has little distortion.
    little: float = 1.0
    # Tolerance on coarse meshes, whose maps are only starts.
    tolerance: float = 1e-1
    # From this height of ears on, all boundary vertices are placed inside the coarse image, not only those at
    # intersections.
    late: float = 1e-3


_TUNING = LevelTuning()
# Heights of ears above their edges, relative to the edges; tried in turn until the map is bijective.
_HEIGHTS = tuple(0.3 * 4.0**-k for k in range(18))
#: Number of vertices of the coarsest mesh.
COARSEST = 150
#: Minimum ratio between the vertex counts of successive meshes.
RATIO = 4.0
# Maximum number of steps on the coarsest mesh, and on the others.
_STEPS = (300, 40)


@dataclass(frozen=True, eq=False)
class Level:
    """One mesh of a hierarchy, with its own vertex numbering.

    ``stop`` is the hierarchy's stop that the mesh belongs to. ``vertices`` (m,) are the finest mesh's indices of its
    vertices, ascending, and ``V`` (m, 3) their positions.
    """

    stop: int
    vertices: IntArray
    V: FloatArray
    F: IntArray
    loops: list[IntArray]


class Hierarchy:
    """A sequence of increasingly coarse meshes of a surface.

    The surface is connected, and ``V`` (n, 3) of about unit size. The coarsest mesh has ``goal`` vertices, or more if
    no others can be removed. ``stops`` are the rounds after which there is a mesh, finest first; 0 is the surface
    itself.
    """

    def __init__(self, V: FloatArray, F: IntArray, loops: list[IntArray], goal: int) -> None:
        self.V = V
        self._n = n = len(V)
        self._n_filled = n + len(loops)
        filled = make_fans(loops, n)
        held = np.arange(self._n_filled) >= n
        self._coarsening = coarsen(np.concatenate([F, filled]), held.size, held, goal + len(loops))
        self._rounds = len(self._coarsening.rounds)
        # There are meshes before some of the rounds, and after the last.
        self.stops = [*sorted(self._coarsening.levels), self._rounds]

    def select_stops(self, ratio: float) -> list[int]:
        """Some of the `stops`, coarsest first; each mesh has at least ``ratio`` times the vertices of the last."""
        left = self._left()
        chosen = [0]
        for stop in self.stops[1:]:
            if left[stop] * ratio <= left[chosen[-1]]:
                chosen.append(stop)
        if len(chosen) == 1:
            chosen.append(self.stops[-1])
        return chosen[::-1]

    def coarsest(self, min_vertices: float) -> int:
        """Return the last of the `stops` whose mesh has at least ``min_vertices`` vertices; 0 if none has."""
        left = self._left()
        return max((stop for stop in self.stops if left[stop] >= min_vertices), default=0)

    def finer(self, stop: int) -> int:
        """Return the next finer stop."""
        return self.stops[self.stops.index(stop) - 1]

    def _left(self) -> IntArray:
        """Numbers of vertices left after each number of rounds."""
        removed = [0, *(sum(vertices.size for vertices, _ in removals) for removals in self._coarsening.rounds)]
        return np.asarray(self._n - np.cumsum(removed))

    def level(self, stop: int) -> Level:
        """Return the mesh at a stop."""
        T = self._coarsening.F if stop == self._rounds else self._coarsening.levels[stop]
        T = T[T.max(axis=1) < self._n]
        used = mark(self._n, T)
        vertices = np.flatnonzero(used)
        number = invert_indices(self._n, vertices)
        F = number[T]
        return Level(stop, vertices, self.V[vertices], F, boundary_loops(F, vertices.size))

    def prolong(
        self,
        w: ComplexArray,
        start: int,
        stop: int,
        kept_inside: BoolArray,
        height: float,
        before: ComplexArray | None = None,
    ) -> ComplexArray:
        """Prolong a map ``w`` (n,) from the mesh at one stop to a finer one, ``stop < start``.

        ``w`` has the finest mesh's numbering. ``kept_inside`` (n,) marks boundary vertices that are placed inside the
        coarse image, so that their edges do not intersect others. The surface's shape places the other vertices. Such
        vertices that cannot be placed inside rise above their edges by ``height`` times the edge's length. If all
        boundary vertices are marked and the height is small enough, a bijective map stays bijective.

        ``before`` is the result for the same ``w`` with fewer vertices marked and any height. Only vertices whose
        positions may differ from it are placed again.
        """
        w = (w if before is None else before).copy()
        # Vertices, and hubs behind them, at which the map differs from the one before.
        moved = np.zeros(self._n_filled, dtype=bool)
        moved[: self._n] = kept_inside
        for number in reversed(range(stop, start)):
            for vertices, rings in self._coarsening.rounds[number]:
                at_rim = (rings >= self._n).any(axis=1)
                again = None if before is None else moved[vertices] | moved[rings].any(axis=1)
                for some, rim in ((~at_rim, False), (at_rim, True)):
                    if again is not None:
                        some &= again
                    if some.any():
                        ring = self._open_rings(rings[some]) if rim else rings[some]
                        placed = vertices[some]
                        position = self._place(w, placed, ring, rim, kept_inside, height)
                        moved[placed] = position != w[placed]
                        w[placed] = position
        return w

    def _open_rings(self, rings: IntArray) -> IntArray:
        """Return the rings of boundary vertices without their hubs, from one end to the other."""
        hub = (rings >= self._n).argmax(axis=1)
        turn = (hub[:, None] + 1 + np.arange(rings.shape[1] - 1)) % rings.shape[1]
        return np.take_along_axis(rings, turn, axis=1)

    def _place(
        self, w: ComplexArray, vertices: IntArray, ring: IntArray, rim: bool, kept_inside: BoolArray, height: float
    ) -> ComplexArray:
        """Positions of vertices with rings (r, d), which are closed, or open if ``rim``."""
        flat = self._lay_out(vertices, ring, rim)
        around = w[ring]
        place = _fit_affine(flat, around)
        if rim and ring.shape[1] == 2:
            # An ear lies to the left of x₁ → x₂, and the rest of the surface to the right.
            return np.where(
                kept_inside[vertices], around[:, 0] + (0.5 + 1j * height) * (around[:, 1] - around[:, 0]), place
            )
        good = _keeps_shape(flat, place, around, rim)
        if rim:
            good &= ~kept_inside[vertices]
        poor = np.flatnonzero(~good)
        if poor.size:
            ring_now = around[poor]
            if rim:
                # Either end of an open ring can be the apex of the fan that fills it.
                ring_now = np.where(_fan_positive(ring_now)[:, None], ring_now, np.roll(ring_now, 1, axis=1))
            place[poor] = reinsertion_positions(ring_now)
        return place

    def _lay_out(self, vertices: IntArray, ring: IntArray, rim: bool) -> ComplexArray:
        """Lay rest rings out flat around their vertices; (r, d) complex128, of about unit size."""
        arm = self.V[ring] - self.V[vertices][:, None]
        length = np.linalg.norm(arm, axis=2)
        following = np.roll(arm, -1, axis=1)
        cross = np.linalg.norm(np.cross(arm, following), axis=2)
        angle = np.arctan2(cross, (arm * following).sum(axis=2))
        if rim:
            angle = angle[:, :-1]
        total = angle.sum(axis=1)
        wanted = np.minimum(total, _TUNING.widest) if rim else np.full(total.shape, 2 * np.pi)
        angle = angle * (wanted / np.where(total > 0, total, 1))[:, None]
        turned = np.zeros(ring.shape)
        turned[:, 1:] = np.cumsum(angle if rim else angle[:, :-1], axis=1)
        size = length.mean(axis=1)
        return length / np.where(size > 0, size, 1)[:, None] * np.exp(1j * turned)


def _fit_affine(flat: ComplexArray, around: ComplexArray) -> ComplexArray:
    """Images of the rings' centres under the affine maps that fit flat rings best to given ones; (r,) complex128."""
    weight = 1 / (flat.real**2 + flat.imag**2 + 1e-12)
    scale, weighted = weight.sum(axis=1), weight * flat
    middle = around.mean(axis=1)
    arm = around - middle[:, None]
    # The normal equations of arm ≈ c + a·flat + b·conj(flat), from which a and b are eliminated.
    first, second = weighted.sum(axis=1), (weighted * flat).sum(axis=1)
    size = (weighted * flat.conj()).real.sum(axis=1)
    of_a, of_b = size + 1e-12 * scale, size + _TUNING.rigid * scale
    determinant = of_a * of_b - np.abs(second) ** 2
    a = (first * of_b - first.conj() * second) / determinant
    b = (first.conj() * of_a - first * second.conj()) / determinant
    load = (weight * arm).sum(axis=1) - a * (weighted.conj() * arm).sum(axis=1) - b * (weighted * arm).sum(axis=1)
    return np.asarray(middle + load / ((1 + 1e-12) * scale - (a * first.conj() + b * first).real))


def _keeps_shape(flat: ComplexArray, place: ComplexArray, around: ComplexArray, rim: bool) -> BoolArray:
    """Whether all triangles around a vertex keep a minimum fraction of their expected area."""
    now, then = around - place[:, None], flat
    last = -1 if rim else None
    following = np.roll(then, -1, axis=1)
    area = (now.conj() * np.roll(now, -1, axis=1)).imag[:, :last]
    rest = (then.conj() * following).imag[:, :last]
    # Both sides of a seam coincide at rest. A triangle between them has no area there, but needs some in the plane.
    longest = np.maximum(np.maximum(np.abs(then), np.abs(following)), np.abs(following - then))[:, :last]
    rest = np.maximum(rest, LOWEST * longest**2)
    scale = area.sum(axis=1) / rest.sum(axis=1)
    least = np.maximum(_TUNING.min_area_share * scale[:, None] * rest, 0)
    return np.asarray((area > least).all(axis=1))


def _fan_positive(ring: ComplexArray) -> BoolArray:
    """Whether the fan from the first vertex of each ring has only positive triangles."""
    arm = ring[:, 1:] - ring[:, :1]
    return np.asarray(((arm[:, :-1].conj() * arm[:, 1:]).imag > 0).all(axis=1))


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
            uv = map_to_disk(level.V, level.F, level.loops, linear_solver)
        else:
            assert uv is not None
            uv = prolong_map(hierarchy, here, level, uv, linear_solver)
        if uv is None or stop == stops[-1]:
            return uv
        uv, guarded = descend_level(level, uv, linear_solver, guarded, _STEPS[here is not None])
        here = level
    return uv


def flatten_level(hierarchy: Hierarchy, stop: int, linear_solver: str) -> tuple[Level, FloatArray] | None:
    """Return the mesh at a stop and its bijective map (m, 2), with a descent on it; None if rounding prevents one."""
    stops = [*(coarser for coarser in hierarchy.select_stops(RATIO) if coarser > stop), stop]
    uv = flatten_levels(hierarchy, stops, linear_solver)
    if uv is None:
        return None
    level = hierarchy.level(stop)
    return level, descend_level(level, uv, linear_solver, False, _STEPS[1])[0]


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
            return smooth_map(there.V, there.F, there.loops, uv, linear_solver)
        # Boundary vertices at intersections are placed inside the coarse image, and from `late` on all of them.
        late = height < _TUNING.late
        kept_inside[there.vertices if late else there.vertices[met]] = True
    return None


def descend_level(
    level: Level, uv: FloatArray, linear_solver: str, guarded: bool, steps: int
) -> tuple[FloatArray, bool]:
    """Lower the symmetric Dirichlet energy of a level's bijective map, if ``guarded`` with a guard from the beginning.

    Return the map, and whether finer levels need a guard from the beginning: where a map with little distortion
    overlaps itself, only the coarse boundary does so.
    """
    rim = Rim(level.loops)
    energy = thick_energy(level.V, level.F)

    def lower(rim: Rim | None) -> FloatArray:
        descent = SurfaceDescent(energy, uv, linear_solver, rim=rim, iterate=True)
        for _ in islice(descend(descent, SymmetricDirichlet(), _TUNING.tolerance), steps):
            pass
        return descent.uv

    if not guarded:
        free = lower(None)
        apart = rim.pull_apart(level.F, free) if rim.meets_itself(free) else free
        if apart is not None:
            return apart, False
        guarded = energy.value(in_units(free, 0)) > _TUNING.little
    energy.energy = SymmetricDirichlet()
    return lower(rim), guarded


def map_to_disk(
    V: FloatArray, F: IntArray, loops: Sequence[IntArray], linear_solver: str = "auto"
) -> FloatArray | None:
    """Map a surface into a disk of its area, with its longest loop on the circle by arc length.

    ``V`` (n, 3) is of about unit size, and the surface is connected and has no handles. Return a bijective map (n, 2),
    or None if none was found in double precision. Ctrl-C raises KeyboardInterrupt.
    """
    # The search's modules take longer to import than `unwrap` takes for a model of flat parts, which needs none.
    from quasiharmonic.solver.mapping import solve

    lengths = [loop_lengths(V, loop) for loop in loops]
    longest = int(np.argmax([length.sum() for length in lengths]))
    outer = loops[longest]
    holes = [loop for k, loop in enumerate(loops) if k != longest]
    # Edges of length zero get a small length, so that no two vertices share a position.
    length = lengths[longest] + 1e-6 * lengths[longest].mean()
    angle = 2 * np.pi * np.cumsum(length) / length.sum()
    radius = np.sqrt(surface_area(V, F) / np.pi)
    circle = radius * np.stack([np.cos(angle), np.sin(angle)], axis=1)
    problem = Problem(
        np.concatenate([V, *(V[hole].mean(axis=0)[None] for hole in holes)]),
        np.concatenate([F, make_fans(holes, len(V))]),
        outer,
        circle,
        reference="equilateral",
    )
    result = solve(problem, linear_solver=linear_solver, max_iterations=200)
    if result.status is Status.INTERRUPTED:
        raise KeyboardInterrupt
    return result.uv[: len(V)] if result.injective else None
