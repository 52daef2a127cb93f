"""Closed surfaces, cut open and mapped onto an outline
=======================================================

A sphere, a torus and a surface with two handles, mapped by ``qhm map … --cut --refine``. Cuts are red; in the written
file they are seams.
"""

from __future__ import annotations

import contextlib
import io as streams
import json
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection
from numpy.typing import NDArray

from common import RED, FloatArray, panels, run, save
from quasiharmonic import io
from quasiharmonic.plot import plot_map, plot_surface
from quasiharmonic.ui.cli import main as qhm
from quasiharmonic.ui.plot.canvas import view

Mesh = tuple[FloatArray, NDArray[np.int64]]


def blocks(solid: NDArray[np.bool_], rounds: int = 12) -> Mesh:
    """The smoothed surface of a solid made of unit blocks."""
    padded = np.pad(solid, 1)
    quads = []
    for axis in range(3):
        for sense in (1, -1):
            at = np.argwhere(padded & ~np.roll(padded, -sense, axis=axis))
            # The face between a block and the empty block next to it, counterclockwise from the empty side.
            first, second = np.eye(3, dtype=np.int64)[[(axis + 1) % 3, (axis + 2) % 3]][::sense]
            low = at + (np.eye(3, dtype=np.int64)[axis] if sense > 0 else 0)
            quads.append(np.stack([low, low + first, low + first + second, low + second], axis=1))
    corners = np.concatenate(quads)
    points, index = np.unique(corners.reshape(-1, 3), axis=0, return_inverse=True)
    Q = index.reshape(-1, 4)
    F = np.concatenate([Q[:, [0, 1, 2]], Q[:, [0, 2, 3]]])
    V = points.astype(np.float64)
    ends = np.concatenate([F[:, [0, 1]], F[:, [1, 2]], F[:, [2, 0]]])
    count = np.bincount(ends[:, 0], minlength=len(V))[:, None]
    for _ in range(rounds):
        total = np.zeros_like(V)
        np.add.at(total, ends[:, 0], V[ends[:, 1]])
        V = total / count
    return V, F


def solids(size: int) -> dict[str, tuple[str, Mesh]]:
    """The target and the surface of each example, by name."""
    ball = np.linalg.norm(np.indices((size, size, size)) - (size - 1) / 2, axis=0) < size / 2
    plate = np.ones((size, size, max(2, size // 4)), dtype=bool)
    third = size // 3
    plate[third : size - third, third : size - third] = False
    two = np.ones((2 * size - third, size, max(2, size // 4)), dtype=bool)
    for x in (third, size):
        two[x : x + third, third : size - third] = False
    return {
        "a sphere": ("disk", blocks(ball)),
        "a torus": ("rect:1x1", blocks(plate)),
        "two handles": ("letter:O", blocks(two)),
    }


def cut_lines(ax: Axes, V: FloatArray, F: NDArray[np.int64], ends: NDArray[np.int64]) -> None:
    """Draw the cut edges that are on the visible side."""
    seen = view(V, F)
    near = np.zeros(len(V), dtype=bool)
    near[F[~seen.inside]] = True
    ax.add_collection(LineCollection(seen.points[ends[near[ends].all(axis=1)]], colors=[RED], lw=1.5))


def main(output: Path, size: int = 12) -> dict[str, Any]:
    figure, axes = panels(2, 3, (3.4, 3.7))
    numbers: dict[str, Any] = {}
    for k, (name, (to, (V, F))) in enumerate(solids(size).items()):
        with TemporaryDirectory() as folder, contextlib.redirect_stdout(streams.StringIO()):
            source, written, report = (str(Path(folder, file)) for file in ("in.obj", "out.obj", "report.json"))
            io.write_obj(source, io.MeshData(V, F))
            status = qhm(["map", source, "--to", to, "--cut", "--refine", "-o", written, "--json", report])
            facts = json.loads(Path(report).read_text(encoding="utf-8"))
            flat = io.read_mesh(written)
        plot_surface(V, F, axes[0][k])
        mapped = io.mapped(flat)
        cut_lines(axes[0][k], V, F, mapped.seams[(mapped.seams < len(V)).all(axis=1)])
        axes[0][k].set_title(f"{name}, cut along {len(mapped.seams)} edges", size=10)
        opened = mapped.opened()
        assert opened.uv is not None
        plot_map(opened.V, opened.F, opened.uv, ax=axes[1][k])
        axes[1][k].set_title(f"--to {to}", size=10)
        numbers[name] = {
            "triangles": len(F),
            "handles": (2 - len(V) + len(F) // 2) // 2,
            "edges cut": facts["cut_edges"],
            "vertices added": facts["added_vertices"],
            "exit status": status,
            "bijective": facts["bijective"],
        }
    save(figure, output, "cut")
    return numbers


if __name__ == "__main__":
    run(main)
