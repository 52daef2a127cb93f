"""Placement of one boundary loop along one contour: the start, and the vertices at corners.

The vertices at corners are chosen so that chords have space. A chord, an interior edge between two boundary vertices,
cuts off a part of the surface. That part has positive area only if the target bends to the left between the chord's
ends. On a polygon, there must be a convex corner between them. So the vertices at convex corners must be chosen such
that no chord has both ends between (or at) two successive ones.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from quasiharmonic.geometry.exact.loops import contacts
from quasiharmonic.geometry.mesh.topology import edges, trace_loops
from quasiharmonic.io.objects import mesh_triangles
from quasiharmonic.targets.boundary.correspondence import (
    BoundaryStretch,
    LoopPins,
    arc_parameters,
    find_parameters,
    find_start,
    max_deviation,
    points_at,
    stretches,
)
from quasiharmonic.targets.outlines.contours import corners, turns
from quasiharmonic.util.arrays import (
    BoolArray,
    FloatArray,
    IntArray,
    check_non_negative,
    cyclic_pairs,
    distinct_vertices,
    invert_indices,
    reject,
    scale_to_unit,
    target_positions,
    to_complex,
    triangle_array,
    triangle_rows,
)

# Maximum shift of a vertex to a corner, as a share of the loop. Beyond it, the target no longer resembles the surface,
# and splitting edges is better.
FARTHEST = 0.2
# Maximum outward bend of a straight line, as a share of the outline's larger side.
STRAIGHT = 1e-9


def clear_chords(
    s: FloatArray, contour: FloatArray, pins: LoopPins, *, corner_angle: float, chords: IntArray
) -> list[tuple[int, float]] | None:
    """Choose vertices for the convex corners of a contour, near them along the loop, so that chords have space.

    ``s`` (n,) are the vertices' parameters along their loop, and ``chords`` (c, 2) pairs of them. The result contains
    the ``pins`` and the chosen vertices with their corners, in order around. It is None if no choice leaves space for
    all chords, or only one that shifts a vertex by more than a fifth of the loop. Chords across a pin are ignored.
    """
    # Minimum left turn in radians, larger than that of a rounded straight line.
    min_turn = 1e-9
    t, bends = arc_parameters(contour), turns(contour)
    sharp = corners(contour, corner_angle)
    left = np.flatnonzero(bends > min_turn)
    found: list[tuple[int, float]] = []
    for stretch in stretches(s, pins):
        here, wanted = stretch.find_inside(t, sharp[bends[sharp] > 0])
        spare = _find_between(wanted, stretch.find_inside(t, sharp[bends[sharp] < 0])[1])
        straight = _find_between(wanted, stretch.find_inside(t, left)[1]) == 0
        conditions = ChordConditions(reach(stretch, chords, len(s)), straight, spare, FARTHEST / stretch.gap)
        chosen = choose(stretch.along, wanted, conditions)
        if chosen is None:
            return None
        found.append((int(stretch.run[0]), stretch.begin))
        found += [(int(stretch.run[k]), float(t[corner])) for k, corner in zip(chosen, here, strict=True)]
    return found


@dataclass(frozen=True)
class ChordConditions:
    """Conditions on the vertices at convex corners of a stretch."""

    # (c + 1,): for every vertex of the stretch, the smallest end of a chord that begins there or later. Ascending.
    reach: IntArray
    straight: BoolArray  # (w + 1,): whether each side, from one convex corner to the next, has no left turn
    spare: IntArray  # (w + 1,): number of vertices that each side needs for other corners
    farthest: float  # Maximum distance of a vertex from the corner that it takes


def reach(stretch: BoundaryStretch, chords: IntArray, n: int) -> IntArray:
    """Compute `ChordConditions.reach` for a stretch of a loop with ``n`` vertices; c + 1 where no chord is left."""
    count = len(stretch.run) - 1
    # Chords in both directions around the loop; those that leave the stretch are ignored.
    begin = (np.concatenate([chords[:, 0], chords[:, 1]]) - stretch.run[0]) % n
    length = np.concatenate([chords[:, 1] - chords[:, 0], chords[:, 0] - chords[:, 1]]) % n
    within = begin + length <= count
    reach = np.full(count + 1, count + 1)
    np.minimum.at(reach, begin[within], (begin + length)[within])
    return np.minimum.accumulate(reach[::-1])[::-1]


def _find_between(wanted: FloatArray, others: FloatArray) -> IntArray:
    """Numbers of ``others`` before the first, strictly between successive, and after the last of ``wanted``."""
    ends = np.concatenate([[0.0], wanted, [1.0]])
    return np.searchsorted(others, ends[1:], side="left") - np.searchsorted(others, ends[:-1], side="right")


def choose(along: FloatArray, wanted: FloatArray, conditions: ChordConditions) -> IntArray | None:
    """Choose vertices for wanted parameters with the least sum of squared distances that leave space, or None.

    Row j + 1 of ``cost`` has, for every vertex, the lowest cost of the parameters up to j if j takes that vertex. On a
    straight side, the next corner must come before the end of any chord that begins at or after this one.
    """
    count = len(along) - 1
    vertex = np.arange(count + 1)
    # Row 0: before the first parameter there is only the pin at the start.
    cost = [np.where(vertex == 0, 0.0, np.inf)]
    for j in range(len(wanted) + 1):
        # Consider only earlier candidates that leave space for a chord to this vertex and enough vertices for the other
        # corners.
        low = (
            np.searchsorted(conditions.reach, vertex, side="right")
            if conditions.straight[j]
            else np.zeros(count + 1, np.int64)
        )
        best = _range_minima(cost[j], low, vertex - conditions.spare[j])
        if j < len(wanted):
            away = np.abs(along - wanted[j])
            best += np.where(away <= conditions.farthest, away**2, np.inf)
            best[count] = np.inf
        cost.append(best)
    if not np.isfinite(cost[-1][count]):
        return None
    chosen = np.empty(len(wanted), dtype=np.int64)
    end = count
    for j in reversed(range(len(wanted))):
        options = np.where(vertex < end - conditions.spare[j + 1], cost[j + 1], np.inf)
        if conditions.straight[j + 1]:
            options[conditions.reach <= end] = np.inf
        end = chosen[j] = int(np.argmin(options))
    return chosen


def _range_minima(values: FloatArray, low: IntArray, high: IntArray) -> FloatArray:
    """Minimum of ``values[low[i]:high[i]]`` for every i; infinite where the range is empty."""
    # Row k has the minimum of every 2ᵏ successive values. Two overlapping ranges of this length cover any range.
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


@dataclass(frozen=True, eq=False)
class CornerPlacement:
    """One boundary loop and its contour."""

    # Maximum number of starts to try, nearest to the best fit first, if chords lack space.
    _MAX_STARTS = 256
    # Number of rotations to try for a hole.
    _ROTATIONS = 48
    # Additional deviation of a target from its contour allowed for chords, as a share of the larger side.
    _ALLOWED_DEVIATION = 0.02

    s: FloatArray  # (n,): parameters of the vertices along the loop
    contour: FloatArray  # (k, 2)
    pins: list[tuple[int, float]]  # Vertices with given parameters along the contour
    chords: IntArray  # (c, 2): interior edges between vertices of the loop
    names: IntArray  # (n,): the loop's vertices
    corner_angle: float  # Degrees

    def place(self, start: int = 0) -> tuple[FloatArray, bool]:
        """Return positions and whether chords have space; without pins, ``start`` goes to the contour's first point."""
        pins: LoopPins = self.pins or [(start, 0.0)]
        along = self._along(pins)
        positions = points_at(self.contour, along)
        if self._fits(positions):
            return positions, True
        clear = clear_chords(self.s, self.contour, pins, corner_angle=self.corner_angle, chords=self.chords)
        if clear is None:
            return positions, False
        moved = self._along(clear)
        other = points_at(self.contour, moved)
        # Vertices moved away from a bend cut it off, so limit the deviation.
        side = float(np.ptp(self.contour, axis=0).max())
        allowed = max_deviation(self.contour, along, positions) + self._ALLOWED_DEVIATION * side
        near = max_deviation(self.contour, moved, other) <= allowed
        return (other, True) if near and self._fits(other) else (positions, False)

    def _along(self, pins: LoopPins) -> FloatArray:
        return find_parameters(self.s, self.contour, pins, corner_angle=self.corner_angle, names=self.names)

    def _fits(self, positions: FloatArray) -> bool:
        """Whether chords have space and the positions bound a region."""
        min_bulge = STRAIGHT * float(np.ptp(self.contour, axis=0).max())
        if next(flat_chords(self.chords, positions, min_bulge), None) is not None:
            return False
        here = np.arange(len(positions))
        return not len(contacts(positions, cyclic_pairs(here), 0).pairs)

    def fit(self, flat: FloatArray) -> FloatArray:
        """Positions from the best start, or from the nearest start that leaves chords space if one exists."""
        first = find_start(self.s, flat, self.contour)
        best, clear = self.place(first)
        away = np.minimum((self.s - self.s[first]) % 1.0, (self.s[first] - self.s) % 1.0)
        for start in np.argsort(away, kind="stable")[1 : 1 if self.pins else self._MAX_STARTS]:
            if clear:
                break
            positions, clear = self.place(int(start))
            best = positions if clear else best
        return best

    def choices(self) -> list[FloatArray]:
        """Positions from starts all around the loop, restricted to those that leave chords space if any do."""
        if self.pins:
            return [self.place()[0]]
        wanted = np.arange(self._ROTATIONS) / self._ROTATIONS
        starts = np.unique(np.searchsorted(self.s, wanted, side="right") - 1)
        found = [self.place(int(start)) for start in starts]
        return [positions for positions, clear in found if clear] or [positions for positions, _ in found]


