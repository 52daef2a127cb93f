"""A sewing pattern
===================

A plush fish of four panels, flattened to scale and written with a seam allowance. Colours show changes of length.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection, PolyCollection
from matplotlib.colors import TwoSlopeNorm
from numpy.typing import NDArray

from common import INK, FloatArray, colorbar, panels, run, save
from quasiharmonic import distortion, flatten, surfaces, write_pattern
from quasiharmonic.apps.flattening.patterns import pattern
from quasiharmonic.geometry.mesh.topology import boundary_edges, boundary_loops
from quasiharmonic.ui.plot.canvas import shade
from quasiharmonic.util.arrays import IntArray

LENGTH, ALLOWANCE, GAP = 300.0, 7.0, 20.0
BACK, BELLY = (0.95, 0.55, 0.25), (1.00, 0.85, 0.60)
# The eye: position along the body, height on its side (both from 0 to 1), and radius in millimetres.
EYE = 0.15, 0.38, 11.0


class Panel(NamedTuple):
    """A part of the body between two seams.

    Attributes
    ----------
    V, F
        Vertices in millimetres, and triangles, counterclockwise from outside.
    side : (n, 2) float64
        Each vertex's position along the body and height on the side, both from 0 to 1; 1 is the back or the belly.
    """

    V: FloatArray
    F: IntArray
    side: FloatArray


def body(along: FloatArray, up: FloatArray, top: bool) -> FloatArray:
    """The right side of the fish, (n, 3) in millimetres."""
    # A drop that starts at the nose and ends in a high, flat tail.
    drop = 2.35 * np.sqrt(along) * (1 - along) ** 0.9
    tail = np.clip((along - 0.72) / 0.28, 0, 1) ** 1.6
    high = (64 if top else 52) * drop + 58 * tail + 3 * along
    wide = 40 * drop + 7 * along * (1 - along**6)
    angle = 0.5 * np.pi * up * (1 if top else -1)
    return np.stack([LENGTH * along, -wide * np.cos(angle), high * np.sin(angle) + 10 * drop], axis=1)


def panel(size: int, top: bool, left: bool) -> Panel:
    """One of the four panels, from a grid whose first column is collapsed at the nose."""
    side, F = surfaces.grid(3 * size, size)
    nose = side[:, 0] < 1e-9
    number = np.where(nose, np.count_nonzero(~nose), np.cumsum(~nose) - 1)
    side, F = np.concatenate([side[~nose], [[0.0, 0.0]]]), number[F]
    F = F[(F[:, [1, 2, 0]] != F).all(axis=1)]
    if top:
        side, F = with_eye(side, F)
    if not top:
        F = F[:, ::-1]
    V = body(side[:, 0], side[:, 1], top)
    return Panel(V * [1, -1, 1], F[:, ::-1], side) if left else Panel(V, F, side)


def with_eye(side: FloatArray, F: IntArray) -> tuple[FloatArray, IntArray]:
    """Remove the triangles of the eye, and move the vertices around them to its rim."""
    along, up, radius = EYE
    step = 1e-4
    middle, ahead, above = (
        body(np.array([x]), np.array([y]), True)[0] for x, y in ((along, up), (along + step, up), (along, up + step))
    )
    metric = np.array([np.linalg.norm(ahead - middle), np.linalg.norm(above - middle)]) / step
    away = (side - [along, up]) * metric
    inside = np.hypot(*away.T) < radius
    F = F[~inside[F].any(axis=1)]
    rim = max(boundary_loops(F, len(side)), key=lambda loop: -np.hypot(*away[loop].T).max())
    side = side.copy()
    side[rim] = [along, up] + radius * away[rim] / np.hypot(*away[rim].T)[:, None] / metric
    used, F = np.unique(F, return_inverse=True)
    return side[used], F.reshape(-1, 3)


def laid_out(maps: list[FloatArray]) -> list[FloatArray]:
    """Arrange maps below each other, with space for their allowances."""
    placed, low = [], 0.0
    for uv in maps:
        uv = uv - uv.min(axis=0)
        low -= np.ptp(uv[:, 1]) + GAP
        placed.append(uv + np.array([0.0, low]))
    return placed


def seam_length(places: FloatArray, F: IntArray, on: NDArray[np.bool_]) -> float:
    """Length of the boundary edges between marked vertices."""
    ends = boundary_edges(F, len(places))
    ends = ends[on[ends].all(axis=1)]
    return float(np.linalg.norm(places[ends[:, 0]] - places[ends[:, 1]], axis=1).sum())


def show_body(ax: Axes, parts: list[Panel]) -> None:
    """Draw the fish from its right, with its seams as lines."""
    turn = np.radians(-28)
    frame = np.array([[np.cos(turn), np.sin(turn), 0], [-0.25 * np.sin(turn), 0.25 * np.cos(turn), 0.97]])
    towards = np.cross(frame[0], frame[1])
    triangles, colors, depth, lines = [], [], [], []
    for k, part in enumerate(parts):
        corners = part.V[part.F]
        normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
        normal /= np.linalg.norm(normal, axis=1)[:, None]
        front = normal @ towards > 0
        light = normal[front] @ (np.array([-0.3, -0.6, 0.75]) / np.linalg.norm([0.3, 0.6, 0.75]))
        triangles.append(corners[front] @ frame.T)
        colors.append(shade(np.tile(BACK if k < 2 else BELLY, (light.size, 1)), light))
        depth.append(corners[front].mean(axis=1) @ towards)
        ends = boundary_edges(part.F, len(part.V))
        seen = np.isin(ends, part.F[front]).all(axis=1)
        lines.append(part.V[ends[seen]] @ frame.T)
    order = np.argsort(np.concatenate(depth))
    color = np.concatenate(colors)[order]
    ax.add_collection(PolyCollection(np.concatenate(triangles)[order], facecolors=color, edgecolors=color, lw=0.4))
    ax.add_collection(LineCollection(np.concatenate(lines), colors=[INK], lw=1.2))


def main(output: Path, size: int = 24) -> dict[str, Any]:
    names = "upper right", "upper left", "lower right", "lower left"
    parts = [panel(size, top, left) for top in (True, False) for left in (False, True)]
    results = [flatten(part.V, part.F) for part in parts]
    placed = laid_out([result.uv for result in results])
    starts = np.cumsum([0, *(len(part.V) for part in parts)])
    F = np.concatenate([part.F + start for part, start in zip(parts, starts, strict=False)])
    uv = np.concatenate(placed)
    output.mkdir(parents=True, exist_ok=True)
    write_pattern(output / "pattern.svg", F, uv, unit="mm", allowance=ALLOWANCE)
    lines = pattern(F, uv, unit="mm", allowance=ALLOWANCE)

    figure, axes = panels(1, 2, (6.2, 5.6))
    show_body(axes[0][0], parts)
    axes[0][0].set_title("a fish of four panels", size=11)
    # The change of the mean length over both directions, in percent.
    measured = [distortion(part.V, part.F, place) for part, place in zip(parts, placed, strict=True)]
    change = np.concatenate([50 * (found.sigma1 + found.sigma2) - 100 for found in measured])
    drawn = PolyCollection(uv[F], array=change, cmap="RdBu_r", norm=TwoSlopeNorm(0, -6, 6), edgecolors="face", lw=0.3)
    axes[0][1].add_collection(drawn)
    for loops, style in ((lines.seam, (0, (4, 2))), (lines.cut, "solid")):
        closed = [np.concatenate([loop, loop[:1]]) for loop in loops]
        axes[0][1].add_collection(LineCollection(closed, colors=[INK], lw=0.9, linestyles=[style]))
    axes[0][1].set_title(f"to cut and to sew, {ALLOWANCE:g} mm apart", size=11)
    for ax in axes[0]:
        ax.autoscale_view()
        ax.set_aspect("equal")
        ax.set_axis_off()
    colorbar(figure, drawn, "change of lengths, %", extend="both")
    save(figure, output, "pattern")

    numbers: dict[str, Any] = {}
    for name, part, place, result, found in zip(names, parts, placed, results, measured, strict=True):
        middle, edge = part.side[:, 1] < 1e-9, part.side[:, 1] > 1 - 1e-9
        numbers[name] = {
            "triangles": len(part.F),
            "bijective": result.certificate.bijective,
            "area, of the surface's": float((found.share * found.area_ratio).sum() / found.scale**2),
            "strongest stretch": float(found.sigma1.max()),
            "strongest shrinking": float(found.sigma2.min()),
            "seam along the side, mm": seam_length(place, part.F, middle),
            "seam along the back or belly, mm": seam_length(place, part.F, edge),
        }
    return numbers


if __name__ == "__main__":
    run(main)
