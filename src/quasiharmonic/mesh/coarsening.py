"""Coarse meshes by taking interior vertices out, a fifth of those left at a time.

The triangles around a vertex form a polygon, its *ring*. When the vertex is taken out, a *fan* of triangles
around one vertex of the ring, the *apex*, fills the polygon:

        r₂ ───── r₁            r₂ ───── r₁
       ╱  ╲     ╱  ╲          ╱       ╱  ╲
      ╱     ╲ ╱      ╲       ╱     ╱       ╲
    r₃ ────── v ────── r₀   r₃ ─────────────── r₀ = apex
      ╲     ╱ ╲      ╱       ╲     ╲       ╱
       ╲  ╱     ╲  ╱          ╲       ╲  ╱
        r₄ ───── r₅            r₄ ───── r₅

Any injective map of the mesh without the vertex becomes one of the mesh with it: all of the ring is seen from
the apex, so next to the apex there is a place for the vertex from where it is seen too (`prolongation`) [1]_.
So a coarse mesh is not an approximation here. It is the fine problem with fewer unknowns, and a map of it is as
good as solved; only whether there is one may differ.

References
----------
.. [1] H. Shen, Z. Jiang, D. Zorin, D. Panozzo, Progressive embedding. ACM Transactions on Graphics 38 (2019).
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from quasiharmonic.arrays import BoolArray, FloatArray, IntArray

# Vertices with more neighbours stay until they have lost some.
_MOST_NEIGHBOURS = 8
# Where so small a share of the vertices is all that a round can take out, it is the last.
_FEW = 0.04
# Passes in which vertices are chosen for a round.
_PASSES = 3
# How much a neighbour counts in the order of removal, in which a random number from 0 to 1 counts too.
_PER_NEIGHBOUR = 0.35


class Removal(NamedTuple):
    """Vertices of one degree that are taken out together, no two of them neighbours.

    Attributes
    ----------
    vertices : (r,) int64
    rings : (r, d) int64
        Their neighbours counterclockwise, the apex first.
    """

    vertices: IntArray
    rings: IntArray


@dataclass(frozen=True, eq=False)
class Coarsening:
    """A coarse mesh and the way back. Vertices keep the numbers they have in the fine mesh.

    Attributes
    ----------
    F : (fc, 3) int64
        Triangles of the coarse mesh.
    rounds : list of list of Removal
        What was taken out, round by round.
    levels : dict of int to (f, 3) int64
        Triangles before some of the rounds: before the first, and whenever half of the vertices have gone.
    """

    F: IntArray
    rounds: list[list[Removal]]
    levels: dict[int, IntArray]


def coarsen(F: IntArray, n: int, held: BoolArray, goal: int) -> Coarsening:
    """Take vertices out until few are left.

    Vertices with few neighbours go first. No new edge ends at a held vertex: it would be a constraint that the
    fine mesh does not have, since the held vertex must see the other end. So there are no new chords either, and the
    triangles along the boundary stay about as they are.

    Parameters
    ----------
    F : (f, 3) int64
        Triangles of a surface, consistently oriented.
    n : int
        Number of vertices.
    held : (n,) bool
        Vertices that stay: at least the whole boundary.
    goal : int
        How many vertices to leave; more are left where no other can be taken out.
    """
    names, free = np.arange(n), ~held
    dice = np.random.default_rng(0).random(n)
    # Corner by corner, (3, f): what is done to all first corners at once is done quickly.
    T: IntArray = np.ascontiguousarray(F.T)
    rounds: list[list[Removal]] = []
    levels: dict[int, IntArray] = {}
    left, halved = n, 2 * n
    while left > goal:
        if left < 0.7 * len(names):
            T, names, free, dice = _renumbered(T, names, free, dice)
        kept, found = _removable(T, free, dice)
        gone = sum(removal.vertices.size for removal in found)
        if gone < _FEW * left:
            break
        if 2 * left <= halved:
            levels[len(rounds)], halved = names[T].T if rounds else F, left
        T = np.concatenate([T.compress(kept, axis=1), *(_fans(rings) for _, rings in found)], axis=1)
        rounds.append([Removal(names[vertices], names[rings.T].T) for vertices, rings in found])
        left -= gone
    return Coarsening(np.ascontiguousarray(names[T].T), rounds, levels)


def touching(T: IntArray, marked: BoolArray) -> BoolArray:
    """Which triangles have a marked corner; (f,) bool."""
    corners = marked.take(T)
    return corners[:, 0] | corners[:, 1] | corners[:, 2]


def _renumbered(
    T: IntArray, names: IntArray, free: BoolArray, dice: FloatArray
) -> tuple[IntArray, IntArray, BoolArray, FloatArray]:
    """The same without the vertices that have gone."""
    used = np.zeros(len(names), dtype=bool)
    used[T] = True
    left = np.flatnonzero(used)
    number = np.empty(len(names), dtype=np.int64)
    number[left] = np.arange(left.size)
    return number.take(T), names[left], free[left], dice[left]


def _removable(T: IntArray, free: BoolArray, dice: FloatArray) -> tuple[BoolArray, list[Removal]]:
    """One round: which triangles stay, which vertices go, and the rings they leave."""
    degree = np.bincount(T.ravel(), minlength=free.size)
    chosen = _independent(T, free, degree, dice)
    # A fan takes edges from the apex's neighbours and gives them to the apex: best if that has few.
    burden = np.where(free, degree + dice, np.inf)
    held, edges, new = ~free, _EdgeSet(T), _EdgeOwners(T.shape[1])
    candidates = []
    for vertices, rings, triangles in _rings(T, chosen, degree):
        rings = _from_apex(rings, burden)
        apex, others = rings[0], rings[2:-1]
        fits = ~(held[apex] | held[others].any(axis=0) | edges.may_hold(apex, others).any(axis=0))
        vertices, rings, triangles = vertices[fits], rings.compress(fits, axis=1), triangles.compress(fits, axis=1)
        new.claim(vertices, rings)
        candidates.append((vertices, rings, triangles))
    kept, found = np.ones(T.shape[1], dtype=bool), []
    for vertices, rings, triangles in candidates:
        # Two fans must not bring in the same edge.
        own = new.owned(vertices, rings)
        kept[triangles.compress(own, axis=1)] = False
        if own.any():
            found.append(Removal(vertices[own], rings.compress(own, axis=1).T))
    return kept, found


def _independent(T: IntArray, free: BoolArray, degree: IntArray, dice: FloatArray) -> BoolArray:
    """A set of free vertices of few neighbours, no two of them neighbours."""
    order = np.where(free & (degree > 0) & (degree <= _MOST_NEIGHBOURS), dice + _PER_NEIGHBOUR * degree, np.inf)
    chosen = np.zeros(order.size, dtype=bool)
    # A vertex that comes first in all its triangles is chosen. Further passes over the triangles that have no chosen
    # corner, where neighbours of chosen ones no longer count, find half as many again.
    for _ in range(_PASSES):
        first, soonest = T[0], order.take(T[0])
        for corner in T[1:]:
            at = order.take(corner)
            first = np.where(at < soonest, corner, first)
            soonest = np.minimum(at, soonest)
        now = (np.bincount(first, minlength=order.size) == degree) & np.isfinite(order)
        chosen |= now
        near = now.take(first)
        order[T.compress(near, axis=1)] = np.inf
        T = T.compress(~near, axis=1)
    return chosen


def _rings(T: IntArray, chosen: BoolArray, degree: IntArray) -> Iterator[tuple[IntArray, IntArray, IntArray]]:
    """Chosen vertices, all interior and no two neighbours, with their rings and triangles, degree by degree.

    Yields
    ------
    vertices : (r,) int64
    rings, triangles : (d, r) int64
        Neighbours counterclockwise; triangles in any order.
    """
    from scipy.sparse import csr_array

    vertices = np.flatnonzero(chosen)
    of_degree = degree[vertices].astype(np.uint8)
    vertices = vertices[np.argsort(of_degree, kind="stable")]
    number = np.full(chosen.size, -1, dtype=np.int32)
    number[vertices] = np.arange(vertices.size)
    columns = [number.take(corner) for corner in T]
    places = [np.flatnonzero(column >= 0) for column in columns]
    columns = [column.take(place) for column, place in zip(columns, places, strict=True)]
    # Turning the table of entries and vertices on its side sorts by vertex, in a fifth of a sort's time.
    entries = sum(place.size for place in places)
    table = (np.ones(entries, dtype=np.int8), np.concatenate(columns), np.arange(entries + 1, dtype=np.int32))
    order = csr_array(table, shape=(entries, vertices.size)).tocsc().indices
    del number, columns, table
    tail, head = (
        np.concatenate([T[(corner + step) % 3].take(place) for corner, place in enumerate(places)]).take(order)
        for step in (1, 2)
    )
    triangle = np.concatenate(places).take(order)
    del places, order
    begin = done = 0
    for d, count in enumerate(np.bincount(of_degree, minlength=_MOST_NEIGHBOURS + 1).tolist()):
        if d < 3 or not count:
            continue
        tails, heads, triangles = (
            np.ascontiguousarray(part[begin : begin + d * count].reshape(-1, d).T) for part in (tail, head, triangle)
        )
        rings = np.empty_like(tails)
        rings[0], rings[1] = tails[0], heads[0]
        for i in range(2, d):
            # The triangle whose tail is the last vertex found has the next one for its head.
            rings[i] = (heads[1:] * (tails[1:] == rings[i - 1])).sum(axis=0)
        yield vertices[done : done + count], rings, triangles
        begin, done = begin + d * count, done + count


def _from_apex(rings: IntArray, burden: FloatArray) -> IntArray:
    """Rings (d, r) turned so that they begin with the vertex of least burden."""
    d, r = rings.shape
    turn = burden.take(rings).argmin(axis=0)
    turned: IntArray = rings.take((turn + np.arange(d)[:, None]) % d * r + np.arange(r))
    return turned


def _fans(rings: IntArray) -> IntArray:
    """The triangles that fill rings (r, d) from their apexes; (3, r·(d − 2))."""
    r, d = rings.shape
    fans = np.empty((3, d - 2, r), dtype=np.int64)
    fans[0], fans[1], fans[2] = rings.T[0], rings.T[1:-1], rings.T[2:]
    return fans.reshape(3, -1)


class _EdgeSet:
    """The edges of a mesh (3, f), by their hashes: it may take an edge that is not there for one that is."""

    def __init__(self, T: IntArray) -> None:
        # One and a half edges a triangle in 20 to 40 places.
        self._bits = (20 * T.shape[1]).bit_length()
        self._held = np.zeros(1 << self._bits, dtype=bool)
        corners = T.astype(np.uint32)
        for i in range(3):
            self._held[_hashes(corners[i - 1], corners[i], self._bits)] = True

    def may_hold(self, tails: IntArray, heads: IntArray) -> BoolArray:
        """Whether there may be edges between these vertices."""
        return self._held.take(_hashes(tails.astype(np.uint32), heads.astype(np.uint32), self._bits))


class _EdgeOwners:
    """To whom new edges belong, by their hashes: of several that claim one, the last has it."""

    def __init__(self, triangles: int) -> None:
        # A round makes a new edge for every three triangles.
        self._bits = (3 * triangles).bit_length()
        self._owner = np.empty(1 << self._bits, dtype=np.int32)

    def claim(self, vertices: IntArray, rings: IntArray) -> None:
        """Claim the edges of the vertices' fans, for rings (d, r)."""
        self._owner[self._of(rings)] = vertices

    def owned(self, vertices: IntArray, rings: IntArray) -> BoolArray:
        """Whether all edges of each vertex's fan belong to it."""
        own: BoolArray = (self._owner.take(self._of(rings)) == vertices).all(axis=0)
        return own

    def _of(self, rings: IntArray) -> IntArray:
        corners = rings.astype(np.uint32)
        return _hashes(corners[0], corners[2:-1], self._bits)


def _hashes(tails: NDArray[np.uint32], heads: NDArray[np.uint32], bits: int) -> IntArray:
    """Numbers below 2^bits for edges, whichever way they are given."""
    mixed = (tails ^ heads) * np.uint32(0x9E3779B1) + tails * heads * np.uint32(0x85EBCA77)
    mixed ^= mixed >> np.uint32(15)
    mixed *= np.uint32(0x2C1B3C6D)
    return (mixed >> np.uint32(32 - bits)).astype(np.int64)
