"""Relocation: move each vertex of the last inverted triangles to where its triangles have the largest least height.

If all other vertices are fixed, the signed height of a triangle over the edge opposite to a corner is linear in the
position of that corner. The position that maximises the least height around a vertex therefore solves a linear
programme with three unknowns, the position and that height. (The local untangling of Freitag and Plassmann 2000 uses
areas; heights give less distorted maps.) At its solution three heights are equal. For the six or so triangles around a
vertex, all positions with three equal heights are computed, and the best is chosen. Vertices that share no triangle are
moved at the same time.

If a descent has few inverted triangles left, relocation often replaces many more steps, at the cost of two or three of
them. It is tentative: if any triangle stays inverted, the result is discarded.
"""

from __future__ import annotations

from functools import cache
from itertools import combinations
from math import comb
from typing import NamedTuple

import numpy as np

from quasiharmonic.energies.deformation import signed_areas
from quasiharmonic.util.arrays import BoolArray, ComplexArray, IntArray, any_corner, invert_indices, mark
from quasiharmonic.util.kernels import compiled


class RelocationTuning(NamedTuple):
    """Numbers that tune relocation. The C kernel has the same values of the four from `sweeps` to `most_around`."""

    # Maximum number of inverted triangles for a try: with more it usually fails, and without compiled kernels it is
    # slower than a step.
    max_inverted: int = 12
    # The same for the first map, from which the descent may be long.
    max_inverted_at_first: int = 100
    # After a failed try, the next is made when the number of inverted triangles has fallen to this fraction, or when
    # the number of steps has doubled plus two.
    fewer: float = 0.75
    # Maximum number of sweeps over the vertices of inverted triangles.
    sweeps: int = 8
    # Maximum number of consecutive sweeps without progress.
    in_vain: int = 3
    # Number of sweeps over moved vertices and their neighbours after success, to even out the heights.
    sharing: int = 2
    # Maximum number of triangles around a vertex: 16 have 560 triples.
    most_around: int = 16
    # A group with at least this many vertices is divided by the number of triangles around them.
    large_group: int = 16
    # Numbers of triangles at which such a group is divided: 6 triangles have 20 triples, 12 have 220.
    sizes: tuple[int, ...] = (6, 8)
    # Maximum number of heights computed at once, so that arrays stay in the cache.
    heights: int = 30_000


_TUNING = RelocationTuning()


class RetrySchedule:
    """Schedule of tries during a descent."""

    def __init__(self) -> None:
        self._steps = self._retry_step = 0
        self._retry_below = 0.0

    def is_due(self, inverted: int) -> bool:
        """Whether to try the next map of the descent, given its number of inverted triangles."""
        step, self._steps = self._steps, self._steps + 1
        if not 0 < inverted <= (_TUNING.max_inverted if step else _TUNING.max_inverted_at_first):
            return False
        if inverted > self._retry_below and step < self._retry_step:
            return False
        self._retry_below, self._retry_step = _TUNING.fewer * inverted, 2 * step + 2
        return True


def relocate(F: IntArray, w: ComplexArray, fixed: IntArray) -> ComplexArray | None:
    """Relocate the vertices of inverted triangles until none is inverted in floating point; None if some stay inverted.

    ``fixed`` includes the whole boundary.
    """
    moved, untangled = relocate_each(F, w, fixed, np.zeros(len(F), dtype=np.int64))
    return moved if untangled.all() else None


def relocate_each(F: IntArray, w: ComplexArray, fixed: IntArray, mesh: IntArray) -> tuple[ComplexArray, BoolArray]:
    """Apply `relocate` to many meshes that share no vertices; ``mesh`` (f,) is the mesh of each triangle, ascending.

    Return the map (n,) of all meshes, and which meshes (m,) have no inverted triangle.
    """
    free = ~mark(len(w), fixed)
    moved, untangled = np.empty_like(w), np.empty(int(mesh[-1]) + 1, dtype=bool)
    place_inverted(np.ascontiguousarray(F), free, mesh, w, moved, untangled)
    return moved, untangled


@compiled
def place_inverted(
    F: IntArray, free: BoolArray, mesh: IntArray, given: ComplexArray, w: ComplexArray, untangled: BoolArray
) -> None:
    """Fill in the results of `relocate_each`; ``free`` (n,) marks the free vertices."""
    w[:] = given
    fewest, failures = np.full(untangled.size, len(F) + 1), np.zeros(untangled.size, dtype=np.int64)
    vertices, groups = np.empty(0, dtype=np.int64), list[_VertexStars]()
    T, of, active = F, mesh, np.ones(fewest.size, dtype=bool)
    for sweep in range(_TUNING.sweeps + 1):
        left = np.flatnonzero(~(signed_areas(T, w) > 0))
        count = np.bincount(of[left], minlength=fewest.size)
        failures = np.where(count < fewest, 0, failures + 1)
        fewest = np.where(active, np.minimum(count, fewest), fewest)
        active = (count > 0) & (failures < _TUNING.in_vain)
        before, vertices = vertices, np.unique(T[left[active[of[left]]]])
        vertices = vertices[free[vertices]]
        if not vertices.size or sweep == _TUNING.sweeps:
            break
        T, of = T[active[of]], of[active[of]]
        if not np.array_equal(vertices, before):
            groups = _divide(T, vertices, len(w))
        _relocate_groups(w, groups)
    np.equal(fewest, 0, out=untangled)
    if untangled.any():
        # Relocate the moved vertices again, together with their neighbours.
        near = np.zeros(len(w), dtype=bool)
        T, of = F[untangled[mesh]], mesh[untangled[mesh]]
        near[T[any_corner((w != given)[T])]] = True
        groups, there = _divide(T, np.flatnonzero(near & free), len(w)), w.copy()
        for _ in range(_TUNING.sharing):
            _relocate_groups(there, groups)
        # Except for rounding, no height falls below the least of those around it.
        spoilt = np.bincount(of[~(signed_areas(T, there) > 0)], minlength=untangled.size) > 0
        back = T[spoilt[of]]
        there[back] = w[back]
        w[:] = there


