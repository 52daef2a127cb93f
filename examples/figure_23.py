"""Figure 23: three energies that do not mind inversions, alone and quasi-harmonised
===================================================================================

Upper rows: the map of least energy, found by L-BFGS on its vertices from the first injective map. From 3 to over 1,600
triangles are inverted. They lie behind the boundary's concave corners and wherever a fold costs less than compression,
for springs wherever the surface is steep. Lower rows: the same energies with V₃, minimised by `harmonise`. No triangle
is inverted. ARAP is then 42 to 61 % higher on A, P and H, and springs 22 to 45 %. On R, where the unconstrained maps
leave through the gap between the legs, they are 2.7 and 3.1 times as high. The area energy is lower on A, P and H,
because the folds of the unconstrained maps are local minima.

ARAP is the paper's, with σ₂ ≥ 0 (``"arap-unsigned"``), which costs the same for a mirrored triangle. With the signed σ₂
of ``"arap"``, which penalises mirrored triangles, the difference was 2 to 17 % on A, P and H, and a factor of 1.8 on R.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from scipy.optimize import minimize

from common import flips, panels, run, save, show
from quasiharmonic import Problem, solve
from quasiharmonic.energies.deformation import DeformationEnergy, signed_areas
from quasiharmonic.solver.methods import VectorAdam
from quasiharmonic.solver.search.harmonising import ENERGIES, harmonise_map
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
                "and V₃": harmonise_map(problem.domain, first, energy=energy_name).uv,
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
