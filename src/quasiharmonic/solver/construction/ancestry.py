"""A mesh after edges were split one at a time, told as `Refined` has it."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from quasiharmonic.geometry.mesh.refinement import Refined
from quasiharmonic.util.arrays import FloatArray, IntArray


def as_refined(V: FloatArray, F: IntArray, triangles: IntArray, shares: Sequence[dict[int, float]]) -> Refined:
    """Tell where vertices and triangles of a refined mesh lie in the old one.

    Parameters
    ----------
    V : (n, d) float64
        The old mesh's vertices.
    F : (f, 3) int64
        Its triangles.
    triangles : (t, 3) int64
        The new triangles, each within an old one, in any order.
    shares : sequence of dict
        Of each added vertex, in order, the old ones that it lies between and their shares in it.

    Returns
    -------
    Refined
    """
    n = len(V)
    support = [*({vertex} for vertex in range(n)), *(set(row) for row in shares)]
    number = {tuple(sorted(row)): k for k, row in enumerate(F.tolist())}
    rows = triangles.tolist()
    parent = np.array([number[tuple(sorted(support[a] | support[b] | support[c]))] for a, b, c in rows], dtype=np.int64)
    order = np.argsort(parent, kind="stable")
    triangles, parent = triangles[order], parent[order]
    _, first = np.unique(parent, return_index=True)
    further = np.setdiff1d(np.arange(len(parent)), first)
    order = np.concatenate([first, further])
    triangles, parent = triangles[order], parent[order]
    # What was not split stays as it was, its first corner included.
    whole = (np.sort(triangles, axis=1) == np.sort(F[parent], axis=1)).all(axis=1)
    triangles[whole] = F[parent[whole]]
    parents = np.array([(*sorted(row), max(row), max(row))[:3] for row in shares], dtype=np.int64).reshape(-1, 3)
    weights = np.array([[*(row[v] for v in sorted(row)), 0.0, 0.0][:3] for row in shares]).reshape(-1, 3)
    added = np.einsum("sk,skd->sd", weights, V[parents])
    return Refined(np.concatenate([V, added]), triangles, parent, parents, weights)


def midpoints(n: int, parents: Sequence[tuple[int, int]]) -> list[dict[int, float]]:
    """The shares of old vertices in vertices each of which lies in the middle between two that were there before it."""
    shares: list[dict[int, float]] = []
    for pair in parents:
        total: dict[int, float] = {}
        for vertex in pair:
            for old, share in ({vertex: 1.0} if vertex < n else shares[vertex - n]).items():
                total[old] = total.get(old, 0.0) + share / 2
        shares.append(total)
    return shares


def shares_of(refined: Refined) -> list[dict[int, float]]:
    """The shares of old vertices in the added ones of a refinement."""
    rows = zip(refined.parents.tolist(), refined.weights.tolist(), strict=True)
    return [{old: share for old, share in zip(*row, strict=True) if share} for row in rows]
