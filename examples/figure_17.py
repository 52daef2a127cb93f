"""Figure 17: two swapped points
================================

Two points, or two small disks, of a square change places on increasingly fine grids. The paper fails at 160 × 160
cells; here all grids have a map.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.patches import Circle

from common import FloatArray, panels, ratios, run, save, show
from quasiharmonic import Problem, boundary_loops, quasi_harmonic_map, solve, surfaces

PLACES = np.array([(1 / 3, 0.5), (2 / 3, 0.5)])
RADIUS = 0.055


def swap_points(cells: int, radius: float = 0.0) -> Problem:
    """The unit square in ``cells``² cells, with the vertices near two points swapped.

    For each point these are all vertices within ``radius``, or the nearest one.
    """
    V, F = surfaces.grid(cells, cells)
    (loop,) = boundary_loops(F, len(V))
    away = np.linalg.norm(V[:, None] - PLACES, axis=2)
    nearest = np.argmin(away, axis=0)
    # Both points have the same pattern of vertices around them, so one translation maps one set onto the other.
    move = V[nearest[1]] - V[nearest[0]]
    handles = [np.flatnonzero(np.linalg.norm(V - V[i], axis=1) <= radius) for i in nearest]
    fixed = np.concatenate([loop, *handles])
    return Problem(V, F, fixed, np.vstack([V[loop], V[handles[0]] + move, V[handles[1]] - move]))


def draw(ax: Axes, problem: Problem, uv: FloatArray, title: str, radius: float) -> None:
    """Draw a map with its two points, or with circles around its two disks."""
    show(ax, problem, uv, title, pins=not radius)
    for handle in np.split(problem.target[-len(problem.domain.pins) :], 2) if radius else ():
        ax.add_patch(Circle(tuple(handle.mean(axis=0)), radius, fill=False, color="white", lw=2, zorder=6))


def main(output: Path, size: int = 160, finest: bool = False) -> dict[str, Any]:
    sizes = [s for s in (20, 40, 80, 160) if s <= size] + [320] * finest
    figure, axes = panels(2, 3, (3.6, 3.9))
    numbers: dict[str, Any] = {}
    # The iterations with disks do not depend on the grid, so the larger grids are left to ``--finest``.
    plans = ("points", 0.0, sizes), ("disks", RADIUS, sizes if finest else [s for s in sizes if s <= 80])
    for row, (what, radius, grids) in zip(axes, plans, strict=True):
        for cells in grids:
            problem = swap_points(cells, radius)
            result = solve(problem)
            numbers[f"{what}, {cells} × {cells}"] = {
                "held": len(problem.domain.pins),
                "first guess": result.history[0].inverted,
                "flips": len(result.certificate.inverted),
                "iterations": result.n_iterations,
                "stages": [stage.name for stage in result.stages],
                "seconds": round(result.seconds, 1),
                "max σ₁/σ₂": float(f"{ratios(problem, result.uv)[0].max():.3g}"),
            }
            if cells == 20:
                draw(row[0], problem, quasi_harmonic_map(problem), f"{what}: first guess", radius)
                draw(row[1], problem, result.uv, f"{cells} × {cells}: {result.n_iterations} iterations", radius)
        draw(row[2], problem, result.uv, f"{cells} × {cells}: {result.n_iterations} iterations", radius)
    save(figure, output, "figure_17")
    return numbers


if __name__ == "__main__":
    run(main)
