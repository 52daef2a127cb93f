"""A spline surface fitted to a mesh
====================================

A ramp that winds over itself, mapped to the unit square, sampled on a grid and fitted by a bicubic spline.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from scipy.interpolate import RectBivariateSpline

from common import FloatArray, panels, run, save
from quasiharmonic import InverseMap, injective_map, surfaces, targets
from quasiharmonic.geometry.mesh.topology import boundary_edges
from quasiharmonic.plot import plot_map, plot_surface


def ramp(at: FloatArray) -> FloatArray:
    """Points (n, 3) of a spiral ramp of one turn and a quarter, for parameters (n, 2) in the unit square."""
    a, b = at.T
    angle, radius = 2.5 * np.pi * a, 0.5 + b
    return np.stack([radius * np.cos(angle), radius * np.sin(angle), 1.4 * a + 0.15 * np.sin(np.pi * b)], axis=1)


def main(output: Path, size: int = 40) -> dict[str, Any]:
    # Irregular triangles, so that the result does not depend on a regular grid.
    nx, ny = 2 * size, size // 2
    places, F = surfaces.grid(nx, ny)
    inside = np.setdiff1d(np.arange(len(places)), boundary_edges(F, len(places)))
    places[inside] += np.random.default_rng(0).uniform(-0.3, 0.3, (inside.size, 2)) / (nx, ny)
    V = ramp(places)

    corners = 0, nx, len(V) - 1, len(V) - 1 - nx
    boundary = targets.boundary_to(V, F, targets.rectangle(1, 1), corners=corners)
    inverse = InverseMap(V, F, injective_map(V, F, *boundary, polish="symmetric-dirichlet").uv)

    u, v, at = inverse.sample_grid(25, 25)
    samples = inverse.surface(at)
    splines = [RectBivariateSpline(u, v, samples[..., axis]) for axis in range(3)]

    # Compare at the vertices, which lie on the true surface, with the spline at their mapped positions.
    fitted = np.stack([spline.ev(*inverse.uv.T) for spline in splines], axis=1)
    middles = ramp(places[F].mean(axis=1)) - V[F].mean(axis=1)
    extent = float(np.linalg.norm(np.ptp(V, axis=0)))

    fine, cells = surfaces.grid(nx, ny)
    smooth = np.stack([spline.ev(*fine.T) for spline in splines], axis=1)
    figure, axes = panels(1, 3, (4.0, 4.3))
    plot_surface(V, F, axes[0][0])
    plot_map(V, F, inverse.uv, ax=axes[0][1])
    axes[0][1].plot(*np.stack(np.meshgrid(u, v), axis=-1).reshape(-1, 2).T, ".", color="black", ms=2)
    plot_surface(smooth, cells, axes[0][2])
    for ax, title in zip(axes[0], ("the mesh", "its map and the samples", "the spline"), strict=True):
        ax.set_title(title, size=10)
    save(figure, output, "spline_fit")
    return {
        "triangles": len(F),
        "bijective": bool(inverse.certificate.bijective),
        "samples found": int(at.found.sum()),
        "furthest from the surface": float(np.linalg.norm(fitted - V, axis=1).max() / extent),
        "the mesh's own": float(np.linalg.norm(middles, axis=1).max() / extent),
    }


if __name__ == "__main__":
    run(main)
