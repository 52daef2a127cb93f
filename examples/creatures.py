"""An octopus and an armadillo, cut and flattened
=================================================

Left: the cuts of ``find_cuts``. Middle: flattened after one cut only. Right: flattened after all cuts. Colours show
the largest change of length.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.cm import ScalarMappable
from matplotlib.collections import LineCollection, PolyCollection
from matplotlib.colors import LogNorm

from common import INK, FloatArray, colorbar, panels, run, save
from quasiharmonic import cut_open, distortion, find_cuts, flatten
from quasiharmonic.geometry.mesh.topology import boundary_edges, edge_keys
from quasiharmonic.ui.plot.canvas import shade
from quasiharmonic.util.arrays import IntArray
from sculptures import creature

# Angles of view in degrees: rotation about the vertical axis, and elevation.
SURFACES = {"octopus": (-25, 30), "armadillo": (-30, 12)}
# Minimum gain of a cut for its length.
GAIN = 0.1
# Ticks of the colour bar.
BAR = [1, 1.5, 2, 3, 5]


def show_creature(
    ax: Axes, V: FloatArray, F: IntArray, turned: tuple[int, int], color: FloatArray, cut: IntArray
) -> None:
    """Draw a surface in the colours of its triangles, with the cuts on its visible side."""
    yaw, pitch = np.radians(turned)
    from_side = np.array([[np.cos(yaw), 0, np.sin(yaw)], [0, 1, 0], [-np.sin(yaw), 0, np.cos(yaw)]])
    from_above = np.array([[1, 0, 0], [0, np.cos(pitch), -np.sin(pitch)], [0, np.sin(pitch), np.cos(pitch)]])
    seen = V @ (from_above @ from_side).T
    normal = np.cross(seen[F[:, 1]] - seen[F[:, 0]], seen[F[:, 2]] - seen[F[:, 0]])
    normal /= np.linalg.norm(normal, axis=1)[:, None]
    shades = shade(color, normal @ (np.array([-0.45, 0.6, 0.66]) / np.linalg.norm((0.45, 0.6, 0.66))))
    marked = np.isin(edge_keys(F, np.roll(F, -1, axis=1), len(V)), edge_keys(cut[:, 0], cut[:, 1], len(V)))
    # Paint from back to front, lines slightly before their triangles, so that nearer parts hide farther ones.
    front = np.flatnonzero(normal[:, 2] > 0)
    depth = seen[F[front], 2].mean(axis=1)
    patches = [*seen[F[front], :2]]
    lines = np.stack([seen[F], seen[np.roll(F, -1, axis=1)]], axis=2)[front][marked[front]]
    in_front = np.concatenate([depth, lines[..., 2].mean(axis=1) + 0.02])
    order = np.argsort(in_front)
    faces = np.concatenate([shades[front], np.tile(INK, (len(lines), 1))])
    widths = np.concatenate([np.full(len(front), 0.3), np.full(len(lines), 1.6)])
    patches += [*lines[..., :2]]
    ax.add_collection(
        PolyCollection([patches[k] for k in order], facecolors=faces[order], edgecolors=faces[order], lw=widths[order])
    )
    frame(ax)


def show_map(ax: Axes, F: IntArray, uv: FloatArray, color: FloatArray) -> None:
    """Draw a flat map in the colours of its triangles, and its boundary as a line."""
    ax.add_collection(PolyCollection(uv[F], facecolors=color, edgecolors="face", lw=0.3))
    ax.add_collection(LineCollection(uv[boundary_edges(F, len(uv))], colors=[INK], lw=0.7))
    frame(ax)


def frame(ax: Axes) -> None:
    """Fit the axes to their contents and hide the frame."""
    ax.autoscale_view()
    ax.set_aspect("equal")
    ax.set_axis_off()


def main(output: Path, size: int = 56) -> dict[str, Any]:
    colors = ScalarMappable(LogNorm(1, 5), "magma_r")
    figure, axes = panels(2, 3, (4.6, 4.6))
    numbers: dict[str, Any] = {}
    for row, (name, turned) in zip(axes, SURFACES.items(), strict=True):
        V, F = creature(name, size)
        cut = find_cuts(V, F, min_gain=GAIN)
        one, every = cut_open(V, F), cut_open(V, F, edges=cut)
        numbers[name] = {"triangles": len(F), "edges cut": len(cut)}
        for ax, title, (X, T) in (
            (row[1], "one cut", (one.V, one.F)),
            (row[2], "a cut to every limb", (every.V, every.F)),
        ):
            result = flatten(X, T)
            found = distortion(X, T, result.uv)
            color = colors.to_rgba(found.isometric)[:, :3]
            show_map(ax, T, result.uv, color)
            energy = result.history[-1].energy
            ax.set_title(f"{title}: symmetric Dirichlet {energy:.2f}", size=11)
            numbers[name][title] = {
                "bijective": result.certificate.bijective,
                "symmetric Dirichlet": energy,
                "median stretch": found.statistics("isometric").median,
                "worst stretch": found.statistics("isometric").maximum,
                "seconds": result.seconds,
            }
        show_creature(row[0], V, F, turned, color, cut)
        row[0].set_title(f"{name}, {len(F):,} triangles", size=11)
    colorbar(figure, colors, "max(σ₁, 1/σ₂)")
    figure.axes[-1].set_yticks(BAR)
    save(figure, output, "creatures")
    return numbers


if __name__ == "__main__":
    run(main)
