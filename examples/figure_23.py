"""Figure 23: energies without a barrier
========================================

Upper rows: the energy alone inverts triangles (red). Lower rows: the same energy with V₃ inverts none.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from scipy.optimize import minimize

from common import flips, panels, run, save, show
from quasiharmonic import Problem, harmonise, solve
from quasiharmonic.energies.deformation import DeformationEnergy, signed_areas
from quasiharmonic.solver.methods import VectorAdam
from quasiharmonic.solver.search.harmonising import ENERGIES
from quasiharmonic.util.arrays import FloatArray
from sculptures import seven

COLUMNS = "rabbit onto R", "bust onto A", "hand onto P", "gargoyle onto H"
NAMES = {"arap-unsigned": "ARAP", "springs": "springs", "area": "areas"}


def alone(problem: Problem, energy: DeformationEnergy, uv: FloatArray, iterations: int = 1000) -> FloatArray:
    """The map of least energy near ``uv``, by L-BFGS on the free vertices, where triangles may become inverted."""
    free = np.setdiff1d(np.arange(problem.n), problem.fixed)
    w = uv @ (1, 1j)

    def evaluate(x: FloatArray) -> tuple[float, FloatArray]:
        w[free] = x.view(np.complex128)
        return energy.value(w), energy.gradient(w)[free].view(np.float64)

    start = w[free].view(np.float64).copy()
    found = minimize(evaluate, start, jac=True, method="L-BFGS-B", options={"maxiter": iterations})
    evaluate(found.x)
    return np.stack([w.real, w.imag], axis=1)


def main(output: Path, size: int = 32) -> dict[str, Any]:
    figure, axes = panels(2 * len(NAMES), len(COLUMNS), (2.4, 2.9))
    numbers: dict[str, Any] = {}
    for j, name in enumerate(COLUMNS):
        problem = seven(size)[name]
        first = solve(problem, strategy=[VectorAdam(iterations=600)]).uv
        area = float(signed_areas(problem.F, first @ (1, 1j)).sum())
        row = numbers[name] = {"triangles": len(problem.F)}
        for i, (energy_name, title) in enumerate(NAMES.items()):
            energy = DeformationEnergy(problem.V, problem.F, ENERGIES[energy_name](problem.V, problem.F), area=area)
            maps = {
                "alone": alone(problem, energy, first),
                "and V₃": harmonise(problem.V, problem.F, first, fixed=problem.fixed, energy=energy_name).uv,
            }
            for k, (how, uv) in enumerate(maps.items()):
                show(axes[2 * i + k][j], problem, uv, f"{title} {how}")
            row[title] = {
                how: {"flips": flips(problem, uv), "energy": float(f"{energy.value(uv @ (1, 1j)):.4g}")}
                for how, uv in {"first map": first, **maps}.items()
            }
    save(figure, output, "figure_23")
    return numbers


if __name__ == "__main__":
    run(main)
