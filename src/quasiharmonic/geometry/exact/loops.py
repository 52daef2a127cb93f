"""Closed curves in the plane, such as the boundary loops of a map: crossings, nesting and winding.

All tests are exact. The reasons why the curves do not bound a region that is covered once are reported as a list of
`Reason`.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from enum import StrEnum

import numpy as np

from quasiharmonic.geometry.exact.box_pairs import box_pairs_within
from quasiharmonic.geometry.exact.predicates import (
    SegmentRelation,
    orientation,
    segment_relation,
    sure_orientation,
)
from quasiharmonic.util.arrays import (
    BoolArray,
    FloatArray,
    IntArray,
    SignArray,
    enumerate_each,
    enumerate_ranges,
    morton_order,
    repeat_each,
)
from quasiharmonic.util.kernels import compiled

# Maximum number of pairs of boundary edges to list. A collapsed boundary has billions.
_MAX_CROSSINGS = 1000
# Up to this number, loops are not sorted by their places.
_FEW_LOOPS = 16
# Number of pairs of an edge and a point at the same height that are processed together.
PAIR_CHUNK = 1 << 18


class Obstacle(StrEnum):
    """Kinds of reasons why a map is not bijective."""

    NO_TRIANGLES = "no triangles"
    NOT_INJECTIVE = "not injective"
    NOT_A_SURFACE = "not a surface"
    NO_BOUNDARY = "no boundary"
    SELF_INTERSECTION = "self-intersection"
    INTERSECTION = "intersection"
    WINDING = "winding"
    NESTING = "nesting"
    # As the field of `Certificate`. The value is part of reports since 0.2.0.
    MULTIPLY_WOUND = "multiply_wound"


@dataclass(frozen=True)
class Reason:
    """One reason why a map is not bijective.

    ``loops`` are the boundary loops concerned, as indices into `Certificate.loops`.
    """

    kind: Obstacle
    text: str
    loops: tuple[int, ...] = ()

    def __str__(self) -> str:
        return self.text


@dataclass(frozen=True)
class Contacts:
    """Pairs of segments that meet where they should not.

    Attributes
    ----------
    pairs : (c, 2) int64
        Indices of segments, the smaller first.
    relation : (c,) int8
        Values of `SegmentRelation`, never DISJOINT.
    complete : bool
        False if there are more pairs than were collected.
    """

    pairs: IntArray
    relation: SignArray
    complete: bool


def contacts(positions: FloatArray, ends: IntArray, limit: int) -> Contacts:
    """Find at most ``limit`` pairs of segments that share more than a common end.

    ``ends`` (m, 2) int64 has the segments as pairs of points, whose positions are finite. A segment with two equal ends
    is a point. The result has pairs without a common end that meet, and pairs with a common end that overlap.
    """
    tail, head = np.array(ends.T, order="C")
    p, q = positions[tail], positions[head]
    found, relations = [np.empty((0, 2), dtype=np.int64)], [np.empty(0, dtype=np.int8)]
    number = 0
    for i, j in _find_doubtful(positions, tail, head, np.array([0, len(ends)])):
        relation = segment_relation(p.take(i, 0), q.take(i, 0), p.take(j, 0), q.take(j, 0))
        near = np.flatnonzero(relation != SegmentRelation.DISJOINT)
        i, j, relation = i[near], j[near], relation[near]
        joined = (tail[i] == tail[j]) | (tail[i] == head[j]) | (head[i] == tail[j]) | (head[i] == head[j])
        bad = ~joined | (relation == SegmentRelation.OVERLAPPING)
        found.append(np.stack([i[bad], j[bad]], axis=1))
        relations.append(relation[bad])
        number += len(found[-1])
        if number > limit:
            break
    return Contacts(np.concatenate(found)[:limit], np.concatenate(relations)[:limit], number <= limit)


def _find_doubtful(
    positions: FloatArray, tails: IntArray, heads: IntArray, starts: IntArray
) -> Iterable[tuple[IntArray, IntArray]]:
    """Yield portions of the segment pairs that need an exact test."""
    # Usually there are few or no such pairs. A collapsed boundary has billions, which are not stored.
    pairs = np.empty((len(tails), 2), dtype=np.int64)
    number = doubtful_pairs(np.ascontiguousarray(positions, dtype=np.float64), tails, heads, starts, pairs)
    if number < 0:
        p, q = positions[tails], positions[heads]
        return box_pairs_within(np.minimum(p, q), np.maximum(p, q), starts)
    i, j = pairs[:number].T
    return [(i, j)] if number else []


@compiled
def doubtful_pairs(positions: FloatArray, tails: IntArray, heads: IntArray, starts: IntArray, pairs: IntArray) -> int:
    """List pairs of segments of the same group that may share more than an end, as far as floating point can tell.

    Segments (m,) are sorted by group, with starts (g + 1,). Return the number of pairs (k, 2), or -1 if they do not
    fit.
    """
    p, q = positions[tails], positions[heads]
    found, number = [np.empty((0, 2), dtype=np.int64)], 0
    for i, j in box_pairs_within(np.minimum(p, q), np.maximum(p, q), starts):
        tail, head = tails[i] == tails[j], heads[i] == heads[j]
        ahead, behind = heads[i] == tails[j], tails[i] == heads[j]
        shared = np.add(tail, head, dtype=np.int8) + ahead + behind
        doubtful = shared > 1
        one = np.flatnonzero(shared == 1)
        at_tail, others_tail = (tail | behind)[one, None], (tail | ahead)[one, None]
        here, there = i[one], j[one]
        doubtful[one] = _may_overlap(
            np.where(at_tail, p[here], q[here]),
            np.where(at_tail, q[here], p[here]),
            np.where(others_tail, q[there], p[there]),
        )
        apart = np.flatnonzero(shared == 0)
        here, there = i[apart], j[apart]
        doubtful[apart] = _may_meet(p[here], q[here], p[there], q[there])
        found.append(np.stack([i[doubtful], j[doubtful]], axis=1))
        number += len(found[-1])
        if number > len(pairs):
            return -1
    doubtful_ones = np.concatenate(found)
    pairs[:number] = doubtful_ones[np.lexsort(doubtful_ones.T[::-1])]
    return number


def _may_overlap(start: FloatArray, one: FloatArray, other: FloatArray) -> BoolArray:
    """Whether segments from a common start may overlap: one of them is a point, or their directions may be equal."""
    same_way = ((one < start) == (other < start)).all(axis=1) & ((one > start) == (other > start)).all(axis=1)
    same_way[same_way] = sure_orientation(one[same_way], start[same_way], other[same_way]) == 0
    points: BoolArray = (start == one).all(axis=1) | (start == other).all(axis=1)
    return points | same_way


def _may_meet(p: FloatArray, q: FloatArray, r: FloatArray, s: FloatArray) -> BoolArray:
    """Whether the segments pq and rs may have a common point."""
    near: BoolArray = sure_orientation(p, q, r) * sure_orientation(p, q, s) <= 0
    near[near] = sure_orientation(r[near], s[near], p[near]) * sure_orientation(r[near], s[near], q[near]) <= 0
    return near


def simple_loops(loops: list[IntArray], uv: FloatArray) -> BoolArray:
    """Tell which of many loops are simple, (k,) bool; contacts between different loops do not matter."""
    simple = np.ones(len(loops), dtype=bool)
    vertices, starts, following = _concatenate_loops(loops)
    p = uv.take(vertices, 0)
    for i, j in _find_doubtful(p, np.arange(len(p)), following, starts):
        q = p[following]
        relation = segment_relation(p.take(i, 0), q.take(i, 0), p.take(j, 0), q.take(j, 0))
        joined = (following[i] == j) | (following[j] == i)
        meets = np.where(joined, relation == SegmentRelation.OVERLAPPING, relation != SegmentRelation.DISJOINT)
        # An edge of zero length lies entirely on the edges before and after it.
        meets |= (p.take(i, 0) == q.take(i, 0)).all(axis=1) | (p.take(j, 0) == q.take(j, 0)).all(axis=1)
        simple[np.searchsorted(starts, i[meets], side="right") - 1] = False
        if not simple.any():
            break
    return simple


def winding(points: FloatArray, tails: FloatArray, heads: FloatArray) -> tuple[IntArray, BoolArray]:
    """Winding number of closed curves around points.

    Parameters
    ----------
    points : (k, 2) float64
    tails, heads : (m, 2) float64
        Ends of the directed edges that make up the curves.

    Returns
    -------
    winding : (k,) int64
        Counterclockwise number of turns: signed crossings of a ray to the right [1]_. Undefined where ``on``.
    on : (k,) bool
        Whether the point lies on the curves.

    References
    ----------
    .. [1] K. Hormann, A. Agathos, The point in polygon problem for arbitrary polygons.
       Computational Geometry 20 (2001).
    """
    turns = np.zeros(len(points), dtype=np.int64)
    on = np.zeros(len(points), dtype=bool)
    for _, point, turn in _cross_rays(points, tails, heads):
        turns += np.bincount(point, weights=turn, minlength=len(points)).astype(np.int64)
        on[point[turn == 0]] = True
    return turns, on


def _cross_rays(
    points: FloatArray, tails: FloatArray, heads: FloatArray
) -> Iterator[tuple[IntArray, IntArray, SignArray]]:
    """Yield edges, points and turns (m,) where edges cross the rays from points to the right, in portions.

    The turn is 1 for an edge that crosses the ray upwards, -1 for downwards, 0 for an edge that contains the point. The
    lower end of an edge counts as on the ray; the upper end does not.
    """
    low, high = np.minimum(tails, heads), np.maximum(tails, heads)
    by_level = np.argsort(points[:, 1], kind="stable")
    level = points[by_level, 1]
    first, last = np.searchsorted(level, low[:, 1]), np.searchsorted(level, high[:, 1], side="right")
    for edge, nth in enumerate_ranges(first, last, PAIR_CHUNK):
        point = by_level[nth]
        ahead = high[edge, 0] >= points[point, 0]
        edge, point = edge[ahead], point[ahead]
        here, tail, head = points[point], tails[edge], heads[edge]
        side = orientation(tail, head, here)
        rising = (tail[:, 1] <= here[:, 1]) & (here[:, 1] < head[:, 1]) & (side > 0)
        falling = (head[:, 1] <= here[:, 1]) & (here[:, 1] < tail[:, 1]) & (side < 0)
        on = (side == 0) & (low[edge, 0] <= here[:, 0])
        meets = rising | falling | on
        yield edge[meets], point[meets], (rising.astype(np.int8) - falling)[meets]


@dataclass(frozen=True)
class LoopEdges:
    """Closed curves as one array of edges, loop by loop."""

    start: IntArray  # (l + 1,): where each loop's edges start
    owner: IntArray  # (k,): the loop of each edge
    ends: IntArray  # (k, 2): vertices of each edge
    p: FloatArray  # (k, 2): positions of the first vertices
    q: FloatArray  # (k, 2): positions of the second vertices
    following: IntArray  # (k,): the next edge of the same loop

    @classmethod
    def of(cls, loops: list[IntArray], uv: FloatArray) -> LoopEdges:
        tail, start, following = _concatenate_loops(loops)
        head, owner = tail[following], repeat_each(np.arange(len(loops)), np.diff(start))
        return cls(start, owner, np.stack([tail, head], 1), uv[tail], uv[head], following)

    def order_by_place(self) -> IntArray:
        """Return the edges (k,), loop by loop, so that consecutive loops are close to each other if there are many."""
        if len(self.start) <= _FEW_LOOPS:
            return np.arange(len(self.ends))
        loops = morton_order(self.p[self.start[:-1]])
        which, edge = enumerate_each(np.diff(self.start)[loops])
        return self.start[loops][which] + edge


def _concatenate_loops(loops: list[IntArray]) -> tuple[IntArray, IntArray, IntArray]:
    """Return the concatenated loops (k,), their offsets (l + 1,), and the index of each vertex's successor (k,)."""
    starts = np.cumsum([0, *map(len, loops)])
    following = np.arange(1, starts[-1] + 1)
    following[starts[1:] - 1] = starts[:-1]
    return np.concatenate(loops), starts, following


