"""Problems with sliding boundaries."""

from __future__ import annotations

import itertools

import numpy as np
from scipy.optimize import minimize_scalar

from quasiharmonic import boundary_loops, surfaces
from quasiharmonic.targets import boundary_to, filled, outline, outline_curves
from quasiharmonic.targets.outlines.letters import glyph_paths
from shared.meshes import lift

SQUARE = [(0, 0), (1, 0), (1, 1), (0, 1)]


def z_of(points):
    return points @ (1, 1j)


def points_of(z):
    return np.stack([z.real, z.imag], axis=1)


def sheared(n=10):
    """A grid on the unit square, and a map of it that moves the vertices of its sides along them."""
    V, F = surfaces.grid(n, n)
    x, y = V.T
    uv = np.stack([x + 0.7 * x * (1 - x) * (1 - 0.3 * y), y - 0.3 * y * (1 - y) * x], axis=1)
    (loop,) = boundary_loops(F, len(V))
    return V, F, uv, loop


def lettered(text, **options):
    """A curved disk mapped to a letter."""
    V, F = surfaces.random_delaunay(400, seed=4)
    V = lift(V)
    return V, F, *boundary_to(V, F, filled(outline(text))), outline_curves(text)


def off_the_glyph(points, character):
    """Return distances from the pieces that the font draws, by SciPy's search on each; (k,)."""
    away = np.full(len(points), np.inf)
    for control in [piece for path in glyph_paths(character) for piece in path]:

        def at(t, control=control):
            rows = [complex(*row) for row in control]
            t = min(max(t, 0), 1)
            while len(rows) > 1:
                rows = [(1 - t) * a + t * b for a, b in itertools.pairwise(rows)]
            return rows[0]

        near = np.abs(z_of(points)[:, None] - [at(t) for t in np.linspace(0, 1, 30).tolist()]).min(axis=1)
        for i in np.flatnonzero(near < 0.03):
            found = minimize_scalar(
                lambda t, p=complex(*points[i]): abs(at(t) - p) ** 2,
                bounds=(-1e-9, 1 + 1e-9),
                method="bounded",
                options={"xatol": 1e-12},
            )
            away[i] = min(away[i], *(abs(at(t) - complex(*points[i])) for t in (found.x, 0, 1)))
    return away
