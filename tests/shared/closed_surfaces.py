"""Closed surfaces, with and without handles."""

from __future__ import annotations

import numpy as np

TETRAHEDRON = np.vstack([np.zeros(3), np.eye(3)]), np.array([[0, 2, 1], [0, 1, 3], [1, 2, 3], [0, 3, 2]])


def torus(around=36, across=14, radius=2.0):
    """A tube of radius 1 around a circle; vertex ``i * across + j`` is the j-th of the i-th ring, outermost first."""
    i, j = np.divmod(np.arange(around * across), across)
    u, v = 2 * np.pi * i / around, 2 * np.pi * j / across
    V = np.stack([(radius + np.cos(v)) * np.cos(u), (radius + np.cos(v)) * np.sin(u), np.sin(v)], axis=1)

    def at(i, j):
        return (i % around) * across + j % across

    a, b, c, d = at(i, j), at(i + 1, j), at(i + 1, j + 1), at(i, j + 1)
    return V, np.concatenate([np.stack([a, b, c], axis=1), np.stack([a, c, d], axis=1)])


def blocks(solid, rounds=3):
    """The surface of a solid of unit blocks, (x, y, z) bool, smoothed by averaging neighbouring vertices."""
    padded = np.pad(np.asarray(solid, dtype=bool), 1)
    quads = []
    for axis in range(3):
        for sense in (1, -1):
            at = np.argwhere(padded & ~np.roll(padded, -sense, axis=axis))
            first, second = np.eye(3, dtype=int)[[(axis + 1) % 3, (axis + 2) % 3]][::sense]
            low = at + (np.eye(3, dtype=int)[axis] if sense > 0 else 0)
            quads.append(np.stack([low, low + first, low + first + second, low + second], axis=1))
    V, index = np.unique(np.concatenate(quads).reshape(-1, 3), axis=0, return_inverse=True)
    Q = index.reshape(-1, 4)
    ends = np.concatenate([Q[:, [0, 1]], Q[:, [1, 2]], Q[:, [2, 3]], Q[:, [3, 0]]])
    V, count = V.astype(float), np.bincount(ends[:, 0], minlength=len(V))[:, None]
    for _ in range(rounds):
        total = np.zeros_like(V)
        np.add.at(total, ends[:, 0], V[ends[:, 1]])
        V = total / count
    return V, np.concatenate([Q[:, [0, 1, 2]], Q[:, [0, 2, 3]]])


def double_torus(thick=3):
    """The surface of a plate with two holes."""
    solid = np.ones((5 * thick, 3 * thick, thick), dtype=bool)
    for x in (thick, 3 * thick):
        solid[x : x + thick, thick : 2 * thick] = False
    return blocks(solid)