def _relocate_groups(w: ComplexArray, groups: list[_VertexStars]) -> None:
    """Relocate vertices in place, group by group."""
    for some in groups:
        w[some.vertices] = highest_positions(w[some.vertices], w[some.tails], w[some.heads])


class _VertexStars(NamedTuple):
    """Vertices (m,) and the opposite edges of their triangles, two (m, k) int64; short rows repeat their last edge."""

    vertices: IntArray
    tails: IntArray
    heads: IntArray


def _divide(F: IntArray, vertices: IntArray, n: int) -> list[_VertexStars]:
    """Divide interior vertices, in ascending order, into groups whose vertices share no triangle."""
    number = invert_indices(n, vertices)
    around = F[any_corner(number[F] >= 0)]
    triangle, corner = np.nonzero(number[around] >= 0)
    own = number[around[triangle, corner]]
    order = np.argsort(own, kind="stable")
    triangle, corner, own = triangle[order], corner[order], own[order]
    tails, heads = around[triangle, (corner + 1) % 3], around[triangle, (corner + 2) % 3]
    count = np.bincount(own, minlength=vertices.size)
    first = np.cumsum(count) - count
    # In each triangle around a vertex, the next corner is another neighbour; together these are all neighbours.
    neighbours, start = number[tails].tolist(), [*first.tolist(), own.size]
    # Each group is a bit. Vertices without a group have no bit; index -1 stands for vertices outside the list.
    group = [0] * (vertices.size + 1)
    for vertex in np.flatnonzero(count <= _TUNING.most_around).tolist():
        taken = 0
        for other in neighbours[start[vertex] : start[vertex + 1]]:
            taken |= group[other]
        group[vertex] = ~taken & (taken + 1)
    bit, groups = np.array(group[:-1]), range(max(group).bit_length())
    return [
        _VertexStars(vertices[alike], tails[rows], heads[rows])
        for k in groups
        for alike in _divide_by_size(np.flatnonzero(bit == 1 << k), count)
        for rows in [first[alike, None] + np.minimum(np.arange(count[alike].max()), count[alike, None] - 1)]
    ]


def _divide_by_size(members: IntArray, count: IntArray) -> list[IntArray]:
    """Divide a large group by the number of triangles around its vertices, and into parts of limited size."""
    if members.size < _TUNING.large_group:
        return [members]
    size, some = np.searchsorted(_TUNING.sizes, count[members]), list[IntArray]()
    for k in range(len(_TUNING.sizes) + 1):
        alike = members[size == k]
        if alike.size:
            around = int(count[alike].max())
            some += np.array_split(alike, -(-alike.size * around * comb(around, 3) // _TUNING.heights))
    return some


def highest_positions(w: ComplexArray, tails: ComplexArray, heads: ComplexArray) -> ComplexArray:
    """Return the positions (m,) that maximise the least signed height of the triangles around each vertex.

    ``tails`` and ``heads`` (m, k) are the edges opposite to each vertex, which form a closed loop; some may be
    repeated. A vertex keeps its position in ``w`` (m,) if rounding leaves no such position.
    """
    height = np.empty((3, *tails.shape))
    with np.errstate(all="ignore"):
        along = (heads - tails) / np.abs(heads - tails)
        # The height of (x, y) is the first component times x plus the second times y minus the third.
        height[0], height[1] = -along.imag, along.real
        height[2] = height[0] * tails.real + height[1] * tails.imag
        three = height[:, :, _triples(tails.shape[1])]
        (ax, ay, p), (bx, by, q) = three[:, :, 0] - three[:, :, 1], three[:, :, 0] - three[:, :, 2]
        position = np.stack([p * by - q * ay, ax * q - bx * p], axis=1) / (ax * by - ay * bx)[:, None]
        lowest = (height[:2].transpose(1, 2, 0) @ position - height[2][:, :, None]).min(axis=1)
    lowest[~np.isfinite(lowest)] = -np.inf
    best, rows = lowest.argmax(axis=1), np.arange(len(w))
    # Built from real and imaginary parts, because infinity times 1j gives NaN.
    found = np.stack([position[rows, 0, best], position[rows, 1, best]], axis=1).view(np.complex128)[:, 0]
    return np.where(np.isfinite(lowest[rows, best]), found, w)


@cache
def _triples(count: int) -> IntArray:
    """Return all triples of ``count`` indices; (3, …) int64."""
    threes: IntArray = np.array(list(combinations(range(count), 3)), dtype=np.int64).T
    return threes
