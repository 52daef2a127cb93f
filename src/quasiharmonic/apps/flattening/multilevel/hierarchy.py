"""Coarse meshes of a surface with coarse boundaries, and the prolongation of maps to finer meshes.

Each boundary loop is filled by a fan around a new vertex, its *hub*. Boundary vertices then become interior vertices,
and `quasiharmonic.geometry.coarsening` can remove them like others. Hubs are kept, and get no new edges. Without
the hubs, a coarse mesh with coarse loops remains.

Prolongation lays the ring of each removed vertex out flat around it by its rest angles and lengths. The affine map that
fits the flat ring best to the ring's current positions also maps the vertex. If this inverts a triangle, the vertex
gets the position that gives its triangles the best shape, as in `quasiharmonic.geometry.prolongation`. This
position is inside its ring and the coarse image.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from quasiharmonic.geometry.coarsening import coarsen
from quasiharmonic.geometry.mesh.splitting import make_fans
from quasiharmonic.geometry.mesh.topology import boundary_loops
from quasiharmonic.geometry.prolongation import reinsertion_positions
from quasiharmonic.util.arrays import BoolArray, ComplexArray, FloatArray, IntArray, invert_indices, mark

# Weight that keeps the affine map close to a similarity.
_RIGID = 1e-2
# The affine position is used if every triangle has at least this fraction of its area in the flat layout.
_MIN_AREA_SHARE = 0.05
#: Minimum height of a coarse mesh's triangles, relative to their longest side.
LOWEST = 0.05
# Maximum sum of the angles around a boundary vertex when its ring is laid out.
_WIDEST = 1.9 * np.pi


@dataclass(frozen=True, eq=False)
class Level:
    """One mesh of a hierarchy, with its own vertex numbering.

    ``stop`` is the hierarchy's stop that the mesh belongs to. ``vertices`` (m,) are the finest mesh's indices of its
    vertices, ascending.
    """

    stop: int
    vertices: IntArray
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
        held = np.zeros(self._n_filled, dtype=bool)
        held[n:] = True
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
        left: IntArray = self._n - np.cumsum(removed)
        return left

    def level(self, stop: int) -> Level:
        """Return the mesh at a stop."""
        T = self._coarsening.F if stop == self._rounds else self._coarsening.levels[stop]
        T = T[T.max(axis=1) < self._n]
        used = mark(self._n, T)
        vertices = np.flatnonzero(used)
        number = invert_indices(self._n, vertices)
        F = number[T]
        return Level(stop, vertices, F, boundary_loops(F, vertices.size))

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
        wanted = np.minimum(total, _WIDEST) if rim else np.full(total.shape, 2 * np.pi)
        angle = angle * (wanted / np.where(total > 0, total, 1))[:, None]
        turned = np.zeros(ring.shape)
        turned[:, 1:] = np.cumsum(angle if rim else angle[:, :-1], axis=1)
        size = length.mean(axis=1)
        return length / np.where(size > 0, size, 1)[:, None] * np.exp(1j * turned)


def _fit_affine(flat: ComplexArray, around: ComplexArray) -> ComplexArray:
    """Images of the rings' centres under the affine maps that fit flat rings best to given ones; (r,) complex128."""
    weight = 1 / (flat.real**2 + flat.imag**2 + 1e-12)
    columns = np.stack([np.ones(flat.shape, dtype=np.complex128), flat, flat.conj()], axis=2)
    weighted = columns.conj() * weight[:, :, None]
    normal = np.swapaxes(weighted, 1, 2) @ columns
    scale = weight.sum(axis=1)
    normal[:, 2, 2] += _RIGID * scale
    normal[:, (0, 1), (0, 1)] += 1e-12 * scale[:, None]
    middle = around.mean(axis=1)
    load = np.einsum("rdk,rd->rk", weighted, around - middle[:, None])
    return middle + np.linalg.solve(normal, load[:, :, None])[:, 0, 0]


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
    least = np.maximum(_MIN_AREA_SHARE * scale[:, None] * rest, 0)
    good: BoolArray = (area > least).all(axis=1)
    return good


def _fan_positive(ring: ComplexArray) -> BoolArray:
    """Whether the fan from the first vertex of each ring has only positive triangles."""
    arm = ring[:, 1:] - ring[:, :1]
    twice_area: FloatArray = (arm[:, :-1].conj() * arm[:, 1:]).imag
    positive: BoolArray = np.all(twice_area > 0, axis=1)
    return positive
