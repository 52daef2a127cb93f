"""Figure 10: five surfaces onto six letters, by L-BFGS
=======================================================

V₃ solves most of the thirty problems, V₁ and V₄ few; in the paper all three solve all.
``benchmarks/records/letters_alone.csv`` has all runs.
"""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Any

from common import BENCHMARKS, mips, panels, run, save, show
from quasiharmonic import Problem, solve, targets
from quasiharmonic.solver.methods import LBFGS
from sculptures import sculpture

sys.path.append(str(BENCHMARKS))
from recorded import LETTERS, letters_by_kind, read_letters_alone

SURFACES = "angel", "gargoyle", "rabbit", "bust", "hand"


def main(output: Path, size: int = 64, surfaces: int = 5, iterations: int = 600) -> dict[str, Any]:
    figure, axes = panels(surfaces, len(LETTERS), (2.6, 3.1))
    drawn = {"of": 0, "solved": 0, "most iterations": 0}
    numbers: dict[str, Any] = {"drawn": drawn, "recorded": letters_by_kind(read_letters_alone())}
    for row, surface in zip(axes, SURFACES, strict=False):
        V, F = sculpture(surface, size)
        for ax, letter in zip(row, LETTERS, strict=True):
            problem = Problem(V, F, *targets.boundary_to(V, F, targets.filled(targets.letter(letter))))
            result = solve(problem, strategy=[LBFGS(iterations=iterations)], max_iterations=iterations)
            show(ax, problem, result.uv, f"{surface}, {result.n_iterations} iterations", size=8)
            drawn["of"] += 1
            if result.injective:
                drawn["solved"] += 1
                drawn["most iterations"] = max(drawn["most iterations"], result.n_iterations)
            numbers[f"{surface} onto {letter}"] = {
                "triangles": len(F),
                "iterations": result.n_iterations,
                "flips": len(result.certificate.inverted) + len(result.certificate.degenerate),
                "MIPS": round(mips(problem, result.uv), 2) if result.injective else None,
            }
    save(figure, output, "figure_10")
    return numbers


if __name__ == "__main__":
    run(main)
