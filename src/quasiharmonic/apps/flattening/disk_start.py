"""Initial bijective map: the longest boundary loop on a circle, the other loops free.

Each hole is filled by a fan around a new vertex, so the surface becomes a disk. The library's solver maps it onto the
convex outline and certifies the map.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from quasiharmonic.geometry.mesh.reference import surface_area
from quasiharmonic.geometry.mesh.splitting import make_fans
from quasiharmonic.problem import Problem
from quasiharmonic.problem.result import Status
from quasiharmonic.util.arrays import FloatArray, IntArray


def map_to_disk(
    V: FloatArray, F: IntArray, loops: Sequence[IntArray], linear_solver: str = "auto"
) -> FloatArray | None:
    """Map a surface into a disk of its area, with its longest loop on the circle by arc length.

    ``V`` (n, 3) is of about unit size, and the surface is connected and has no handles. Return a bijective map (n, 2),
    or None if none was found in double precision. Ctrl-C raises KeyboardInterrupt.
    """
    # The search's modules take longer to import than `unwrap` takes for a model of flat parts, which needs none.
    from quasiharmonic.solver.mapping import solve

    lengths = [np.linalg.norm(V[np.roll(loop, -1)] - V[loop], axis=1) for loop in loops]
    longest = int(np.argmax([length.sum() for length in lengths]))
    outer = loops[longest]
    holes = [loop for k, loop in enumerate(loops) if k != longest]
    # Edges of length zero get a small length, so that no two vertices share a position.
    length = lengths[longest] + 1e-6 * lengths[longest].mean()
    angle = 2 * np.pi * np.cumsum(length) / length.sum()
    radius = np.sqrt(surface_area(V, F) / np.pi)
    circle = radius * np.stack([np.cos(angle), np.sin(angle)], axis=1)
    problem = Problem(
        np.concatenate([V, *(V[hole].mean(axis=0)[None] for hole in holes)]),
        np.concatenate([F, make_fans(holes, len(V))]),
        outer,
        circle,
        reference="equilateral",
    )
    result = solve(problem, linear_solver=linear_solver, max_iterations=200)
    if result.status is Status.INTERRUPTED:
        raise KeyboardInterrupt
    return result.uv[: len(V)] if result.injective else None
