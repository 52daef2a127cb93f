"""Figure 11: a point moved inside a rectangle
==============================================

si-log keeps the largest σ₁/σ₂ small. The map of least MIPS concentrates it at the point, as in the paper.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from common import colorbar, first_map, flips, mips, panels, ratios, run, save, show, show_ratios
from quasiharmonic import Problem, boundary_loops, polish, quasi_harmonic_map, surfaces

MOVE = 0.5


def moved_point(size: int) -> Problem:
    """A 2 × 1 rectangle, ``size`` cells high, whose middle moves a quarter of the width to the left."""
    V, F = surfaces.grid(2 * size, size)
    V = V * (2, 1)
    (loop,) = boundary_loops(F, len(V))
    middle = int(np.argmin(np.linalg.norm(V - (1, 0.5), axis=1)))
    return Problem(V, F, np.append(loop, middle), np.vstack([V[loop], V[middle] - (MOVE, 0)]))


def main(output: Path, size: int = 40) -> dict[str, Any]:
    problem = moved_point(size)
    harmonic = quasi_harmonic_map(problem, reference="rest")
    runs = {name: first_map(problem, name) for name in ("si-log", "tanh")}
    maps = {f"{name}: {r.n_iterations} iterations": r.uv for name, r in runs.items()}
    maps["si-log, then least MIPS"] = polish(
        problem.V, problem.F, runs["si-log"].uv, fixed=problem.fixed, energy="mips"
    ).uv
    figure, axes = panels(2, 2, (5.4, 3.4))
    show(axes[0][0], problem, harmonic, "harmonic")
    numbers: dict[str, Any] = {"triangles": len(problem.F), "harmonic": flips(problem, harmonic)}
    for ax, (name, uv) in zip([*axes[0][1:], *axes[1]], maps.items(), strict=True):
        ratio, _ = ratios(problem, uv)
        left = flips(problem, uv)
        how = f"{name}, by polishing" if "then" in name else name
        title = f"{how}\n" + (f"{left} inverted" if left else f"σ₁/σ₂ up to {ratio.max():.1f}")
        drawn = show_ratios(ax, problem, uv, title, 20)
        ax.plot(*uv[problem.domain.pins].T, "o", color="white", mec="black", markersize=5)
        numbers[name.split(":")[0]] = {
            "flips": left,
            "MIPS": round(mips(problem, uv), 3),
            "median σ₁/σ₂": round(float(np.median(ratio)), 2),
            "max": round(float(ratio.max()), 1),
        }
    for name, result in runs.items():
        numbers[name]["iterations"] = result.n_iterations
    colorbar(figure, drawn)
    save(figure, output, "figure_11")
    return numbers


if __name__ == "__main__":
    run(main)
