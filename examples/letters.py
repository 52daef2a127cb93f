"""Seven letters by one command
===============================

Each surface is mapped by ``qhm map surface.obj --to letter:X``. The surfaces of A and P have a hole of their own.
"""

from __future__ import annotations

import contextlib
import io as streams
import json
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
from numpy.typing import NDArray

from common import FloatArray, flips, panels, run, save, show
from quasiharmonic import Problem, boundary_loops, io, quasi_harmonic_map, surfaces
from quasiharmonic.plot import plot_surface
from quasiharmonic.ui.cli import main as qhm

Mesh = tuple[FloatArray, NDArray[np.int64]]


def disk(height: Any, size: int) -> Mesh:
    """The unit disk lifted to a height, a function of x and y."""
    V, F = surfaces.disk(size)
    return np.column_stack([V, height(*V.T)]), F


def ring(height: Any, size: int) -> Mesh:
    """A square with a round hole, lifted to a height, a function of x and y."""
    V, F = surfaces.annulus(2 * size)
    far = np.abs(V).max(axis=1)
    V *= (far / np.hypot(*V.T))[:, None] ** (2 - 2 * far)[:, None]
    return np.column_stack([V, height(*V.T)]), F


def seven(size: int) -> dict[str, tuple[str, Mesh]]:
    """The letter and the surface of each example."""
    return {
        "cat": ("R", surfaces.cat(size)),
        "vault with a hole": ("A", ring(lambda x, y: 0.6 * np.cos(x) * np.cos(y), size)),
        "saddle": ("G", disk(lambda x, y: x * y, size)),
        "dome": ("H", disk(lambda x, y: 1.2 * (1 - x * x - y * y), size)),
        "wave with a hole": ("P", ring(lambda x, y: 0.3 * np.sin(3 * x + y), size)),
        "ripples": ("G", disk(lambda x, y: 0.2 * np.cos(8 * np.hypot(x, y)), size)),
        "folds": ("S", disk(lambda x, y: 0.25 * np.sin(6 * x) * (1 + y), size)),
    }


def main(output: Path, size: int = 20) -> dict[str, Any]:
    figure, axes = panels(3, 7, (2.3, 2.6))
    numbers: dict[str, Any] = {}
    for k, (name, (letter, (V, F))) in enumerate(seven(size).items()):
        with TemporaryDirectory() as folder, contextlib.redirect_stdout(streams.StringIO()):
            source, written, report = (str(Path(folder, file)) for file in ("in.obj", "out.obj", "report.json"))
            io.write_obj(source, io.MeshData(V, F))
            status = qhm(["map", source, "--to", f"letter:{letter}", "-o", written, "--json", report])
            facts = json.loads(Path(report).read_text(encoding="utf-8"))
            uv = io.map_of(io.read_mesh(written))
        fixed = np.concatenate(boundary_loops(F, len(V)))
        problem = Problem(V, F, fixed, uv[fixed])
        tutte = quasi_harmonic_map(problem)
        plot_surface(V, F, axes[0][k])
        axes[0][k].set_title(name, size=10)
        show(axes[1][k], problem, tutte, "Tutte", pins=False)
        show(axes[2][k], problem, uv, f"letter:{letter}", pins=False)
        numbers[f"{name} onto {letter}"] = {
            "triangles": len(F),
            "loops": len(problem.domain.loops),
            "exit status": status,
            "bijective": facts["bijective"],
            "iterations": facts["n_iterations"],
            "inverted by Tutte's embedding": flips(problem, tutte),
        }
    save(figure, output, "letters")
    return numbers


if __name__ == "__main__":
    run(main)
