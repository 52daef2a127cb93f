"""Figure 8: first maps of tanh and si-log
==========================================

si-log has the lower MIPS energy, as in the paper. Its worst triangle is worse, because the last untangled triangle is
nearly degenerate.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from common import colorbar, first_map, flips, mips, onto, panels, ratios, ring, run, save, show, show_ratios
from quasiharmonic import quasi_harmonic_map, surfaces, targets


def main(output: Path, size: int = 40) -> dict[str, Any]:
    cat = onto(*surfaces.cat(size), targets.letter("S")[0])
    problems = {"cat onto S": cat, "hole turned by π/2": ring(size, (-0.25, -0.25, 0.25, 0.25), np.pi / 2)}
    figure, axes = panels(len(problems), 3, (3.6, 3.9))
    numbers: dict[str, Any] = {}
    for row, (name, problem) in zip(axes, problems.items(), strict=True):
        harmonic = quasi_harmonic_map(problem, reference="rest")
        show(row[0], problem, harmonic, f"{name}: harmonic")
        numbers[name] = {"triangles": len(problem.F), "harmonic": flips(problem, harmonic)}
        for ax, parameterisation in zip(row[1:], ("tanh", "si-log"), strict=True):
            result = first_map(problem, parameterisation)
            ratio, share = ratios(problem, result.uv)
            energy = mips(problem, result.uv)
            drawn = show_ratios(
                ax, problem, result.uv, f"{parameterisation}: {result.n_iterations} iterations\nMIPS {energy:.2f}", 100
            )
            numbers[name][parameterisation] = {
                "flips": len(result.certificate.inverted),
                "iterations": result.n_iterations,
                "MIPS": round(energy, 2),
                "mean σ₁/σ₂": round(float(share @ ratio), 2),
                "99 % below": round(float(np.percentile(ratio, 99)), 1),
                "max": round(float(ratio.max()), 1),
            }
    colorbar(figure, drawn)
    save(figure, output, "figure_08")
    return numbers


if __name__ == "__main__":
    run(main)
