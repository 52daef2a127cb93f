"""Shared helpers of the examples: a turned ring, measures of distortion, panels, and the command line."""

from __future__ import annotations

import argparse
import inspect
import json
import sys
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.collections import PolyCollection
from matplotlib.colors import LogNorm
from matplotlib.figure import Figure
from numpy.typing import NDArray

from quasiharmonic import MapResult, Problem, boundary_loops, inverted_triangles, solve, surfaces, targets
from quasiharmonic.plot import plot_map
from quasiharmonic.solver.methods import VectorAdam
from quasiharmonic.util.arrays import FloatArray

BENCHMARKS = Path(__file__).resolve().parent.parent / "benchmarks"
RED, INK = (0.89, 0.07, 0.17), (0.06, 0.12, 0.29)
COLORS = {"tanh": (0.85, 0.45, 0.10), "si-log": (0.16, 0.38, 0.75)}
#: The colour of `Untangling`, which minimises SBP's regularised energy.
GREEN = (0.35, 0.55, 0.25)


def ring(cells: int, hole: tuple[float, float, float, float], turn: float) -> Problem:
    """The square [-1, 1]² with a hole whose boundary is turned about its own centre by ``turn`` radians."""
    V, F = surfaces.annulus(cells, hole=hole)
    target = V[:, 0] + 1j * V[:, 1]
    inner = np.abs(V).max(axis=1) < 1
    middle = complex(hole[0] + hole[2], hole[1] + hole[3]) / 2
    target[inner] = middle + (target[inner] - middle) * np.exp(1j * turn)
    fixed = np.concatenate(boundary_loops(F, len(V)))
    return Problem(V, F, fixed, np.stack([target.real, target.imag], axis=1)[fixed])


def onto(V: FloatArray, F: NDArray[np.int64], outline: FloatArray, start: int | None = None) -> Problem:
    """A disk-like mesh mapped onto an outline by arc length; boundary vertex ``start`` goes to its first point."""
    (loop,) = boundary_loops(F, len(V))
    at = None if start is None else int(np.flatnonzero(loop == start)[0])
    return Problem(V, F, loop, targets.arc_length(V[loop], outline, start=at))


def first_map(problem: Problem, parameterisation: str, iterations: int = 1000, **options: Any) -> MapResult:
    """The first injective map found by one stage of VectorAdam on V₃, in the rest triangles."""
    stage = VectorAdam(parameterisation=parameterisation, reference="corrected", iterations=iterations)
    return solve(problem, strategy=[stage], max_iterations=iterations, **options)


def ratios(problem: Problem, uv: FloatArray) -> tuple[FloatArray, FloatArray]:
    """σ₁/σ₂ of every triangle relative to its rest shape, and its share of the rest area."""
    mesh = problem.domain.mesh("rest")
    p, q, _ = mesh.derivatives(uv @ (1, 1j))
    p, q = np.abs(p), np.abs(q)
    return (p + q) / np.abs(p - q), mesh.m / mesh.m.sum()


def mips(problem: Problem, uv: FloatArray) -> float:
    """The MIPS energy of §10, ``∫ (σ₁/σ₂ + σ₂/σ₁ − 2)`` over the rest area."""
    ratio, share = ratios(problem, uv)
    return float(share @ (ratio + 1 / ratio - 2))


def flips(problem: Problem, uv: FloatArray) -> int:
    """The exact number of triangles that are not strictly positive."""
    return int(inverted_triangles(problem.F, uv).size)


def colorbar(figure: Figure, drawn: PolyCollection, label: str = "σ₁/σ₂", extend: str = "max") -> None:
    """Add a colour bar at the right and widen the figure for it."""
    width, height = figure.get_size_inches()
    kept = width / (width + 0.9)
    for ax in figure.axes:
        x, y, w, h = ax.get_position(original=True).bounds
        ax.set_position((x * kept, y, w * kept, h))
    figure.set_size_inches(width + 0.9, height)
    bar = figure.colorbar(drawn, cax=figure.add_axes((kept, 0.15, 0.15 / (width + 0.9), 0.7)), extend=extend)
    bar.ax.yaxis.set_major_formatter("{x:g}")
    bar.ax.yaxis.set_minor_formatter("")
    bar.set_label(label)


