"""Find positions for many free vertices by trial, and prove them exactly.

If a vertex has a valid position, simple trial positions nearly always include one. Proving a position valid is much
cheaper than proving that there is none.
"""

from __future__ import annotations

from itertools import pairwise
from typing import NamedTuple

import numpy as np

from quasiharmonic.geometry.exact.box_pairs import box_pairs_between
from quasiharmonic.geometry.exact.predicates import SegmentRelation, orientation, segment_relation
from quasiharmonic.problem.diagnosis.fixture import Corners, Fixture, Stars
from quasiharmonic.util.arrays import BoolArray, FloatArray, IntArray, morton_order
from quasiharmonic.util.progress import heartbeat


class WitnessTuning(NamedTuple):
    """Numbers that tune the search for witnesses."""

    # Number of segments per batch.
    segments: int = 1 << 14
    # Distances of trial positions from the edges around a vertex, relative to the distance of its neighbours.
    margins: tuple[float, ...] = (0.1, 0.01, 0.001)
    # Number of steps to move a trial position.
    steps: int = 8
    # Limit on the pairs of a segment and a nearby wall to check in each trial: a constant.
    pairs: int = 1_000_000
    # The number per star that is added to this limit.
    pairs_per_star: int = 100


_TUNING = WitnessTuning()


def clear(
    p: FloatArray, q: FloatArray, ends: IntArray, walls: IntArray, positions: FloatArray, max_pairs: int
) -> BoolArray:
    """Return which segments p–q (k, 2) provably meet no wall, except walls that share an end with them; (k,) bool.

    True is exact. False may also mean that the segment was not checked. ``ends`` (k, 2) are the indices of the
    segments' ends in ``positions`` (n, 2), -1 for other points. ``walls`` (m, 2) are pairs of points. ``max_pairs`` is
    an approximate limit on the pairs of a segment and a nearby wall to check.
    """
    result = np.zeros(len(p), dtype=bool)
    if not len(p):
        return result
    # Sort along a space-filling curve, so that few boxes overlap.
    order = morton_order(p / 2 + q / 2)
    walls = walls[morton_order(positions[walls[:, 0]] / 2 + positions[walls[:, 1]] / 2)]
    r, s = positions[walls.T]
    tail, head = walls.T
    low, high = np.minimum(r, s), np.maximum(r, s)
    spent = 0
    for start in range(0, len(p), _TUNING.segments):
        part = order[start : start + _TUNING.segments]
        a, b, (first, last) = p[part], q[part], ends[part].T
        blocked = np.zeros(len(part), dtype=bool)
        heartbeat()
        for i, j in box_pairs_between(np.minimum(a, b), np.maximum(a, b), low, high):
            spent += i.size
            if spent > max_pairs:
                return result
            apart = (first[i] != tail[j]) & (first[i] != head[j]) & (last[i] != tail[j]) & (last[i] != head[j])
            apart &= ~blocked[i]
            i, j = i[apart], j[apart]
            relation = segment_relation(a.take(i, 0), b.take(i, 0), r.take(j, 0), s.take(j, 0))
            blocked[i[relation != SegmentRelation.DISJOINT]] = True
        result[part] = ~blocked
    return result


def find_unplaced(stars: Stars, fixture: Fixture, corners: Corners | None, walls: IntArray) -> IntArray:
    """Return the indices of stars for which no trial position is valid, ascending.

    ``corners`` are those of the target if it is simple and properly nested, or None if vertices need not see their
    neighbours. ``walls`` (m, 2) are the edges that block the view.
    """
    waiting = np.arange(len(stars))
    positions = _neighbour_means(stars, fixture)
    for margin in (0.0, *_TUNING.margins, None):
        stars_left = stars.take(waiting)
        if margin is None:
            positions = _area_middles(stars_left, fixture, corners)
        elif margin > 0:
            positions = _move_inward(stars_left, positions, fixture, corners, margin)
        left = ~_are_valid(stars_left, positions, fixture, corners, walls)
        waiting, positions = waiting[left], positions[left]
        if not waiting.size:
            break
    return waiting


