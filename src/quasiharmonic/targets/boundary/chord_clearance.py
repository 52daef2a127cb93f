"""Corners moved along the boundary so that chords have room.

A chord, an interior edge between two boundary vertices, cuts off a part of the surface. That part has
room only if the target bends to the left somewhere between the chord's ends. On a polygon it has to
have a convex corner there; so the vertices that go to convex corners must be chosen such that no chord
has both ends on what lies between two of them.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from quasiharmonic.targets.boundary.correspondence import Held, Stretch, arc, stretches
from quasiharmonic.targets.outlines.contours import corners, turns
from quasiharmonic.util.arrays import BoolArray, FloatArray, IntArray

# A bend to the left that is one, and not a straight line rounded; radians.
_BEND = 1e-9
# How far a vertex may be moved to a corner, as a share of the way around: beyond it the target is not the outline's
# likeness to the surface any more, and splitting edges does less harm.
FARTHEST = 0.2


def make_room(
    s: FloatArray, contour: FloatArray, pins: Held, *, corner_angle: float, chords: IntArray
) -> list[tuple[int, float]] | None:
    """Choose vertices for the convex corners of a contour, near to them along the way, so that chords have room.

    Parameters
    ----------
    s : (n,) float64
        Where the vertices of the loop lie along it.
    contour : (k, 2) float64
    pins : sequence of (int, float)
        Vertices with a given place along the contour, in order around; at least one.
    corner_angle : float
        Degrees.
    chords : (c, 2) int64
        Pairs of vertices of the loop.

    Returns
    -------
    list of (int, float) or None
        The pins and the chosen vertices with their corners, in order around; None if no choice makes
        room for all chords, or only one that moves a vertex by more than a fifth of the way around.
        Chords across a pin are not looked at.
    """
    t, bends = arc(contour), turns(contour)
    sharp = corners(contour, corner_angle)
    left = np.flatnonzero(bends > _BEND)
    found: list[tuple[int, float]] = []
    for stretch in stretches(s, pins):
        here, wanted = stretch.within(t, sharp[bends[sharp] > 0])
        spare = _between(wanted, stretch.within(t, sharp[bends[sharp] < 0])[1])
        straight = _between(wanted, stretch.within(t, left)[1]) == 0
        room = ChordRoom(reach(stretch, chords, len(s)), straight, spare, FARTHEST / stretch.gap)
        chosen = choose(stretch.along, wanted, room)
        if chosen is None:
            return None
        found.append((int(stretch.run[0]), stretch.begin))
        found += [(int(stretch.run[k]), float(t[corner])) for k, corner in zip(chosen, here, strict=True)]
    return found


@dataclass(frozen=True)
class ChordRoom:
    """What the convex corners of a stretch must leave between them, side by side.

    Attributes
    ----------
    reach : (c + 1,) int64
        For every vertex of the stretch the least end of a chord that begins there or later. Ascending.
    straight : (w + 1,) bool
        Whether each side, from one convex corner to the next, bends nowhere to the left.
    spare : (w + 1,) int64
        Vertices that it needs for other corners.
    farthest : float
        How far a vertex may be from the place it takes.
    """

    reach: IntArray
    straight: BoolArray
    spare: IntArray
    farthest: float


def reach(stretch: Stretch, chords: IntArray, n: int) -> IntArray:
    """`Room.reach` of a stretch of a loop with ``n`` vertices; c + 1 where no chord is left."""
    count = len(stretch.run) - 1
    # Either way around the loop; what goes beyond the stretch does not matter.
    begin = (np.concatenate([chords[:, 0], chords[:, 1]]) - stretch.run[0]) % n
    length = np.concatenate([chords[:, 1] - chords[:, 0], chords[:, 0] - chords[:, 1]]) % n
    within = begin + length <= count
    reach = np.full(count + 1, count + 1)
    np.minimum.at(reach, begin[within], (begin + length)[within])
    return np.minimum.accumulate(reach[::-1])[::-1]


def _between(wanted: FloatArray, others: FloatArray) -> IntArray:
    """How many of some places lie strictly between each two successive ones of ``wanted``, and before and after."""
    ends = np.concatenate([[0.0], wanted, [1.0]])
    return np.searchsorted(others, ends[1:], side="left") - np.searchsorted(others, ends[:-1], side="right")


def choose(along: FloatArray, wanted: FloatArray, room: ChordRoom) -> IntArray | None:
    """Vertices for wanted places with the least sum of squared distances that leaves room; None if none does.

    Row j of ``cost`` holds, for every vertex, the best that can be done for the places up to j when j
    takes that vertex. The next place may take a vertex that the reach of this one does not include.
    """
    count = len(along) - 1
    vertex = np.arange(count + 1)
    # The pin at the beginning is all there is before the first place.
    cost = [np.where(vertex == 0, 0.0, np.inf)]
    for j in range(len(wanted) + 1):
        # Those before this vertex that leave room for a chord up to it, and for other corners.
        low = np.searchsorted(room.reach, vertex, side="right") if room.straight[j] else np.zeros(count + 1, np.int64)
        best = _least(cost[j], low, vertex - room.spare[j])
        if j < len(wanted):
            away = np.abs(along - wanted[j])
            best += np.where(away <= room.farthest, away**2, np.inf)
            best[count] = np.inf
        cost.append(best)
    if not np.isfinite(cost[-1][count]):
        return None
    chosen = np.empty(len(wanted), dtype=np.int64)
    end = count
    for j in reversed(range(len(wanted))):
        options = np.where(vertex < end - room.spare[j + 1], cost[j + 1], np.inf)
        if room.straight[j + 1]:
            options[room.reach <= end] = np.inf
        end = chosen[j] = int(np.argmin(options))
    return chosen


def _least(values: FloatArray, low: IntArray, high: IntArray) -> FloatArray:
    """The least of ``values[low[i]:high[i]]`` for every i; infinite where that is empty."""
    # Row k holds the least of every 2ᵏ successive values; any range is two such that overlap.
    rows = [values]
    while 2 ** len(rows) <= values.size:
        half = 2 ** (len(rows) - 1)
        rows.append(np.minimum(rows[-1], np.append(rows[-1][half:], np.full(half, np.inf))))
    length = high - low
    least = np.full(low.size, np.inf)
    for k, row in enumerate(rows):
        here = (length >= 2**k) & (length < 2 ** (k + 1))
        least[here] = np.minimum(row[low[here]], row[high[here] - 2**k])
    return least
