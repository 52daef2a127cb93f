"""Figure 10: seven surfaces onto letters, from four functionals
================================================================

In the paper L-BFGS with si-log finds injective maps of thirty shapes onto letters from V₃, V₄ and V₁ alike. Here are
seven of the kind, from V₃, V₂, V₁ and V₄, each by at most 200 steps of VectorAdam on the functional itself, and then
by Newton's method on V₃ and local repair (§9.2) where triangles are left.

V₃ needs no help: all seven are injective after 5 to 142 iterations. V₂ leaves 1 to 26 triangles on three of seven, V₁
2 to 51 on four, V₄ 1 to 449 on six. With help all but one of the twenty-eight are injective; V₄'s rabbit keeps two
inverted triangles. (L-BFGS instead of VectorAdam takes longer and leaves a few triangles of most, V₃'s included.)
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

from common import mips, panels, run, save, show
from quasiharmonic import solve
from quasiharmonic.descent import Newton, Patches, VectorAdam
from quasiharmonic.plot import plot_surface
from sculptures import seven

NAMES = {"V₃": "dirichlet", "V₂": "sobolev", "V₁": "neumann", "V₄": "poisson"}


def main(output: Path, size: int = 40, rows: int = 7) -> dict[str, Any]:
    problems = dict(list(seven(size).items())[:rows])
    figure, axes = panels(len(problems), 5, (2.7, 3.1))
    numbers: dict[str, Any] = {}
    finish = [
        Newton(parameterisation="si-log", reference="corrected", iterations=60, resume=True),
        Patches(tries=60, resume=True),
    ]
    for row, (name, problem) in zip(axes, problems.items(), strict=True):
        plot_surface(problem.V, problem.F, row[0])
        row[0].set_title(f"{name}\n{len(problem.F):,} triangles", size=9)
        numbers[name] = {}
        for ax, (symbol, functional) in zip(row[1:], NAMES.items(), strict=True):
            own = VectorAdam(parameterisation="si-log", functional=functional, reference="corrected", iterations=200)
            result = solve(problem, strategy=[own, *finish])
            show(ax, problem, result.uv, f"{symbol}, {result.iterations} iterations", size=9)
            numbers[name][symbol] = {
                "iterations": [stage.iterations for stage in result.stages],
                "left by the functional": result.stages[0].flipped[1],
                "flips": len(result.certificate.flipped),
                "MIPS": round(mips(problem, result.uv), 2),
            }
    save(figure, output, "figure_10")
    return numbers


if __name__ == "__main__":
    run(main)
