"""Conditions on single elements: vertices, edges, triangles and patches.

The first ones hold for every map without inverted triangles, also onto a target that overlaps itself: the triangles of
an element must be positive for any positions of the other vertices.

Further ones, `bad_chords` and `Sight`, are for targets whose loops are simple, disjoint and properly nested. A map
without inverted triangles is then injective onto the region between the loops, and maps interior points to interior
points. So no two edges cross, and every open edge lies strictly inside. For an edge between fixed vertices this is
checked directly. For other edges the free end must see the fixed end.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import suppress

import numpy as np

from quasiharmonic.geometry.exact.loops import contacts, winding
from quasiharmonic.geometry.exact.predicates import orientation
from quasiharmonic.geometry.mesh.topology import label_components, pair_keys
from quasiharmonic.problem import Problem
from quasiharmonic.problem.diagnosis.clipping import Convex, Effort, EffortSpentError, Walls
from quasiharmonic.problem.diagnosis.fixture import MAX_CONTACTS, Corners, Fixture, Star, TargetCurves
from quasiharmonic.problem.diagnosis.obstruction import Forbids, Kind, Obstruction, smallest_conflict
from quasiharmonic.problem.diagnosis.views import Views
from quasiharmonic.util.arrays import (
    BoolArray,
    FloatArray,
    IntArray,
    cyclic_pairs,
    edge_names,
    mark,
    triangle_names,
    vertex_names,
)


def collapsed_edges(problem: Problem, fixture: Fixture) -> Iterator[Obstruction]:
    """Yield edges whose two ends are fixed at the same position."""
    every = np.concatenate([problem.domain.edges.boundary, fixture.chords])
    where = fixture.positions
    for edge in every[(where[every[:, 0]] == where[every[:, 1]]).all(axis=1)]:
        message = f"The target gives both ends of {edge_names(edge[None])} the same position."
        yield Obstruction(Kind.COLLAPSED_EDGE, Forbids.INJECTIVE, message, vertices=edge, edges=edge)


def inverted_fixed_triangles(problem: Problem, fixture: Fixture) -> Iterator[Obstruction]:
    """Yield triangles of three fixed vertices that the target makes inverted or degenerate."""
    boundary = problem.domain.edges.boundary
    for t, abc, s, split in find_inverted_fixed(problem.F, fixture.fixed, fixture.positions, boundary):
        message = (
            f"All vertices of {triangle_names(t)} are fixed, and the target {'inverts' if s < 0 else 'flattens'} it."
        )
        yield Obstruction(Kind.INVERTED_TRIANGLE, Forbids.INJECTIVE, message, vertices=abc, triangles=t, split=split)


def find_inverted_fixed(
    F: IntArray, fixed: BoolArray, where: FloatArray, boundary: IntArray
) -> Iterator[tuple[IntArray, IntArray, np.int8, IntArray]]:
    """Yield triangles (f, 3) of three fixed vertices that their positions ``where`` (n, 2) invert or flatten.

    With each triangle (1,), its corners, its orientation, and its sides that are not in ``boundary`` (k, 2).
    """
    triangles, border = np.flatnonzero(fixed[F].all(axis=1)), pair_keys(boundary, len(fixed))
    corners = F[triangles]
    sign = orientation(*(where[corners[:, k]] for k in range(3)))
    for t, abc, s in zip(triangles[sign <= 0, None], corners[sign <= 0], sign[sign <= 0], strict=True):
        sides = cyclic_pairs(abc)
        yield t, abc, s, sides[~np.isin(pair_keys(sides, len(fixed)), border)]


def inverted_patches(problem: Problem, fixture: Fixture) -> Iterator[Obstruction]:
    """Yield parts of the mesh, cut off by fixed edges, whose area in the target is not positive.

    The areas of a patch's triangles add up to the area that its fixed border encloses.
    """
    if not len(fixture.chords):
        return

    # Triangles that share a free vertex belong to one patch, and so do those at two joined free vertices.
    free, inner = ~fixture.fixed, fixture.inner
    label = label_components(inner[:, 0], inner[:, 1], problem.n)
    open_triangles = np.flatnonzero(free[problem.F].any(axis=1))
    corners = problem.F[open_triangles]
    patch = label[corners[np.arange(len(corners)), np.argmax(free[corners], axis=1)]]
    sides = np.stack([corners, np.roll(corners, -1, axis=1)], axis=2)
    border = fixture.fixed[sides].all(axis=2)
    of, edge = patch[np.nonzero(border)[0]], sides[border]

    if len(open_triangles) == len(problem.F) and (patch == patch[0]).all():
        return  # The fixed edges do not divide the mesh.

    twice_area: dict[int, int] = {}
    for k, (px, py), (qx, qy) in zip(of.tolist(), fixture.points(edge[:, 0]), fixture.points(edge[:, 1]), strict=True):
        twice_area[k] = twice_area.get(k, 0) + px * qy - py * qx
    boundary = pair_keys(problem.domain.edges.boundary, problem.n)
    for k in sorted(k for k, area in twice_area.items() if area <= 0):
        around = edge[of == k]
        message = f"The fixed {edge_names(around)} around a part of the mesh leave it no positive area."
        split = around[~np.isin(pair_keys(around, problem.n), boundary)]
        inside = open_triangles[patch == k]
        yield Obstruction(Kind.INVERTED_PATCH, Forbids.INJECTIVE, message, edges=around, triangles=inside, split=split)


def misplaced_pins(problem: Problem, fixture: Fixture, curves: TargetCurves) -> Iterator[Obstruction]:
    """Yield pins whose positions no map can reach.

    The number of pins at a position must not exceed the winding number of the boundary there. If the boundary winds at
    most once, pins must lie inside, at distinct positions.
    """
    pins = problem.domain.pins
    if not pins.size:
        return
    where, same, times = np.unique(fixture.positions[pins], axis=0, return_inverse=True, return_counts=True)
    covered, on = winding(where, curves.tails, curves.heads)
    bad = np.where(on, curves.proper, covered < times)
    for k in np.flatnonzero(bad).tolist():
        here = pins[same.ravel() == k]
        if on[k]:
            reason = "lies on the target's boundary"
        elif covered[k] <= 0:
            reason = "lies outside the target"
        else:
            once = "once" if covered[k] == 1 else f"{covered[k]} times"
            reason = f"share a position that the target covers only {once}"
        message = f"The pinned interior {vertex_names(here)} {reason}."
        yield Obstruction(Kind.PIN, Forbids.INJECTIVE, message, vertices=here)


def half_planes(star: Star, fixture: Fixture) -> Obstruction | None:
    """Return an obstruction if no point lies to the left of all fixed edges that form triangles with a vertex."""
    area = fixture.extent()
    if fixture.left_of(area, star.opposite) is not None:
        return None
    conflict = smallest_conflict(
        len(star.opposite), lambda some: fixture.left_of(area, star.opposite[some]) is not None
    )
    needed = star.opposite[conflict]
    vertex = np.array([star.vertex])
    message = (
        f"{vertex_names(vertex).capitalize()} must lie to the left of the fixed {edge_names(needed)}, "
        "but no point of the target's bounding box does."
    )
    split = star.edges_to(needed)
    return Obstruction(Kind.HALF_PLANES, Forbids.INJECTIVE, message, vertices=vertex, edges=needed, split=split)


def bad_chords(problem: Problem, fixture: Fixture, curves: TargetCurves, corner: Corners) -> Iterator[Obstruction]:
    """Yield obstructions of interior edges with fixed ends that leave the target or meet other fixed elements."""
    chords, where = fixture.chords, fixture.positions
    if not len(chords):
        return
    segments = np.concatenate([curves.ends, np.stack([problem.domain.pins, problem.domain.pins], axis=1), chords])
    first = len(segments) - len(chords)
    meeting: dict[int, list[IntArray]] = {}
    for i, j in contacts(where, segments, MAX_CONTACTS).pairs.tolist():
        if j >= first:
            # Of two edges that cross each other, report one.
            meeting.setdefault(j - first, []).append(segments[i])
    outside = np.zeros(len(chords), dtype=bool)
    for end, other in (chords.T, chords[:, ::-1].T):
        outside |= corner.known[end] & ~corner.opens_to(end, where[other], where)
    for k, chord in enumerate(chords):
        if k not in meeting and not outside[k]:
            continue
        others = np.array(meeting.get(k, []), dtype=np.int64).reshape(-1, 2)
        edges, points = others[others[:, 0] != others[:, 1]], others[others[:, 0] == others[:, 1], 0]
        what = [edge_names(edges)] * bool(len(edges)) + [vertex_names(points)] * bool(len(points))
        reason = f"meets {' and '.join(what)} there" if what else "lies outside the target"
        yield Obstruction(
            Kind.CHORD,
            Forbids.INJECTIVE,
            f"Both ends of the interior {edge_names(chord[None])} are fixed, and the segment between them {reason}.",
            vertices=np.concatenate([chord, points]),
            edges=np.concatenate([chord[None], edges]),
            split=chord,
        )


class Sight:
    """Checks whether a free vertex has a position that sees all its fixed neighbours.

    The target is simple and properly nested. ``walls`` (m, 2) are the edges that block the view: boundary edges, and
    interior edges with both ends fixed. ``effort`` is the budget for all checks.
    """

    # Number of fixed vertices, far apart from each other, that are checked first.
    _FIRST_CHECKED = 8

    def __init__(self, problem: Problem, fixture: Fixture, corners: Corners, walls: IntArray, effort: Effort) -> None:
        self._fixture = fixture
        ends = fixture.row[walls]
        beside = np.stack([corners.after, corners.before], axis=1)[problem.fixed]
        beside = np.where(beside >= 0, fixture.row[beside], -1)
        self._walls = Walls(ends, fixture.lattice, effort)
        self._views = Views(ends, problem.target, fixture.lattice, beside, effort)

    def check_view(self, star: Star) -> Obstruction | None:
        """Return an obstruction if no point sees all fixed neighbours to the left of the fixed edges, else None.

        Raise `EffortSpentError` if the budget is exhausted before a decision.
        """
        neighbours, opposite = self._apart_first(star.neighbours), star.opposite
        if self._has_position(neighbours, opposite):
            return None
        edges, seen = opposite, neighbours
        # If the budget ends before the conflict is minimal, a larger conflict is still valid.
        with suppress(EffortSpentError):
            edges = opposite[
                smallest_conflict(len(opposite), lambda chosen: self._has_position(neighbours, opposite[chosen]))
            ]
            # Without neighbours to see, a position exists: otherwise `half_planes` has reported the edges.
            seen = neighbours[
                smallest_conflict(
                    len(neighbours), lambda chosen: not chosen or self._has_position(neighbours[chosen], edges)
                )
            ]
        vertex = np.array([star.vertex])
        beside = f", from the left of {edge_names(edges)}" if len(edges) else ""
        return Obstruction(
            Kind.HIDDEN,
            Forbids.INJECTIVE,
            f"{vertex_names(vertex).capitalize()} is joined to the fixed {vertex_names(seen)}, "
            f"but no point of the target sees all of them{beside}.",
            vertices=np.concatenate([vertex, seen]),
            edges=edges,
            split=star.edges_to(np.concatenate([seen, edges.ravel()])),
        )

    def _apart_first(self, vertices: IntArray) -> IntArray:
        """Sort fixed vertices so that each of the first few is far from those before it.

        If they cannot all be seen, the check then fails early, before the area is cut into many small parts.
        """
        approximate = self._fixture.lattice.approximate[self._fixture.row[vertices]]
        distance = np.full(len(vertices), np.inf)
        first = [0]
        while len(first) < min(self._FIRST_CHECKED, len(vertices)):
            distance = np.minimum(distance, np.hypot(*(approximate - approximate[first[-1]]).T))
            distance[first] = -1.0
            first.append(int(np.argmax(distance)))
        return np.concatenate([vertices[first], np.delete(vertices, first)])

    def _has_position(self, neighbours: IntArray, edges: IntArray) -> bool:
        """Return whether a point inside sees the neighbours and lies to the left of the edges."""
        eyes, overlaps = self._order_by_overlaps(self._fixture.row[neighbours].tolist())
        if overlaps is not None and not len(overlaps):
            return False
        area = self._fixture.left_of(self._fixture.extent(), edges)
        return area is not None and any(
            self._walls.find_seeing(part, eyes) is not None for part in self._in_view(area, eyes, overlaps)
        )

    def _order_by_overlaps(self, eyes: list[int]) -> tuple[list[int], IntArray | None]:
        """Return eyes, the first two with few overlapping wedges, and the pairs of their wedges that may overlap."""
        order, least = eyes, None
        for k in range(1, len(eyes)):
            if least is not None and not len(least):
                break
            overlaps = self._views.wedges(eyes[0]).find_overlapping(self._views.wedges(eyes[k]))
            if overlaps is not None and (least is None or len(overlaps) < len(least)):
                order, least = [eyes[0], eyes[k], *eyes[1:k], *eyes[k + 1 :]], overlaps
        return order, least

    def _in_view(self, area: Convex, eyes: list[int], overlaps: IntArray | None) -> Iterator[Convex]:
        """Yield the parts of an area in wedges of all eyes.

        ``overlaps`` are the pairs of wedges of the first two eyes that may overlap.
        """
        if not eyes:
            yield area
            return
        # Depth-first search without recursion, one level per eye.
        levels = [self._parts(area, eyes[0], None if overlaps is None else overlaps[:, 0])]
        while levels:
            k, part = next(levels[-1], (-1, None))
            if part is None:
                levels.pop()
            elif len(levels) == len(eyes):
                yield part
            else:
                few = overlaps[overlaps[:, 0] == k, 1] if overlaps is not None and len(levels) == 1 else None
                levels.append(self._parts(part, eyes[len(levels)], few))

    def _parts(self, area: Convex, eye: int, wedges: IntArray | None) -> Iterator[tuple[int, Convex]]:
        """Return an iterator of the parts of an area in all or some wedges of an eye, with the index of the wedge."""
        view = self._views.wedges(eye)
        if wedges is None:
            return view.parts(area)
        chosen = mark(len(view), wedges)
        return view.parts(area, chosen)
