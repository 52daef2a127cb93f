"""Figure 1: an angel mapped to a G
===================================

Maps by tanh and by `Untangling`, which minimises the energy of SBP. In the paper: Lucy onto G, by tanh and by SBP.
"""

from __future__ import annotations

from pathlib import Path
from time import perf_counter
from typing import Any

from common import mips, panels, run, save, show
from quasiharmonic import Problem, injective_map, quasi_harmonic_map, solve
from quasiharmonic.plot import plot_surface
from quasiharmonic.solver.methods import Untangling, VectorAdam
from sculptures import seven


def main(output: Path, size: int = 96) -> dict[str, Any]:
    problem = seven(size)["angel onto G"]
    given = problem.V, problem.F, problem.fixed, problem.target
    quasi_harmonic_map(problem)  # import lazily loaded modules before timing
    seconds, maps = {}, {}
    for name, found_by in {
        "Tutte": lambda: quasi_harmonic_map(Problem(*given)),
        "tanh": lambda: solve(Problem(*given), strategy=[VectorAdam()]),
        "untangling": lambda: solve(Problem(*given), strategy=[Untangling()]),
        "injective_map": lambda: injective_map(*given),
    }.items():
        start = perf_counter()
        maps[name] = found_by()
        seconds[name] = perf_counter() - start
    tutte, result, untangled = maps["Tutte"], maps["tanh"], maps["untangling"]
    figure, axes = panels(1, 4, (4.2, 4.8))
    plot_surface(problem.V, problem.F, axes[0][0])
    axes[0][0].set_title(f"{len(problem.F):,} triangles", size=10)
    show(axes[0][1], problem, tutte, "Tutte's embedding")
    show(axes[0][2], problem, result.uv, f"tanh, {result.n_iterations} iterations")
    show(axes[0][3], problem, untangled.uv, f"SBP's energy, our way, {untangled.n_iterations} iterations")
    save(figure, output, "figure_01")
    return {
        "triangles": len(problem.F),
        "inverted by Tutte's embedding": result.history[0].inverted,
        "inverted": len(result.certificate.inverted),
        "bijective": bool(result.certificate.bijective),
        "iterations": result.n_iterations,
        "seconds": {name: round(value, 3) for name, value in seconds.items()},
        "MIPS": round(mips(problem, result.uv), 2),
        "untangling": {
            "inverted": len(untangled.certificate.inverted),
            "iterations": untangled.n_iterations,
            "MIPS": round(mips(problem, untangled.uv), 2),
        },
    }


if __name__ == "__main__":
    run(main)
