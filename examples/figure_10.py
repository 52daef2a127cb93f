"""Figure 10: five surfaces onto six letters, by L-BFGS alone
===========================================================

In the paper L-BFGS with si-log finds injective maps of thirty shapes onto letters from V₃, V₄ and V₁. This example
reproduces that for V₃, except for a few of the thirty, and not for V₄ and V₁. The table counts problems solved of 30,
with at most 600 evaluations and L-BFGS alone. In parentheses is the largest number of iterations of a solved problem.
*small* are 1,258 to 2,820 triangles, *large* 9,198 to 21,212, the *scans* 19,996 to 40,006 (not shipped):

====================== ========= ========= =========
functional             small     large     scans
====================== ========= ========= =========
V₃, tanh               30 (413)  29 (151)  27 (515)
V₃, si-log             26 (554)  28 (477)
V₃, si-log, rest pose  6 (372)
V₁, tanh               11 (554)
V₁, si-log             15 (254)
V₄, tanh               0
V₄, si-log             1 (4)
V₄ by edges, tanh      29 (101)
====================== ========= ========= =========

All rows use equilateral reference triangles except the third, which uses the surface's own triangles, as the paper
does. There limbs shrink to tiny areas, and the triangles that stay inverted are too small to affect V₃. On A their
median area is 5e-14 of the total for the angel, 1e-15 for the rabbit and 5e-18 for the hand. Their number is the same
on every letter. V₁ with si-log leaves 1 to 9 triangles. V₄ in linear elements becomes negative. In Crouzeix-Raviart
elements it behaves like V₃ (`edge_elements`).

The drawn maps are those of V₃ with tanh. On the rabbit onto H it leaves three inverted triangles at the concave corners
of the bar, each with a ten-millionth of the area, and one after 4,000 evaluations. `speed` takes 17 iterations, on a
coarse mesh. Three scans keep 4 to 8 inverted triangles. More evaluations solve two of them: David onto H takes 1,623
and the gargoyle onto H 1,472. The bunny onto G is not solved by 3,000.

``benchmarks/letters_alone.py`` lists all runs.
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
from letters_alone import LETTERS, RECORDS, by_kind, read

SURFACES = "angel", "gargoyle", "rabbit", "bust", "hand"


def main(output: Path, size: int = 64, surfaces: int = 5, iterations: int = 600) -> dict[str, Any]:
    figure, axes = panels(surfaces, len(LETTERS), (2.6, 3.1))
    drawn = {"of": 0, "solved": 0, "most iterations": 0}
    numbers: dict[str, Any] = {"drawn": drawn, "recorded": by_kind(read(RECORDS))}
    for row, surface in zip(axes, SURFACES, strict=False):
        V, F = sculpture(surface, size)
        for ax, letter in zip(row, LETTERS, strict=True):
            problem = Problem(V, F, *targets.boundary_to(V, F, targets.filled(targets.letter(letter))))
            result = solve(problem, strategy=[LBFGS(iterations=iterations)], max_iterations=iterations)
            show(ax, problem, result.uv, f"{surface}, {result.iterations} iterations", size=8)
            drawn["of"] += 1
            if result.injective:
                drawn["solved"] += 1
                drawn["most iterations"] = max(drawn["most iterations"], result.iterations)
            numbers[f"{surface} onto {letter}"] = {
                "triangles": len(F),
                "iterations": result.iterations,
                "flips": len(result.certificate.inverted) + len(result.certificate.degenerate),
                "MIPS": round(mips(problem, result.uv), 2) if result.injective else None,
            }
    save(figure, output, "figure_10")
    return numbers


if __name__ == "__main__":
    run(main)
