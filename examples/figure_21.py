"""Figure 21: surfaces mapped to the disk
=========================================

By an area-preserving energy, si-log and ARAP. si-log compresses tall parts into a point; the others give them space.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from common import first_map, flips, mips, onto, panels, run, save, show
from quasiharmonic import distortion, harmonise, solve, surfaces, targets
from sculptures import sculpture

SURFACES = "cat", "angel", "gargoyle", "rabbit", "bust", "hand"


def main(output: Path, size: int = 40) -> dict[str, Any]:
    figure, axes = panels(3, len(SURFACES), (2.4, 2.9))
    numbers: dict[str, Any] = {}
    for column, name in zip(zip(*axes, strict=True), SURFACES, strict=True):
        V, F = surfaces.cat(size // 2) if name == "cat" else sculpture(name, size)
        problem = onto(V, F, targets.disk())
        first = solve(problem).uv
        maps = {
            "area-preserving": harmonise(
                problem.V, problem.F, first, fixed=problem.fixed, energy="area", conformal=0
            ).uv,
            "si-log": first_map(problem, "si-log").uv,
            "ARAP": harmonise(problem.V, problem.F, first, fixed=problem.fixed, energy="arap").uv,
        }
        numbers[name] = {"triangles": len(F)}
        for ax, (title, uv) in zip(column, maps.items(), strict=True):
            show(ax, problem, uv, f"{name}, {title}")
            found = distortion(V, F, uv)
            numbers[name][title] = {
                "flips": flips(problem, uv),
                "MIPS": round(mips(problem, uv), 3),
                "ARAP": round(found.statistics("arap").mean, 3),
                "areas off by": round(float(found.share @ np.abs(found.area_ratio - 1)), 4),
            }
    save(figure, output, "figure_21")
    return numbers


if __name__ == "__main__":
    run(main)
