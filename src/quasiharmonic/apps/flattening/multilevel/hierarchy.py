"""Coarse meshes of a surface whose boundary is coarsened too, and the way back.

Each boundary loop is filled by a fan around a vertex of its own, its *hub*, which makes the boundary's vertices inner
ones and lets `quasiharmonic.geometry.coarsening.levels` take them out as any other; hubs stay, and no new edge ends at
them. So what is left without the hubs is a coarse mesh with coarse loops.

On the way back a vertex goes to where the surface says that it is. Its ring is laid out flat around it, by the angles
and lengths at rest; the affine map that takes the ring nearest to where it is now takes the vertex along. That
is exact where the map is affine. Where it inverts a triangle the vertex goes where its triangles are
best shaped, as in `quasiharmonic.geometry.coarsening.prolongation`: inside of its ring, and of the coarse surface's
image.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from quasiharmonic.apps.flattening.start import fans
from quasiharmonic.geometry.coarsening.levels import coarsen
from quasiharmonic.geometry.coarsening.prolongation import places
from quasiharmonic.geometry.mesh.topology import boundary_loops
from quasiharmonic.util.arrays import BoolArray, ComplexArray, FloatArray, IntArray

# The affine map is held to a similarity where the ring does not say otherwise, with this weight.
_RIGID = 1e-2
# A vertex keeps its place if none of its triangles has less than this share of the area that it has laid out flat.
_LEAST = 0.05
#: Triangles of a mesh whose triangles were never there are no lower than this share of their longest side.
LOWEST = 0.05
# Angles around a vertex of the boundary add up to this at most when its ring is laid out.
_WIDEST = 1.9 * np.pi


@dataclass(frozen=True, eq=False)
class Level:
    """One mesh of a hierarchy, with vertices numbered for itself.

    Attributes
    ----------
    stop : int
        Which of the hierarchy's.
    vertices : (m,) int64
        Its vertices as the finest mesh numbers them, ascending.
    F : (f, 3) int64
    loops : list of (l,) int64
    """

    stop: int
    vertices: IntArray
    F: IntArray
    loops: list[IntArray]


class Hierarchy:
    """Coarser and coarser meshes of a surface.

    Parameters
    ----------
    V : (n, 3) float64
        Rest positions, of about unit size.
    F : (f, 3) int64
        Triangles of a connected surface.
    loops : list of (l,) int64
        Its boundary loops.
    goal : int
        How many vertices the coarsest mesh is to have; it has more where no other can be taken out.

    Attributes
    ----------
    V : (n, 3) float64
        As given.
    stops : list of int
        Where there is a mesh, finest first; 0 is the surface itself.
    """

    def __init__(self, V: FloatArray, F: IntArray, loops: list[IntArray], goal: int) -> None:
        self.V = V
        self._n = n = len(V)
        filled = fans(loops, n)
        held = np.zeros(n + len(loops), dtype=bool)
        held[n:] = True
        self._coarsening = coarsen(np.concatenate([F, filled]), held.size, held, goal + len(loops))
        self._rounds = len(self._coarsening.rounds)
        # Where there are meshes: before some of the rounds, and after the last.
        self.stops = [*sorted(self._coarsening.levels), self._rounds]

    def stations(self, ratio: float) -> list[int]:
        """Some of the `stops`, coarsest first: each mesh has so many times the vertices of the one before, or more."""
        left = self._left()
        chosen = [0]
        for stop in self.stops[1:]:
            if left[stop] * ratio <= left[chosen[-1]]:
                chosen.append(stop)
        if len(chosen) == 1:
            chosen.append(self.stops[-1])
        return chosen[::-1]

    def coarsest(self, least: float) -> int:
        """The last of the `stops` whose mesh has so many vertices or more; 0 where none has."""
        left = self._left()
        return max((stop for stop in self.stops if left[stop] >= least), default=0)

    def finer(self, stop: int) -> int:
        """The stop before one."""
        return self.stops[self.stops.index(stop) - 1]

    def _left(self) -> IntArray:
        """How many vertices there are after none, one, … of the rounds."""
        removed = [0, *(sum(vertices.size for vertices, _ in removals) for removals in self._coarsening.rounds)]
        left: IntArray = self._n - np.cumsum(removed)
        return left

    def level(self, stop: int) -> Level:
        """The mesh after so many rounds, one of `stops`."""
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
            By the numbers of the finest mesh; those of the mesh at ``start`` are read.
        start, stop : int
            Stops, ``stop < start``.
        wary : (n,) bool
            Vertices of the boundary that are put within the coarse image, so that their edges do not meet others there;
            the rest goes where the surface says.
        height : float
            Of wary ears, which have no place within: so high above the edge they stand on, as a share of its length.
            If all are wary and this is small enough, the map is bijective where it was.

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
        """Rings of vertices of the boundary without their hubs, from one end to the other."""
        hub = (rings >= self._n).argmax(axis=1)
        turn = (hub[:, None] + 1 + np.arange(rings.shape[1] - 1)) % rings.shape[1]
        return np.take_along_axis(rings, turn, axis=1)

    def _placed(
        self, w: ComplexArray, vertices: IntArray, ring: IntArray, rim: bool, wary: BoolArray, height: float
    ) -> ComplexArray:
        """Places for vertices whose rings (r, d) are closed, or open where they are of the rim."""
        flat = self._laid_out(vertices, ring, rim)
        around = w[ring]
        place = _carried(flat, around)
        if rim and ring.shape[1] == 2:
            # An ear lies to the left of x₁ → x₂, and all else to the right.
            return np.where(wary[vertices], around[:, 0] + (0.5 + 1j * height) * (around[:, 1] - around[:, 0]), place)
        good = _keeps_shape(flat, place, around, rim)
        if rim:
            good &= ~wary[vertices]
        poor = np.flatnonzero(~good)
        if poor.size:
            ring_now = around[poor]
            if rim:
                # Of an open ring either end may be the apex of the fan that fills it.
                ring_now = np.where(_fan_positive(ring_now)[:, None], ring_now, np.roll(ring_now, 1, axis=1))
            place[poor] = places(ring_now)
        return place

    def _laid_out(self, vertices: IntArray, ring: IntArray, rim: bool) -> ComplexArray:
        """Rings at rest, laid out flat around their vertices; (r, d) complex128, of about unit size."""
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
    """Where the affine maps that take flat rings nearest to given ones take their centres; (r,) complex128."""
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
    """Whether no triangle around a vertex has lost most of the area that it should have."""
    now, then = around - place[:, None], flat
    last = -1 if rim else None
    following = np.roll(then, -1, axis=1)
    area = (now.conj() * np.roll(now, -1, axis=1)).imag[:, :last]
    rest = (then.conj() * following).imag[:, :last]
    # Both sides of a seam are at one place at rest: a triangle between them has no area there, but needs some.
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
