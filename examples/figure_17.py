"""Figure 17: two points of a square change places, at ever finer grids; and two small disks in their stead
===========================================================================================================

The paper's si-log succeeds up to 140 × 140 cells and fails at 160 × 160. With larger steps and less momentum, and
without being told which parameterisation to take, we get through at every size, and with ``--finest`` at 320 squared.
From 80 squared on a coarse mesh is solved first: some 400 iterations, but cheap ones, and 0.6 s at 160 squared. On the
mesh itself, with ``strategy=[VectorAdam(parameterisation="si-log")]``, it is 90, 132, 151 and 192 iterations at 20, 40,
80 and 160 squared. That does grow, about as the logarithm of the size, since a point held in the plane is no boundary
to a Laplacian.

Disks of radius 0.055 in place of the points, as §10.3 suggests, make the iterations independent of the size: on the
mesh itself 312, 194, 225 and 208. (On the coarsest grid a disk is five vertices and the gap between them tight.)
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


def swapped(cells: int, radius: float = 0.0) -> Problem:
    """The unit square in ``cells``² cells; the vertices within ``radius`` of two places, one at least, swapped."""
    V, F = surfaces.grid(cells, cells)
    (loop,) = boundary_loops(F, len(V))
    away = np.linalg.norm(V[:, None] - PLACES, axis=2)
    nearest = np.argmin(away, axis=0)
    # As both places have the same pattern of vertices around them, the handles are alike.
    move = V[nearest[1]] - V[nearest[0]]
    handles = [np.flatnonzero(np.linalg.norm(V - V[i], axis=1) <= radius) for i in nearest]
    fixed = np.concatenate([loop, *handles])
    return Problem(V, F, fixed, np.vstack([V[loop], V[handles[0]] + move, V[handles[1]] - move]))


def draw(ax: Axes, problem: Problem, uv: FloatArray, title: str, radius: float) -> None:
    """A map with its two points, or circles around its two disks."""
    show(ax, problem, uv, title, pins=not radius)
    for handle in np.split(problem.target[-len(problem.domain.pins) :], 2) if radius else ():
        ax.add_patch(Circle(tuple(handle.mean(axis=0)), radius, fill=False, color="white", lw=2, zorder=6))


def main(output: Path, size: int = 160, finest: bool = False) -> dict[str, Any]:
    sizes = [s for s in (20, 40, 80, 160) if s <= size] + [320] * finest
    figure, axes = panels(2, 3, (3.6, 3.9))
    numbers: dict[str, Any] = {}
    # Disks take as many iterations on one grid as on another; the larger ones add time and little else.
    plans = ("points", 0.0, sizes), ("disks", RADIUS, sizes if finest else [s for s in sizes if s <= 80])
    for row, (what, radius, grids) in zip(axes, plans, strict=True):
        for cells in grids:
            problem = swapped(cells, radius)
            result = solve(problem)
            numbers[f"{what}, {cells} × {cells}"] = {
                "held": len(problem.domain.pins),
                "first guess": result.history[0].inverted,
                "flips": len(result.certificate.inverted),
                "iterations": result.iterations,
                "stages": [stage.name for stage in result.stages],
                "seconds": round(result.seconds, 1),
                "max σ₁/σ₂": float(f"{ratios(problem, result.uv)[0].max():.3g}"),
            }
            if cells == 20:
                draw(row[0], problem, quasi_harmonic_map(problem), f"{what}: first guess", radius)
                draw(row[1], problem, result.uv, f"{cells} × {cells}: {result.iterations} iterations", radius)
        draw(row[2], problem, result.uv, f"{cells} × {cells}: {result.iterations} iterations", radius)
    save(figure, output, "figure_17")
    return numbers


if __name__ == "__main__":
    run(main)
