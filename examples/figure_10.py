"""Figure 10: five surfaces onto six letters, by L-BFGS alone
===========================================================

In the paper L-BFGS with si-log finds injective maps of thirty shapes onto letters from V₃, V₄ and V₁ alike. That does
not come out here. Five surfaces of our own, 1,258 to 2,820 triangles, onto the six letters, at most 600 iterations and
no help from any other method:

=================== ====== ===============
functional          solved most iterations
=================== ====== ===============
V₃, tanh            29     104
V₃, si-log          10     214
V₁, si-log          7      355
V₄, si-log          1      4
V₄ by edges, si-log 11     521
=================== ====== ===============

With tanh V₃ leaves one triangle, of the rabbit onto H, for which `speed` finds a map. With si-log the bust and the
hand are solved for the most part, the angel, the gargoyle and the rabbit on no letter: 2 to 46 triangles stay
inverted, on most letters the same number, whichever the functional. V₄ in linear elements goes below zero; in Crouzeix
and Raviart's it does as V₃ does (`edge_elements`). The maps drawn are those of V₃ with tanh.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

from common import mips, panels, run, save, show
from quasiharmonic import Problem, solve, targets
from quasiharmonic.descent import LBFGS
from sculptures import sculpture

SURFACES = "angel", "gargoyle", "rabbit", "bust", "hand"
LETTERS = "GSRAPH"
#: Functional, parameterisation and reference triangles of each column.
COLUMNS = {
    "V₃ tanh": ("dirichlet", "tanh", "equilateral"),
    "V₃": ("dirichlet", "si-log", "corrected"),
    "V₁": ("neumann", "si-log", "corrected"),
    "V₄": ("poisson", "si-log", "corrected"),
    "V₄ by edges": ("edge-poisson", "si-log", "corrected"),
}


def main(output: Path, size: int = 24, surfaces: int = 5, iterations: int = 600) -> dict[str, Any]:
    figure, axes = panels(surfaces, len(LETTERS), (2.6, 3.1))
    numbers: dict[str, Any] = {column: {"solved": 0, "most iterations": 0} for column in COLUMNS}
    for row, surface in zip(axes, SURFACES, strict=False):
        V, F = sculpture(surface, size)
        for ax, letter in zip(row, LETTERS, strict=True):
            problem = Problem(V, F, *targets.boundary_to(V, F, targets.filled(targets.letter(letter))))
            cell: dict[str, Any] = {"triangles": len(F)}
            shown = None
            for column, (functional, parameterisation, reference) in COLUMNS.items():
                stage = LBFGS(
                    functional=functional,
                    parameterisation=parameterisation,
                    reference=reference,
                    iterations=iterations,
                )
                result = solve(problem, strategy=[stage])
                shown = shown or result
                cell[column] = {
                    "iterations": result.iterations,
                    "flips": len(result.certificate.flipped) + len(result.certificate.degenerate),
                    "MIPS": round(mips(problem, result.uv), 2) if result.injective else None,
                }
                if result.injective:
                    total = numbers[column]
                    total["solved"] += 1
                    total["most iterations"] = max(total["most iterations"], result.iterations)
            failed = [column for column in COLUMNS if cell[column]["flips"]]
            show(ax, problem, shown.uv, f"{surface}; not by " + ", ".join(failed) if failed else surface, size=7)
            numbers[f"{surface} onto {letter}"] = cell
    save(figure, output, "figure_10")
    return numbers


if __name__ == "__main__":
    run(main)
