"""Nodes that slide along walls
===============================

A disk turns in a mesh of a channel. Upper row: fixed nodes on the walls; lower row: with ``slide=True`` these nodes
(white) slide along their side, and triangles are sheared less.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import Delaunay

from common import INK, panels, run, save, show
from quasiharmonic import Problem, boundary_loops, distortion, morph

DEGREES = (30, 60, 90)
LENGTH, HEIGHT, RADIUS = 4.0, 2.0, 0.7


def channel(size: int) -> tuple[NDArray[np.float64], NDArray[np.int64]]:
    """The rectangle [-2, 2] × [-1, 1] without a disk around the origin, ``size`` edges across its height."""
    step = HEIGHT / size
    around = np.exp(2j * np.pi * np.arange(count := round(2 * np.pi * RADIUS / step)) / count)
    # Rings of nodes near the disk, then a triangular lattice, and nodes on the walls.
    rings = np.concatenate([(RADIUS + k * step) * around * np.exp(1j * np.pi * k / count) for k in range(3)])
    x, y = np.meshgrid(np.arange(-2 * size, 2 * size) * step, np.arange(-size, size) * step * np.sqrt(0.75))
    x = x + np.where(np.arange(2 * size) % 2, 0.5 * step, 0)[:, None]
    inside = (abs(x) < (LENGTH - step) / 2) & (abs(y) < (HEIGHT - step) / 2) & (np.hypot(x, y) > RADIUS + 2.6 * step)
    long, high = np.linspace(-LENGTH / 2, LENGTH / 2, 2 * size + 1), np.linspace(-HEIGHT / 2, HEIGHT / 2, size + 1)
    walls = [long - 1j * HEIGHT / 2, long + 1j * HEIGHT / 2]
    walls += [side * LENGTH / 2 + 1j * high[1:-1] for side in (-1, 1)]
    rings = rings[abs(rings.imag) < HEIGHT / 2 - step / 3]
    nodes = np.concatenate([rings, (x + 1j * y)[inside], *walls])
    points = np.stack([nodes.real, nodes.imag], axis=1)
    F = Delaunay(points).simplices.astype(np.int64)
    middle = points[F].mean(axis=1)
    F = F[np.hypot(*middle.T) > RADIUS * np.cos(np.pi / count)]
    a, b, c = nodes[F].T
    turned = ((b - a).conj() * (c - a)).imag < 0
    F[turned] = F[turned][:, ::-1]
    return points, F


def main(output: Path, size: int = 20) -> dict[str, Any]:
    points, F = channel(size)
    loops = boundary_loops(F, len(points))
    walls, disk = sorted(loops, key=lambda loop: -np.abs(points[loop]).max())
    fixed = np.concatenate([walls, disk])
    corners = walls[(np.abs(points[walls]) == (LENGTH / 2, HEIGHT / 2)).all(axis=1)]
    figure, axes = panels(2, len(DEGREES), (4.4, 3.2))
    numbers: dict[str, Any] = {"triangles": len(F)}
    for k, degrees in enumerate(DEGREES):
        turn = np.exp(1j * np.radians(degrees)) * (points[disk] @ (1, 1j))
        place = np.stack([turn.real, turn.imag], axis=1)
        problem = Problem(points, F, fixed, np.concatenate([points[walls], place]))
        row: dict[str, Any] = {}
        for i, (name, slide) in enumerate((("fixed", False), ("sliding", True))):
            morphed = morph(points, F, disk, place, slide=slide)
            ax = axes[i][k]
            show(ax, problem, morphed.points, f"{degrees}°, {name} walls", pins=False)
            ax.plot(*morphed.points[walls].T, "o", ms=3.2, mfc="white", mec=INK, mew=0.7)
            row[name] = {
                "symmetric Dirichlet": distortion(points, F, morphed.points).statistics("symmetric_dirichlet").mean,
                "worst mean ratio": float(morphed.quality_after.min()),
                "valid": morphed.valid,
                "bijective": bool(morphed.result.certificate.bijective),
                "corners off by": float(np.abs(morphed.points[corners] - points[corners]).max()),
                "walls off by": float(
                    np.minimum(
                        abs(abs(morphed.points[walls, 0]) - LENGTH / 2), abs(abs(morphed.points[walls, 1]) - HEIGHT / 2)
                    ).max()
                ),
            }
        numbers[f"{degrees}°"] = row
    save(figure, output, "channel")
    return numbers


if __name__ == "__main__":
    run(main)