def inverted_area(problem: Problem, uv: FloatArray) -> float:
    """The total area of the inverted triangles' images."""
    area = problem.domain.mesh("rest").derivatives(uv @ (1, 1j)).area
    return float(-area[area < 0].sum())


def panels(rows: int, columns: int, size: tuple[float, float]) -> tuple[Figure, list[list[Axes]]]:
    """A figure of axes of equal ``size`` in inches, with space for a title above each."""
    width, height = size
    figure = Figure(figsize=(columns * width, rows * height), dpi=100, facecolor="white")
    FigureCanvasAgg(figure)
    axes = [
        [
            figure.add_axes(((j + 0.02) / columns, 1 - (i + 0.98) / rows, 0.96 / columns, 0.84 / rows))
            for j in range(columns)
        ]
        for i in range(rows)
    ]
    return figure, axes


def show(ax: Axes, problem: Problem, uv: FloatArray, title: str, *, size: float = 10, pins: bool = True) -> None:
    """Draw a map, with the number of its inverted triangles under the title."""
    plot_map(problem.V, problem.F, uv, fixed=problem.fixed if pins else None, ax=ax)
    count = flips(problem, uv)
    verdict = f"{count:,} inverted" if count else "none inverted"
    # With a given height matplotlib does not measure the labels of a frame that is not drawn.
    ax.set_title(f"{title}\n{verdict}", y=1, size=size, color=RED if count else INK)


def show_ratios(ax: Axes, problem: Problem, uv: FloatArray, title: str, highest: float) -> PolyCollection:
    """Draw a map coloured by σ₁/σ₂ from 1 to ``highest``, and return the collection for a colour bar."""
    drawn = PolyCollection(
        uv[problem.F],
        array=ratios(problem, uv)[0],
        cmap="viridis",
        norm=LogNorm(1, highest),
        edgecolors="face",
        lw=0.4,
        snap=False,
    )
    ax.add_collection(drawn)
    ax.autoscale_view()
    ax.set_aspect("equal")
    ax.set_axis_off()
    ax.set_title(title, y=1, size=10, color=RED if flips(problem, uv) else INK)
    return drawn


def frames(falling: Sequence[float], count: int) -> list[int]:
    """``count`` indices into a sequence: the first, the last, and those where its running minimum has fallen evenly."""
    left = np.minimum.accumulate(falling)
    last = len(left) - 1
    found = [int(np.argmax(left <= wanted)) for wanted in np.linspace(left[0], left[-1], count)[:-1]]
    for k in range(1, count - 1):
        found[k] = min(max(found[k], found[k - 1] + 1), last)
    return [*found, last]


def save(figure: Figure, output: Path, name: str) -> None:
    """Write a figure as PNG into a folder, and create the folder if it is missing."""
    output.mkdir(parents=True, exist_ok=True)
    figure.savefig(output / f"{name}.png")


def run(main: Callable[..., dict[str, Any]]) -> None:
    """Call ``main(output, …)`` from the command line, with its other integer and boolean parameters as options.

    In a notebook, call it as it is and show the pictures it made.
    """
    parser = argparse.ArgumentParser(
        description=inspect.getmodule(main).__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("-o", "--output", type=Path, default=Path("figures"), metavar="DIR", help="folder (figures)")
    for name, parameter in list(inspect.signature(main).parameters.items())[1:]:
        if isinstance(parameter.default, bool):
            parser.add_argument(f"--{name}", action="store_true")
        else:
            parser.add_argument(f"--{name}", type=int, default=parameter.default, help=f"({parameter.default})")
    in_notebook = "ipykernel" in sys.modules
    options = vars(parser.parse_args([] if in_notebook else None))
    before = {path: path.stat().st_mtime_ns for path in options["output"].glob("*")}
    print(json.dumps(main(**options), indent=2, ensure_ascii=False))
    if in_notebook:
        from IPython.display import Image, display

        for path in sorted(options["output"].glob("*.png")):
            if path.stat().st_mtime_ns != before.get(path):
                display(Image(path))
