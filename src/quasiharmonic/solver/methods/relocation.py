"""Placing: the vertices of the last inverted triangles, each where the triangles around it have most room.

With all other vertices held, the signed height of a triangle over the edge opposite to a corner is linear in where that
corner lies, and so the place at which the least height around a vertex is greatest solves a linear programme of three
unknowns, the place and that height. (The local untangling of Freitag and Plassmann 2000 does so with areas; heights
leave maps that are less distorted.) At its solution three heights are alike: for the six triangles or so around a
vertex all places where three are alike are looked at, and the best is taken. Vertices that share no triangle are
placed at the same time.

Where a descent has come so far that few triangles are inverted this often does what it would take many more steps
for, in no more time than two or three of them. It is tried in passing: where it leaves anything inverted, nothing has
happened.
"""

from __future__ import annotations

from functools import cache
from itertools import combinations
from math import comb
from typing import NamedTuple

import numpy as np

from quasiharmonic.energies.deformation import signed_areas
from quasiharmonic.util.arrays import BoolArray, ComplexArray, IntArray
from quasiharmonic.util.kernels import compiled

# Inverted triangles at most for a try: with more it mostly fails, and takes longer than a step where it is not
# compiled. The first map, from which the way may be far, is tried with more.
_MOST_FLIPS, _MOST_AT_FIRST = 12, 100
# After a try in vain the next is made when so large a part of the inverted triangles is left, or after as many steps
# again and two more.
_FEWER = 0.75
# Times that the vertices of what is inverted are placed anew at most, and how often in a row that may be in vain.
_SWEEPS, _IN_VAIN = 8, 3
# Times that what has been righted is placed once more, with its neighbours, so that the room is shared.
_SHARING = 2
# Triangles around a vertex that is placed at most: of 16 there are 560 threes.
_MOST_AROUND = 16
# So many vertices are parted by how many triangles are around them, up to these numbers (6 have 20 threes, 12 have
# 220), and so that there are so many heights at once: their arrays stay in the processor's cache.
_MANY, _SIZES, _HEIGHTS = 16, (6, 8), 30_000


class RetrySchedule:
    """When it is time for a try, while a descent goes on."""

    def __init__(self) -> None:
        self._seen = self._next = 0
        self._few_enough = 0.0

    def due(self, inverted: int) -> bool:
        """Whether to try the next map of the descent, of which so many triangles are inverted."""
        seen, self._seen = self._seen, self._seen + 1
        if not 0 < inverted <= (_MOST_FLIPS if seen else _MOST_AT_FIRST):
            return False
        if inverted > self._few_enough and seen < self._next:
            return False
        self._few_enough, self._next = _FEWER * inverted, 2 * seen + 2
        return True


def placed(F: IntArray, w: ComplexArray, fixed: IntArray) -> ComplexArray | None:
    """Place the vertices of inverted triangles until none is left.

    Parameters
    ----------
    F : (f, 3) int64
    w : (n,) complex128
    fixed : (k,) int64
        Vertices that stay; all those of the boundary are among them.

    Returns
    -------
    (n,) complex128 or None
        A map without inverted triangles, in floating point; None where some stay inverted.
    """
    moved, righted = placed_each(F, w, fixed, np.zeros(len(F), dtype=np.int64))
    return moved if righted.all() else None


def placed_each(F: IntArray, w: ComplexArray, fixed: IntArray, mesh: IntArray) -> tuple[ComplexArray, BoolArray]:
    """As `placed`, for many meshes side by side.

    Parameters
    ----------
    F, w, fixed
        Of all meshes, none joined to another.
    mesh : (f,) int64
        Which mesh a triangle belongs to, ascending.

    Returns
    -------
    w : (n,) complex128
    righted : (m,) bool
        Of which meshes no triangle is inverted any more.
    """
    moves = np.ones(len(w), dtype=bool)
    moves[fixed] = False
    moved, righted = np.empty_like(w), np.empty(int(mesh[-1]) + 1, dtype=bool)
    place_inverted(np.ascontiguousarray(F), moves, mesh, w, moved, righted)
    return moved, righted


@compiled
def place_inverted(
    F: IntArray, moves: BoolArray, mesh: IntArray, given: ComplexArray, w: ComplexArray, righted: BoolArray
) -> None:
    """Fill in what `placed_each` returns; moves: which vertices may (n,)."""
    w[:] = given
    fewest, in_vain = np.full(righted.size, len(F) + 1), np.zeros(righted.size, dtype=np.int64)
    vertices, groups = np.empty(0, dtype=np.int64), list[_Stars]()
    T, of, looked_at = F, mesh, np.ones(fewest.size, dtype=bool)
    for sweep in range(_SWEEPS + 1):
        left = np.flatnonzero(~(signed_areas(T, w) > 0))
        count = np.bincount(of[left], minlength=fewest.size)
        in_vain = np.where(count < fewest, 0, in_vain + 1)
        fewest = np.where(looked_at, np.minimum(count, fewest), fewest)
        looked_at = (count > 0) & (in_vain < _IN_VAIN)
        before, vertices = vertices, np.unique(T[left[looked_at[of[left]]]])
        vertices = vertices[moves[vertices]]
        if not vertices.size or sweep == _SWEEPS:
            break
        T, of = T[looked_at[of]], of[looked_at[of]]
        if not np.array_equal(vertices, before):
            groups = _apart(T, vertices, len(w))
        _place(w, groups)
    np.equal(fewest, 0, out=righted)
    if righted.any():
        # What has moved is placed again, together with its neighbours.
        near = np.zeros(len(w), dtype=bool)
        T, of = F[righted[mesh]], mesh[righted[mesh]]
        near[T[_any_corner((w != given)[T])]] = True
        groups, there = _apart(T, np.flatnonzero(near & moves), len(w)), w.copy()
        for _ in range(_SHARING):
            _place(there, groups)
        # No height falls below the least of those around it, but for rounding.
        spoilt = np.bincount(of[~(signed_areas(T, there) > 0)], minlength=righted.size) > 0
        back = T[spoilt[of]]
        there[back] = w[back]
        w[:] = there


