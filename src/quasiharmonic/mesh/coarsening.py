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
    T: IntArray = np.ascontiguousarray(F)
    rounds: list[list[Removal]] = []
    levels: dict[int, IntArray] = {}
    left, halved = n, 2 * n
    while left > goal:
        if left < 0.7 * len(names):
            T, names, free, dice = _renumbered(T, names, free, dice)
        degree = np.bincount(T.ravel(), minlength=len(names))
        found = _removable(T, free, degree, dice)
        gone = np.zeros(len(names), dtype=bool)
        for vertices, _ in found:
            gone[vertices] = True
        if np.count_nonzero(gone) < _FEW * left:
            break
        if 2 * left <= halved:
            levels[len(rounds)], halved = names[T] if rounds else F, left
        T = np.concatenate([T.compress(~touching(T, gone), axis=0), *(_fans(rings) for _, rings in found)])
        rounds.append([Removal(names[vertices], names[rings]) for vertices, rings in found])
        left -= int(np.count_nonzero(gone))
    return Coarsening(names[T], rounds, levels)


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


def _removable(T: IntArray, free: BoolArray, degree: IntArray, dice: FloatArray) -> list[Removal]:
    """One round: which vertices go, and the rings they leave."""
    edges, new = _EdgeSet(T), _EdgeOwners(len(T))
    candidates = []
    for vertices, rings in _rings(T, _independent(T, free, degree, dice), degree):
        # A fan takes edges from the apex's neighbours and gives them to the apex: best if that has few.
        burden = degree[rings] + dice[rings]
        burden[~free[rings]] = np.inf
        turn = burden.argmin(axis=1)[:, None] + np.arange(rings.shape[1])
        rings = np.take_along_axis(rings, turn % rings.shape[1], axis=1)
        apex, others = rings[:, :1], rings[:, 2:-1]
        fits = (free[apex] & free[others]).all(axis=1) & ~edges.may_hold(apex, others).any(axis=1)
        vertices, rings = vertices[fits], rings[fits]
        new.claim(vertices, rings)
        candidates.append((vertices, rings))
    # Two fans must not bring in the same edge.
    claimed = [new.owned(vertices, rings) for vertices, rings in candidates]
    found = [Removal(v[own], r[own]) for (v, r), own in zip(candidates, claimed, strict=True)]
    return [removal for removal in found if removal.vertices.size]


def _independent(T: IntArray, free: BoolArray, degree: IntArray, dice: FloatArray) -> BoolArray:
    """A set of free vertices of few neighbours, no two of them neighbours."""
    order = np.where(free & (degree <= _MOST_NEIGHBOURS), dice + _PER_NEIGHBOUR * degree, np.inf)
    chosen = np.zeros(order.size, dtype=bool)
    # A vertex that comes before all its neighbours in `order` is chosen. A second round among the vertices that have no
    # chosen neighbour finds half as many again.
    for _ in range(2):
        at = order.take(T)
        first = np.minimum(np.minimum(at[:, 0], at[:, 1]), at[:, 2])
        later = np.zeros(order.size, dtype=bool)
        later[T.ravel().compress((at > first[:, None]).ravel())] = True
        now = ~later & np.isfinite(order)
        chosen |= now
        order[T.compress(touching(T, now), axis=0)] = np.inf
    return chosen


def _rings(T: IntArray, chosen: BoolArray, degree: IntArray) -> Iterator[Removal]:
    """Rings of the chosen vertices, all interior and no two neighbours, degree by degree."""
    flat = T.ravel()
    place = np.flatnonzero(chosen[flat])
    corner = place % 3
    vertex, tail, head = flat[place], flat[place + 1 - 3 * (corner == 2)], flat[place + 2 - 3 * (corner > 0)]
    order = np.argsort(vertex)
    vertex, tail, head = vertex[order], tail[order], head[order]
    of_degree = degree[vertex]
    for d in range(3, _MOST_NEIGHBOURS + 1):
        some = np.flatnonzero(of_degree == d)
        tails, heads = tail[some].reshape(-1, d), head[some].reshape(-1, d)
        rows = np.arange(len(tails))
        rings = np.empty_like(tails)
        rings[:, 0], rings[:, 1] = tails[:, 0], heads[:, 0]
        for i in range(2, d):
            rings[:, i] = heads[rows, (tails == rings[:, i - 1, None]).argmax(axis=1)]
        yield Removal(vertex[some[::d]], rings)


def _fans(rings: IntArray) -> IntArray:
    """The triangles that fill rings from their apexes; (r·(d − 2), 3)."""
    fans = np.empty((len(rings), rings.shape[1] - 2, 3), dtype=np.int64)
    fans[:, :, 0], fans[:, :, 1], fans[:, :, 2] = rings[:, :1], rings[:, 1:-1], rings[:, 2:]
    return fans.reshape(-1, 3)


class _EdgeSet:
    """The edges of a mesh, by their hashes: it may take an edge that is not there for one that is."""

    def __init__(self, T: IntArray) -> None:
        # Twelve places a triangle hold one and a half edges.
        self._bits = (12 * len(T)).bit_length()
        self._held = np.zeros(1 << self._bits, dtype=bool)
        corners = T.astype(np.uint32)
        for i in range(3):
            self._held[_hashes(corners[:, i - 1], corners[:, i], self._bits)] = True

    def may_hold(self, tails: IntArray, heads: IntArray) -> BoolArray:
        """Whether there may be edges between these vertices."""
        return self._held[_hashes(tails.astype(np.uint32), heads.astype(np.uint32), self._bits)]


class _EdgeOwners:
    """To whom new edges belong, by their hashes: of several that claim one, the last has it."""

    def __init__(self, triangles: int) -> None:
        # A round makes a new edge for every four triangles.
        self._bits = (2 * triangles).bit_length()
        self._owner = np.empty(1 << self._bits, dtype=np.int64)

    def claim(self, vertices: IntArray, rings: IntArray) -> None:
        """Claim the edges of the vertices' fans."""
        self._owner[self._of(rings)] = vertices[:, None]

    def owned(self, vertices: IntArray, rings: IntArray) -> BoolArray:
        """Whether all edges of each vertex's fan belong to it."""
        own: BoolArray = (self._owner[self._of(rings)] == vertices[:, None]).all(axis=1)
        return own

    def _of(self, rings: IntArray) -> IntArray:
        corners = rings.astype(np.uint32)
        return _hashes(corners[:, :1], corners[:, 2:-1], self._bits)


def _hashes(tails: NDArray[np.uint32], heads: NDArray[np.uint32], bits: int) -> IntArray:
    """Numbers below 2^bits for edges, whichever way they are given."""
    mixed = (tails ^ heads) * np.uint32(0x9E3779B1) + tails * heads * np.uint32(0x85EBCA77)
    mixed ^= mixed >> np.uint32(15)
    mixed *= np.uint32(0x2C1B3C6D)
    return (mixed >> np.uint32(32 - bits)).astype(np.int64)