def check_loops(loops: list[IntArray], uv: FloatArray) -> tuple[IntArray, list[Reason]]:
    """Pairs of edges that meet where they should not (m, 4), and the reasons why the loops are not valid."""
    curves = LoopEdges.of(loops, uv)
    pairs = _find_meeting_edges(curves, uv)
    if not len(pairs):
        # Nesting is defined only for simple, disjoint loops.
        return np.empty((0, 4), dtype=np.int64), _find_misplaced(curves)
    crossings = curves.ends[pairs].reshape(-1, 4)
    owners = curves.owner[pairs]
    reasons = []
    for i, j in np.unique(owners, axis=0).tolist():
        meets = crossings[(owners == (i, j)).all(axis=1)]
        where = join_items([f"{a}→{b} with {c}→{d}" for a, b, c, d in meets.tolist()], 3)
        if i == j:
            reasons.append(Reason(Obstacle.SELF_INTERSECTION, f"boundary loop {i} meets itself ({where})", (i,)))
        else:
            reasons.append(Reason(Obstacle.INTERSECTION, f"boundary loops {i} and {j} meet ({where})", (i, j)))
    return crossings, reasons


def _find_meeting_edges(curves: LoopEdges, uv: FloatArray) -> IntArray:
    """Sorted pairs of edges (m, 2) that share more than a common vertex."""
    consecutive = np.stack([np.arange(len(curves.ends)), curves.following], axis=1)
    # An edge of zero length lies entirely on the edges before and after it.
    point = (curves.p == curves.q).all(axis=1)
    on_zero_edges = np.sort(consecutive[point[consecutive].any(axis=1)], axis=1)
    # Trees of boxes are tight only if consecutive loops are close to each other.
    order = curves.order_by_place()
    found = np.sort(order[contacts(uv, curves.ends[order], _MAX_CROSSINGS).pairs], axis=1)
    pairs = np.concatenate([on_zero_edges, found])
    return np.unique(pairs, axis=0)[:_MAX_CROSSINGS] if len(pairs) else pairs


