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
the apex, so it is also visible from a position close to the apex (`prolongation`) [1]_.
So the coarse mesh poses the same problem with fewer unknowns, and a map of it extends to the fine mesh. However, the
coarse mesh may have no injective map even if the fine mesh has one.

References
----------
.. [1] H. Shen, Z. Jiang, D. Zorin, D. Panozzo, Progressive embedding. ACM Transactions on Graphics 38 (2019).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from quasiharmonic.geometry.coarsening.removal import allocate_round, fill_rings, remove_vertices, split_by_degree
from quasiharmonic.util.arrays import BoolArray, IntArray, any_corner
from quasiharmonic.util.progress import heartbeat

# A round that can remove only this fraction of the vertices is not carried out.
_MIN_FRACTION = 0.04
# If fewer than this fraction of the vertices in the arrays remain, the arrays are compacted.
_COMPACT_BELOW = 0.7


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
        if left < _COMPACT_BELOW * len(names):
            # Renumber the remaining vertices in the same order.
            T = (np.cumsum(remains) - 1).take(T)
            names, free, random_order, remains = names[remains], free[remains], random_order[remains], remains[remains]
        vertices, rings, of_degree = allocate_round(T)
        remove_vertices(T, free, random_order, vertices, rings, of_degree)
        removed = int(of_degree.sum())
        if removed < _MIN_FRACTION * left:
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


def _removals(names: IntArray, vertices: IntArray, rings: IntArray, of_degree: IntArray) -> list[Removal]:
    """The removals of a round, with the vertex numbers of the fine mesh."""
    found, done = [], 0
    for ring_rows in split_by_degree(names.take(rings[: of_degree @ np.arange(of_degree.size)]), of_degree):
        found.append(Removal(names.take(vertices[done : done + len(ring_rows)]), ring_rows))
        done += len(ring_rows)
    return found
