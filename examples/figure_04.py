"""Figure 4: a rectangle turned by π in a ring
==============================================

Rings of several widths, each by several functionals. The diagnosis proves that three rings have no map. ``--full``
runs all combinations.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from common import panels, ring, run, save, show
from quasiharmonic import MapResult, Problem, Status, solve
from quasiharmonic.solver.methods import Newton, VectorAdam

Hole = tuple[float, float, float, float]


def rectangle(half_width: float, half_height: float, x: float = 0.0, y: float = 0.0) -> Hole:
    """A rectangular hole centred at (x, y)."""
    return x - half_width, y - half_height, x + half_width, y + half_height


CASES: dict[str, tuple[int, Hole]] = {
    "strip 0.75 wide, 9 layers": (24, rectangle(0.25, 0.25)),
    "strip 0.5, 6 layers": (24, rectangle(0.5, 0.5)),
    "strip 0.5, 2 layers": (8, rectangle(0.5, 0.5)),
    "strip 0.5, 12 layers": (48, rectangle(0.5, 0.5)),
    "strip 0.3, 4 layers": (24, rectangle(0.7, 0.7)),
    "strip 0.2, 5 layers": (48, rectangle(0.8, 0.8)),
    "off-centre, 3 layers at the corner": (24, rectangle(0.25, 0.25, 0.5, 0.5)),
    "off-centre, 2 layers": (24, rectangle(0.25, 0.25, 0.6, 0.6)),
    "off-centre, 4 layers": (48, rectangle(0.25, 0.25, 0.6, 0.6)),
    "hole 1 × 1/8, 8 layers": (32, rectangle(0.5, 0.0625)),
    "hole 1.5 × 0.5, 3 layers": (24, rectangle(0.75, 0.25)),
    "hole 1.8 × 0.5, 2 layers": (16, rectangle(0.9, 0.25)),
    "strip 0.1, 5 layers": (96, rectangle(0.9, 0.9)),
    "strip 0.05, 5 layers": (200, rectangle(0.95, 0.95)),
}
NAMES = {"V₃": "dirichlet", "V₂": "sobolev", "V₁": "neumann", "V₄": "poisson"}
COLUMNS = [f"{name} {parameterisation}" for name in NAMES for parameterisation in ("tanh", "si-log")]
# All eight combinations run on the first ring, and these on the other rings.
USUAL = ["V₃ tanh", "V₃ si-log", "V₂ si-log", "V₁ si-log"]
DRAWN = ["strip 0.5, 12 layers", "strip 0.2, 5 layers", "off-centre, 4 layers", "hole 1.5 × 0.5, 3 layers"]


def search(problem: Problem, column: str) -> MapResult:
    """Descend a functional for 100 iterations (tanh) or 300 (si-log), then run Newton's method on V₃ with tanh."""
    name, parameterisation = column.split()
    steps = 100 if parameterisation == "tanh" else 300
    first = VectorAdam(functional=NAMES[name], parameterisation=parameterisation, iterations=steps)
    return solve(problem, strategy=[first, Newton(iterations=400, resume=True)])


def outcome(result: MapResult) -> str:
    """The text of a table cell: iterations, or what is left to untangle."""
    if result.injective:
        return f"{result.n_iterations}"
    return "none exists" if result.status is Status.IMPOSSIBLE else f"{len(result.certificate.inverted)} inverted"


def main(output: Path, size: int = 12, full: bool = False) -> dict[str, Any]:
    numbers: dict[str, Any] = {}
    maps = {}
    for name, (cells, hole) in list(CASES.items())[:size]:
        problem = ring(cells, hole, np.pi)
        first = search(problem, COLUMNS[0])
        columns = COLUMNS if full or not numbers else USUAL
        if first.status is Status.IMPOSSIBLE:
            columns = COLUMNS[:1]
        row = {COLUMNS[0]: first} | {column: search(problem, column) for column in columns[1:]}
        numbers[name] = {"triangles": len(problem.F)} | {column: outcome(result) for column, result in row.items()}
        if name in DRAWN:
            maps[name] = problem, first.uv
    figure, axes = panels(3, len(DRAWN), (3.2, 3.4))
    for (above, below, _), (name, (problem, uv)) in zip(zip(*axes, strict=True), maps.items(), strict=False):
        show(above, problem, uv, name)
        show(below, problem, uv, "")
        below.triplot(*uv.T, problem.F, color="white", lw=0.4)
        below.set_title("a corner of the hole, × 17", size=10)
        corner = problem.target[np.argmax(problem.target @ (1, 1) * (np.abs(problem.target).max(axis=1) < 1))]
        below.set(xlim=corner[0] + np.array((-0.09, 0.03)), ylim=corner[1] + np.array((-0.09, 0.03)))
    for ax in axes[2]:
        ax.remove()
    table(figure, numbers)
    save(figure, output, "figure_04")
    return numbers


def table(figure: Figure, numbers: dict[str, Any]) -> None:
    """Draw the table of iterations to the first injective map, or of remaining inverted triangles."""
    ax = figure.add_axes((0.27, 0.01, 0.72, 0.3))
    ax.set_axis_off()
    cells = [[row.get(column, "") for column in COLUMNS] for row in numbers.values()]
    rows = [f"{name} ({row['triangles']:,})" for name, row in numbers.items()]
    drawn = ax.table(cells, rowLabels=rows, colLabels=COLUMNS, loc="upper center", cellLoc="center")
    drawn.auto_set_font_size(False)
    drawn.set_fontsize(9)
    drawn.scale(1, 1.15)
    colors = {"": "white", "exists": "0.85", "inverted": "#f6b8bf"}
    for (i, j), cell in drawn.get_celld().items():
        cell.set_edgecolor("0.8")
        if i > 0 and j >= 0:
            words = cells[i - 1][j].split()
            cell.set_facecolor(
                next((colors[word] for word in words if word in colors), "#c8e8d0" if words else "white")
            )


if __name__ == "__main__":
    run(main)
