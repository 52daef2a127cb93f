"""Figure 12: a rectangle whose boundary is displaced upwards by twice |x|; the distribution of σ₁/σ₂
=====================================================================================================

In the paper si-log distributes distortion evenly and TLC concentrates it at the concave corner. This example does not
run TLC, which is another program, and shows tanh's first map instead, which behaves similarly. The dotted line is the
ratio of the plain shear ``(x, y + 2|x|)``, which is 5.83 everywhere.

With si-log, half of all triangles lie between 5.31 and 5.45, and 99 % below 6.7. With tanh, half lie between 5.16 and
5.46, but the tail at the corner puts the 99 % quantile at 44. A map of least MIPS (3.37; si-log 3.64, tanh 4.74) leaves
a disk in the middle nearly conformal. It is less even than si-log: 99 % lie below 7.2. As in Figure 8, si-log's one
outlier, at 480, is the triangle untangled last.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from common import COLORS, colorbar, first_map, flips, mips, panels, ratios, run, save, show_ratios
from quasiharmonic import Problem, boundary_loops, quasi_harmonic_map, surfaces
from quasiharmonic.energies.polishing import polish_map

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
    maps["least MIPS"] = polish_map(problem.domain, maps["si-log"], energy="mips").uv
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
        numbers[name]["iterations"] = result.iterations
    colorbar(figure, drawn)
    save(figure, output, "figure_12")
    return numbers


if __name__ == "__main__":
    run(main)
