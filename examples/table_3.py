"""Table 3: CPU time on letters
===============================

tanh and si-log on seven generated surfaces. ``benchmarks/records/letters.csv`` has the times of SBP and TLC on other
meshes.
"""

from __future__ import annotations

from pathlib import Path
from time import perf_counter
from typing import Any

import numpy as np

from common import COLORS, panels, run, save
from quasiharmonic import Problem, quasi_harmonic_map, solve
from quasiharmonic.solver.methods import VectorAdam
from sculptures import seven

STAGES = {
    "tanh": VectorAdam(iterations=1000),
    "si-log": VectorAdam(parameterisation="si-log", reference="corrected", iterations=1000),
}


def afresh(problem: Problem) -> Problem:
    """A copy of the problem without cached results."""
    return Problem(problem.V, problem.F, problem.fixed, problem.target)


def main(output: Path, size: int = 80, problems: int = 7) -> dict[str, Any]:
    numbers: dict[str, Any] = {}
    for name, problem in seven(size, problems).items():
        quasi_harmonic_map(problem)  # import lazily loaded modules before timing
        start = perf_counter()
        quasi_harmonic_map(afresh(problem))
        row: dict[str, Any] = {"triangles": len(problem.F), "Tutte": {"seconds": round(perf_counter() - start, 3)}}
        for column, stage in STAGES.items():
            start = perf_counter()
            result = solve(afresh(problem), strategy=[stage])
            row[column] = {
                "seconds": round(perf_counter() - start, 3),
                "iterations": result.n_iterations,
                "flips": len(result.certificate.inverted),
            }
        numbers[name] = row
    figure, ((ax,),) = panels(1, 1, (8.0, 4.6))
    ax.set_position((0.22, 0.13, 0.74, 0.76))
    places = np.arange(len(numbers))[::-1]
    colors = {"Tutte": (0.6, 0.6, 0.6), **COLORS}
    for k, (column, color) in enumerate(colors.items()):
        seconds = [row[column]["seconds"] for row in numbers.values()]
        ax.barh(places + 0.27 * (1 - k), seconds, 0.25, color=color, label=column)
        for place, row in zip(places, numbers.values(), strict=True):
            words = f"{row[column]['seconds']:.2f} s" + (
                f", {row[column]['iterations']} it." if column in STAGES else ""
            )
            ax.text(row[column]["seconds"] * 1.08, place + 0.27 * (1 - k), words, va="center", size=7)
    ax.set_yticks(places, [f"{name}\n({row['triangles']:,})" for name, row in numbers.items()], size=8)
    ax.set(xscale="log", xlabel="seconds on one core, everything included")
    ax.set_xlim(right=3 * ax.get_xlim()[1])
    ax.set_title("Tutte's embedding, and the first injective maps of tanh and si-log", size=10)
    ax.legend(loc="lower right")
    save(figure, output, "table_3")
    return numbers


if __name__ == "__main__":
    run(main)
