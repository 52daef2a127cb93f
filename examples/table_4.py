"""Table 4: angles or sizes
===========================

First maps preserve angles and not sizes, as in the paper. Polishing by symmetric Dirichlet lowers the isometric
distortion and raises MIPS.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from common import COLORS, first_map, flips, mips, panels, run, save
from quasiharmonic import distortion, polish
from sculptures import seven

COLUMNS = {
    "si-log, first map": COLORS["si-log"],
    "then least MIPS": (0.35, 0.55, 0.25),
    "then symmetric Dirichlet": COLORS["tanh"],
}


def main(output: Path, size: int = 48, problems: int = 7) -> dict[str, Any]:
    numbers: dict[str, Any] = {}
    for name, problem in seven(size, problems).items():
        first = first_map(problem, "si-log")
        row: dict[str, Any] = {"triangles": len(problem.F), "iterations": first.n_iterations}
        maps = [
            first.uv,
            *(
                polish(problem.V, problem.F, first.uv, fixed=problem.fixed, energy=e).uv
                for e in ("mips", "symmetric-dirichlet")
            ),
        ]
        for column, uv in zip(COLUMNS, maps, strict=True):
            isometric = distortion(problem.V, problem.F, uv).statistics("isometric")
            row[column] = {
                "flips": flips(problem, uv),
                "MIPS": round(mips(problem, uv), 3),
                "isometric": float(f"{isometric.maximum:.3g}"),
            }
        numbers[name] = row
    figure, (axes,) = panels(1, 2, (5.6, 4.4))
    places = np.arange(len(numbers))[::-1]
    for k, (ax, column) in enumerate(zip(axes, ("MIPS", "isometric"), strict=True)):
        ax.set_position((0.13 + 0.45 * k, 0.13, 0.41, 0.75))
        for name, color in COLUMNS.items():
            ax.plot([row[name][column] for row in numbers.values()], places, "o", color=color, ms=8, label=name)
        ax.set_yticks(places, list(numbers) if k == 0 else [], size=8)
        ax.set(xscale="log", xlabel=("MIPS energy", "largest max(σ₁, 1/σ₂)")[k])
        ax.grid(axis="x", alpha=0.3)
    axes[1].legend(loc="lower right", fontsize=8)
    figure.suptitle("angles (left) and sizes (right), of the same maps", size=10)
    save(figure, output, "table_4")
    return numbers


if __name__ == "__main__":
    run(main)
