"""Figure 10: five surfaces onto six letters, by L-BFGS
=======================================================

V₃ solves most of the thirty problems, V₁ and V₄ few; in the paper all three solve all.
``benchmarks/records/letters_alone.csv`` has all runs.
"""

from __future__ import annotations

import csv
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any, NamedTuple

from common import BENCHMARKS, mips, panels, run, save, show
from quasiharmonic import Problem, solve, targets
from quasiharmonic.solver.methods import LBFGS
from sculptures import sculpture

SURFACES = "angel", "gargoyle", "rabbit", "bust", "hand"
LETTERS = "GSRAPH"
#: Maximum number of triangles of the gallery's surfaces at size 24; at size 64 they have more.
SMALL = 5000


class LetterRun(NamedTuple):
    """L-BFGS alone on one surface and one letter, as stored in `letters_alone.csv`."""

    surface: str
    letter: str
    triangles: int
    column: str
    iterations: int
    flips: int
    mips: str
    cpu_seconds: float


def read_letters_alone(path: Path = BENCHMARKS / "records" / "letters_alone.csv") -> list[LetterRun]:
    """Return the runs of L-BFGS alone."""
    with path.open(newline="", encoding="utf-8") as file:
        return [
            LetterRun(surface, letter, int(triangles), column, int(iterations), int(flips), mips, float(seconds))
            for surface, letter, triangles, column, iterations, flips, mips, seconds in [*csv.reader(file)][1:]
        ]


def summarise_letters(runs: Iterable[LetterRun]) -> dict[str, dict[str, int | float]]:
    """Return for each column the problems solved, their total, the maximum iterations and the CPU seconds."""
    found: dict[str, dict[str, int | float]] = {}
    for one in runs:
        column = found.setdefault(one.column, {"of": 0, "solved": 0, "most iterations": 0, "CPU seconds": 0})
        column["of"] += 1
        column["CPU seconds"] = round(column["CPU seconds"] + one.cpu_seconds, 1)
        if one.flips == 0:
            column["solved"] += 1
            column["most iterations"] = max(column["most iterations"], one.iterations)
    return found


def letters_by_kind(runs: Sequence[LetterRun]) -> dict[str, dict[str, dict[str, int | float]]]:
    """Return the summary separately for small and large gallery surfaces and for scans."""
    groups: dict[str, list[LetterRun]] = {"gallery": [], "gallery, small": [], "scans": []}
    for one in runs:
        scan = one.surface.startswith("scan of ")
        groups["scans" if scan else "gallery" if one.triangles > SMALL else "gallery, small"].append(one)
    return {name: summarise_letters(group) for name, group in groups.items()}


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
