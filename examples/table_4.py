"""Table 4: angles or sizes, seven surfaces onto letters
========================================================

The paper compares si-log with IsoTLC. si-log's MIPS energies are lower on six of seven, all but the gargoyle onto G
(0.4 to 3.7 against 1.6 to 5.7). Its isometric distortion, the largest max(σ₁, 1/σ₂), is far higher (5.7 to 2.6e8
against 0.9 to 6.7). si-log preserves angles but not sizes.

This example agrees: the first maps have MIPS 0.7 to 7.4 and isometric distortion 690 to 3e9. Minimising MIPS lowers the
former to 0.08 to 2.3 and the latter only to 400 or more. Polishing by symmetric Dirichlet raises MIPS to 2.2 to 10 and
lowers the isometric distortion to between 8.7 and 15, with every boundary vertex fixed. IsoTLC, another program, moves
the boundary.

The paper's isometric columns cannot be this maximum itself. For David onto A the paper gives 0.853, but max(σ₁, 1/σ₂)
is at least 1 for every triangle: if σ₁ is below 1, so is σ₂, and 1/σ₂ is above 1. The text does not say what was
subtracted or divided by, so only a qualitative comparison with those columns is possible.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from common import COLORS, first_map, flips, mips, panels, run, save
from quasiharmonic import distortion
from quasiharmonic.energies.polishing import polish_map
from sculptures import seven

COLUMNS = {
    "si-log, first map": COLORS["si-log"],
    "then least MIPS": (0.35, 0.55, 0.25),
    "then symmetric Dirichlet": COLORS["tanh"],
}


def main(output: Path, size: int = 48) -> dict[str, Any]:
    numbers: dict[str, Any] = {}
    for name, problem in seven(size).items():
        first = first_map(problem, "si-log")
        row: dict[str, Any] = {"triangles": len(problem.F), "iterations": first.iterations}
        maps = [first.uv, *(polish_map(problem.domain, first.uv, energy=e).uv for e in ("mips", "symmetric-dirichlet"))]
        for column, uv in zip(COLUMNS, maps, strict=True):
            isometric = distortion(problem.V, problem.F, uv).summary("isometric")
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