def chords_of(loop: IntArray, interior: IntArray, n: int) -> IntArray:
    """Return the interior edges (e, 2) between two vertices of a loop, as positions in it, smaller first; (c, 2)."""
    position = invert_indices(n, loop)
    found = position[interior]
    return np.sort(found[(found >= 0).all(axis=1)], axis=1)


def flattened_edges(F: ArrayLike, fixed: ArrayLike, target: ArrayLike, *, tolerance: float = STRAIGHT) -> IntArray:
    """Return interior edges that the target places along its boundary, so that the part they cut off has no area.

    Between the ends of such an edge, the target boundary does not bend outwards. It is straight, like a side of a
    polygon, or goes around a notch. A common case is a triangle with two boundary edges on one side of a rectangle.
    Then no map without inverted triangles exists. (`diagnose` proves this on the exact coordinates, where rounding may
    change the answer.) `refine` splits these edges.

    Parameters
    ----------
    F : (f, 3) array of int
        Triangles of a surface.
    fixed : (k,) array of int
        Fixed vertices, including the whole boundary.
    target : (k, 2) float
        Their target positions.
    tolerance : float
        Maximum outward bend of a straight line, as a share of the target's larger side.

    Returns
    -------
    (s, 2) int64
        The edges, smaller vertex first.

    Raises
    ------
    ValueError
        When an array is malformed, or a boundary vertex is not in ``fixed``.
    """
    check_non_negative("tolerance", tolerance)
    F = triangle_rows(mesh_triangles(F))
    n = int(F.max(initial=-1)) + 1
    F = triangle_array(F, n)
    fixed = distinct_vertices("fixed", fixed, n)
    places = target_positions(target, len(fixed))
    found = edges(F, n)
    reject(np.setdiff1d(found.boundary, fixed), "vertex", "vertices", "the boundary {} not in fixed")
    places = scale_to_unit(places)
    position = np.full((n, 2), np.nan)
    position[fixed] = places
    min_bulge = tolerance * float(np.ptp(places, axis=0).max()) if len(places) else 0.0
    flat = [np.empty((0, 2), dtype=np.int64)]
    for loop in trace_loops(found.boundary):
        chords = chords_of(loop, found.interior, n)
        flat.append(np.sort(loop[chords[list(flat_chords(chords, position[loop], min_bulge))]], axis=1))
    return np.concatenate(flat)


def flat_chords(chords: IntArray, positions: FloatArray, min_bulge: float) -> Iterator[int]:
    """Yield rows of chords between whose ends the loop bends outwards by at most ``min_bulge``."""
    w = to_complex(positions)
    for k, (i, j) in enumerate(chords.tolist()):
        if min(_bulge(w[i : j + 1]), _bulge(np.concatenate([w[j:], w[: i + 1]]))) <= min_bulge:
            yield k


def _bulge(w: NDArray[np.complex128]) -> float:
    """Maximum distance of a curve to the right of the line from its first point to its last."""
    across = w[-1] - w[0]
    if across == 0:
        return 0.0
    return float(-((w[1:-1] - w[0]) * np.conj(across / abs(across))).imag.min())
