"""Table 2: MIPS on letters
===========================

MIPS of si-log's first map, of a quasi-harmonised map, and of a map by SBP's energy. ``benchmarks/records/letters.csv``
has SBP's own results on other meshes.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

from common import colorbar, first_map, flips, mips, panels, run, save, show_ratios
from quasiharmonic import distortion, harmonise, polish, solve
from sculptures import seven

COLUMNS = ("SBP's energy", "si-log", "tanh + MIPS")


def main(output: Path, size: int = 48, problems: int = 7) -> dict[str, Any]:
    figure, axes = panels(len(COLUMNS), 1 + problems, (1.8, 2.1))
    numbers: dict[str, Any] = {}
    for j, (name, problem) in enumerate(seven(size, problems).items()):
        tanh, si_log = solve(problem).uv, first_map(problem, "si-log").uv
        maps = dict(
            zip(
                COLUMNS,
                (
                    polish(problem.V, problem.F, tanh, fixed=problem.fixed, energy="blend").uv,
                    si_log,
                    harmonise(problem.V, problem.F, tanh, fixed=problem.fixed, energy="mips", conformal=0).uv,
                ),
                strict=True,
            )
        )
        numbers[name] = {"triangles": len(problem.F), "tanh": round(mips(problem, tanh), 3)}
        for i, (column, uv) in enumerate(maps.items()):
            drawn = show_ratios(axes[i][1 + j], problem, uv, f"{name[-1]}: {mips(problem, uv):.3g}", 20)
            worst = distortion(problem.V, problem.F, uv).statistics("isometric").maximum
            numbers[name][column] = {
                "flips": flips(problem, uv),
                "MIPS": round(mips(problem, uv), 3),
                "max(σ₁, 1/σ₂)": float(f"{worst:.3g}"),
            }
    for (ax, *_), column in zip(axes, COLUMNS, strict=True):
        ax.set_axis_off()
        ax.text(0.5, 0.5, f"{column}\nMIPS", ha="center", va="center", transform=ax.transAxes)
    colorbar(figure, drawn)
    save(figure, output, "table_2")
    return numbers


if __name__ == "__main__":
    run(main)
