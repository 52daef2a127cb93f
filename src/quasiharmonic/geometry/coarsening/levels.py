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

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from quasiharmonic.geometry.coarsening.removal import by_degree, fill_rings, remove_vertices, room_for_round
from quasiharmonic.util.arrays import BoolArray, IntArray
from quasiharmonic.util.progress import heartbeat

# Where so small a share of the vertices is all that a round can take out, it is the last.
_FEW = 0.04
# Where a smaller share of the numbers is of vertices that are left, the others are taken out of the arrays.
_SPARSE = 0.7


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
    names, free, there = np.arange(n), ~held, np.ones(n, dtype=bool)
    dice = np.random.default_rng(0).random(n)
    # Corner by corner, (3, f): what is done to all first corners at once is done quickly.
    T: IntArray = np.ascontiguousarray(F.T)
    rounds: list[list[Removal]] = []
    levels: dict[int, IntArray] = {}
    left, halved = n, 2 * n
    while left > goal:
        heartbeat()
        if left < _SPARSE * len(names):
            # Numbers for those that are left alone, in the same order.
            T = (np.cumsum(there) - 1).take(T)
            names, free, dice, there = names[there], free[there], dice[there], there[there]
        vertices, rings, of_degree = room_for_round(T)
        remove_vertices(T, free, dice, vertices, rings, of_degree)
        gone = int(of_degree.sum())
        if gone < _FEW * left:
            break
        if 2 * left <= halved:
            levels[len(rounds)], halved = names[T].T if rounds else F, left
        there[vertices[:gone]] = False
        filled = np.empty((3, T.shape[1] - 2 * gone), dtype=np.int64)
        fill_rings(T, there, rings, of_degree, filled)
        T = filled
        rounds.append(_removals(names, vertices, rings, of_degree))
        left -= gone
    return Coarsening(np.ascontiguousarray(names[T].T), rounds, levels)


def touching(T: IntArray, marked: BoolArray) -> BoolArray:
    """Which triangles have a marked corner; (f,) bool."""
    corners = marked.take(T)
    return corners[:, 0] | corners[:, 1] | corners[:, 2]


def _removals(names: IntArray, vertices: IntArray, rings: IntArray, of_degree: IntArray) -> list[Removal]:
    """What a round takes out, by the names that vertices have in the fine mesh."""
    found, done = [], 0
    for some in by_degree(names.take(rings[: of_degree @ np.arange(of_degree.size)]), of_degree):
        found.append(Removal(names.take(vertices[done : done + len(some)]), some))
        done += len(some)
    return found
