"""Compare `unwrap` on hard-surface models with uvunwrap and xatlas.

    python benchmarks/hard_surface.py [-o docs/speed/hard_surface.md] [--picture docs/images/hard_surface.png]

Requires uvunwrap and xatlas (``pip install '.[bench]'``). All programs pack charts for a texture of 1,024 texels with a
padding of 4. Columns are those of `unwrapping.py`, and two more: "whole" is the share of the edges inside flat faces,
by length, that are no seams. "straight" is the share of the charts' outlines, by length, that lies within 1° of an axis
of the texture. The first rows are medians over the models of the ratio of `unwrap` to another program.
"""

from __future__ import annotations

import argparse
from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np

import hard_models as models
from hard_models import Mesh
from quasiharmonic import surfaces, unwrap
from quasiharmonic.util.arrays import FloatArray, IntArray
from speed import machine
from unwrapping import RESOLUTION, Corners, Unwrap, by_uvunwrap, by_xatlas, cpu_seconds, measure, ours

# Largest angles in degrees between triangles in one plane, and between a straight side and an axis.
_FLAT, _SKEW = 1e-4, 1.0
_DRAWN = "L bracket with a fillet", "stairs", "house", "plate with holes", "tube with caps", "robot"
_COLUMNS = "charts", "seams", "used", "stretch, 99 %", "whole", "straight", "CPU s"


def shares(V: FloatArray, F: IntArray, corners: Corners) -> tuple[float, float]:
    """Return which share of the flat edges is whole, and which share of the outlines is straight."""
    start, end = F.ravel(), np.roll(F, -1, axis=1).ravel()
    uv, ahead = corners.reshape(-1, 2), np.roll(corners, -1, axis=1).reshape(-1, 2)
    upward = (start < end)[:, None]
    low, high = np.where(upward, uv, ahead), np.where(upward, ahead, uv)
    order = np.lexsort((np.maximum(start, end), np.minimum(start, end)))
    ends = np.sort(np.stack([start, end], axis=1), axis=1)[order]
    pair = np.flatnonzero((ends[1:] == ends[:-1]).all(axis=1))
    one, other = order[pair], order[pair + 1]
    joined = np.hypot(*(low[one] - low[other]).T) + np.hypot(*(high[one] - high[other]).T) < 1e-3
    normals = np.cross(V[F[:, 1]] - V[F[:, 0]], V[F[:, 2]] - V[F[:, 0]])
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    turned = np.degrees(2 * np.arcsin(np.linalg.norm(normals[one // 3] - normals[other // 3], axis=1) / 2))
    length = np.linalg.norm(V[start[one]] - V[end[one]], axis=1)
    flat = turned < _FLAT
    inner = np.zeros(len(start), dtype=bool)
    inner[one[joined]] = inner[other[joined]] = True
    short, long = np.sort(np.abs(ahead - uv)[~inner], axis=1).T
    run = np.hypot(short, long)
    straight = run[short <= np.tan(np.radians(_SKEW)) * long].sum() / run.sum()
    return float(length[flat & joined].sum() / length[flat].sum()) if flat.any() else 1.0, float(straight)


def all_models() -> Iterator[tuple[str, Mesh]]:
    """Yield name and mesh of every model."""
    yield "box", models.box(1, 2, 3, times=2)
    yield "channel", models.channel()
    yield "L bracket with a fillet", models.bracket(fillet=6)
    yield "stairs", models.stairs()
    yield "house", models.house()
    yield "plate with holes", models.plate(4, 2)
    yield "gear", models.gear()
    yield "tube", models.tube(24, rings=4)
    yield "tube with caps", models.tube(16, rings=4, caps=True)
    yield "hexagonal prism", models.tube(6, rings=4, caps=True)
    yield "cone", models.cone(24)
    yield "robot", models.robot()
    yield "blocks", models.terrain(6, np.random.default_rng(1))


def draw(layouts: dict[tuple[str, str], Corners], names: Sequence[str], ways: Sequence[str], path: Path) -> None:
    """Draw the layouts of some models (columns) by several programs (rows), each triangle by its normal."""
    import matplotlib.pyplot as plt
    from matplotlib.collections import PolyCollection

    meshes = dict(all_models())
    figure, axes = plt.subplots(len(ways), len(names), figsize=(2.4 * len(names), 2.5 * len(ways)))
    for row, way in zip(axes, ways, strict=True):
        for axis, name in zip(row, names, strict=True):
            V, F = meshes[name]
            normal = np.cross(V[F[:, 1]] - V[F[:, 0]], V[F[:, 2]] - V[F[:, 0]])
            normal /= np.linalg.norm(normal, axis=1)[:, None]
            uv = layouts[name, way]
            uv = uv * (RESOLUTION if uv.max() <= 1 else 1)
            axis.add_collection(PolyCollection(uv, facecolors=0.55 + 0.4 * normal, edgecolors="black", linewidths=0.15))
            axis.set(xlim=(0, RESOLUTION), ylim=(0, RESOLUTION), aspect="equal", xticks=[], yticks=[])
            axis.set_title(f"{name}, {way.strip('`')}", fontsize=8)
    figure.tight_layout()
    figure.savefig(path, dpi=80)
    plt.close(figure)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("-o", "--output", type=Path, help="write the table here as well")
    parser.add_argument("--picture", type=Path, help="draw some layouts side by side")
    options = parser.parse_args()
    ways: dict[str, Unwrap] = {"`unwrap`": ours, "uvunwrap": by_uvunwrap, "xatlas": by_xatlas}
    unwrap(*surfaces.disk(4), resolution=64)  # imports are not timed
    rows, figures = list[str](), dict[str, list[list[float]]]()
    layouts: dict[tuple[str, str], Corners] = {}
    for name, (V, F) in all_models():
        for way, method in ways.items():
            began = cpu_seconds()
            corners = method(V, F)
            seconds = cpu_seconds() - began
            layouts[name, way] = corners
            found, (whole, straight) = measure(V, F, corners), shares(V, F, corners)
            values = [found.charts, found.seams, found.used, found.at_99, whole, straight, seconds]
            figures.setdefault(way, []).append(values)
            certified = "yes" if found.certified else "no"
            cells = f"{found.charts} | " + " | ".join(f"{value:.2f}" for value in values[1:])
            rows.append(f"| {name} | {way} | {cells} | {certified} |")
    head = f"| model | program | {' | '.join(_COLUMNS)} | certified |\n|{'---|' * (len(_COLUMNS) + 3)}\n"
    mine = np.array(figures["`unwrap`"])
    medians = []
    for way in list(ways)[1:]:
        with np.errstate(all="ignore"):
            ratio = np.nanmedian(mine / np.array(figures[way]), axis=0)
        medians.append(f"| median ratio | to {way} | {' | '.join(f'{value:.2f}' for value in ratio)} | |")
    table = f"{machine()}\n\n{head}" + "\n".join([*medians, *rows]) + "\n"
    print(table)
    if options.output is not None:
        options.output.write_text(table, encoding="utf-8")
    if options.picture is not None:
        draw(layouts, _DRAWN, list(ways), options.picture)


if __name__ == "__main__":
    main()
