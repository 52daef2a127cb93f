"""Charts of the developable pieces of a surface: unrolled, and joined across creases like the parts of a paper model.

Two pieces are joined if their union does not overlap itself, is not too long for the texture, and its box is hardly
larger than the boxes of both. Longest edges come first.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from heapq import heapify, heappop, heappush
from typing import Any, NamedTuple

import numpy as np

from quasiharmonic.apps.atlas.packing.shapes import convex_hull, find_smallest_box
from quasiharmonic.apps.unwrapping.chart import Chart, cut_out_chart
from quasiharmonic.apps.unwrapping.hinges import DEMANDED_COST, KEPT_COST, UNDIVIDED_COST, Hinges
from quasiharmonic.apps.unwrapping.layout import LayoutChoice
from quasiharmonic.apps.unwrapping.pieces import Pieces, find_pieces
from quasiharmonic.apps.unwrapping.symmetry import Mirror
from quasiharmonic.apps.unwrapping.unrolling import SAME, meet
from quasiharmonic.geometry.exact.loops import check_loops
from quasiharmonic.geometry.mesh.reference import surface_area
from quasiharmonic.geometry.mesh.splitting import fans
from quasiharmonic.geometry.mesh.topology import ahead, boundary_loops, group_by_label
from quasiharmonic.util.arrays import BoolArray, ComplexArray, FloatArray, IntArray, to_points

# Rounds with a larger loss than this are left out if there are too many charts to compare: the choice between lists of
# charts would not notice that the union of two charts uses the texture worse.
_SMALL_LOSS = 0.02
# Share of the texture that charts are expected to cover.
_EXPECTED = 0.7
# Boundaries that are closer than this multiple of the root of the area count as touching.
_GAP = 2.0**-20
# Lengths count as equal up to this factor.
_AS_LONG = 1 + 1e-9
# Edges between two pieces that are compared, longest first.
_TRIES = 64


class JoiningRound(NamedTuple):
    """Limits of the unions of charts in one round of joining, as in `PaperModel.join`."""

    longest: float  # Largest length of a union, in sides of the expected texture
    loss: float  # By which fraction the box of a union may be larger than the boxes of its parts


# The rounds, in this order.
_ROUNDS = (
    JoiningRound(0.25, 0.02),
    JoiningRound(0.45, 0.02),
    JoiningRound(0.8, 0.02),
    JoiningRound(0.8, 0.3),
    JoiningRound(1.2, 1.0),
)
# Limits at which charts are joined only where they must be.
_ONLY_FORCED = JoiningRound(0.0, -1.0)


def develop_charts(
    V: FloatArray,
    F: IntArray,
    cost: FloatArray,
    hinges: Hinges,
    choose: LayoutChoice | None,
    check_wanted: Callable[[], object],
    mirror: Mirror | None = None,
    *,
    max_stretch: float = 1.0,
) -> tuple[BoolArray, list[Chart]]:
    """Unroll the developable pieces of a surface, and join them to charts without stretch.

    Parameters
    ----------
    V : (n, 3) float64
    F : (f, 3) int64
    cost : (f, 3) float64
        Factor on the cost of cutting each side of each triangle. Pieces are joined across sides with factors of at
        least `UNDIVIDED_COST` unless they overlap, and never at factors of at most `DEMANDED_COST`. Pieces that cannot
        be joined at a factor of at least `KEPT_COST` count as curved.
    hinges : Hinges
    choose : LayoutChoice or None
        How to choose from several lists of charts, whose number decreases; None for the last one.
    check_wanted : callable
        Called now and then; may raise an exception.
    mirror : Mirror, optional
        Mirror images, if seams and charts are to be mirrored.
    max_stretch : float
        As in `find_pieces`.

    Returns
    -------
    developed : (f,) bool
        The triangles of these charts.
    charts : list of Chart
        By rows of ``F``.
    """
    demanded = hinges.touch(cost <= DEMANDED_COST)
    pieces = find_pieces(V, F, hinges, cost, mirror, max_stretch=max_stretch)
    if not pieces.count:
        return pieces.label >= 0, []
    area = surface_area(V, F) if choose is None else choose.measure_area(V, F)
    weight = hinges.price(cost)
    model = PaperModel(F, hinges, pieces, area, ~demanded, mirror)
    together = hinges.touch(cost >= UNDIVIDED_COST)
    kept = hinges.touch(cost >= KEPT_COST)
    if kept.any():
        own = replace(pieces, label=pieces.label.copy(), place=pieces.place.copy(), glued=pieces.glued.copy())
        model.join(weight, kept, *_ONLY_FORCED, check_wanted)
        torn = kept & ~pieces.glued
        lost = np.unique(pieces.label[np.concatenate([hinges.first[torn], hinges.second[torn]])])
        if lost[lost >= 0].size:
            pieces = own.without(hinges, np.isin(pieces.label, lost))
            model = PaperModel(F, hinges, pieces, area, ~demanded, mirror)
            model.join(weight, kept, *_ONLY_FORCED, check_wanted)
        if not pieces.count:
            return pieces.label >= 0, []
    found = [model.list_charts()]
    for longest, loss in _ROUNDS:
        if loss > _SMALL_LOSS and choose is not None and not choose.is_generous(found[-1]):
            break
        model.join(weight, together, longest, loss, check_wanted)
        found.append(model.list_charts())
    return pieces.label >= 0, found[-1] if choose is None else choose.choose(found, V, cost)


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
    may_join : (e,) bool
        Hinges at which pieces may be joined. All others stay open.
    mirror : Mirror, optional
        Mirror images. What is joined is then joined on both sides.
    """

    def __init__(
        self,
        F: IntArray,
        hinges: Hinges,
        pieces: Pieces,
        area: float,
        may_join: BoolArray,
        mirror: Mirror | None = None,
    ) -> None:
        self._F, self._hinges, self._pieces = F, hinges, pieces
        self._mirror = mirror
        self._hinge_image = None if mirror is None else mirror.of_hinges(hinges, F)
        self._joined_sides = hinges.mark_sides(pieces.glued, len(F)).ravel()
        self._side = np.sqrt(area / _EXPECTED)
        self._unit = _GAP * np.sqrt(area)
        groups = group_by_label(pieces.label)
        self._charts = {k: _Leaf(rows, pieces.place[rows].ravel()) for k, rows in enumerate(groups)}
        # The charts that were listed last, by label.
        self._known: dict[int, Chart] = {}
        # Hinges between two charts, and how often each chart has changed.
        self._contacts: dict[int, dict[int, IntArray]] = {k: {} for k in self._charts}
        self._version = dict.fromkeys(self._charts, 0)
        # Pairs of charts that overlap if they are joined at this number of hinges. They also do when others are added.
        self._overlapping = set[tuple[int, int, int]]()
        # The largest limit of boxes at which pairs of charts, with their versions, could not be joined.
        self._loose: dict[tuple[int, ...], float] = {}
        self._demanded = np.flatnonzero(~may_join)
        one, other = pieces.label[hinges.first], pieces.label[hinges.second]
        self._watched = may_join & (one >= 0) & (other >= 0) & (one != other)
        between = np.flatnonzero(self._watched)
        low, high = np.minimum(one, other)[between], np.maximum(one, other)[between]
        for group in group_by_label(low * len(self._charts) + high):
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
        union = self._find_union(a, b, weight, limits)
        if union is None:
            return set()
        before = self._save()
        self._unite(a, b, *union)
        c, d = sorted(label[images].tolist())
        # The union may be its own image. Otherwise, the images are two charts, one of which may be the union.
        if (c == d or (d in self._contacts.get(c, ()) and self._try(c, d, weight, limits))) and self._is_mirrored():
            return {a, c} & self._charts.keys()
        self._restore(before)
        return set()

    def _is_mirrored(self) -> bool:
        """Whether the mirror image of every glued hinge is glued."""
        glued = self._pieces.glued
        return bool((glued[self._hinge_image] == glued)[self._watched].all())

    def _save(self) -> tuple[Any, ...]:
        """Return a copy of everything that `_unite` changes."""
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
        union = self._find_union(a, b, weight, limits)
        if union is not None:
            self._unite(a, b, *union)
        return union is not None

    def _find_union(
        self, a: int, b: int, weight: FloatArray, limits: tuple[float, float]
    ) -> tuple[_Leaf, ComplexArray, IntArray] | None:
        """Return the union of two charts, the places of ``b``, and the hinges that meet; None if it is not good."""
        contact = self._contacts[a][b]
        longest, boxes = limits
        state = (a, b, self._version[a], self._version[b])
        if (a, b, contact.size) in self._overlapping or boxes <= self._loose.get(state, 0.0):
            return None
        turn, shift = self._find_motion(a, b, weight)
        one, other = self._charts[a], self._charts[b]
        union = _Leaf(
            np.concatenate([one.triangles, other.triangles]), np.concatenate([one.hull, turn * other.hull + shift])
        )
        # Boxes that are too large in one round are too large in the next one, unless its limit is higher.
        if union.box > boxes * (one.box + other.box):
            self._loose[state] = boxes
            return None
        if union.longest > _AS_LONG * max(longest, one.longest, other.longest):
            return None
        place, before = self._pieces.place, self._pieces.place[other.triangles]
        place[other.triangles] = moved = turn * before + shift
        glued = contact[meet(place, self._hinges, contact)]
        sides = np.concatenate([self._hinges.one[glued], self._hinges.other[glued]])
        self._joined_sides[sides] = True
        simple = self._is_simple(union.triangles)
        place[other.triangles], self._joined_sides[sides] = before, False
        if not simple:
            self._overlapping.add((a, b, contact.size))
            return None
        return union, moved, glued

    def _unite(self, a: int, b: int, union: _Leaf, moved: ComplexArray, glued: IntArray) -> None:
        """Join chart ``b`` to chart ``a``, as found by `_find_union`."""
        rows = self._charts[b].triangles
        self._pieces.place[rows], self._pieces.label[rows] = moved, a
        self._pieces.glued[glued] = True
        self._joined_sides[self._hinges.one[glued]] = self._joined_sides[self._hinges.other[glued]] = True
        self._charts[a] = union
        self._version[a] += 1
        del self._charts[b], self._version[b]
        mine, theirs = self._contacts[a], self._contacts.pop(b)
        del mine[b], theirs[a]
        for c, more in theirs.items():
            del self._contacts[c][b]
            mine[c] = np.concatenate([mine[c], more]) if c in mine else more
            self._contacts[c][a] = mine[c]

    def _find_motion(self, a: int, b: int, weight: FloatArray) -> tuple[complex, complex]:
        """Rotation and shift of chart ``b`` at which most of the common edges, by weight, meet."""
        hinges, contact = self._hinges, self._contacts[a][b]
        contact = contact[np.argsort(-weight[contact], kind="stable")[:_TRIES]]
        z = self._pieces.place.ravel()
        swapped = self._pieces.label[hinges.one[contact] // 3] != a
        mine = np.where(swapped, hinges.other[contact], hinges.one[contact])
        theirs = np.where(swapped, hinges.one[contact], hinges.other[contact])
        (start, end), (tail, head) = ((z[side], z[ahead(side)]) for side in (mine, theirs))
        turn = (end - start) / (tail - head)
        turn /= np.abs(turn)
        shift = start - turn * head
        moved = turn[:, None] * tail + shift[:, None], turn[:, None] * head + shift[:, None]
        apart = np.maximum(np.abs(moved[0] - end), np.abs(moved[1] - start))
        met = (apart <= SAME * hinges.length[contact]) @ weight[contact]
        best = int(np.argmax(met))
        return complex(turn[best]), complex(shift[best])

    def _is_simple(self, rows: IntArray) -> bool:
        """Whether some triangles, joined at the glued hinges, have boundaries that stay apart."""
        own = self._split(rows)
        if self._closes_demanded(rows, own):
            return False
        uv = np.empty((int(own.max()) + 1, 2))
        uv[own] = to_points(self._pieces.place[rows].ravel()).reshape(-1, 3, 2)
        # A closed surface has no boundary, and overlaps itself in the plane.
        loops = boundary_loops(own, len(uv))
        return bool(loops) and not check_loops(loops, np.rint(uv / self._unit) * self._unit)[1]

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

    def list_charts(self) -> list[Chart]:
        """Return the joined pieces as charts, by their labels."""
        pieces, known = self._pieces, self._known
        charts = []
        for rows in group_by_label(pieces.label):
            label = int(pieces.label[rows[0]])
            # A label keeps its triangles unless more are joined to them.
            if label not in known or len(known[label].triangles) != rows.size:
                uv = to_points(pieces.place[rows].ravel())
                known[label] = cut_out_chart(rows, self._split(rows), self._F[rows], uv, np.ones(rows.size))
            charts.append(known[label])
        return charts

    def _split(self, rows: IntArray) -> IntArray:
        """Return some triangles (k, 3) by vertices of their own, joined at the glued hinges only."""
        return fans(self._F[rows], ~self._joined_sides.reshape(-1, 3)[rows])[0]
