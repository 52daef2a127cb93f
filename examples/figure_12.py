"""Figure 12: a sheared rectangle
=================================

si-log distributes distortion evenly; tanh concentrates it at the concave corner. The paper shows TLC instead of tanh.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from common import COLORS, colorbar, first_map, flips, mips, panels, ratios, run, save, show_ratios
from quasiharmonic import Problem, boundary_loops, polish, quasi_harmonic_map, surfaces

SLOPE = 2.0


def wedge(size: int) -> Problem:
    """The rectangle [-1, 1] × [0, 1], ``size`` cells high, with its boundary displaced by SLOPE · |x|."""
    V, F = surfaces.grid(2 * size, size)
    V = (V - (0.5, 0)) * (2, 1)
    (loop,) = boundary_loops(F, len(V))
    return Problem(V, F, loop, V[loop] + SLOPE * np.abs(V[loop, :1]) * (0, 1))


def main(output: Path, size: int = 32) -> dict[str, Any]:
    problem = wedge(size)
    runs = {name: first_map(problem, name) for name in ("tanh", "si-log")}
    maps = {name: result.uv for name, result in runs.items()}
    maps["least MIPS"] = polish(problem.V, problem.F, maps["si-log"], fixed=problem.fixed, energy="mips").uv
    shear = 1 + SLOPE**2 / 2 + SLOPE * np.sqrt(1 + SLOPE**2 / 4)
    figure, axes = panels(2, 3, (3.6, 3.9))
    harmonic = quasi_harmonic_map(problem, reference="rest")
    numbers: dict[str, Any] = {
        "triangles": len(problem.F),
        "harmonic": flips(problem, harmonic),
        "plain shear": round(shear, 3),
    }
    colors = {**COLORS, "least MIPS": (0.35, 0.55, 0.25)}
    for k, (name, uv) in enumerate(maps.items()):
        ratio, _ = ratios(problem, uv)
        drawn = show_ratios(axes[0][k], problem, uv, f"{name}: MIPS {mips(problem, uv):.2f}", 50)
        below = axes[1][k]
        below.set_position(((k + 0.18) / 3, 0.07, 0.76 / 3, 0.36))
        below.hist(ratio, bins=np.geomspace(1, 1000, 91), color=colors[name])
        below.axvline(shear, color="black", lw=0.8, ls=":")
        below.set(xscale="log", yscale="log", ylim=(0.7, len(problem.F)), xlabel="σ₁/σ₂", ylabel="triangles")
        numbers[name] = {
            "flips": flips(problem, uv),
            "MIPS": round(mips(problem, uv), 3),
            "quartiles": [round(float(q), 2) for q in np.percentile(ratio, (25, 50, 75))],
            "99 % below": round(float(np.percentile(ratio, 99)), 1),
            "max": round(float(ratio.max()), 1),
        }
    for name, result in runs.items():
        numbers[name]["iterations"] = result.n_iterations
    colorbar(figure, drawn)
    save(figure, output, "figure_12")
    return numbers


if __name__ == "__main__":
    run(main)
