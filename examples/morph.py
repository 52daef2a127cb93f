"""A finite-element mesh with a moved boundary
==============================================

A flap turns by up to 75°. Upper row: Laplace's equation inverts triangles (red). Lower row: ``morph`` inverts none.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from common import flips, panels, run, save, show
from quasiharmonic import Problem, boundary_loops, morph, quasi_harmonic_map, surfaces

DEGREES = (25, 50, 75)


def main(output: Path, size: int = 48) -> dict[str, Any]:
    points, F = surfaces.annulus(size, hole=(-0.6, -0.05, 0.6, 0.05))
    walls, flap = boundary_loops(F, len(points))
    fixed = np.concatenate([walls, flap])
    figure, axes = panels(2, 1 + len(DEGREES), (3.0, 3.3))
    rest = Problem(points, F, fixed, points[fixed])
    show(axes[0][0], rest, points, "the mesh", pins=False)
    axes[1][0].set_axis_off()
    numbers: dict[str, Any] = {"triangles": len(F)}
    for k, degrees in enumerate(DEGREES, 1):
        angle = np.radians(degrees)
        place = points[flap] @ np.array([(np.cos(angle), -np.sin(angle)), (np.sin(angle), np.cos(angle))])
        problem = Problem(points, F, fixed, np.concatenate([points[walls], place]))
        spread = quasi_harmonic_map(problem, reference="rest")
        morphed = morph(points, F, flap, place)
        show(axes[0][k], problem, spread, f"{degrees}°, by Laplace's equation", pins=False)
        show(axes[1][k], problem, morphed.points, f"{degrees}°, morphed", pins=False)
        numbers[f"{degrees}°"] = {
            "inverted by Laplace's equation": flips(problem, spread),
            "valid": morphed.valid,
            "worst mean ratio before": float(morphed.quality_before.min()),
            "worst mean ratio": float(morphed.quality_after.min()),
            "boundary off by": float(np.abs(morphed.points[fixed] - problem.target).max()),
        }
    save(figure, output, "morph")
    return numbers


if __name__ == "__main__":
    run(main)
