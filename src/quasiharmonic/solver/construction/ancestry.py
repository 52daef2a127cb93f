"""Relation of a mesh, after splitting edges one at a time, to the original mesh, as a `Refined`."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from quasiharmonic.geometry.mesh.refinement import Refined, Shares, combine_shares, parents_and_weights
from quasiharmonic.util.arrays import FloatArray, IntArray


def as_refined(V: FloatArray, F: IntArray, triangles: IntArray, shares: Sequence[Shares]) -> Refined:
    """Return the relation of a refined mesh to the original mesh ``V``, ``F``.

    ``triangles`` (t, 3) are the new ones, each within an original one, in any order. For each added vertex, in order,
    ``shares`` has the original vertices that it lies between and their weights.
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
    # Unsplit triangles keep their order of corners.
    whole = (np.sort(triangles, axis=1) == np.sort(F[parent], axis=1)).all(axis=1)
    triangles[whole] = F[parent[whole]]
    parents, weights = parents_and_weights(shares)
    added = np.einsum("sk,skd->sd", weights, V[parents])
    return Refined(np.concatenate([V, added]), triangles, parent, parents, weights)


def midpoints(n: int, parents: Sequence[tuple[int, int]]) -> list[Shares]:
    """Return the weights of original vertices in vertices that are midpoints of two earlier vertices each."""
    shares: list[Shares] = []
    for a, b in parents:
        shares.append(combine_shares({a: 0.5, b: 0.5}, shares, n))
    return shares
