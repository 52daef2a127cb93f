"""Join developable pieces across creases, like the parts of a paper model, while the texture is used as well as before.

Two pieces are joined if their union does not overlap itself, is not too long for the texture, and its box is hardly
larger than the boxes of both. Longest edges come first.
"""

from __future__ import annotations

from collections.abc import Callable
from heapq import heapify, heappop, heappush
from typing import Any

import numpy as np

from quasiharmonic.apps.atlas.packing.shapes import convex_hull, find_smallest_box
from quasiharmonic.apps.unwrapping.hinges import Hinges
from quasiharmonic.apps.unwrapping.pieces import Pieces
from quasiharmonic.apps.unwrapping.symmetry import Mirror
from quasiharmonic.geometry.exact.loops import check_loops
from quasiharmonic.geometry.mesh.fans import fans
from quasiharmonic.geometry.mesh.topology import boundary_loops
from quasiharmonic.util.arrays import BoolArray, ComplexArray, FloatArray, IntArray, to_points

# Two sides of an edge are at one place if their ends are at most this fraction of its length apart.
_SAME = 1e-3
# Share of the texture that charts are expected to cover.
_EXPECTED = 0.7
# Boundaries that are closer than this multiple of the root of the area count as touching.
_GAP = 2.0**-20
# Lengths count as equal up to this factor.
_AS_LONG = 1 + 1e-9
# Edges between two pieces that are compared, longest first.
_TRIES = 64


class _Leaf:
    """Triangles (k,) that are laid out together, the convex hull of their corners, and the area of its smallest box."""

    def __init__(self, triangles: IntArray, place: ComplexArray) -> None:
        self.triangles = triangles
        self.hull = convex_hull(place)
        seen = self.hull * find_smallest_box(self.hull).conjugate()
        self.width, self.height = float(np.ptp(seen.real)), float(np.ptp(seen.imag))

    @property
    def box(self) -> float:
        return self.width * self.height

    @property
    def longest(self) -> float:
        return max(self.width, self.height)


