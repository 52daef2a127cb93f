"""Figure 24: areas or angles alone
===================================

The two terms of SBP's energy, minimised by `polish`, by quasi-harmonisation and by `Untangling`. In the paper SBP fails
for areas alone on most letters.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.collections import PolyCollection
from matplotlib.colors import LogNorm

from common import INK, RED, colorbar, first_map, flips, mips, panels, run, save
from quasiharmonic import Problem, distortion, harmonise, polish, solve
from quasiharmonic.energies.energies import conformal_area_blend
from quasiharmonic.solver.methods import Untangling, VectorAdam
from quasiharmonic.util.arrays import FloatArray
from sculptures import seven

COLUMNS = "bust onto A", "rabbit onto R", "gargoyle onto H"


def maps_of(problem: Problem) -> dict[str, FloatArray]:
    """The maps to compare, by name."""
    first = solve(problem, strategy=[VectorAdam(iterations=600)]).uv
    return {
        "θ = 1: areas": polish(problem.V, problem.F, first, fixed=problem.fixed, energy=conformal_area_blend(1.0)).uv,
        "(σ₁σ₂ − 1)² and V₃": harmonise(problem.V, problem.F, first, fixed=problem.fixed, energy="area").uv,
        "θ = 0: angles": polish(problem.V, problem.F, first, fixed=problem.fixed, energy="mips").uv,
        "si-log's first": first_map(problem, "si-log").uv,
        "SBP's energy, our way": solve(problem, strategy=[Untangling()]).uv,
    }


def show_areas(ax: Axes, problem: Problem, uv: FloatArray, title: str) -> PolyCollection:
    """Draw a map coloured by its area ratio, with mean 1, and return the collection for a colour bar."""
    ratio = distortion(problem.V, problem.F, uv).area_ratio
    drawn = PolyCollection(
        uv[problem.F], array=ratio, cmap="RdBu_r", norm=LogNorm(0.1, 10), edgecolors="face", lw=0.3, snap=False
    )
    ax.add_collection(drawn)
    ax.autoscale_view()
    ax.set_aspect("equal")
    ax.set_axis_off()
    ax.set_title(title, size=9, color=RED if flips(problem, uv) else INK)
    return drawn


def main(output: Path, size: int = 40) -> dict[str, Any]:
    figure, axes = panels(len(COLUMNS), 5, (2.6, 3.0))
    numbers: dict[str, Any] = {}
    for row, name in zip(axes, COLUMNS, strict=True):
        problem = seven(size)[name]
        found: dict[str, Any] = {"triangles": len(problem.F)}
        for ax, (title, uv) in zip(row, maps_of(problem).items(), strict=True):
            d = distortion(problem.V, problem.F, uv)
            off = float(d.share @ np.abs(d.area_ratio - 1))
            drawn = show_areas(ax, problem, uv, f"{title}\nareas off by {off:.2g}, MIPS {mips(problem, uv):.3g}")
            found[title] = {
                "flips": flips(problem, uv),
                "areas off by": round(off, 4),
                "MIPS": round(mips(problem, uv), 3),
                "max(σ₁, 1/σ₂)": float(f"{d.statistics('isometric').maximum:.3g}"),
            }
        numbers[name] = found
    colorbar(figure, drawn, "area over area at rest", "both")
    save(figure, output, "figure_24")
    return numbers


if __name__ == "__main__":
    run(main)
