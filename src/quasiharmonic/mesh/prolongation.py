"""From a map of a coarse mesh to one of the fine mesh: vertices are put back in the reverse order of their removal.

Each goes where its triangles are best shaped, which is in the middle of its ring where that is convex, and next
to the apex where nothing else is left. If the coarse map is injective, so is the fine one, but for rounding.
"""

from __future__ import annotations

import numpy as np

from quasiharmonic.arrays import BoolArray, ComplexArray, FloatArray, IntArray
from quasiharmonic.hearing import still_at_it
from quasiharmonic.mesh.coarsening import Coarsening

# A triangle's squared sides over twice its area are 2√3 = 3.5 when it is equilateral. Below this on average a vertex
# has a good place.
_GOOD = 8.0
# Places to try otherwise, besides the ring's middle: so far from the apex towards it, and straight into the ring, in
# units of the distance to the nearest side; and what is tried where none of these will do. The last one is sure to.
_TOWARDS_MIDDLE, _INWARDS = (0.75, 0.5), (2.0, 1.0, 0.5)
_LESS_LIKELY_TOWARDS_MIDDLE, _LESS_LIKELY_INWARDS = (0.25, 0.1), (8.0, 4.0, 0.25)
# Rings at a time: what is in work stays in the cache.
_RINGS = 1024


def prolong(w: ComplexArray, coarsening: Coarsening, held: BoolArray) -> ComplexArray:
    """Carry a map from the coarse mesh to the fine one.

    Parameters
    ----------
    w : (n,) complex128
        ``u + i v``, of which the values at the coarse mesh's vertices are read.
    coarsening : Coarsening
    held : (n,) bool
        Vertices that are not moved.

    Returns
    -------
    (n,) complex128
        Equal to ``w`` at held vertices. Others are moved on the way, to smooth the map, as far as no triangle
        is inverted by it.
    """
    w = w.copy()
    for number in reversed(range(len(coarsening.rounds))):
        for vertices, rings in coarsening.rounds[number]:
            still_at_it()
            w[vertices] = places(w.take(rings.T).T)
        if number in coarsening.levels:
            _smooth(w, coarsening.levels[number], held)
    return w


def places(ring: ComplexArray) -> ComplexArray:
    """Where to put a vertex into each ring; (r,) from (r, d), the apex first."""
    place = np.empty(len(ring), dtype=np.complex128)
    with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
        for start in range(0, len(ring), _RINGS):
            # Column by column: rows are too short for NumPy to be quick along them.
            columns = np.ascontiguousarray(ring[start : start + _RINGS].T)
            place[start : start + _RINGS] = _best(columns)
    return place


def _best(ring: ComplexArray) -> ComplexArray:
    """Places for rings (d, r), the apex first; (r,)."""
    place = ring.mean(axis=0)
    shape = _shape(place[None], ring)[0]
    poor = np.flatnonzero(~(shape < _GOOD * len(ring)))
    for towards, inwards in (
        (_TOWARDS_MIDDLE, _INWARDS),
        (_LESS_LIKELY_TOWARDS_MIDDLE, _LESS_LIKELY_INWARDS),
    ):
        if not poor.size:
            break
        around = ring.take(poor, axis=1)
        candidates = _candidates(around, towards, inwards)
        shapes = _shape(candidates, around)
        best, number = shapes.argmin(axis=0), np.arange(poor.size)
        lowest = shapes[best, number]
        better = lowest < shape[poor]
        place[poor[better]], shape[poor[better]] = candidates[best, number][better], lowest[better]
        poor = poor[np.isinf(shape[poor])]
    return place


def _candidates(ring: ComplexArray, towards: tuple[float, ...], inwards: tuple[float, ...]) -> ComplexArray:
    """Places that rings (d, r) may be seen from; (c, r)."""
    apex = ring[0]
    arm = ring[1:] - apex
    length = np.abs(arm)
    left, right = arm[1:], arm[:-1]
    size = length[1:] * length[:-1]
    turn = right.conj()
    turn *= left
    room = (turn.imag / np.abs(left - right)).min(axis=0)
    # A fan of positive triangles turns from the first arm to the last; half that turn leads inwards. Half of a
    # triangle's part of it is where the sum of both its arms' unit vectors points.
    turn /= size
    turn += 1
    turn /= np.abs(turn)
    step = room / length[0] * arm[0] * np.multiply.reduce(turn, axis=0)
    return apex + np.concatenate([np.outer(towards, ring.mean(axis=0) - apex), np.outer(inwards, step)])


def _shape(place: ComplexArray, ring: ComplexArray) -> FloatArray:
    """Squared sides over twice the area, summed over the triangles around each vertex; infinite if one is inverted.

    Parameters
    ----------
    place : (c, r) complex128
    ring : (d, r) complex128
    """
    # Real numbers take half the time of complex ones here.
    around = ((ring.real, place.real), (ring.imag, place.imag))
    spokes = [np.concatenate([corners[-1:], corners])[:, None] - middle for corners, middle in around]
    square = spokes[0] ** 2
    square += spokes[1] ** 2
    (a_x, a_y), (b_x, b_y) = ([spoke[part] for spoke in spokes] for part in (slice(-1), slice(1, None)))
    # |a|² + |b|² + |b − a|² = 2 (|a|² + |b|² − a·b), and the area is half of a × b.
    area = a_x * b_y
    area -= a_y * b_x
    shape = square[:-1] + square[1:]
    shape -= a_x * b_x
    shape -= a_y * b_y
    shape /= area
    total: FloatArray = 2 * shape.sum(axis=0)
    total[~(area.min(axis=0) > 0)] = np.inf
    return total


def _smooth(w: ComplexArray, F: IntArray, held: BoolArray) -> None:
    """Move every vertex to the middle of its neighbours, and those back that invert a triangle; in place."""
    from scipy.sparse import csr_array

    # Of an interior vertex every neighbour is once the head of a half-edge.
    degree, total = np.bincount(F.ravel(), minlength=w.size), np.zeros_like(w)
    for tail, head in ((0, 1), (1, 2), (2, 0)):
        heads = w.take(F[:, head])
        total.real += np.bincount(F[:, tail], heads.real, w.size)
        total.imag += np.bincount(F[:, tail], heads.imag, w.size)
    moving = np.flatnonzero((degree > 0) & ~held)
    new = w.copy()
    new[moving] = total[moving] / degree[moving]
    del degree, total, heads
    inverted = np.flatnonzero(~positive(new, F))
    if inverted.size:
        table = (np.ones(F.size, dtype=np.int8), F.ravel(), np.arange(0, F.size + 1, 3))
        of_vertex = csr_array(table, shape=(len(F), w.size)).tocsc()
    back = np.zeros(w.size, dtype=bool)
    while inverted.size:
        corners = np.unique(F[inverted])
        corners = corners[~back[corners]]
        back[corners] = True
        new[corners] = w[corners]
        # Only what is around those that have just gone back may be inverted now and was not before.
        around = of_vertex[:, corners].indices
        inverted = around[~positive(new, F[around])]
    w[:] = new


def positive(w: ComplexArray, T: IntArray) -> BoolArray:
    """Whether triangles (t, 3) of a map are positive, in floating point; (t,) bool."""
    corners = w.take(T)
    positive: BoolArray = ((corners[:, 1] - corners[:, 0]).conj() * (corners[:, 2] - corners[:, 0])).imag > 0
    return positive
