"""Closed curves in the plane, such as a map's boundary loops: whether they cross, how they nest and wind.

Everything is decided exactly. What keeps the curves from bounding a region that is covered once is
reported as a list of `Reason`.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from enum import StrEnum

import numpy as np
from numpy.typing import NDArray

from quasiharmonic.predicates import SegmentRelation, box_pairs, orientation, segment_relation

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]

# Pairs of boundary edges listed at most; a collapsed boundary has billions.
_MOST_CROSSINGS = 1000
# Pairs of an edge and a point that the nesting test handles at a time.
_PAIR_CHUNK = 1 << 18


class Obstacle(StrEnum):
    """What keeps a map from being bijective."""

    NO_TRIANGLES = "no triangles"
    NOT_INJECTIVE = "not injective"
    NOT_A_SURFACE = "not a surface"
    NO_BOUNDARY = "no boundary"
    SELF_INTERSECTION = "self-intersection"
    INTERSECTION = "intersection"
    WINDING = "winding"
    NESTING = "nesting"
    OVERWOUND = "overwound"


@dataclass(frozen=True)
class Reason:
    """One reason why a map is not bijective.

    Attributes
    ----------
    kind : Obstacle
        What is wrong.
    text : str
        What is wrong and where, in words.
    loops : tuple of int
        The boundary loops concerned, as indices into `Certificate.loops`.
    """

    kind: Obstacle
    text: str
    loops: tuple[int, ...] = ()

    def __str__(self) -> str:
        return self.text


@dataclass(frozen=True)
class _Curves:
    """Boundary loops as one array of edges, loop after loop."""

    start: IntArray
    """(l + 1,) Where each loop's edges start."""
    owner: IntArray
    """(k,) The loop of each edge."""
    ends: IntArray
    """(k, 2) Vertices of each edge."""
    p: FloatArray
    """(k, 2) Places of the first vertices."""
    q: FloatArray
    """(k, 2) Places of the second vertices."""

    @classmethod
    def of(cls, loops: list[IntArray], uv: FloatArray) -> _Curves:
        length = np.array([len(loop) for loop in loops])
        start = np.concatenate([[0], np.cumsum(length)])
        tail = np.concatenate(loops)
        following = np.arange(1, len(tail) + 1)
        following[start[1:] - 1] = start[:-1]
        head = tail[following]
        return cls(start, np.repeat(np.arange(len(loops)), length), np.stack([tail, head], 1), uv[tail], uv[head])


def judge_loops(loops: list[IntArray], uv: FloatArray) -> tuple[IntArray, list[Reason]]:
    """Edges that meet where they should not (m, 4), and what is wrong with the loops."""
    curves = _Curves.of(loops, uv)
    pairs = _meeting_edges(curves)
    if not len(pairs):
        # Only loops that are simple and apart have an inside to speak of.
        return np.empty((0, 4), dtype=np.int64), _misplaced(curves)
    crossings = curves.ends[pairs].reshape(-1, 4)
    owners = curves.owner[pairs]
    reasons = []
    for i, j in np.unique(owners, axis=0).tolist():
        met = crossings[(owners == (i, j)).all(axis=1)]
        where = listed([f"{a}→{b} with {c}→{d}" for a, b, c, d in met.tolist()], 3)
        if i == j:
            reasons.append(Reason(Obstacle.SELF_INTERSECTION, f"boundary loop {i} meets itself ({where})", (i,)))
        else:
            reasons.append(Reason(Obstacle.INTERSECTION, f"boundary loops {i} and {j} meet ({where})", (i, j)))
    return crossings, reasons


def _meeting_edges(curves: _Curves) -> IntArray:
    """Pairs of edges (m, 2) that share more than the vertex they have in common, if any; sorted."""
    p, q, tail, head = curves.p, curves.q, curves.ends[:, 0], curves.ends[:, 1]
    point = (p == q).all(axis=1)
    found = [np.empty((0, 2), dtype=np.int64)]
    number = 0
    for i, j in box_pairs(np.minimum(p, q), np.maximum(p, q)):
        relation = segment_relation(p.take(i, 0), q.take(i, 0), p.take(j, 0), q.take(j, 0))
        adjacent = (head[i] == tail[j]) | (head[j] == tail[i])
        # Next to each other on the loop, edges may touch: at their common vertex, and nowhere else
        # unless they overlap or one of them has no length.
        folded = (relation == SegmentRelation.OVERLAPPING) | point[i] | point[j]
        meet = np.where(adjacent, folded, relation != SegmentRelation.DISJOINT)
        found.append(np.stack([i[meet], j[meet]], axis=1))
        number += len(found[-1])
        if number >= _MOST_CROSSINGS:
            break
    pairs = np.concatenate(found)[:_MOST_CROSSINGS]
    return pairs[np.lexsort(pairs.T[::-1])]


