"""Figure 18: boundaries without a map
======================================

The search converges to a map of least unsigned area, and the diagnosis gives the reason.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from common import first_map, panels, ring, run, save, show
from quasiharmonic import Problem, boundary_loops, surfaces


def problems(size: int) -> dict[str, Problem]:
    """A disk onto two curves that bound no immersed disk, and a ring too coarse for its prescribed turn."""
    V, F = surfaces.disk(size)
    (loop,) = boundary_loops(F, len(V))
    t = 2 * np.pi * np.arange(len(loop)) / len(loop)
    eight = np.stack([np.cos(t), 0.5 * np.sin(2 * t) + 0.25 * np.sin(t)], axis=1)
    # Four loops that point outwards at the corners of a disk and are wound the wrong way.
    looped = np.stack([1.2 * np.cos(t) - 0.5 * np.cos(3 * t), 0.6 * np.sin(t) + 0.45 * np.sin(3 * t)], axis=1)
    return {
        "lopsided eight": Problem(V, F, loop, eight),
        "four loops": Problem(V, F, loop, looped),
        "coarse ring by π": ring(8, (-0.5, -0.5, 0.5, 0.5), np.pi),
    }


def winding_area(problem: Problem) -> float:
    """``∫ |winding number|`` of the target's boundary, by sampling: a lower bound on the area of every map."""
    place = dict(zip(problem.fixed.tolist(), problem.target @ (1, 1j), strict=True))
    low, high = problem.target.min(axis=0), problem.target.max(axis=0)
    x, y = (low[k] + (np.arange(400) + 0.5) / 400 * (high - low)[k] for k in range(2))
    turns = np.zeros((len(y), len(x)))
    for loop in problem.domain.loops:
        b = np.array([place[i] for i in loop.tolist()])
        for start, end in zip(b, np.roll(b, -1), strict=True):
            # An edge that goes up adds one turn to the points at its left.
            rows = np.flatnonzero((start.imag <= y) != (end.imag <= y))
            crossing = start.real + (y[rows] - start.imag) / (end - start).imag * (end - start).real
            turns[rows] += np.sign((end - start).imag) * (x < crossing[:, None])
    return float(np.abs(turns).mean() * np.prod(high - low))


def main(output: Path, size: int = 16) -> dict[str, Any]:
    numbers: dict[str, Any] = {}
    cases = problems(size)
    figure, axes = panels(2, len(cases), (3.6, 3.9))
    for above, below, (name, problem) in zip(*axes, cases.items(), strict=True):
        result = first_map(problem, "tanh", 3000, record_every=3000)
        lowest_energy, uv = min(result.history, key=lambda step: step.energy), result.uv
        area = problem.domain.mesh("rest").derivatives(uv @ (1, 1j)).area
        signed, unsigned = float(area.sum()), float(np.abs(area).sum())
        show(above, problem, result.path[0].uv, f"{name}: first guess")
        show(below, problem, uv, f"{result.status.name.lower()} after {result.n_iterations} iterations")
        numbers[name] = {
            "flips at first": result.history[0].inverted,
            "flips": lowest_energy.inverted,
            "iterations": result.n_iterations,
            "status": result.status.name,
            "unsigned area": round(unsigned, 4),
            "A-Dirichlet energy": round(signed + lowest_energy.energy * abs(signed), 4),
            "least unsigned area of any map": round(winding_area(problem), 4),
            "known obstructions": sorted({o.kind.name for o in result.diagnosis.obstructions}),
        }
    save(figure, output, "figure_18")
    return numbers


if __name__ == "__main__":
    run(main)
