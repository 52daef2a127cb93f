"""Conditions on targets whose loops are simple, disjoint and properly nested.

A map without inverted triangles is then injective, onto the region between the loops, and takes
interior points to interior points. So no two edges cross and every open edge lies strictly inside:
an edge between fixed vertices where it is given, any other where its free end sees the fixed one.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

from quasiharmonic.diagnosis.clipping import Convex, Walls, line, reverse
from quasiharmonic.diagnosis.curves import BoundaryCurves, contacts
from quasiharmonic.diagnosis.fixture import Fixture, Star
from quasiharmonic.diagnosis.obstruction import (
    Forbids,
    Kind,
    Obstruction,
    named_vertices,
    smallest_conflict,
)
from quasiharmonic.mesh.topology import named_edges
from quasiharmonic.predicates import orientation
from quasiharmonic.problem import Problem

IntArray = NDArray[np.int64]
BoolArray = NDArray[np.bool_]

# So many vertices are looked at before all others, however many have to be seen.
_APART = 8


def bad_chords(problem: Problem, fixture: Fixture, curves: BoundaryCurves) -> Iterator[Obstruction]:
    """Interior edges with both ends fixed that do not lie strictly inside, free of all else that is fixed."""
    chords, where = fixture.chords, fixture.positions
    if not len(chords):
        return
    corner = Corners(problem, curves)
    segments = np.concatenate([curves.ends, np.stack([problem.pins, problem.pins], axis=1), chords])
    first = len(segments) - len(chords)
    met: dict[int, list[IntArray]] = {}
    for i, j in contacts(where, segments).pairs.tolist():
        if j >= first:
            # Of two edges that cross one another it is enough to name one.
            met.setdefault(j - first, []).append(segments[i])
    outside = np.zeros(len(chords), dtype=bool)
    for end, other in (chords.T, chords[:, ::-1].T):
        outside |= corner.known[end] & ~corner.opens_to(end, where[other], where)
    for k, chord in enumerate(chords):
        if k not in met and not outside[k]:
            continue
        others = np.array(met.get(k, []), dtype=np.int64).reshape(-1, 2)
        edges, points = others[others[:, 0] != others[:, 1]], others[others[:, 0] == others[:, 1], 0]
        what = [named_edges(edges)] * bool(len(edges)) + [named_vertices(points)] * bool(len(points))
        place = f"meets {' and '.join(what)} there" if what else "lies outside the target"
        yield Obstruction(
            Kind.CHORD,
            Forbids.INJECTIVE,
            f"Both ends of the interior {named_edges(chord[None])} are fixed, and the segment between them {place}.",
            vertices=np.concatenate([chord, points]),
            edges=np.concatenate([chord[None], edges]),
            split=chord,
        )


class Corners:
    """The angles of the target at its boundary vertices.

    Attributes
    ----------
    known : (n,) bool
        Boundary vertices.
    """

    def __init__(self, problem: Problem, curves: BoundaryCurves) -> None:
        self.known = np.zeros(problem.n, dtype=bool)
        self.before, self.after = np.full((2, problem.n), -1)
        tails, heads = curves.ends.T
        self.known[tails] = True
        self.before[heads], self.after[tails] = tails, heads

    def reflex(self, vertices: IntArray, where: NDArray[np.float64]) -> BoolArray:
        """Whether the angle inside is larger than π; (k,) bool."""
        turns: BoolArray = orientation(where[self.before[vertices]], where[vertices], where[self.after[vertices]]) < 0
        return turns

    def opens_to(self, vertices: IntArray, points: NDArray[np.float64], where: NDArray[np.float64]) -> BoolArray:
        """Whether the way to a point starts strictly inside the angle; (k,) bool, False at pins."""
        result = np.zeros(len(vertices), dtype=bool)
        known = np.flatnonzero(self.known[vertices])
        v, x = vertices[known], points[known]
        left_of_last = orientation(where[self.before[v]], where[v], x) > 0
        left_of_next = orientation(where[v], where[self.after[v]], x) > 0
        reflex = self.reflex(v, where)
        result[known] = np.where(reflex, left_of_last | left_of_next, left_of_last & left_of_next)
        return result


class Sight:
    """Looks for a place from which a vertex sees all its fixed neighbours.

    Parameters
    ----------
    problem : Problem
    fixture : Fixture
    curves : BoundaryCurves
        Simple and properly nested.
    chords : (c, 2) int64
        Interior edges with both ends fixed that are where they can be; nothing sees through them.
    """

    def __init__(self, problem: Problem, fixture: Fixture, curves: BoundaryCurves, chords: IntArray) -> None:
        self._fixture = fixture
        self._corner = Corners(problem, curves)
        ends = fixture.row[np.concatenate([curves.ends, chords])]
        self._walls = Walls(ends, fixture.lattice)

    def hidden(self, star: Star) -> Obstruction | None:
        """Whether no point sees all fixed neighbours of a vertex from the left of the edges around it."""
        neighbours, opposite = self._apart_first(star.neighbours), star.opposite
        if self._place(neighbours, opposite):
            return None
        edges = opposite[smallest_conflict(len(opposite), lambda some: self._place(neighbours, opposite[some]))]
        # Without anything to be seen, half-planes alone leave room: otherwise they were the reason.
        seen = neighbours[
            smallest_conflict(len(neighbours), lambda some: not some or self._place(neighbours[some], edges))
        ]
        vertex = np.array([star.vertex])
        beside = f", from the left of {named_edges(edges)}" if len(edges) else ""
        ends = np.unique(np.concatenate([seen, edges.ravel()]))
        return Obstruction(
            Kind.HIDDEN,
            Forbids.INJECTIVE,
            f"{named_vertices(vertex).capitalize()} is joined to the fixed {named_vertices(seen)}, "
            f"which no point of the target sees together{beside}.",
            vertices=np.concatenate([vertex, seen]),
            edges=edges,
            split=np.stack([np.full(len(ends), star.vertex), ends], axis=1),
        )

    def _apart_first(self, vertices: IntArray) -> IntArray:
        """Fixed vertices in an order in which each of the first few is far from those before it.

        What they cannot all see is then found out before many small pieces of it are looked at.
        """
        near = self._fixture.lattice.near[self._fixture.row[vertices]]
        distance = np.full(len(vertices), np.inf)
        first = [0]
        while len(first) < min(_APART, len(vertices)):
            distance = np.minimum(distance, np.hypot(*(near - near[first[-1]]).T))
            distance[first] = -1.0
            first.append(int(np.argmax(distance)))
        return np.concatenate([vertices[first], np.delete(vertices, first)])

    def _place(self, neighbours: IntArray, edges: IntArray) -> bool:
        """Whether some point inside sees the neighbours and lies to the left of the edges."""
        eyes = self._fixture.row[neighbours].tolist()
        return any(self._walls.seeing(area, eyes) is not None for area in self._areas(neighbours, edges))

    def _areas(self, neighbours: IntArray, edges: IntArray) -> Iterator[Convex]:
        """Where to look: near the neighbours first, then everywhere.

        Points that see one boundary vertex from within its angle are inside, and those that see the
        others too then do so from inside.
        """
        corner, where = self._corner, self._fixture.positions
        known = neighbours[corner.known[neighbours]]
        reflex = corner.reflex(known, where)
        xs, ys = zip(*self._fixture.points(neighbours), strict=True)
        reach = max(max(xs) - min(xs), max(ys) - min(ys), 1)
        near = Convex.box((min(xs) - reach, min(ys) - reach), (max(xs) + reach, max(ys) + reach))
        for box in (near, self._fixture.extent()):
            area = self._fixture.left_of(box, edges)
            if area is None:
                continue
            if not known.size:
                yield area
                continue
            v = known[np.argmin(reflex)]
            last, here, following = self._fixture.points(np.array([corner.before[v], v, corner.after[v]]))
            left = area.cut(line(here, following))
            if not reflex.all():
                parts = [left and left.cut(line(last, here))]
            else:
                right = area.cut(reverse(line(here, following)))
                parts = [left, right and right.cut(line(last, here))]
            yield from (part for part in parts if part is not None)
