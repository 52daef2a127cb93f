"""Split given edges of a mesh at their midpoints."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from quasiharmonic.geometry.mesh.topology import edge_keys, pair_keys
from quasiharmonic.geometry.mesh.topology import edges as sort_edges
from quasiharmonic.util.arrays import (
    FloatArray,
    IntArray,
    check_bool,
    check_range,
    edge_array,
    edge_names,
    triangle_rows,
    vertex_array,
)

#: Weights of old vertices in a new vertex.
Shares = dict[int, float]


@dataclass(frozen=True, eq=False)
class Refined:
    """A mesh after some of its edges were split, with its relation to the old mesh.

    Attributes
    ----------
    V : (n + s, d) float64
        Vertices: the old ones with their old indices, then the new ones.
    F : (f + …, 3) int64
        Triangles. An old triangle that is not split keeps its index. The first part of a split triangle takes its
        index; further parts follow all old triangles.
    parent : (f + …,) int64
        Index of the old triangle that contains each triangle.
    parents : (s, k) int64
        Old vertices between which each new vertex lies, ascending. After one round these are the two ends of the split
        edge; after several rounds, up to three corners of an old triangle. The last index is repeated to fill the row.
    weights : (s, k) float64
        Weights of the parents; 0 for repeated ones.

    See Also
    --------
    refine : Makes it.
    results.RefinedProblem : A problem on such a mesh.

    Examples
    --------
    >>> from quasiharmonic import refine
    >>> V = [[0.0, 0.0], [1.0, 0.0], [1.0, 1.0], [0.0, 1.0]]
    >>> refined = refine(V, [[0, 1, 2], [0, 2, 3]], [[0, 2]])
    >>> refined.parents.tolist(), refined.V[4].tolist()
    ([[0, 2]], [0.5, 0.5])
    """

    V: FloatArray
    F: IntArray
    parent: IntArray
    parents: IntArray
    weights: FloatArray

    def shares(self) -> list[Shares]:
        """The weights of old vertices in every new vertex."""
        rows = zip(self.parents.tolist(), self.weights.tolist(), strict=True)
        return [{old: share for old, share in zip(*row, strict=True) if share} for row in rows]

    def extend(self, values: ArrayLike) -> FloatArray:
        """Interpolate values (n, …) at the old vertices to all vertices, linearly on the old triangles."""
        old, count = np.asarray(values, dtype=np.float64), len(self.V) - len(self.parents)
        if not old.ndim or len(old) != count:
            rows = "a number" if not old.ndim else f"{len(old)} rows"
            raise ValueError(f"values must have {count} rows, one for each vertex, not {rows}")
        return np.concatenate([old, np.einsum("sk,sk...->s...", self.weights, old[self.parents])])


def compose(first: Refined, second: Refined) -> Refined:
    """Compose two successive refinements into one, with three parents for each vertex."""
    n = len(first.V) - len(first.parents)

    shares = first.shares()
    later = [combine_shares(row, shares, n) for row in second.shares()]
    return Refined(second.V, second.F, first.parent[second.parent], *parents_and_weights([*shares, *later]))


def combine_shares(row: Shares, shares: Sequence[Shares], n: int) -> Shares:
    """Express a vertex between vertices of a refinement by old vertices; ``n`` is their number.

    ``row`` has the weights of those vertices. ``shares`` has the weights of old vertices for each added one.
    """
    total: Shares = {}
    for vertex, weight in row.items():
        for old, share in ({vertex: 1.0} if vertex < n else shares[vertex - n]).items():
            total[old] = total.get(old, 0.0) + weight * share
    return total


def parents_and_weights(shares: Sequence[Shares]) -> tuple[IntArray, FloatArray]:
    """Arrays (s, 3) as in `Refined` of the old vertices and weights; a vertex in an old triangle has at most three."""
    parents = np.array([(*sorted(row), max(row), max(row))[:3] for row in shares], dtype=np.int64).reshape(-1, 3)
    weights = [[*(row[old] for old in sorted(row)), 0.0, 0.0][:3] for row in shares]
    return parents, np.array(weights, dtype=np.float64).reshape(-1, 3)


def split_edges(V: ArrayLike, F: ArrayLike, edges: ArrayLike, *, boundary: bool = False) -> Refined:
    """Split edges at their midpoints; array version of `quasiharmonic.refine`."""
    V, F = vertex_array(V), triangle_rows(F)
    n = len(V)
    check_range("F", F, n)
    wanted = np.unique(np.sort(edge_array("edges", edges), axis=1), axis=0)
    found = sort_edges(F, n)
    allowed = [found.interior, np.sort(found.boundary, axis=1)]
    _check_known(wanted, pair_keys(np.concatenate(allowed), n), n, "not an edge of the mesh")
    check_bool("boundary", boundary)
    if not boundary:
        _check_known(wanted, pair_keys(found.interior, n), n, "on the boundary; pass boundary=True to split it")

    V = np.concatenate([V, V[wanted[:, 0]] / 2 + V[wanted[:, 1]] / 2])
    keys = pair_keys(wanted, n)
    # Midpoint of the side opposite to each corner, or -1.
    sides = edge_keys(F[:, (1, 2, 0)].ravel(), F[:, (2, 0, 1)].ravel(), n)
    at = np.minimum(np.searchsorted(keys, sides), max(len(keys) - 1, 0))
    middle = np.where(keys[at] == sides, n + at, -1).reshape(-1, 3) if len(keys) else np.full(F.shape, -1)
    F, parent = _subdivide(V, F, middle)
    return Refined(V, F, parent, wanted, np.full(wanted.shape, 0.5))


def _subdivide(V: FloatArray, F: IntArray, middle: IntArray) -> tuple[IntArray, IntArray]:
    r"""Replace triangles by their parts; ``middle`` (f, 3) has the midpoint opposite to each corner, or -1.

    Drawn with the midpoints p, q, r opposite to a, b, c:

            c                c                 c
           /|\              / \               / \
          / | \            q---p             q---p
         /  |  \          / `-. \           / \ / \
        a---r---b        a-----`-b         a---r---b
    """
    count = (middle >= 0).sum(axis=1)
    first, parts, of = F.copy(), [np.empty((0, 3), dtype=np.int64)], [np.empty(0, dtype=np.int64)]

    def replace(t: IntArray, *triangles: tuple[IntArray, IntArray, IntArray]) -> None:
        first[t] = np.stack(triangles[0], axis=1)
        for corners in triangles[1:]:
            parts.append(np.stack(corners, axis=1))
            of.append(t)

    def rotate(number: int, to: IntArray) -> tuple[IntArray, IntArray, IntArray]:
        # Corners and midpoints of triangles, rotated so that corner `to` is the last.
        t = np.flatnonzero(count == number)
        columns = (to[t, None] + [1, 2, 0]) % 3
        return t, F[t[:, None], columns].T, middle[t[:, None], columns].T

    t, (a, b, c), (_, _, r) = rotate(1, np.argmax(middle, axis=1))
    replace(t, (r, c, a), (r, b, c))
    t, (a, b, c), (p, q, _) = rotate(2, np.argmin(middle, axis=1))
    through_b = _length(V, b, q) <= _length(V, a, p)
    replace(t, (c, q, p), (q, a, b), (q, b, p))
    k = np.flatnonzero(~through_b)
    parts[-2][k] = np.stack([a, b, p], axis=1)[k]
    parts[-1][k] = np.stack([a, p, q], axis=1)[k]
    t, (a, b, c), (p, q, r) = rotate(3, np.zeros(len(F), dtype=np.int64))
    replace(t, (p, q, r), (a, r, q), (b, p, r), (c, q, p))
    return np.concatenate([first, *parts]), np.concatenate([np.arange(len(F)), *of])


def _length(V: FloatArray, i: IntArray, j: IntArray) -> FloatArray:
    """A quarter of the distances between vertices; the scale prevents overflow."""
    return np.hypot.reduce(V[i] / 4 - V[j] / 4, axis=1)


def _check_known(wanted: IntArray, known: IntArray, n: int, reason: str) -> None:
    inside = ((wanted >= 0) & (wanted < n)).all(axis=1)
    bad = wanted[~(inside & np.isin(pair_keys(wanted, n), known))]
    if len(bad):
        raise ValueError(f"cannot split {edge_names(bad)}: {reason}")
