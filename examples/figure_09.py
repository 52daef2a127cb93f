"""Figures 9 and 22: the surfaces at rest
=========================================

Five generated surfaces replace the paper's scans. Their boundaries are red.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.collections import LineCollection

from common import RED, panels, run, save
from quasiharmonic.geometry.mesh.topology import boundary_edges
from quasiharmonic.plot import plot_surface
from quasiharmonic.ui.plot.canvas import view
from sculptures import SCULPTURES, sculpture


def main(output: Path, size: int = 72) -> dict[str, Any]:
    figure, axes = panels(1, len(SCULPTURES), (3.4, 4.4))
    numbers = {}
    for ax, name in zip(axes[0], SCULPTURES, strict=True):
        V, F = sculpture(name, size)
        plot_surface(V, F, ax)
        rim, seen = boundary_edges(F, len(V)), view(V, F)
        # The visible part of the rim.
        of = {
            edge: triangle
            for triangle, corners in enumerate(F.tolist())
            for edge in zip(corners, np.roll(corners, -1).tolist(), strict=True)
        }
        front = [edge for edge in rim.tolist() if not seen.inside[of[tuple(edge)]]]
        ax.add_collection(LineCollection(seen.points[front], color=RED, lw=2.5, capstyle="round"))
        ax.set_title(f"{name}, {len(F):,} triangles", size=10)
        sides = V[np.roll(F, -1, axis=1)] - V[F]
        lengths = np.linalg.norm(sides, axis=2)
        cosines = -(sides * np.roll(sides, 1, axis=1)).sum(axis=2) / (lengths * np.roll(lengths, 1, axis=1))
        numbers[name] = {
            "triangles": len(F),
            "boundary edges": len(rim),
            "least angle": round(float(np.degrees(np.arccos(cosines.max()))), 1),
        }
    save(figure, output, "figure_09")
    return numbers


if __name__ == "__main__":
    run(main)
