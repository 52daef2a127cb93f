"""Colours of a fine model on a coarse one
=======================================

A coarse starfish gets texture coordinates by ``unwrap``. The inverse of the map bakes the colours of a fine starfish
into its texture.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.collections import PolyCollection
from matplotlib.image import imsave
from numpy.typing import NDArray
from scipy.ndimage import distance_transform_edt
from scipy.spatial import cKDTree

from common import FloatArray, panels, run, save
from quasiharmonic import InverseMap, surfaces, unwrap
from quasiharmonic.plot import plot_map

# Texels beside a chart that take its colours; half of the space between two charts.
PADDING = 4


def paint(V: FloatArray) -> FloatArray:
    """Colours (n, 3) of a starfish: from orange to violet with dark rings, and light spots."""
    distance = np.hypot(V[:, 0], V[:, 1]) / np.hypot(V[:, 0], V[:, 1]).max()
    base = np.outer(1 - distance, [1.0, 0.6, 0.15]) + np.outer(distance, [0.5, 0.2, 0.65])
    base *= 0.8 + 0.2 * np.cos(30 * distance)[:, None]
    spots = (np.cos(9 * V[:, 0]) * np.cos(9 * V[:, 1]) > 0.75)[:, None]
    return np.clip(np.where(spots, [1.0, 0.95, 0.85], base), 0, 1)


def bake(inverse: InverseMap, side: int, points: FloatArray, colours: FloatArray) -> tuple[FloatArray, float]:
    """The texture (side, side, 3), first row on top, and the share of the texels whose centre is in a chart."""
    u, v = np.meshgrid((np.arange(side) + 0.5) / side, 1 - (np.arange(side) + 0.5) / side)
    at = inverse.locate(np.stack([u, v], axis=2).reshape(-1, 2))
    image = np.zeros((side * side, 3))
    image[at.found] = colours[cKDTree(points).query(inverse.surface(at)[at.found])[1]]
    covered = at.found.reshape(side, side)
    distance, nearest = distance_transform_edt(~covered, return_indices=True)
    padded = np.where((distance <= PADDING)[:, :, None], image.reshape(side, side, 3)[tuple(nearest)], 0.93)
    return padded, float(covered.mean())


def draw(ax: Axes, V: FloatArray, F: NDArray[np.int64], colours: FloatArray) -> None:
    """Draw triangles (f, 3) in colours (f, 3) from above, those behind first."""
    corners = V[F]
    normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    front = np.flatnonzero(normal[:, 2] > 0)
    order = front[np.argsort(corners[front, :, 2].mean(axis=1))]
    shade = 0.55 + 0.45 * normal[order, 2] / np.linalg.norm(normal[order], axis=1)
    faces = colours[order] * shade[:, None]
    ax.add_collection(PolyCollection(corners[order, :, :2], facecolors=faces, edgecolors=faces, linewidths=0.3))
    ax.autoscale_view()
    ax.set_aspect("equal")
    ax.set_axis_off()


def main(output: Path, size: int = 12) -> dict[str, Any]:
    side = 32 * size
    V, F = surfaces.starfish(rings=size)
    fine, fine_faces = surfaces.starfish(rings=6 * size)
    colours = paint(fine)
    result = unwrap(V, F, resolution=side, padding=2 * PADDING)
    vmapping, indices, uvs = result
    texture, covered = bake(InverseMap(V[vmapping], indices, uvs), side, fine, colours)
    output.mkdir(parents=True, exist_ok=True)
    imsave(output / "bake_colours_texture.png", texture)

    figure, axes = panels(1, 4, (3.4, 3.7))
    for ax, title in zip(
        axes[0],
        ("the fine model's colours", f"charts of the coarse model: {result.n_charts}", "texture", "the coarse model"),
        strict=True,
    ):
        ax.set_title(title, size=10)
    draw(axes[0][0], fine, fine_faces, colours[fine_faces].mean(axis=1))
    plot_map(V[vmapping], indices, uvs, ax=axes[0][1])
    axes[0][2].imshow(texture)
    axes[0][2].set_axis_off()
    # The coarse model, its triangles divided so that the picture shows the texture.
    points, positions, faces = V[vmapping], uvs, indices
    for _ in range(3):
        (points, _), (positions, faces) = surfaces.refine(points, faces), surfaces.refine(positions, faces)
    column, row = (side * positions[faces].mean(axis=1).T).astype(int)
    draw(axes[0][3], points, faces, texture[side - 1 - row, column])
    save(figure, output, "bake_colours")
    return {
        "triangles": [len(F), len(fine_faces)],
        "charts": result.n_charts,
        "certified": bool(result.certificate.bijective),
        "stretch at 99 %": result.stretch.p99,
        "covered texels": covered,
        "utilisation": result.utilisation,
    }


if __name__ == "__main__":
    run(main)
