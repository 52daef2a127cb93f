"""Split named edges of a mesh at their midpoints and nothing else."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from quasiharmonic.mesh.topology import edge_keys
from quasiharmonic.mesh.topology import edges as sort_edges

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]


@dataclass(frozen=True)
class Refined:
    """A mesh some of whose edges were split, and how it came from the old one.

    Attributes
    ----------
    V : (n + s, d) float64
        Vertices: the old ones first, at their old indices, then one for each edge that was split.
    F : (f + …, 3) int64
        Triangles. Every old one keeps its index, or leaves it to its first part; further parts follow.
    parent : (f + …,) int64
        The old triangle each new one is a part of.
    parents : (s, 2) int64
        The old vertices between which each new one lies, smaller index first.
    weights : (s, 2) float64
        Their shares in it.
    """

    V: FloatArray
    F: IntArray
    parent: IntArray
    parents: IntArray
    weights: FloatArray

    def extend(self, values: ArrayLike) -> FloatArray:
        """Carry values at the old vertices over to the new ones, linear along the old edges.

        Parameters
        ----------
        values : (n, …) array
            One row for each old vertex.

        Returns
        -------
        (n + s, …) float64
        """
        old = np.asarray(values, dtype=np.float64)
        if len(old) != len(self.V) - len(self.parents):
            raise ValueError(f"values must have {len(self.V) - len(self.parents)} rows, one a vertex, not {len(old)}")
        return np.concatenate([old, np.einsum("sk,sk...->s...", self.weights, old[self.parents])])


def refine(V: ArrayLike, F: ArrayLike, edges: ArrayLike, *, boundary: bool = False) -> Refined:
    """Split edges of a mesh at their midpoints, and the triangles beside them to match.

    A triangle with one split edge becomes two, with two three (along the shorter diagonal of the
    quadrilateral that remains), with three four. No other triangle changes, and no old vertex moves
    or changes its index, so that fixed vertices stay as they are.

    Parameters
    ----------
    V : (n, 2) or (n, 3) array
        Vertices.
    F : (f, 3) array of int
        Triangles, no edge in more than two of them.
    edges : (s, 2) array of int
        Edges to split, as pairs of vertices in any order; naming one twice does no harm.
        `Diagnosis.split` names those that stand in the way of a map.
    boundary : bool
        Also split edges on the boundary. Their midpoints are new boundary vertices, which need a
        position in the target: `Refined.extend` finds them one.

    Returns
    -------
    Refined

    Raises
    ------
    ValueError
        When a pair is not an edge of the mesh, or is on its boundary and ``boundary`` is false; when
        indices are no integers, have the wrong shape or refer to no vertex.

    Examples
    --------
    >>> V = [[0.0, 0.0], [1.0, 0.0], [1.0, 1.0], [0.0, 1.0]]
    >>> refined = refine(V, [[0, 1, 2], [0, 2, 3]], [[0, 2]])
    >>> refined.F.tolist(), refined.parent.tolist()
    ([[4, 1, 2], [4, 3, 0], [4, 0, 1], [4, 2, 3]], [0, 1, 0, 1])
    """
    V = np.array(V, dtype=np.float64)
    F = _indices("F", F, 3)
    n = len(V)
    if F.size and (F.min() < 0 or F.max() >= n):
        raise ValueError(f"F refers to a vertex outside 0 … {n - 1}")
    wanted = np.unique(np.sort(_indices("edges", edges, 2), axis=1), axis=0)
    found = sort_edges(F, n)
    allowed = [found.interior, np.sort(found.boundary, axis=1)]
    _refuse(wanted, _keys(np.concatenate(allowed), n), n, "not an edge of the mesh")
    if not boundary:
        _refuse(wanted, _keys(found.interior, n), n, "on the boundary; pass boundary=True to split it all the same")

    V = np.concatenate([V, V[wanted[:, 0]] / 2 + V[wanted[:, 1]] / 2])
    keys = _keys(wanted, n)
    # Midpoint of the side opposite to each corner, or -1.
    sides = edge_keys(F[:, (1, 2, 0)].ravel(), F[:, (2, 0, 1)].ravel(), n)
    at = np.minimum(np.searchsorted(keys, sides), max(len(keys) - 1, 0))
    middle = np.where(keys[at] == sides, n + at, -1).reshape(-1, 3) if len(keys) else np.full(F.shape, -1)
    F, parent = _subdivide(V, F, middle)
    return Refined(V, F, parent, wanted, np.full(wanted.shape, 0.5))


def _subdivide(V: FloatArray, F: IntArray, middle: IntArray) -> tuple[IntArray, IntArray]:
    r"""Replace triangles by their parts; ``middle`` (f, 3) has the midpoints opposite to the corners.

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

    def turned(number: int, to: IntArray) -> tuple[IntArray, IntArray, IntArray]:
        # Corners and midpoints, cyclically so that corner `to` is the last.
        t = np.flatnonzero(count == number)
        columns = (to[t, None] + [1, 2, 0]) % 3
        return t, F[t[:, None], columns].T, middle[t[:, None], columns].T

    t, (a, b, c), (_, _, r) = turned(1, np.argmax(middle, axis=1))
    replace(t, (r, c, a), (r, b, c))
    t, (a, b, c), (p, q, _) = turned(2, np.argmin(middle, axis=1))
    through_b = _length(V, b, q) <= _length(V, a, p)
    replace(t, (c, q, p), (q, a, b), (q, b, p))
    k = np.flatnonzero(~through_b)
    parts[-2][k] = np.stack([a, b, p], axis=1)[k]
    parts[-1][k] = np.stack([a, p, q], axis=1)[k]
    t, (a, b, c), (p, q, r) = turned(3, np.zeros(len(F), dtype=np.int64))
    replace(t, (p, q, r), (a, r, q), (b, p, r), (c, q, p))
    return np.concatenate([first, *parts]), np.concatenate([np.arange(len(F)), *of])


def _length(V: FloatArray, i: IntArray, j: IntArray) -> FloatArray:
    """A quarter of the distances of vertices, which no coordinates make overflow."""
    lengths: FloatArray = np.hypot.reduce(V[i] / 4 - V[j] / 4, axis=1)
    return lengths


def _indices(name: str, values: ArrayLike, width: int) -> IntArray:
    array = np.asarray(values)
    if array.size and (array.dtype.kind not in "iu" or array.ndim != 2 or array.shape[1] != width):
        raise ValueError(f"{name} must hold integers in shape (k, {width}), not {array.dtype} {array.shape}")
    return np.array(array, dtype=np.int64).reshape(-1, width)


def _refuse(wanted: IntArray, known: IntArray, n: int, why: str) -> None:
    inside = ((wanted >= 0) & (wanted < n)).all(axis=1)
    bad = wanted[~(inside & np.isin(_keys(wanted, n), known))]
    if len(bad):
        listed = ", ".join(f"({i}, {j})" for i, j in bad[:5].tolist())
        rest = f", … ({len(bad)} in all)" if len(bad) > 5 else ""
        raise ValueError(f"cannot split {listed}{rest}: {why}")


def _keys(pairs: IntArray, n: int) -> IntArray:
    return edge_keys(pairs[:, 0], pairs[:, 1], n)
