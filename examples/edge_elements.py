"""V₄ in two kinds of elements
==============================

In linear elements V₄ is zero at a map with inverted triangles (left, red), and can be negative (middle). In
Crouzeix–Raviart elements it equals V₃. In both it ignores the position of a hole (right).
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from scipy.optimize import brentq

from common import panels, ring, run, save, show
from quasiharmonic import Problem, boundary_loops, solve, surfaces
from quasiharmonic.solver.field.objective import Objective
from quasiharmonic.solver.methods import VectorAdam

CURVES = {"V₃": ("dirichlet", "-"), "V₄": ("poisson", "-"), "V₄ by edges": ("edge-poisson", "--")}


def star(size: int) -> Problem:
    """A disk onto a star with five arms."""
    V, F = surfaces.disk(size)
    (loop,) = boundary_loops(F, len(V))
    turn = np.angle(V[loop] @ (1, 1j))
    return Problem(V, F, loop, (1 + 0.7 * np.cos(5 * turn))[:, None] * V[loop])


def displaced_ring(size: int) -> Problem:
    """A square ring onto itself, except that the target of its hole crosses the outer boundary."""
    problem = ring(size, (-0.25, -0.25, 0.25, 0.25), 0.0)
    target = problem.target.copy()
    target[np.abs(target).max(axis=1) < 0.5] += [0.9, 0.0]
    return Problem(problem.V, problem.F, problem.fixed, target, reference="rest")


def iterations(problem: Problem, functional: str, parameterisation: str) -> int | str:
    """Iterations of VectorAdam to an injective map, or the number of triangles left inverted."""
    stage = VectorAdam(functional=functional, parameterisation=parameterisation, iterations=600)
    result = solve(problem, strategy=[stage])
    return result.n_iterations if result.injective else f"{len(result.certificate.inverted)} inverted"


def main(output: Path, size: int = 10, cells: int = 24) -> dict[str, Any]:
    problem, moved = star(size), displaced_ring(16)
    objectives = {name: Objective(problem, functional) for name, (functional, _) in CURVES.items()}
    random = np.random.default_rng(0)
    rough = random.standard_normal((len(problem.F), 2)) @ (1, 1j)
    zero = brentq(lambda t: objectives["V₄"].evaluate(t * rough).value, 0, 1.5, xtol=1e-15)
    there = objectives["V₄"].evaluate(zero * rough)
    area = float(there.dw.area.sum())

    figure, (row,) = panels(1, 3, (4.2, 4.4))
    show(row[0], problem, problem.frame.outward(there.w), f"V₄ = 0, V₃ = {there.dirichlet / area:.2f} areas")
    scales = np.linspace(0, 1.2, 25)
    box = row[1].get_position()
    row[1].set_position((box.x0 + 0.03, box.y0 + 0.1, box.width - 0.04, box.height - 0.1))
    values = {}
    for name, (_, line) in CURVES.items():
        values[name] = np.array([objectives[name].evaluate(t * rough).value / area for t in scales])
        row[1].plot(scales, values[name], line, label=name)
    row[1].axhline(0, color="0.6", lw=0.8)
    row[1].set(xlabel="roughness of the tensors", ylim=(-1.1, 3))
    row[1].set_title("over the target's area", fontsize=10)
    row[1].legend()

    unit = np.zeros(len(moved.F), dtype=complex)
    at = {name: Objective(moved, functional).evaluate(unit) for name, (functional, _) in CURVES.items()}
    show(row[2], moved, moved.frame.outward(at["V₃"].w), "V₄ = 0: it does not see where the hole lies")
    save(figure, output, "edge_elements")
    turned = ring(cells, (-0.25, -0.25, 0.25, 0.25), np.pi)
    return {
        "star": {
            "triangles": len(problem.F),
            "inverted where V₄ is zero": there.inverted,
            "V₄ there": there.value / area,
            "V₃ there": there.dirichlet / area,
            "least V₄ on the way": float(values["V₄"].min()),
            "V₄ by edges less V₃, at most": float(np.abs(values["V₄ by edges"] - values["V₃"]).max()),
            "iterations": {name: iterations(problem, f, "tanh") for name, (f, _) in CURVES.items()},
        },
        "hole across the boundary": {name: it.value / float(it.dw.area.sum()) for name, it in at.items()},
        "ring turned by π": {name: iterations(turned, f, "si-log") for name, (f, _) in CURVES.items()},
    }


if __name__ == "__main__":
    run(main)
