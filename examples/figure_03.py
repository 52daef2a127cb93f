"""Figure 3: harmonic maps onto nonconvex outlines
==================================================

Harmonic maps invert triangles at concave corners, and si-log inverts none, as in the paper. The sheet's target overlaps
itself, so its map is injective and not bijective.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from common import first_map, flips, mips, onto, panels, run, save, show
from quasiharmonic import quasi_harmonic_map, surfaces

ARROW = np.array([(0, 0), (1, 0), (0.15, 0.15), (0, 1)], dtype=float)
CROSS = np.array(
    [(1, 0), (2, 0), (2, 1), (3, 1), (3, 2), (2, 2), (2, 3), (1, 3), (1, 2), (0, 2), (0, 1), (1, 1)], dtype=float
)
# A sheet with two corners bent across each other: four crossings and turning number one.
OVERLAP = np.array([(8, 0), (8, 9.5), (0, 9.5), (0, 0.6), (4, 5), (5, 4), (-1.3, 3)], dtype=float)


def main(output: Path, size: int = 24) -> dict[str, Any]:
    square, faces = surfaces.grid(size, size)
    figure, axes = panels(2, 3, (3.6, 3.9))
    numbers = {}
    shapes = ("arrow", ARROW, 0), ("cross", CROSS, None), ("overlap", OVERLAP, size)
    for (above, below), (name, outline, start) in zip(zip(*axes, strict=True), shapes, strict=True):
        problem = onto(square, faces, outline, start)
        harmonic = quasi_harmonic_map(problem, reference="rest")
        result = first_map(problem, "si-log")
        show(above, problem, harmonic, f"{name}: harmonic")
        show(below, problem, result.uv, f"{name}: si-log, {result.n_iterations} iterations")
        numbers[name] = {
            "triangles": len(faces),
            "harmonic": flips(problem, harmonic),
            "si-log": flips(problem, result.uv),
            "iterations": result.n_iterations,
            "MIPS": round(mips(problem, result.uv), 2),
            "bijective": result.certificate.bijective,
        }
    save(figure, output, "figure_03")
    return numbers


if __name__ == "__main__":
    run(main)
