"""Prolongation of a map from a coarse mesh to the fine mesh: vertices are inserted in the reverse order of removal.

Each vertex goes to the position where its triangles have the best shape. This is the centre of a convex ring,
or a position close to the apex if no other is valid. If the coarse map is injective, so is the fine map, up to
rounding.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from quasiharmonic.geometry.coarsening import Coarsening
from quasiharmonic.util.arrays import BoolArray, ComplexArray, FloatArray, IntArray
from quasiharmonic.util.kernels import compiled
from quasiharmonic.util.progress import heartbeat


class ProlongationTuning(NamedTuple):
    """Positions to try for a vertex in its ring. The C kernel has the same values of the first three."""

    # The sum of the squared sides of a triangle over twice its area is 2√3 ≈ 3.5 if it is equilateral. A vertex whose
    # triangles have a mean below this limit has a good position.
    good: float = 8.0
    # Other positions to try: fractions of the way from the apex to the centre of the ring, and distances from the apex
    # into the ring, in units of the distance to the nearest side. The second row is tried if none of the first is
    # valid. Its last position is always valid up to rounding.
    towards_middle: tuple[tuple[float, ...], ...] = ((0.75, 0.5), (0.25, 0.1))
    inwards: tuple[tuple[float, ...], ...] = ((2.0, 1.0, 0.5), (8.0, 4.0, 0.25))
    # Rings per block, so that the data stay in the cache.
    rings_per_block: int = 1024


_TUNING = ProlongationTuning()


def prolong(w: ComplexArray, coarsening: Coarsening, fixed: BoolArray) -> ComplexArray:
    """Prolong a map (n,) complex128, given at the vertices of the coarse mesh, to the fine mesh.

    The result equals ``w`` at fixed vertices. Other vertices may move, because the map is smoothed where this inverts
    no triangle.
    """
    w = w.copy()
    for number in reversed(range(len(coarsening.rounds))):
        for vertices, rings in coarsening.rounds[number]:
            heartbeat()
            w[vertices] = reinsertion_positions(w.take(rings))
        if number in coarsening.levels:
            smooth(w, coarsening.levels[number], fixed)
    return w


def reinsertion_positions(ring: ComplexArray) -> ComplexArray:
    """Position of a vertex in each ring (r, d), the apex first; (r,) complex128."""
    position = np.empty(len(ring), dtype=np.complex128)
    find_places(np.ascontiguousarray(ring), position)
    return position


@compiled
def find_places(ring: ComplexArray, position: ComplexArray) -> None:
    """Fill in the position (r,) of a vertex in each ring (r, d), the apex first."""
    with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
        for start in range(0, len(ring), _TUNING.rings_per_block):
            part = slice(start, start + _TUNING.rings_per_block)
            block = ring[part]
            # Transpose to corner by corner, because rows are too short for fast NumPy operations. Use real numbers,
            # because products of complex numbers are not rounded the same way on all platforms.
            corners = np.ascontiguousarray(block.view(np.float64).reshape(*block.shape, 2).transpose(1, 2, 0))
            position.view(np.float64).reshape(-1, 2)[part] = _best_positions(corners).T


def _best_positions(ring: FloatArray) -> FloatArray:
    """Positions for rings (d, 2, r), the apex first; (2, r)."""
    position = _sum_in_order(ring) / len(ring)
    shape = _shape(position[None], ring)[0]
    poor = np.flatnonzero(~(shape < _TUNING.good * len(ring)))
    for towards, inwards in zip(_TUNING.towards_middle, _TUNING.inwards, strict=True):
        if not poor.size:
            break
        around = ring.take(poor, axis=2)
        candidates = _candidates(around, position.take(poor, axis=1), towards, inwards)
        shapes = _shape(candidates, around)
        best = shapes.argmin(axis=0)
        lowest = shapes[best, np.arange(poor.size)]
        better = np.flatnonzero(lowest < shape.take(poor))
        at, best = poor.take(better), best.take(better)
        position[0, at], position[1, at] = candidates[best, 0, better], candidates[best, 1, better]
        shape[at] = lowest.take(better)
        poor = poor[np.isinf(shape.take(poor))]
    return position


def _candidates(
    ring: FloatArray, middle: FloatArray, towards: tuple[float, ...], inwards: tuple[float, ...]
) -> FloatArray:
    """Candidate positions (c, 2, r) in rings (d, 2, r) with the given centres."""
    apex = ring[0]
    arm_x, arm_y = ((ring[1:] - apex)[:, i] for i in (0, 1))
    length = _length(arm_x, arm_y)
    right_x, right_y, left_x, left_y = arm_x[:-1], arm_y[:-1], arm_x[1:], arm_y[1:]
    turn_x = right_x * left_x + right_y * left_y
    turn_y = right_x * left_y - right_y * left_x
    clearance = (turn_y / _length(left_x - right_x, left_y - right_y)).min(axis=0)
    # A fan of positive triangles turns from the first arm to the last; half that turn points inwards. For one triangle,
    # the sum of the unit vectors of its two arms points in the direction of half its angle.
    size = length[1:] * length[:-1]
    turn_x /= size
    turn_x += 1
    turn_y /= size
    unit = _length(turn_x, turn_y)
    turn_x /= unit
    turn_y /= unit
    x, y = turn_x[0], turn_y[0]
    for by_x, by_y in zip(turn_x[1:], turn_y[1:], strict=True):
        x, y = x * by_x - y * by_y, x * by_y + y * by_x
    clearance /= length[0]
    first_x, first_y = clearance * arm_x[0], clearance * arm_y[0]
    step = np.stack([first_x * x - first_y * y, first_x * y + first_y * x])
    found = np.concatenate([np.multiply.outer(towards, middle - apex), np.multiply.outer(inwards, step)])
    found += apex
    return found


def _length(x: FloatArray, y: FloatArray) -> FloatArray:
    """Lengths of vectors."""
    square = x * x
    square += y * y
    return np.sqrt(square, out=square)


def _shape(position: FloatArray, ring: FloatArray) -> FloatArray:
    """Squared sides over twice the area, summed over the triangles around each vertex; infinite if one is not positive.

    ``position`` is (c, 2, r) and ``ring`` (d, 2, r).
    """
    x, y = (np.concatenate([ring[-1:, i], ring[:, i]])[:, None] - position[:, i] for i in (0, 1))
    square = x * x
    square += y * y
    # |a|² + |b|² + |b − a|² = 2 (|a|² + |b|² − a·b), and the area is half of a × b.
    area = x[:-1] * y[1:]
    area -= y[:-1] * x[1:]
    shape = square[:-1] + square[1:]
    shape -= x[:-1] * x[1:]
    shape -= y[:-1] * y[1:]
    shape /= area
    total = 2 * _sum_in_order(shape)
    total[~(area.min(axis=0) > 0)] = np.inf
    return total


def _sum_in_order(terms: FloatArray) -> FloatArray:
    """Sum over the first axis in order. NumPy uses another order if each term is a single number."""
    total: FloatArray = terms[0].copy()
    for term in terms[1:]:
        total += term
    return total


@compiled
def smooth(w: ComplexArray, F: IntArray, fixed: BoolArray) -> None:
    """Move every free vertex to the centre of its neighbours, in place; undo moves that invert a triangle."""
    from scipy.sparse import csr_array

    # Every neighbour of an interior vertex is the head of exactly one half-edge from it.
    tail, head = F.ravel(), F[:, (1, 2, 0)].ravel()
    degree = np.bincount(tail, minlength=w.size)
    moving = np.flatnonzero((degree > 0) & ~fixed)
    new = w.copy()
    for to, of in ((new.real, w.real), (new.imag, w.imag)):
        to[moving] = np.bincount(tail, of.take(head), w.size)[moving] / degree[moving]
    del degree, head
    inverted = np.flatnonzero(~are_positive(new, F))
    if inverted.size:
        table = (np.ones(F.size, dtype=np.int8), tail, np.arange(0, F.size + 1, 3))
        of_vertex = csr_array(table, shape=(len(F), w.size)).tocsc()
    back = np.zeros(w.size, dtype=bool)
    while inverted.size:
        corners = np.unique(F[inverted])
        corners = corners[~back[corners]]
        back[corners] = True
        new[corners] = w[corners]
        # Only triangles around the restored vertices may have become inverted.
        around = of_vertex[:, corners].indices
        inverted = around[~are_positive(new, F[around])]
    w[:] = new


def are_positive(w: ComplexArray, T: IntArray) -> BoolArray:
    """Whether triangles (t, 3) of a map are positive in floating point; (t,) bool."""
    corners = w.take(T)
    x, y = corners.real, corners.imag
    area = (x[:, 1] - x[:, 0]) * (y[:, 2] - y[:, 0])
    area -= (y[:, 1] - y[:, 0]) * (x[:, 2] - x[:, 0])
    return area > 0
