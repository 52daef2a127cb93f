"""Figure 19: one surface by five energies
==========================================

Every energy starts at the same first map. Each map is the best of the seven in its own energy, and no triangle is
inverted.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from common import flips, panels, run, save, show
from quasiharmonic import harmonise, solve
from quasiharmonic.energies.deformation import DeformationEnergy, signed_areas
from quasiharmonic.solver.methods import VectorAdam
from quasiharmonic.solver.search.harmonising import ENERGIES
from sculptures import seven

NAMES = {
    "arap": "ARAP",
    "springs": "mass and springs",
    "area": "area-preserving",
    "mips": "MIPS",
    "symmetric-dirichlet": "symmetric Dirichlet",
}


def main(output: Path, size: int = 40) -> dict[str, Any]:
    problem = seven(size)["rabbit onto R"]
    first = solve(problem, strategy=[VectorAdam(iterations=600)]).uv
    w = first @ (1, 1j)
    area = float(signed_areas(problem.F, w).sum())
    measures = {
        title: DeformationEnergy(problem.V, problem.F, ENERGIES[name](problem.V, problem.F), area=area)
        for name, title in NAMES.items()
    }
    maps = {"tanh, the first map": first}
    maps |= {
        title: harmonise(problem.V, problem.F, first, fixed=problem.fixed, energy=name, max_iterations=60).uv
        for name, title in NAMES.items()
    }
    maps["R₁"] = harmonise(
        problem.V, problem.F, first, fixed=problem.fixed, energy=None, conformal=1.0, max_iterations=60
    ).uv
    figure, axes = panels(2, 4, (2.9, 3.2))
    numbers: dict[str, Any] = {}
    for ax, (name, uv) in zip([*axes[0], *axes[1]], maps.items(), strict=False):
        show(ax, problem, uv, name)
        numbers[name] = {"flips": flips(problem, uv)}
        numbers[name] |= {title: float(f"{energy.value(uv @ (1, 1j)):.4g}") for title, energy in measures.items()}
    last = axes[1][3]
    last.set_axis_off()
    # The value of each energy relative to the least of all maps.
    values = np.array([[numbers[name][title] for title in measures] for name in maps])
    relative = values / values.min(axis=0)
    rows = ("first", "ARAP", "springs", "area", "MIPS", "sym. D.", "R₁")
    cells = [[f"{x:.1f}" if x < 100 else f"{x:.0e}".replace("e+0", "e") for x in row] for row in relative]
    table = last.table(
        [[name, *row] for name, row in zip(rows, cells, strict=True)],
        colLabels=["map", *rows[1:-1]],
        cellLoc="center",
        bbox=(0.0, 0.15, 1.0, 0.75),
    )
    table.auto_set_font_size(False)
    table.set_fontsize(7)
    last.set_title("energy of each map over the least", size=10)
    save(figure, output, "figure_19")
    return numbers


if __name__ == "__main__":
    run(main)
