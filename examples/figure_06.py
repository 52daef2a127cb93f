"""Figure 6: a ring turned by π, by four functionals
====================================================

V₁, V₂ and V₃ find an injective map. V₄ leaves inverted triangles, because it is not bounded below by zero in linear
elements; in the paper it succeeds.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from common import frames, inverted_area, panels, ring, run, save, show
from quasiharmonic import Problem, solve
from quasiharmonic.solver.field.objective import Objective
from quasiharmonic.solver.methods import VectorAdam

HOLE = (-0.25, -0.25, 0.25, 0.25)
NAMES = {"dirichlet": "V₃", "neumann": "V₁", "sobolev": "V₂", "poisson": "V₄"}
SHOTS = 6


def around_own_tensor(problem: Problem, uv: np.ndarray) -> dict[str, float]:
    """V₄ over the target's area at an injective map's own tensor, and the largest of twenty values near that tensor."""
    objective = Objective(problem, "poisson", "tanh")
    xi = objective.near_map(problem.frame.inward(uv)).xi
    random = np.random.default_rng(0)
    near = [xi + 0.01 * (random.standard_normal((*xi.shape, 2)) @ (1, 1j)) for _ in range(20)]
    here, others = objective.evaluate(xi), [objective.evaluate(x).value for x in near]
    area = float(here.dw.area.sum())
    return {"V₄ at an injective map's tensor": here.value / area, "largest close by": max(others) / area}


def main(output: Path, size: int = 24, iterations: int = 1000) -> dict[str, Any]:
    problem = ring(size, HOLE, np.pi)
    figure, axes = panels(4, SHOTS, (2.2, 2.6))
    numbers: dict[str, Any] = {"triangles": len(problem.F)}
    maps = {}
    for row, (functional, name) in zip(axes, NAMES.items(), strict=True):
        stage = VectorAdam(parameterisation="si-log", functional=functional)
        result = solve(problem, strategy=[stage], max_iterations=iterations, record_every=1)
        # V₄ untangles nothing, so its frames are spaced evenly by iteration.
        still = functional == "poisson"
        path = [-shot.iteration if still else inverted_area(problem, shot.uv) for shot in result.path]
        for ax, at in zip(row, frames(path, SHOTS), strict=True):
            show(ax, problem, result.path[at].uv, f"{name}, iteration {at}", size=9)
        maps[name] = result.uv
        numbers[name] = {
            "iterations": result.n_iterations,
            "flips": len(result.certificate.inverted),
            "V₃ / area": float(f"{result.history[-1].energy:.2g}"),
        }
    numbers["V₄"] |= around_own_tensor(problem, maps["V₃"])
    quarter = solve(ring(2 * size, HOLE, np.pi / 2), strategy=[VectorAdam(functional="poisson", iterations=100)])
    numbers["V₄ with tanh, turned by π/2"] = {
        "iterations": quarter.n_iterations,
        "flips": len(quarter.certificate.inverted),
    }
    save(figure, output, "figure_06")
    return numbers


if __name__ == "__main__":
    run(main)
