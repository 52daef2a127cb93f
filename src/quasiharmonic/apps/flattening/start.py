"""A bijective map to start from: the longest boundary loop on a circle, the others free.

Holes are filled by a fan around a vertex of their own. What is left is a disk, and its map onto a convex outline is
found and certified by the library's own search, whose first try is Tutte's embedding.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from quasiharmonic.problem import Problem
from quasiharmonic.solver.search.solving import solve
from quasiharmonic.util.arrays import FloatArray, IntArray


def disk_start(V: FloatArray, F: IntArray, loops: Sequence[IntArray], linear_solver: str = "auto") -> FloatArray | None:
    """Map a surface into a disk of its own area, its longest loop onto the circle by length.

    Parameters
    ----------
    V : (n, 3) float64
        Rest positions, of about unit size.
    F : (f, 3) int64
        Triangles of a connected surface without handles.
    loops : sequence of (l,) int64
        Its boundary loops.
    linear_solver : str

    Returns
    -------
    (n, 2) float64 or None
        Bijective; None where double precision does not hold such a map.
    """
    lengths = [np.linalg.norm(V[np.roll(loop, -1)] - V[loop], axis=1) for loop in loops]
    longest = int(np.argmax([length.sum() for length in lengths]))
    outer = loops[longest]
    holes = [loop for k, loop in enumerate(loops) if k != longest]
    # Edges without length get some, so that no two vertices share a place.
    length = lengths[longest] + 1e-6 * lengths[longest].mean()
    angle = 2 * np.pi * np.cumsum(length) / length.sum()
    corners = V[F]
    cross = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    radius = np.sqrt(0.5 * float(np.linalg.norm(cross, axis=1).sum()) / np.pi)
    circle = radius * np.stack([np.cos(angle), np.sin(angle)], axis=1)
    problem = Problem(
        np.concatenate([V, *(V[hole].mean(axis=0)[None] for hole in holes)]),
        np.concatenate([F, fans(holes, len(V))]),
        outer,
        circle,
        reference="equilateral",
    )
    result = solve(problem, linear_solver=linear_solver, max_iterations=200)
    return result.uv[: len(V)] if result.injective else None


def fans(loops: Sequence[IntArray], n: int) -> IntArray:
    """Fill loops, the surface to their left, by triangles (k, 3) around new vertices from ``n`` on."""
    triangles = [np.stack([np.roll(loop, -1), loop, np.full(len(loop), n + k)], axis=1) for k, loop in enumerate(loops)]
    return np.concatenate([np.zeros((0, 3), dtype=np.int64), *triangles])