def _neighbour_means(stars: Stars, fixture: Fixture) -> FloatArray:
    """Return the mean of each star's neighbours, (s, 2) float64."""
    number = np.bincount(stars.of_neighbour, minlength=len(stars))
    share = fixture.positions[stars.neighbours] / number[stars.of_neighbour, None]
    return np.stack([np.bincount(stars.of_neighbour, share[:, c], minlength=len(stars)) for c in (0, 1)], axis=1)


def _move_inward(
    stars: Stars, positions: FloatArray, fixture: Fixture, corners: Corners | None, margin: float
) -> FloatArray:
    """Return positions moved to the left of the edges that bound them, one edge after another."""
    where = fixture.positions
    of, edge = _sides(stars, fixture, corners)
    with np.errstate(over="ignore", invalid="ignore", divide="ignore"):
        along = where[edge[:, 1]] - where[edge[:, 0]]
        inward = np.stack([-along[:, 1], along[:, 0]], axis=1) / np.hypot(*along.T)[:, None]
        size = np.zeros(len(stars))
        np.maximum.at(size, stars.of_neighbour, np.hypot(*(where[stars.neighbours] - positions[stars.of_neighbour]).T))
        for _ in range(_TUNING.steps):
            lacking = margin * size[of] - np.einsum("ij,ij->i", positions[of] - where[edge[:, 0]], inward)
            order = np.lexsort([-lacking, of])
            worst = order[np.append(True, of[order[1:]] != of[order[:-1]])[: len(order)]]
            worst = worst[lacking[worst] > 0]
            if not worst.size:
                break
            positions = positions.copy()
            positions[of[worst]] += lacking[worst, None] * inward[worst]
    return positions


def _area_middles(stars: Stars, fixture: Fixture, corners: Corners | None) -> FloatArray:
    """Return the middle of the area to the left of each star's edges, NaN if it is empty."""
    positions = np.full((len(stars), 2), np.nan)
    of, edge = _sides(stars, fixture, corners)
    edge = edge[np.argsort(of, kind="stable")]
    ends = np.cumsum(np.bincount(of, minlength=len(stars)))
    for k, (begin, end) in enumerate(pairwise([0, *ends.tolist()])):
        area = fixture.left_of(fixture.extent(), edge[begin:end])
        if area is not None:
            positions[k] = fixture.lattice.find_middle(area)
    return positions


def _sides(stars: Stars, fixture: Fixture, corners: Corners | None) -> tuple[IntArray, IntArray]:
    """Return the edges that stars must be to the left of: the index of the star (h,) and the edge (h, 2)."""
    of, edge = stars.of_opposite, stars.opposite
    if corners is None:
        return of, edge
    # The points visible from a convex corner are to the left of both its edges.
    known = corners.known[stars.neighbours]
    v, star = stars.neighbours[known], stars.of_neighbour[known]
    convex = ~corners.reflex(v, fixture.positions)
    v, star = v[convex], star[convex]
    of = np.concatenate([of, star, star])
    return of, np.concatenate([edge, np.stack([corners.before[v], v], 1), np.stack([v, corners.after[v]], 1)])


def _are_valid(
    stars: Stars, positions: FloatArray, fixture: Fixture, corners: Corners | None, walls: IntArray
) -> BoolArray:
    """Return whether positions are valid, exact if True; (s,) bool."""
    where = fixture.positions
    fixed = where[fixture.fixed]
    # A map without inverted triangles stays inside the bounding box of the fixed vertices. NaN fails this test.
    good: BoolArray = np.all((fixed.min(axis=0) < positions) & (positions < fixed.max(axis=0)), axis=1)
    positions = np.where(good[:, None], positions, 0.0)
    of, edge = stars.of_opposite, stars.opposite
    good[of[orientation(where[edge[:, 0]], where[edge[:, 1]], positions[of]) <= 0]] = False
    if corners is None:
        return good
    of, eye = stars.of_neighbour, stars.neighbours
    known = corners.known[eye]
    shut = ~corners.opens_to(eye[known], positions[of[known]], where)
    good[of[known][shut]] = False
    candidates = np.flatnonzero(good[of])
    ends = np.stack([eye[candidates], np.full(len(candidates), -1)], axis=1)
    max_pairs = _TUNING.pairs + _TUNING.pairs_per_star * len(stars)
    seen = clear(where[eye[candidates]], positions[of[candidates]], ends, walls, where, max_pairs)
    good[of[candidates[~seen]]] = False
    return good
