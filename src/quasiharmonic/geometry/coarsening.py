"""Coarse meshes by removal of interior vertices, about a fifth of the remaining ones in each round.

The triangles around a vertex form a polygon, its *ring*. When the vertex is removed, a *fan* of triangles
around one vertex of the ring, the *apex*, fills the polygon:

        r₂ ───── r₁            r₂ ───── r₁
       ╱  ╲     ╱  ╲          ╱       ╱  ╲
      ╱     ╲ ╱      ╲       ╱     ╱       ╲
    r₃ ────── v ────── r₀   r₃ ─────────────── r₀ = apex
      ╲     ╱ ╲      ╱       ╲     ╲       ╱
       ╲  ╱     ╲  ╱          ╲       ╲  ╱
        r₄ ───── r₅            r₄ ───── r₅

An injective map of the mesh without the vertex always extends to the mesh with it. All of the ring is visible from
the apex, so it is also visible from a position close to the apex (`quasiharmonic.geometry.prolongation`) [1]_.
So the coarse mesh poses the same problem with fewer unknowns, and a map of it extends to the fine mesh. However, the
coarse mesh may have no injective map even if the fine mesh has one.

No two vertices removed in one round are neighbours. No fan adds an edge that ends at a fixed vertex, that
exists already, or that another fan adds, too. So the vertices may be removed and inserted in any order.

References
----------
.. [1] H. Shen, Z. Jiang, D. Zorin, D. Panozzo, Progressive embedding. ACM Transactions on Graphics 38 (2019).
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from quasiharmonic.geometry.mesh.topology import edge_keys
from quasiharmonic.util.arrays import BoolArray, FloatArray, IntArray, any_corner, mark, repeat_each
from quasiharmonic.util.kernels import compiled
from quasiharmonic.util.progress import heartbeat

#: Maximum number of neighbours of a vertex to remove.
MOST_NEIGHBOURS = 8


class RemovalTuning(NamedTuple):
    """Numbers that tune the rounds of removals. The C kernel has the same values of the first two."""

    # Number of passes that choose the vertices of a round.
    passes: int = 3
    # Weight of each neighbour in the order of removal, relative to a random number in [0, 1].
    per_neighbour: float = 0.35
    # A round that can remove only this fraction of the vertices is not carried out.
    min_fraction: float = 0.04
    # If fewer than this fraction of the vertices in the arrays remain, the arrays are compacted.
    compact_below: float = 0.7


_TUNING = RemovalTuning()


def allocate_round(T: IntArray) -> tuple[IntArray, IntArray, IntArray]:
    """Allocate vertices, rings and degrees of a round. Each triangle belongs to at most one removed vertex."""
    f = T.shape[1]
    vertices, rings, of_degree = (np.empty(size, dtype=np.int64) for size in (f // 3, f, MOST_NEIGHBOURS + 1))
    return vertices, rings, of_degree


@compiled
def remove_vertices(
    T: IntArray, free: BoolArray, random_order: FloatArray, vertices: IntArray, rings: IntArray, of_degree: IntArray
) -> None:
    """Choose the vertices that one round removes.

    Parameters
    ----------
    T : (3, f) int64
        Triangles, corner by corner.
    free : (n,) bool
        Vertices that may be removed or get new edges; all interior.
    random_order : (n,) float64
        Random numbers in [0, 1] for the order of removal.
    vertices : (f // 3,) int64
        Output: the chosen vertices, sorted by degree, then by index.
    rings : (f,) int64
        Output: their neighbours, vertex after vertex, each ring counterclockwise from its apex.
    of_degree : (MOST_NEIGHBOURS + 1,) int64
        Output: the number of chosen vertices of each degree.
    """
    degree = np.bincount(T.ravel(), minlength=free.size)
    chosen = _choose_independent(T, free, degree, random_order)
    # A fan moves edges from the apex's neighbours to the apex, so an apex with few edges is best.
    cost = np.where(free, degree + random_order, np.inf)
    candidates = []
    for some, around in _trace_rings(T, chosen, degree):
        around = _rotate_to_apex(around, cost)
        fits = free.take(around[0]) & free.take(around[2:-1]).all(axis=0)
        candidates.append((some.compress(fits), around.compress(fits, axis=1)))
    of_degree[:] = 0
    if not candidates:
        return
    new = _adds_new_edges(T, free.size, [around for _, around in candidates])
    begin = done = 0
    for (some, around), taken in zip(candidates, new, strict=True):
        d, r = len(around), int(taken.sum())
        of_degree[d] = r
        vertices[done : done + r] = some.compress(taken)
        rings[begin : begin + d * r].reshape(r, d).T[:] = around.compress(taken, axis=1)
        begin, done = begin + d * r, done + r


@compiled
def fill_rings(T: IntArray, remains: BoolArray, rings: IntArray, of_degree: IntArray, filled: IntArray) -> None:
    """Fill in the triangles after a round: those of T (3, f) with all corners left, and the fans of the rings."""
    kept = remains.take(T[0])
    for corner in T[1:]:
        kept &= remains.take(corner)
    parts = [T.compress(kept, axis=1)]
    for some in split_by_degree(rings, of_degree):
        r, d = some.shape
        fans = np.empty((3, d - 2, r), dtype=np.int64)
        fans[0], fans[1], fans[2] = some.T[0], some.T[1:-1], some.T[2:]
        parts.append(fans.reshape(3, -1))
    np.concatenate(parts, axis=1, out=filled)


def split_by_degree(rings: IntArray, of_degree: IntArray) -> Iterator[IntArray]:
    """Yield concatenated rings as arrays (r, d), for every degree d that occurs."""
    begin = 0
    for d, r in enumerate(of_degree.tolist()):
        if r:
            yield rings[begin : begin + d * r].reshape(r, d)
            begin += d * r


def _choose_independent(T: IntArray, free: BoolArray, degree: IntArray, random_order: FloatArray) -> BoolArray:
    """Choose free vertices of few neighbours, no two of them neighbours; (n,) bool."""
    order = np.where(
        free & (degree > 0) & (degree <= MOST_NEIGHBOURS), random_order + _TUNING.per_neighbour * degree, np.inf
    )
    chosen = np.zeros(order.size, dtype=bool)
    # Choose every vertex that comes first in all its triangles. Further passes use the triangles without a chosen
    # corner and exclude the neighbours of chosen vertices. They add about half as many vertices.
    for _ in range(_TUNING.passes):
        first, earliest = T[0], order.take(T[0])
        for corner in T[1:]:
            at = order.take(corner)
            first = np.where(at < earliest, corner, first)
            earliest = np.minimum(at, earliest)
        selected = (np.bincount(first, minlength=order.size) == degree) & np.isfinite(order)
        chosen |= selected
        near = selected.take(first)
        order[T.compress(near, axis=1)] = np.inf
        T = T.compress(~near, axis=1)
    return chosen


def _trace_rings(T: IntArray, chosen: BoolArray, degree: IntArray) -> Iterator[tuple[IntArray, IntArray]]:
    """Yield the chosen vertices (r,) with their rings (d, r), counterclockwise, degree by degree.

    The vertices are interior and no two are neighbours.
    """
    from scipy.sparse import csr_array

    vertices = np.flatnonzero(chosen)
    of_degree = degree[vertices].astype(np.uint8)
    vertices = vertices[np.argsort(of_degree, kind="stable")]
    number = np.full(chosen.size, -1, dtype=np.int32)
    number[vertices] = np.arange(vertices.size)
    columns = [number.take(corner) for corner in T]
    entries_of = [np.flatnonzero(column >= 0) for column in columns]
    columns = [column.take(entry_of) for column, entry_of in zip(columns, entries_of, strict=True)]
    # Converting the sparse matrix of entries and vertices to columns sorts by vertex in a fifth of the time of a sort.
    entries = sum(entry_of.size for entry_of in entries_of)
    table = (np.ones(entries, dtype=np.int8), np.concatenate(columns), np.arange(entries + 1, dtype=np.int32))
    order = csr_array(table, shape=(entries, vertices.size)).tocsc().indices
    del number, columns, table
    tail, head = (
        np.concatenate([T[(corner + step) % 3].take(entry_of) for corner, entry_of in enumerate(entries_of)]).take(
            order
        )
        for step in (1, 2)
    )
    del entries_of, order
    begin = done = 0
    for d, count in enumerate(np.bincount(of_degree, minlength=MOST_NEIGHBOURS + 1).tolist()):
        if d < 3 or not count:
            continue
        tails, heads = (np.ascontiguousarray(part[begin : begin + d * count].reshape(-1, d).T) for part in (tail, head))
        rings = np.empty_like(tails)
        rings[0], rings[1] = tails[0], heads[0]
        for i in range(2, d):
            # The triangle whose tail is the last vertex found has the next vertex as its head.
            rings[i] = (heads[1:] * (tails[1:] == rings[i - 1])).sum(axis=0)
        yield vertices[done : done + count], rings
        begin, done = begin + d * count, done + count


def _rotate_to_apex(rings: IntArray, cost: FloatArray) -> IntArray:
    """Rotate rings (d, r) so that they begin with the vertex of least cost."""
    d, r = rings.shape
    turn = cost.take(rings).argmin(axis=0)
    return rings.take((turn + np.arange(d)[:, None]) % d * r + np.arange(r))


def _adds_new_edges(T: IntArray, n: int, candidates: list[IntArray]) -> list[BoolArray]:
    """Whether each fan of rings (d, r) adds only edges that do not exist and that no earlier fan adds."""
    apex = np.concatenate([rings[0].repeat(len(rings) - 3) for rings in candidates])
    other = np.concatenate([rings[2:-1].T.ravel() for rings in candidates])
    claims = edge_keys(apex, other, n)
    # Existing edges that may be claimed: from an apex to a vertex that is to get an edge to an apex.
    tails, heads = mark(n, apex), mark(n, other)
    remains = []
    for tail, head in zip(T, T[(1, 2, 0), :], strict=True):
        at = np.flatnonzero(tails.take(tail) & heads.take(head))
        remains.append(edge_keys(tail.take(at), head.take(at), n))
    # Sort existing edges and claims together, with a claim after the edge of the same key.
    keys = 2 * np.concatenate([*remains, claims])
    keys[keys.size - claims.size :] += 1
    keys.sort()
    step, is_claim = np.diff(keys), (keys[1:] & 1).astype(bool)
    lost = np.isin(claims, keys[1:][is_claim & (step == 1)] >> 1)
    repeated = np.flatnonzero(np.isin(claims, keys[1:][is_claim & (step == 0)] >> 1))
    _, first = np.unique(claims[repeated], return_index=True)
    lost[np.delete(repeated, first)] = True
    size = [rings.shape[1] for rings in candidates]
    claimed = repeat_each([len(rings) - 3 for rings in candidates], size)
    good = ~mark(claimed.size, repeat_each(np.arange(claimed.size), claimed)[lost])
    return np.split(good, np.cumsum(size)[:-1])


class Removal(NamedTuple):
    """Vertices (r,) int64 of one degree that are removed together, no two of them neighbours.

    ``rings`` (r, d) int64 has their neighbours counterclockwise, the apex first.
    """

    vertices: IntArray
    rings: IntArray


@dataclass(frozen=True, eq=False)
class Coarsening:
    """A coarse mesh and the removals that led to it. Vertices keep their numbers in the fine mesh.

    Attributes
    ----------
    F : (fc, 3) int64
        Triangles of the coarse mesh.
    rounds : list of list of Removal
        Removed vertices, round by round.
    levels : dict of int to (f, 3) int64
        Triangles before some of the rounds: before the first, and whenever half of the vertices have been removed.
    """

    F: IntArray
    rounds: list[list[Removal]]
    levels: dict[int, IntArray]


def coarsen(F: IntArray, n: int, fixed: BoolArray, goal: int) -> Coarsening:
    """Remove vertices of a surface (f, 3) int64 until ``goal`` are left, or no other vertex can be removed.

    ``fixed`` (n,) bool is True at least on the whole boundary. Vertices with few neighbours are removed first. No new
    edge ends at a fixed vertex. Such an edge would be a constraint that the fine mesh does not have, because the other
    end must be visible from the fixed vertex. So there are no new chords, and the triangles along the boundary change
    little.
    """
    names, free, remains = np.arange(n), ~fixed, np.ones(n, dtype=bool)
    random_order = np.random.default_rng(0).random(n)
    # Transposed, (3, f), because operations on all first corners are then contiguous.
    T: IntArray = np.ascontiguousarray(F.T)
    rounds: list[list[Removal]] = []
    levels: dict[int, IntArray] = {}
    left, halved = n, 2 * n
    while left > goal:
        heartbeat()
        if left < _TUNING.compact_below * len(names):
            # Renumber the remaining vertices in the same order.
            T = (np.cumsum(remains) - 1).take(T)
            names, free, random_order, remains = names[remains], free[remains], random_order[remains], remains[remains]
        vertices, rings, of_degree = allocate_round(T)
        remove_vertices(T, free, random_order, vertices, rings, of_degree)
        removed = int(of_degree.sum())
        if removed < _TUNING.min_fraction * left:
            break
        if 2 * left <= halved:
            levels[len(rounds)], halved = names[T].T if rounds else F, left
        remains[vertices[:removed]] = False
        filled = np.empty((3, T.shape[1] - 2 * removed), dtype=np.int64)
        fill_rings(T, remains, rings, of_degree, filled)
        T = filled
        rounds.append(_removals(names, vertices, rings, of_degree))
        left -= removed
    return Coarsening(np.ascontiguousarray(names[T].T), rounds, levels)


def has_marked_corner(T: IntArray, marked: BoolArray) -> BoolArray:
    """Whether each triangle has a marked corner; (f,) bool."""
    return any_corner(marked.take(T))


def mark_rings(F: IntArray, marked: BoolArray, rings: int = 1) -> BoolArray:
    """Return the marked vertices (n,) and those of some rings of triangles (f, 3) around them."""
    marked = marked.copy()
    for _ in range(rings):
        marked[F[has_marked_corner(F, marked)]] = True
    return marked


def _removals(names: IntArray, vertices: IntArray, rings: IntArray, of_degree: IntArray) -> list[Removal]:
    """The removals of a round, with the vertex numbers of the fine mesh."""
    found, done = [], 0
    for ring_rows in split_by_degree(names.take(rings[: of_degree @ np.arange(of_degree.size)]), of_degree):
        found.append(Removal(names.take(vertices[done : done + len(ring_rows)]), ring_rows))
        done += len(ring_rows)
    return found
