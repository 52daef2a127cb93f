"""Surfaces whose boundaries are placed on outlines."""

from __future__ import annotations

import numpy as np

from quasiharmonic import surfaces
from quasiharmonic.targets import boundary_to
from shared.meshes import lift


def holed(n, *holes, seed=0):
    """Return a curved disk without the triangles whose centres lie in some circles (x, y, radius)."""
    V, F = surfaces.random_delaunay(n, seed)
    middle = V[F].mean(axis=1)
    solid = np.ones(len(F), dtype=bool)
    for x, y, radius in holes:
        solid &= np.hypot(*(middle - (x, y)).T) > radius
    used, F = np.unique(F[solid], return_inverse=True)
    V, F = surfaces.refine(V[used], F.reshape(-1, 3))
    return lift(V), F


def plain_grid(nx, ny):
    """Return a grid whose diagonals all rise to the right, with ears at two of its corners."""
    x, y = np.meshgrid(np.arange(nx + 1.0), np.arange(ny + 1.0))
    j, i = np.divmod(np.arange(nx * ny), nx)
    low = i + j * (nx + 1)
    corners = np.stack([low, low + 1, low + nx + 2, low, low + nx + 2, low + nx + 1], axis=1)
    return np.stack([x.ravel(), y.ravel()], axis=1), corners.reshape(-1, 3)


def placed(V, F, *arguments, **options):
    fixed, target = boundary_to(V, F, *arguments, **options)
    where = np.full((len(V), 2), np.nan)
    where[fixed] = target
    return where


def torus(n=24, m=12):
    a, b = np.meshgrid(np.arange(n), np.arange(m), indexing="ij")
    u, v = a.ravel() * 2 * np.pi / n, b.ravel() * 2 * np.pi / m
    V = np.stack([(2 + np.cos(v)) * np.cos(u), (2 + np.cos(v)) * np.sin(u), np.sin(v)], axis=1)
    at = lambda i, j: (i % n) * m + j % m  # noqa: E731
    a, b = a.ravel(), b.ravel()
    F = [
        np.stack([at(a, b), at(a + 1, b), at(a + 1, b + 1)], 1),
        np.stack([at(a, b), at(a + 1, b + 1), at(a, b + 1)], 1),
    ]
    return V, np.concatenate(F)
