"""Hand-made meshes of a few triangles: wheels, an ear, a handle."""

from __future__ import annotations

import numpy as np

from shared.polygons import circle


def wheel(n):
    """A hub ``n`` in a ring of ``n`` vertices; each pair of ring neighbours forms a triangle with the hub."""
    i = np.arange(n)
    return np.concatenate([circle(n), np.zeros((1, 2))]), np.stack([i, (i + 1) % n, np.full(n, n)], axis=1)


def loose_wheel(n):
    """As `wheel`, with a vertex ``n + 1 + i`` inside each triangle, so no triangle at the hub has a boundary edge."""
    V, F = wheel(n)
    a, b, c = F.T
    k = n + 1 + np.arange(n)
    parts = [np.stack(t, axis=1) for t in ((a, b, k), (b, c, k), (c, a, k))]
    return np.concatenate([V, V[F].mean(axis=1)]), np.concatenate(parts)


def two_wheels():
    """A ring of 8 with the chord 0, 4 and a hub on each side: 8 to its right and 9 to its left."""
    rings = [[0, 1, 2, 3, 4], [4, 5, 6, 7, 0]]
    V = np.concatenate([circle(8), [circle(8)[ring].mean(axis=0) for ring in rings]])
    return V, np.array([(r[k - 1], r[k], hub) for hub, r in enumerate(rings, start=8) for k in range(5)])


def eared():
    """A square whose corner 1 is an ear, cut off by the chord 0, 2; vertex 4 is in the middle of the rest."""
    return np.array([[0, 0], [4, 0], [4, 4], [0, 4], [1, 3.0]]), np.array([[0, 1, 2], [0, 2, 4], [2, 3, 4], [3, 0, 4]])


def handle(n=6):
    """A torus of ``n`` by ``n`` cells with one cell removed: one boundary loop, and a handle."""
    i, j = (k.ravel() for k in np.meshgrid(np.arange(n), np.arange(n), indexing="ij"))
    here, right, up, across = (((i + a) % n) * n + (j + b) % n for a, b in ((0, 0), (1, 0), (0, 1), (1, 1)))
    F = np.stack([here, right, across, here, across, up], axis=1).reshape(-1, 3)
    a, b = 2 * np.pi * i / n, 2 * np.pi * j / n
    return np.stack([(2 + np.cos(b)) * np.cos(a), (2 + np.cos(b)) * np.sin(a), np.sin(b)], axis=1), F[2:]