def _find_misplaced(curves: LoopEdges) -> list[Reason]:
    """Reasons why simple, disjoint loops do not bound a region that is covered once."""
    sense, around, inner = find_nesting(curves)
    covered = np.bincount(inner, weights=sense[around], minlength=len(sense)).astype(np.int64)
    fits = ((covered == 0) & (sense > 0)) | ((covered == 1) & (sense < 0))
    reasons = []
    for loop in np.flatnonzero(~fits).tolist():
        outside = around[inner == loop].tolist()
        runs = f"boundary loop {loop} runs {'counterclockwise' if sense[loop] > 0 else 'clockwise'}"
        if outside:
            text = f"{runs} inside {join_items(outside)}: its interior is covered {covered[loop] + sense[loop]} times"
            reasons.append(Reason(Obstacle.NESTING, text, (loop, *outside)))
        else:
            reasons.append(Reason(Obstacle.WINDING, f"{runs} and no other loop is around it", (loop,)))
    return reasons


def find_nesting(curves: LoopEdges) -> tuple[SignArray, IntArray, IntArray]:
    """Orientations (l,) of simple, disjoint loops, and the pairs of loops of which the first is around the second."""
    p, q, start = curves.p, curves.q, curves.start
    # At the lexicographically first vertex of a simple loop the turn is strict and has the orientation of the loop.
    lowest = np.lexsort((p[:, 1], p[:, 0], curves.owner))[start[:-1]]
    before = np.where(lowest == start[:-1], start[1:], lowest) - 1
    sense = orientation(p[before], p[lowest], q[lowest])
    number = len(sense)
    if number == 1:
        return sense, np.empty(0, dtype=np.int64), np.empty(0, dtype=np.int64)
    turns: dict[int, int] = {}
    for edge, point, turn in _cross_rays(p[lowest], p, q):
        key, at = np.unique(curves.owner[edge] * number + point, return_inverse=True)
        sums = np.bincount(at, weights=turn, minlength=len(key))
        for pair, change in zip(key.tolist(), sums.tolist(), strict=True):
            turns[pair] = turns.get(pair, 0) + int(change)
    around, inner = np.divmod(np.array([pair for pair, turn in turns.items() if turn], dtype=np.int64), number)
    others = around != inner
    return sense, around[others], inner[others]


def join_items(items: Sequence[object], limit: int = 5) -> str:
    """Join the first few items for a message."""
    return ", ".join(str(item) for item in items[:limit]) + (", …" if len(items) > limit else "")
