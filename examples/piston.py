"""Collision avoidance over time
================================

A piston pushes a cheese with holes into an hourglass. All parts and the air form one bijective mesh, so nothing
overlaps.
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.collections import PolyCollection
from matplotlib.figure import Figure
from numpy.typing import NDArray
from scipy.spatial import Delaunay

from common import panels, run, save
from quasiharmonic import AirMesh
from quasiharmonic.plot import save_figures
from quasiharmonic.results import AirMeshState
from quasiharmonic.util.arrays import FloatArray

HOLES = np.array([(0.0, 0.35, 0.2), (-0.42, 0.08, 0.17), (0.4, 0.02, 0.19), (-0.12, -0.42, 0.21), (0.3, -0.55, 0.1)])


def circle(x: float, y: float, radius: float, count: int) -> FloatArray:
    angle = np.linspace(0, 2 * np.pi, count, endpoint=False)
    return np.stack([x + radius * np.cos(angle), y + radius * np.sin(angle)], axis=1)


def cheese(spacing: float) -> tuple[FloatArray, NDArray[np.int64]]:
    """A disk of radius 0.9 with five holes."""
    rings = [circle(x, y, r, max(8, round(2 * np.pi * r / spacing))) for x, y, r in [(0, 0, 0.9), *HOLES]]
    x, y = np.meshgrid(np.arange(-1, 1, spacing), np.arange(-1, 1, spacing * np.sqrt(0.75)))
    x[::2] += spacing / 2
    inner = np.stack([x.ravel(), y.ravel()], axis=1)
    gap = np.linalg.norm(inner[:, None] - HOLES[:, :2], axis=2) - HOLES[:, 2]
    inner = inner[(gap.min(axis=1) > 0.6 * spacing) & (np.linalg.norm(inner, axis=1) < 0.9 - 0.6 * spacing)]
    points = np.concatenate([*rings, inner])
    triangles = Delaunay(points).simplices.astype(np.int64)
    middle = points[triangles].mean(axis=1)
    kept = (np.linalg.norm(middle[:, None] - HOLES[:, :2], axis=2) > HOLES[:, 2]).all(axis=1)
    a, b, c = points[triangles].transpose(1, 0, 2)
    clockwise = np.cross(np.column_stack([b - a, a[:, 0] * 0]), np.column_stack([c - a, a[:, 0] * 0]))[:, 2] < 0
    triangles[clockwise] = triangles[clockwise, ::-1]
    return points, triangles[kept]


def hourglass(neck: float = 0.35) -> FloatArray:
    y = np.linspace(-2.2, 2.7, 71)
    right = np.stack([neck + (1.3 - neck) * np.clip(np.abs(y) / 1.3, 0, 1) ** 1.5, y], axis=1)
    return np.concatenate([right, right[::-1] * (-1, 1)])


def piston(bottom: float, neck: float = 0.35) -> FloatArray:
    """A plate as wide as the hourglass at the height of its lower side, and rounded below."""
    room = neck + (1.3 - neck) * np.clip((bottom - 0.1) / 1.3, 0, 1) ** 1.5
    x = np.linspace(-1, 1, 33) * (0.93 * room)
    below = np.stack([x, bottom - 0.1 * (1 - (x / x[-1]) ** 2)], axis=1)
    return np.concatenate([below, np.stack([x[::-1], np.full(33, bottom + 0.12)], axis=1)])


def draw(ax: Axes, moment: AirMeshState, frame: FloatArray) -> None:
    for triangles, face, edge in ((moment.air, "#fbe7a1", "#e3b93c"), (moment.F, "#4f7fd0", "#24447e")):
        ax.add_collection(PolyCollection(moment.points[triangles], facecolors=face, edgecolors=edge, linewidths=0.25))
    ax.fill(*frame.T, color="#5a5a5a")
    ax.set(xlim=(-1.35, 1.35), ylim=(-2.25, 2.75), aspect="equal")
    ax.set_axis_off()


def main(output: Path, size: int = 10, steps: int = 40) -> dict[str, Any]:
    points, triangles = cheese(1 / size)
    glass, heights = hourglass(), np.linspace(2.5, 0.6, steps)
    frames = [piston(height) for height in heights]
    air = AirMesh(points + np.array((0, 1.35)), triangles, [glass, frames[0]])
    moments = [air.moment, *(air.advance([glass, frame]) for frame in frames[1:])]

    figure, ((*axes,),) = panels(1, 6, (2.2, 4.2))
    for ax, k in zip(axes, np.linspace(0, steps - 1, 6).astype(int), strict=True):
        draw(ax, moments[k], frames[k])
        ax.set_title(f"energy {moments[k].energy:.3f}", size=10)
    save(figure, output, "piston")

    def pictures() -> Iterator[Figure]:
        for moment, frame in zip(moments, frames, strict=True):
            small, ((ax,),) = panels(1, 1, (3, 5))
            draw(ax, moment, frame)
            yield small

    save_figures(output / "piston.gif", pictures())
    corners = moments[-1].points[moments[-1].air]
    longest = np.linalg.norm(corners - np.roll(corners, 1, axis=1), axis=2).max(axis=1)
    a, b, c = corners.transpose(1, 0, 2)
    area = 0.5 * ((b - a)[:, 0] * (c - a)[:, 1] - (b - a)[:, 1] * (c - a)[:, 0])
    return {
        "triangles": len(triangles),
        "air": [int(min(len(m.air) for m in moments)), int(max(len(m.air) for m in moments))],
        "moments": steps,
        "bijective": sum(m.certificate.bijective for m in moments),
        "energy": [round(m.energy, 4) for m in moments[:: max(1, steps // 5)]],
        "thinnest air": float((2 * area / longest).min()),
    }


if __name__ == "__main__":
    run(main)
