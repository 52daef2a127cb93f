"""Figure 22: a cactus with bad triangles
=========================================

Almost half of the triangles have an angle below 1°. The map of the cactus is injective all the same.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.collections import PolyCollection

from common import INK, flips, onto, panels, run, save, show
from quasiharmonic import Problem, solve, targets
from quasiharmonic.geometry.mesh.reference import Reference
from quasiharmonic.plot import plot_surface
from quasiharmonic.solver.methods import VectorAdam
from quasiharmonic.util.arrays import FloatArray, IntArray
from sculptures import cone, join, standing


def cactus(x: FloatArray) -> FloatArray:
    """The field of a ribbed trunk with two arms."""
    ribs = 0.025 * np.cos(9 * np.arctan2(x[..., 2], x[..., 0]))
    trunk = cone(x, (0, -0.6, 0), (0, 1.9, 0), 0.40, 0.34) + ribs
    left = join(
        0.1, cone(x, (0, 0.5, 0), (-0.75, 0.62, 0), 0.17, 0.17), cone(x, (-0.75, 0.62, 0), (-0.8, 1.35, 0), 0.18, 0.16)
    )
    right = join(
        0.1, cone(x, (0, 0.9, 0), (0.66, 1.0, 0.1), 0.15, 0.15), cone(x, (0.66, 1.0, 0.1), (0.7, 1.6, 0.1), 0.16, 0.14)
    )
    return join(0.12, trunk, left, right)


def make_slivers(V: FloatArray, F: IntArray, height: float, rounds: int = 3) -> tuple[FloatArray, IntArray]:
    """Insert points near corners and sides into the triangles below a height, in several rounds: needles and caps."""
    random = np.random.default_rng(22)
    for _ in range(rounds):
        low = np.flatnonzero((V[F, 1] < height).all(axis=1))
        parts = 10.0 ** random.uniform(-4, 0, (len(low), 3))
        new = len(V) + np.arange(len(low))
        V = np.concatenate([V, np.einsum("tk,tkd->td", parts / parts.sum(axis=1, keepdims=True), V[F[low]])])
        around = [np.stack([F[low, k], F[low, (k + 1) % 3], new], axis=1) for k in range(3)]
        F = np.concatenate([np.delete(F, low, axis=0), *around])
    return V, F


def least_angles(V: FloatArray, F: IntArray) -> FloatArray:
    """The smallest angle of every triangle, in degrees."""
    sides = V[np.roll(F, -1, axis=1)] - V[F]
    other = -np.roll(sides, 1, axis=1)
    sines = np.linalg.norm(np.cross(sides, other), axis=2)
    return np.degrees(np.arctan2(sines, (sides * other).sum(axis=2))).min(axis=1)


def count_iterations(problem: Problem, parameterisation: str, reference: Reference, most: int) -> int | None:
    """Iterations of VectorAdam alone to the first injective map, or None if it takes more than ``most``."""
    stage = VectorAdam(parameterisation=parameterisation, reference=reference, iterations=most)
    result = solve(problem, strategy=[stage], max_iterations=most)
    return result.n_iterations if result.injective else None


def main(output: Path, size: int = 44, iterations: int = 1000) -> dict[str, Any]:
    figure, (axes,) = panels(1, 4, (3.2, 4.0))
    V, F = make_slivers(*standing(cactus, (-1.15, -0.5, -0.6), (1.05, 2.4, 0.6), size), height=-0.15)
    angles = least_angles(V, F)
    plot_surface(V, F, axes[0])
    axes[0].set_title(f"{len(F):,} triangles,\nleast angle {angles.min():.1e}°", size=10)
    corners = V[F]
    front = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])[:, 2] > 0
    axes[1].add_collection(PolyCollection(corners[front, :, :2], facecolors="#cfe0d4", edgecolors=INK, linewidths=0.25))
    axes[1].set(xlim=(-0.22, 0.22), ylim=(-0.5, 0.05), aspect="equal")
    axes[1].set_axis_off()
    axes[1].set_title("its bottom", size=10)
    numbers: dict[str, Any] = {
        "triangles": len(F),
        "least angle": float(f"{angles.min():.2g}"),
        "angles below 1°": int((angles < 1).sum()),
    }
    for ax, name in zip(axes[2:], ("the disk", "G"), strict=True):
        if name == "G":
            problem = Problem(V, F, *targets.boundary_to(V, F, targets.letter("G")))
        else:
            problem = onto(V, F, targets.disk())
        result = solve(problem)
        show(ax, problem, result.uv, f"onto {name}: iterations {result.n_iterations}")
        numbers[name] = {
            "flips": flips(problem, result.uv),
            "iterations": result.n_iterations,
            "alone": {
                f"{p}, {reference}": count_iterations(problem, p, reference, iterations)
                for p in ("tanh", "si-log")
                for reference in ("equilateral", "corrected", "rest")
            },
        }
    save(figure, output, "figure_22")
    return numbers


if __name__ == "__main__":
    run(main)