def _misplaced(curves: _Curves) -> list[Reason]:
    """Loops, all of them simple and apart, that do not bound a region covered once."""
    p, q, start = curves.p, curves.q, curves.start
    # At the lexicographically first vertex of a simple loop the turn is strict and has the loop's sense.
    lowest = np.lexsort((p[:, 1], p[:, 0], curves.owner))[start[:-1]]
    before = np.where(lowest == start[:-1], start[1:], lowest) - 1
    sense = orientation(p[before], p[lowest], q[lowest])
    around, inner = _containing(curves, p[lowest])
    covered = np.bincount(inner, weights=sense[around], minlength=len(sense)).astype(np.int64)
    fits = ((covered == 0) & (sense > 0)) | ((covered == 1) & (sense < 0))
    reasons = []
    for loop in np.flatnonzero(~fits).tolist():
        outside = around[inner == loop].tolist()
        runs = f"boundary loop {loop} runs {'counterclockwise' if sense[loop] > 0 else 'clockwise'}"
        if outside:
            text = f"{runs} inside {listed(outside)}: what it encloses is covered {covered[loop] + sense[loop]} times"
            reasons.append(Reason(Obstacle.NESTING, text, (loop, *outside)))
        else:
            reasons.append(Reason(Obstacle.WINDING, f"{runs} and no other loop is around it", (loop,)))
    return reasons


def _containing(curves: _Curves, anchor: FloatArray) -> tuple[IntArray, IntArray]:
    """Pairs of loops, the first around the second; ``anchor`` (l, 2) has a vertex of each loop.

    A loop is around a point that is not on it if a ray from the point, here to the right, crosses it
    in one sense more often than in the other.
    """
    p, q = curves.p, curves.q
    by_level = np.argsort(anchor[:, 1])
    # The edges that the line through an anchor crosses: one end above it, the other not.
    first = np.searchsorted(anchor[by_level, 1], np.minimum(p[:, 1], q[:, 1]))
    count = np.searchsorted(anchor[by_level, 1], np.maximum(p[:, 1], q[:, 1])) - first
    until = np.cumsum(count)
    number = len(anchor)
    turns: dict[int, int] = {}
    begin = 0
    while begin < len(p):
        done = until[begin - 1] if begin else 0
        end = max(int(np.searchsorted(until, done + _PAIR_CHUNK, side="right")), begin + 1)
        edge = np.repeat(np.arange(begin, end), count[begin:end])
        point = by_level[first[edge] + np.arange(edge.size) - (until[edge] - count[edge] - done)]
        relevant = (curves.owner[edge] != point) & (np.maximum(p[edge, 0], q[edge, 0]) > anchor[point, 0])
        edge, point = edge[relevant], point[relevant]
        downward = p[edge, 1] > q[edge, 1]
        # To the right of the point, an upward edge has it on its left and a downward one on its right.
        passing = (orientation(p[edge], q[edge], anchor[point]) < 0) == downward
        key, at = np.unique(curves.owner[edge[passing]] * number + point[passing], return_inverse=True)
        sums = np.bincount(at, weights=1 - 2 * downward[passing], minlength=len(key))
        for pair, turn in zip(key.tolist(), sums.tolist(), strict=True):
            turns[pair] = turns.get(pair, 0) + int(turn)
        begin = end
    around, inner = np.divmod(np.array([pair for pair, turn in turns.items() if turn], dtype=np.int64), number)
    return around, inner


def listed(items: Sequence[object], most: int = 5) -> str:
    """The first few of some items, in words."""
    return ", ".join(str(item) for item in items[:most]) + (", …" if len(items) > most else "")