class PaperModel:
    """Pieces in the plane, some of which are joined.

    Parameters
    ----------
    F : (f, 3) int64
    hinges : Hinges
    pieces : Pieces
        Changed: joined pieces get one label and one frame.
    area : float
        Area of the whole surface.
    mirror : Mirror, optional
        Mirror images. What is joined is then joined on both sides.
    """

    def __init__(self, F: IntArray, hinges: Hinges, pieces: Pieces, area: float, mirror: Mirror | None = None) -> None:
        self._F, self._hinges, self._pieces = F, hinges, pieces
        self._mirror = mirror
        self._hinge_image = None if mirror is None else mirror.of_hinges(hinges, F)
        self._joined_sides = hinges.mark_sides(pieces.glued, len(F)).ravel()
        self._side = np.sqrt(area / _EXPECTED)
        self._unit = _GAP * np.sqrt(area)
        order = np.argsort(pieces.label, kind="stable")
        order = order[pieces.label[order] >= 0]
        parts = np.split(order, np.flatnonzero(np.diff(pieces.label[order])) + 1) if order.size else []
        self._charts = {k: _Leaf(rows, pieces.place[rows].ravel()) for k, rows in enumerate(parts)}
        # Hinges between two charts, and how often each chart has changed.
        self._contacts: dict[int, dict[int, IntArray]] = {k: {} for k in self._charts}
        self._version = dict.fromkeys(self._charts, 0)
        self._watched: BoolArray = np.zeros(hinges.one.size, dtype=np.bool_)
        # Pairs of charts that overlap if they are joined at this number of hinges. They also do when others are added.
        self._overlapping = set[tuple[int, int, int]]()
        # The largest limit of boxes at which pairs of charts, with their versions, could not be joined.
        self._loose: dict[tuple[int, ...], float] = {}
        self._demanded = np.flatnonzero(self._watched)

    def list_contacts(self, may_join: BoolArray) -> None:
        """Find where charts may be joined, given a mask of hinges (e,). All others stay open."""
        label, hinges = self._pieces.label, self._hinges
        self._demanded = np.flatnonzero(~may_join)
        one, other = label[hinges.first], label[hinges.second]
        self._watched = may_join & (one >= 0) & (other >= 0) & (one != other)
        between = np.flatnonzero(self._watched)
        low, high = np.minimum(one, other)[between], np.maximum(one, other)[between]
        order = np.lexsort((high, low))
        starts = np.flatnonzero(np.diff(low[order] * len(self._charts) + high[order], prepend=-1))
        for group in np.split(order, starts[1:]) if order.size else []:
            a, b = int(low[group[0]]), int(high[group[0]])
            self._contacts[a][b] = self._contacts[b][a] = between[group]

    def join(
        self, weight: FloatArray, undivided: BoolArray, longest: float, loss: float, check: Callable[[], object]
    ) -> None:
        """Join charts, largest sum of the hinges' weights (e,) first.

        Parameters
        ----------
        weight : (e,) float64
        undivided : (e,) bool
            Hinges at which only overlaps matter.
        longest : float
            Largest length of a union, in sides of the expected texture.
        loss : float
            By which fraction the box of a union may be larger than the boxes of its parts.
        check : callable
            Called before each attempt; may raise an exception.
        """
        limits = longest * self._side, 1 + loss
        queue = [self._entry(a, b, weight) for a in self._contacts for b in self._contacts[a] if a < b]
        heapify(queue)
        while queue:
            check()
            _, a, b, *versions = heappop(queue)
            if versions != [self._version.get(a), self._version.get(b)]:
                continue
            forced = bool(undivided[self._contacts[a][b]].any())
            for chart in self._join_symmetrically(a, b, weight, (np.inf, np.inf) if forced else limits):
                for c in self._contacts[chart]:
                    heappush(queue, self._entry(min(chart, c), max(chart, c), weight))

    def _join_symmetrically(self, a: int, b: int, weight: FloatArray, limits: tuple[float, float]) -> set[int]:
        """Join two charts, and their mirror images; return the charts that changed."""
        if self._mirror is None:
            return {a} if self._try(a, b, weight, limits) else set()
        label = self._pieces.label
        images = [self._mirror.triangle[self._charts[k].triangles[0]] for k in (a, b)]
        before = self._save()
        if not self._try(a, b, weight, limits):
            return set()
        c, d = sorted(label[images].tolist())
        # The union may be its own image. Otherwise, the images are two charts, one of which may be the union.
        if (c == d or (d in self._contacts.get(c, ()) and self._try(c, d, weight, limits))) and self._is_mirrored():
            return {a, c} & self._charts.keys()
        self._restore(before)
        return set()

    def _is_mirrored(self) -> bool:
        """Whether the mirror image of every glued hinge is glued."""
        glued = self._pieces.glued
        return self._hinge_image is None or bool((glued[self._hinge_image] == glued)[self._watched].all())

    def _save(self) -> tuple[Any, ...]:
        """Return a copy of everything that `_try` changes."""
        pieces = self._pieces
        contacts = {k: dict(others) for k, others in self._contacts.items()}
        arrays = [array.copy() for array in (pieces.label, pieces.place, pieces.glued, self._joined_sides)]
        return contacts, dict(self._charts), dict(self._version), set(self._overlapping), arrays

    def _restore(self, saved: tuple[Any, ...]) -> None:
        """Undo what was done since `_save`."""
        self._contacts, self._charts, self._version, self._overlapping, (label, place, glued, sides) = saved
        self._pieces.label[:], self._pieces.place[:], self._pieces.glued[:] = label, place, glued
        self._joined_sides[:] = sides

    def _entry(self, a: int, b: int, weight: FloatArray) -> tuple[float, int, int, int, int]:
        return (-float(weight[self._contacts[a][b]].sum()), a, b, self._version[a], self._version[b])

    def _try(self, a: int, b: int, weight: FloatArray, limits: tuple[float, float]) -> bool:
        """Move chart ``b`` to chart ``a`` and join them, if their union is good."""
        contact = self._contacts[a][b]
        longest, boxes = limits
        state = (a, b, self._version[a], self._version[b])
        if (a, b, contact.size) in self._overlapping or boxes <= self._loose.get(state, 0.0):
            return False
        motion = self._find_motion(a, b, weight)
        one, other = self._charts[a], self._charts[b]
        place = self._pieces.place
        moved = motion[0] * place[other.triangles] + motion[1]
        union = _Leaf(
            np.concatenate([one.triangles, other.triangles]),
            np.concatenate([one.hull, motion[0] * other.hull + motion[1]]),
        )
        # Boxes that are too large in one round are too large in the next one, unless its limit is higher.
        if union.box > boxes * (one.box + other.box):
            self._loose[state] = boxes
            return False
        if union.longest > _AS_LONG * max(longest, one.longest, other.longest):
            return False
        before = place[other.triangles]
        place[other.triangles] = moved
        glued = contact[self._meet(contact)]
        glued_sides = np.concatenate([self._hinges.one[glued], self._hinges.other[glued]])
        self._joined_sides[glued_sides] = True
        if not self._is_simple(union.triangles):
            place[other.triangles] = before
            self._joined_sides[glued_sides] = False
            self._overlapping.add((a, b, contact.size))
            return False
        self._pieces.glued[glued] = True
        self._pieces.label[other.triangles] = a
        self._charts[a] = union
        self._version[a] += 1
        del self._charts[b], self._version[b]
        mine, theirs = self._contacts[a], self._contacts.pop(b)
        del mine[b], theirs[a]
        for c, more in theirs.items():
            del self._contacts[c][b]
            mine[c] = np.concatenate([mine[c], more]) if c in mine else more
            self._contacts[c][a] = mine[c]
        return True

    def _find_motion(self, a: int, b: int, weight: FloatArray) -> tuple[complex, complex]:
        """Rotation and shift of chart ``b`` at which most of the common edges, by weight, meet."""
        hinges, contact = self._hinges, self._contacts[a][b]
        contact = contact[np.argsort(-weight[contact], kind="stable")[:_TRIES]]
        z, ahead = self._pieces.place.ravel(), np.roll(self._pieces.place, -1, axis=1).ravel()
        swapped = self._pieces.label[hinges.one[contact] // 3] != a
        mine = np.where(swapped, hinges.other[contact], hinges.one[contact])
        theirs = np.where(swapped, hinges.one[contact], hinges.other[contact])
        turn = (ahead[mine] - z[mine]) / (z[theirs] - ahead[theirs])
        turn /= np.abs(turn)
        shift = z[mine] - turn * ahead[theirs]
        moved = turn[:, None] * z[theirs] + shift[:, None], turn[:, None] * ahead[theirs] + shift[:, None]
        apart = np.maximum(np.abs(moved[0] - ahead[mine]), np.abs(moved[1] - z[mine]))
        met = (apart <= _SAME * hinges.length[contact]) @ weight[contact]
        best = int(np.argmax(met))
        return complex(turn[best]), complex(shift[best])

    def _meet(self, contact: IntArray) -> BoolArray:
        """Return which hinges have both sides at one place."""
        z, ahead = self._pieces.place.ravel(), np.roll(self._pieces.place, -1, axis=1).ravel()
        one, other = self._hinges.one[contact], self._hinges.other[contact]
        apart = np.maximum(np.abs(z[one] - ahead[other]), np.abs(ahead[one] - z[other]))
        same: BoolArray = apart <= _SAME * self._hinges.length[contact]
        return same

    def _is_simple(self, rows: IntArray) -> bool:
        """Whether some triangles, joined at the glued hinges, have boundaries that stay apart."""
        own = self.split(rows)
        if self._closes_demanded(rows, own):
            return False
        uv = np.empty((int(own.max()) + 1, 2))
        uv[own] = to_points(self._pieces.place[rows].ravel()).reshape(-1, 3, 2)
        return not check_loops(boundary_loops(own, len(uv)), np.rint(uv / self._unit) * self._unit)[1]

    def _closes_demanded(self, rows: IntArray, own: IntArray) -> bool:
        """Whether the two sides of a demanded seam have equal vertices ``own`` (k, 3) at both ends."""
        if not self._demanded.size:
            return False
        order = np.argsort(rows)
        sides = np.stack([self._hinges.one[self._demanded], self._hinges.other[self._demanded]])
        at = np.minimum(np.searchsorted(rows[order], sides // 3), len(rows) - 1)
        place = 3 * order[at] + sides % 3
        here = (rows[order[at]] == sides // 3).all(axis=0)
        tail, head = own.ravel()[place], own[:, (1, 2, 0)].ravel()[place]
        return bool((here & (tail[0] == head[1]) & (head[0] == tail[1])).any())

    def split(self, rows: IntArray) -> IntArray:
        """Return some triangles (k, 3) by vertices of their own, joined at the glued hinges only."""
        return fans(self._F[rows], ~self._joined_sides.reshape(-1, 3)[rows])[0]