def _any_corner(marked: BoolArray) -> BoolArray:
    """Which triangles have a corner that is marked, (f, 3) bool; many times as fast as NumPy's any."""
    some: BoolArray = marked[:, 0] | marked[:, 1] | marked[:, 2]
    return some


def _place(w: ComplexArray, groups: list[_Stars]) -> None:
    """Place vertices, in their array, group after group."""
    for some in groups:
        w[some.vertices] = roomiest(w[some.vertices], w[some.tails], w[some.heads])


class _Stars(NamedTuple):
    """Some vertices and the edges opposite to each, (m,) and twice (m, k) int64; shorter rows repeat their last."""

    vertices: IntArray
    tails: IntArray
    heads: IntArray


def _apart(F: IntArray, vertices: IntArray, n: int) -> list[_Stars]:
    """Interior vertices, in ascending order, in groups of such as share no triangle."""
    number = np.full(n, -1)
    number[vertices] = np.arange(vertices.size)
    around = F[_any_corner(number[F] >= 0)]
    triangle, corner = np.nonzero(number[around] >= 0)
    own = number[around[triangle, corner]]
    order = np.argsort(own, kind="stable")
    triangle, corner, own = triangle[order], corner[order], own[order]
    tails, heads = around[triangle, (corner + 1) % 3], around[triangle, (corner + 2) % 3]
    count = np.bincount(own, minlength=vertices.size)
    first = np.cumsum(count) - count
    # In each of the triangles around a vertex the next corner is another neighbour: they are all neighbours.
    neighbours, start = number[tails].tolist(), [*first.tolist(), own.size]
    # A group is a bit; what has none, or is none of the vertices and so has the last place, has no bit.
    group = [0] * (vertices.size + 1)
    for vertex in np.flatnonzero(count <= _MOST_AROUND).tolist():
        taken = 0
        for other in neighbours[start[vertex] : start[vertex + 1]]:
            taken |= group[other]
        group[vertex] = ~taken & (taken + 1)
    bit, groups = np.array(group[:-1]), range(max(group).bit_length())
    return [
        _Stars(vertices[alike], tails[rows], heads[rows])
        for k in groups
        for alike in _alike(np.flatnonzero(bit == 1 << k), count)
        for rows in [first[alike, None] + np.minimum(np.arange(count[alike].max()), count[alike, None] - 1)]
    ]


def _alike(members: IntArray, count: IntArray) -> list[IntArray]:
    """Members of a group, where they are many by how many triangles are around them, and not too many at once."""
    if members.size < _MANY:
        return [members]
    size, some = np.searchsorted(_SIZES, count[members]), list[IntArray]()
    for k in range(len(_SIZES) + 1):
        alike = members[size == k]
        if alike.size:
            around = int(count[alike].max())
            some += np.array_split(alike, -(-alike.size * around * comb(around, 3) // _HEIGHTS))
    return some


def roomiest(w: ComplexArray, tails: ComplexArray, heads: ComplexArray) -> ComplexArray:
    """Where the least signed height of the triangles around a vertex is greatest, for many vertices.

    Parameters
    ----------
    w : (m,) complex128
        Where the vertices are.
    tails, heads : (m, k) complex128
        The edges opposite to each of them, which make a closed loop; some may be there twice.

    Returns
    -------
    (m,) complex128
        ``w`` where rounding leaves no such place.
    """
    height = np.empty((3, *tails.shape))
    with np.errstate(all="ignore"):
        along = (heads - tails) / np.abs(heads - tails)
        # The height of (x, y) is the first times x and the second times y less the third.
        height[0], height[1] = -along.imag, along.real
        height[2] = height[0] * tails.real + height[1] * tails.imag
        three = height[:, :, _threes(tails.shape[1])]
        (ax, ay, p), (bx, by, q) = three[:, :, 0] - three[:, :, 1], three[:, :, 0] - three[:, :, 2]
        place = np.stack([p * by - q * ay, ax * q - bx * p], axis=1) / (ax * by - ay * bx)[:, None]
        least = (height[:2].transpose(1, 2, 0) @ place - height[2][:, :, None]).min(axis=1)
    least[~np.isfinite(least)] = -np.inf
    best, rows = least.argmax(axis=1), np.arange(len(w))
    # Built from its parts: times 1j, infinity would be no number.
    found = np.stack([place[rows, 0, best], place[rows, 1, best]], axis=1).view(np.complex128)[:, 0]
    return np.where(np.isfinite(least[rows, best]), found, w)


@cache
def _threes(count: int) -> IntArray:
    """All threes out of so many; (3, …) int64."""
    threes: IntArray = np.array(list(combinations(range(count), 3)), dtype=np.int64).T
    return threes
