"""Coarse meshes of a surface with coarse boundaries, and the prolongation of maps to finer meshes.

Each boundary loop is filled by a fan around a new vertex, its *hub*. Boundary vertices then become interior vertices,
and `quasiharmonic.geometry.coarsening.levels` can remove them like others. Hubs are kept, and get no new edges. Without
the hubs, a coarse mesh with coarse loops remains.

Prolongation positions each removed vertex according to the surface's shape. The vertex's ring is laid out flat around
it by its rest angles and lengths. The affine map that fits the flat ring best to the ring's current positions also maps
the vertex. This is exact if the map is affine. If it inverts a triangle, the vertex gets the position that gives its
triangles the best shape, as in `quasiharmonic.geometry.coarsening.prolongation`. This position is inside its ring and
the coarse image.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from quasiharmonic.apps.flattening.start import fans
from quasiharmonic.geometry.coarsening.levels import coarsen
from quasiharmonic.geometry.coarsening.prolongation import places
from quasiharmonic.geometry.mesh.topology import boundary_loops
from quasiharmonic.util.arrays import BoolArray, ComplexArray, FloatArray, IntArray

# Weight that keeps the affine map close to a similarity.
_RIGID = 1e-2
# The affine position is used if every triangle has at least this fraction of its area in the flat layout.
_LEAST = 0.05
#: Minimum height of a coarse mesh's triangles, relative to their longest side.
LOWEST = 0.05
# Maximum sum of the angles around a boundary vertex when its ring is laid out.
_WIDEST = 1.9 * np.pi


@dataclass(frozen=True, eq=False)
class Level:
    """One mesh of a hierarchy, with its own vertex numbering.

    Attributes
    ----------
    stop : int
        The hierarchy's stop that the mesh belongs to.
    vertices : (m,) int64
        The finest mesh's indices of its vertices, ascending.
    F : (f, 3) int64
    loops : list of (l,) int64
    """

    stop: int
    vertices: IntArray
    F: IntArray
    loops: list[IntArray]


class Hierarchy:
    """A sequence of increasingly coarse meshes of a surface.

    Parameters
    ----------
    V : (n, 3) float64
        Rest positions, of about unit size.
    F : (f, 3) int64
        Triangles of a connected surface.
    loops : list of (l,) int64
        Boundary loops of the surface.
    goal : int
        Number of vertices of the coarsest mesh; it has more if no others can be removed.

    Attributes
    ----------
    V : (n, 3) float64
        As given.
    stops : list of int
        Rounds after which there is a mesh, finest first; 0 is the surface itself.
    """

    def __init__(self, V: FloatArray, F: IntArray, loops: list[IntArray], goal: int) -> None:
        self.V = V
        self._n = n = len(V)
        filled = fans(loops, n)
        held = np.zeros(n + len(loops), dtype=bool)
        held[n:] = True
        self._coarsening = coarsen(np.concatenate([F, filled]), held.size, held, goal + len(loops))
        self._rounds = len(self._coarsening.rounds)
        # There are meshes before some of the rounds, and after the last.
        self.stops = [*sorted(self._coarsening.levels), self._rounds]

    def stations(self, ratio: float) -> list[int]:
        """Some of the `stops`, coarsest first; each mesh has at least ``ratio`` times the vertices of the last."""
        left = self._left()
        chosen = [0]
        for stop in self.stops[1:]:
            if left[stop] * ratio <= left[chosen[-1]]:
                chosen.append(stop)
        if len(chosen) == 1:
            chosen.append(self.stops[-1])
        return chosen[::-1]

    def coarsest(self, least: float) -> int:
        """Return the last of the `stops` whose mesh has at least ``least`` vertices; 0 if none has."""
        left = self._left()
        return max((stop for stop in self.stops if left[stop] >= least), default=0)

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
        used = np.zeros(self._n, dtype=bool)
        used[T] = True
        vertices = np.flatnonzero(used)
        number = np.full(self._n, -1)
        number[vertices] = np.arange(vertices.size)
        F = number[T]
        return Level(stop, vertices, F, boundary_loops(F, vertices.size))

    def prolong(self, w: ComplexArray, start: int, stop: int, wary: BoolArray, height: float) -> ComplexArray:
        """Carry a map from the mesh at one stop to a finer one.

        Parameters
        ----------
        w : (n,) complex128
            The map in the finest mesh's numbering; only vertices of the mesh at ``start`` are read.
        start, stop : int
            Stops, ``stop < start``.
        wary : (n,) bool
            Boundary vertices that are placed inside the coarse image, so that their edges do not intersect others. The
            other vertices are placed by the surface's shape.
        height : float
            Height of wary ears, which cannot be placed inside, above their edges, relative to the edges' lengths. If
            all boundary vertices are wary and the height is small enough, a bijective map stays bijective.

        Returns
        -------
        (n,) complex128
        """
        w = w.copy()
        for number in reversed(range(stop, start)):
            for vertices, rings in self._coarsening.rounds[number]:
                at_rim = (rings >= self._n).any(axis=1)
                for some, rim in ((~at_rim, False), (at_rim, True)):
                    if some.any():
                        ring = self._opened(rings[some]) if rim else rings[some]
                        w[vertices[some]] = self._placed(w, vertices[some], ring, rim, wary, height)
        return w

    def _opened(self, rings: IntArray) -> IntArray:
        """Return the rings of boundary vertices without their hubs, from one end to the other."""
        hub = (rings >= self._n).argmax(axis=1)
        turn = (hub[:, None] + 1 + np.arange(rings.shape[1] - 1)) % rings.shape[1]
        return np.take_along_axis(rings, turn, axis=1)

    def _placed(
        self, w: ComplexArray, vertices: IntArray, ring: IntArray, rim: bool, wary: BoolArray, height: float
    ) -> ComplexArray:
        """Positions of vertices with rings (r, d), which are closed, or open if ``rim``."""
        flat = self._laid_out(vertices, ring, rim)
        around = w[ring]
        place = _carried(flat, around)
        if rim and ring.shape[1] == 2:
            # An ear lies to the left of x₁ → x₂, and the rest of the surface to the right.
            return np.where(wary[vertices], around[:, 0] + (0.5 + 1j * height) * (around[:, 1] - around[:, 0]), place)
        good = _keeps_shape(flat, place, around, rim)
        if rim:
            good &= ~wary[vertices]
        poor = np.flatnonzero(~good)
        if poor.size:
            ring_now = around[poor]
            if rim:
                # Either end of an open ring can be the apex of the fan that fills it.
                ring_now = np.where(_fan_positive(ring_now)[:, None], ring_now, np.roll(ring_now, 1, axis=1))
            place[poor] = places(ring_now)
        return place

    def _laid_out(self, vertices: IntArray, ring: IntArray, rim: bool) -> ComplexArray:
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


def _carried(flat: ComplexArray, around: ComplexArray) -> ComplexArray:
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
    least = np.maximum(_LEAST * scale[:, None] * rest, 0)
    good: BoolArray = (area > least).all(axis=1)
    return good


def _fan_positive(ring: ComplexArray) -> BoolArray:
    """Whether the fan from the first vertex of each ring has only positive triangles."""
    arm = ring[:, 1:] - ring[:, :1]
    twice_area: FloatArray = (arm[:, :-1].conj() * arm[:, 1:]).imag
    positive: BoolArray = np.all(twice_area > 0, axis=1)
    return positive
