"""Problems that have an injective map and whose Tutte embedding has inverted triangles."""

from __future__ import annotations

import numpy as np

from quasiharmonic import boundary_loops
from quasiharmonic.surfaces import annulus
from shared.meshes import boundary_of, irregular_disk, lift


def star_problem(depth=0.55, points=5, n=300, seed=0):
    """An irregular disk onto a star, whose Tutte embedding has inverted triangles."""
    V, F = irregular_disk(n, seed)
    (loop,) = boundary_loops(F, len(V))
    angle = np.linspace(0, 2 * np.pi, len(loop), endpoint=False)
    corner = np.abs((angle * points / np.pi) % 2 - 1)
    radius = depth + (1 - depth) * corner
    return lift(V), F, loop, radius[:, None] * np.stack([np.cos(angle), np.sin(angle)], axis=1)


def turned_ring(degrees, cells=12):
    """A square annulus whose hole is turned (Figure 6)."""
    V, F = annulus(cells)
    fixed = boundary_of(F)
    target = V[fixed].copy()
    inner = np.abs(target).max(axis=1) < 0.75
    target[inner] = (target[inner].view(complex) * np.exp(1j * np.deg2rad(degrees))).view(float).reshape(-1, 2)
    return V, F, fixed, target
