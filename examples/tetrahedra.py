"""Tetrahedra around moved bodies
==============================

Cuts through meshes of tetrahedra, coloured by quality (1: regular): a cavity turns by 110°, and the top of a cube is
pinched. Left: at rest; middle: only the boundary has moved, inverted tetrahedra red; right: ``morph``, certified.
"""

from __future__ import annotations

from itertools import permutations
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib import colormaps
from matplotlib.axes import Axes
from matplotlib.collections import PolyCollection
from numpy.typing import NDArray

from common import INK, RED, panels, run, save
from quasiharmonic import TetrahedraResult, certify_tetrahedra, morph
from quasiharmonic.apps.tetrahedra.result import tetrahedron_quality


def cube(size: int) -> tuple[NDArray[np.float64], NDArray[np.int64]]:
    """The cube [-1, 1]³ of six tetrahedra per cell, inner vertices jittered."""
    X = np.stack(np.meshgrid(*[2 * np.arange(size + 1) / size - 1] * 3, indexing="ij"), axis=-1).reshape(-1, 3)
    step = np.array([(size + 1) ** 2, size + 1, 1])
    first = np.stack(np.meshgrid(*[np.arange(size)] * 3, indexing="ij"), axis=-1).reshape(-1, 3) @ step
    T = np.concatenate([first[:, None] + np.cumsum([0, *step[list(p)]]) for p in permutations(range(3))])
    a, b, c, d = X[T].transpose(1, 0, 2)
    left_handed = ((b - a) * np.cross(c - a, d - a)).sum(axis=1) < 0
    return X, np.where(left_handed[:, None], T[:, [1, 0, 2, 3]], T)


def draw_cut(ax: Axes, T: NDArray[np.int64], X: NDArray[np.float64], normal: int, title: str) -> None:
    """Draw the polygons in which the plane through the origin across an axis cuts the tetrahedra."""
    height = X[:, normal] - 0.013
    others = [axis for axis in range(3) if axis != normal]
    quality = tetrahedron_quality(T, X)
    polygons, colours, edges = [], [], []
    for row, value in zip(T, quality, strict=True):
        up, down = row[height[row] > 0], row[height[row] <= 0]
        if not (up.size and down.size):
            continue
        pairs = [(i, j) for i in up for j in down]
        if len(pairs) == 4:
            pairs = [pairs[0], pairs[1], pairs[3], pairs[2]]
        polygons.append([(X[i] + height[i] / (height[i] - height[j]) * (X[j] - X[i]))[others] for i, j in pairs])
        colours.append(value)
        edges.append(RED if value <= 0 else INK)
    cmap = colormaps["viridis"].with_extremes(under=RED)
    drawn = PolyCollection(polygons, array=np.array(colours), cmap=cmap, edgecolors=edges, linewidths=0.25)
    drawn.set_clim(0, 1)
    ax.add_collection(drawn)
    ax.autoscale_view()
    ax.set_aspect("equal")
    ax.set_axis_off()
    count = int(np.count_nonzero(quality <= 0))
    verdict = (
        f"{count:,} inverted, worst quality {quality.min():.2f}" if count else f"worst quality {quality.min():.2f}"
    )
    ax.set_title(f"{title}\n{verdict}", size=10, color=RED if count else INK)


def main(output: Path, size: int = 12) -> dict[str, Any]:
    X, T = cube(size)
    rng = np.random.default_rng(0)
    lattice = X.copy()
    inner = (np.abs(X) < 1).all(axis=1)
    X[inner] += 0.3 / size * rng.uniform(-1, 1, (inner.sum(), 3))
    half = 2 * round(size / 6) / size
    cavity = np.flatnonzero(np.abs(np.abs(lattice).max(axis=1) - half) < 1e-9)
    X[cavity] = lattice[cavity]
    shell = T[np.abs(lattice[T].mean(axis=1)).max(axis=1) > half]
    angle = np.radians(110)
    turn = np.array([(np.cos(angle), np.sin(angle), 0), (-np.sin(angle), np.cos(angle), 0), (0, 0, 1)])
    top = np.flatnonzero(lattice[:, 2] == 1)
    x, y, z = lattice[top].T
    pinched = np.stack([x, y, z - 1.5 * (np.cos(np.pi * x / 2) * np.cos(np.pi * y / 2)) ** 2], axis=1)
    scenes = (("turned cavity", shell, cavity, X[cavity] @ turn, 2), ("pinched cube", T, top, pinched, 1))
    figure, axes = panels(2, 3, (3.9, 3.9))
    numbers: dict[str, Any] = {}
    for row, (name, cells, moved, target, normal) in zip(axes, scenes, strict=True):
        before = X.copy()
        before[moved] = target
        result = morph(X, cells, moved, target)
        assert isinstance(result, TetrahedraResult)
        for ax, points, title in zip(
            row, (X, before, result.points), ("at rest", "boundary moved", "morph"), strict=True
        ):
            draw_cut(ax, cells, points, normal, f"{name}, {title}")
        numbers[name] = {
            "tetrahedra": len(cells),
            "inverted": len(certify_tetrahedra(cells, before).inverted),
            "success": result.success,
            "worst quality": float(result.quality_after.min()),
        }
    save(figure, output, "tetrahedra")
    return numbers


if __name__ == "__main__":
    run(main)
