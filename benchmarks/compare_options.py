"""Cost and benefit of each choice: functional, parameterisation, descent method, strategy, energy.

    OMP_NUM_THREADS=1 python benchmarks/compare_options.py -o docs/choose [--scans FOLDER …]

Seven surfaces are mapped to letters (``examples/sculptures.py``); only one choice varies at a time. ``--scans`` adds
the problems of folders. Write a Markdown table for each choice, which the page *How to choose* includes. Figures are
medians. Times are CPU times relative to the first row, since machines differ.
"""

from __future__ import annotations

import argparse
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
from scipy.spatial import KDTree

from quasiharmonic import Descent, MapResult, Problem, distortion, harmonise, io, polish, solve
from quasiharmonic.solver.methods import LBFGS, Alternating, Newton, Untangling, VectorAdam
from quasiharmonic.solver.search.stages import STRATEGIES
from speed import machine

sys.path.append(str(Path(__file__).resolve().parent.parent / "examples"))
from sculptures import seven

Row = list[str]
#: Rows of cells; the first cell is the row's label.
Table = list[Row]
LIMIT = 600


def afresh(problem: Problem) -> Problem:
    """Return the same problem without cached results."""
    return Problem(problem.V, problem.F, problem.fixed, problem.target)


def clocked(run: Callable[[], MapResult]) -> tuple[MapResult, float]:
    """Return the result of a call, and its CPU seconds."""
    start = time.process_time()
    return run(), time.process_time() - start


def mips(problem: Problem, uv: np.ndarray) -> float:
    """Return the mean MIPS energy over the surface."""
    return float(distortion(problem.V, problem.F, uv).statistics("mips").mean)


def searched(problems: list[Problem], strategy: str | list[Descent]) -> list[tuple[MapResult, float]]:
    """Solve each problem from scratch."""
    most = 2000 if isinstance(strategy, str) else LIMIT
    return [clocked(lambda p=p: solve(afresh(p), strategy=strategy, max_iterations=most)) for p in problems]


def compared(problems: list[Problem], choices: dict[str, str | list[Descent]]) -> Table:
    """Return a row for each choice: number solved, median iterations and time of all, median MIPS of those solved."""
    rows, unit = [HEAD], 0.0
    for name, strategy in choices.items():
        runs = searched(problems, strategy)
        seconds = float(np.median([seconds for _, seconds in runs]))
        unit = unit or seconds
        pairs = zip(problems, runs, strict=True)
        angles = [mips(problem, result.uv) for problem, (result, _) in pairs if result.injective]
        rows.append(
            [
                name,
                f"{len(angles)} of {len(problems)}",
                f"{np.median([result.n_iterations for result, _ in runs]):.0f}",
                f"{seconds / unit:.1f}",
                f"{np.median(angles):.2g}" if angles else "",
            ]
        )
    return rows


HEAD = ["", "solved", "iterations", "time", "MIPS of those solved"]


def functionals(problems: list[Problem]) -> Table:
    """Return the table of the four functionals, with si-log on the rest mesh's triangles."""
    names = {
        "V₃ `dirichlet`": "dirichlet",
        "V₂ `sobolev`": "sobolev",
        "V₁ `neumann`": "neumann",
        "V₄ `poisson`": "poisson",
    }
    choices: dict[str, str | list[Descent]] = {
        name: [VectorAdam(functional=word, parameterisation="si-log", reference="corrected", iterations=LIMIT)]
        for name, word in names.items()
    }
    return compared(problems, choices)


def parameterisations(problems: list[Problem]) -> Table:
    """Return the table of both parameterisations, each on two kinds of triangles."""
    choices: dict[str, str | list[Descent]] = {
        f"`{word}`, {reference}": [VectorAdam(parameterisation=word, reference=reference, iterations=LIMIT)]
        for word in ("tanh", "si-log")
        for reference in ("equilateral", "corrected")
    }
    return compared(problems, choices)


def exchanged(problem: Problem) -> Problem:
    """Swap two interior vertices: the one farthest from the boundary and one halfway to it."""
    uv = solve(afresh(problem)).uv
    inside = np.setdiff1d(np.arange(problem.n), problem.fixed)
    room, _ = KDTree(uv[problem.fixed]).query(uv[inside])
    first = inside[np.argmax(room)]
    away = np.linalg.norm(uv[inside] - uv[first], axis=1)
    second = inside[np.argmin(np.abs(away - 0.5 * room.max()))]
    target = np.vstack([problem.target, uv[second], uv[first]])
    return Problem(problem.V, problem.F, np.append(problem.fixed, [first, second]), target)


def pins(problems: list[Problem]) -> Table:
    """Return the table of problems with two interior vertices swapped."""
    choices: dict[str, str | list[Descent]] = {
        f"`{word}`": [VectorAdam(parameterisation=word, iterations=LIMIT)] for word in ("tanh", "si-log")
    }
    choices["strategy `speed`"] = "speed"
    return compared([exchanged(problem) for problem in problems], choices)


def methods(problems: list[Problem]) -> Table:
    """Return the table of descent methods, each from ξ = 0; tanh on equilateral triangles unless stated otherwise."""
    choices: dict[str, str | list[Descent]] = {
        f"`{method.label}`": [method(iterations=LIMIT)] for method in (VectorAdam, LBFGS, Newton, Alternating)
    }
    choices["`l-bfgs`, si-log"] = [LBFGS(parameterisation="si-log", reference="corrected", iterations=LIMIT)]
    choices["`untangling`"] = [Untangling(iterations=LIMIT)]
    return compared(problems, choices)


def strategies(problems: list[Problem]) -> Table:
    """Return the table of all strategies with their default settings."""
    return compared(problems, {f"`{name}`": name for name in STRATEGIES})


def lowered(problem: Problem, uv: np.ndarray) -> Iterator[tuple[str, Callable[[], MapResult]]]:
    """Yield the name and the call of every method that lowers distortion."""
    given = problem.V, problem.F, uv
    for energy in ("symmetric-dirichlet", "arap-barrier", "blend", "mips"):
        yield f'`polish`, "{energy}"', lambda e=energy: polish(*given, fixed=problem.fixed, energy=e)
    for energy in ("symmetric-dirichlet", "arap", "springs", "area"):
        yield f'`harmonise`, "{energy}"', lambda e=energy: harmonise(*given, fixed=problem.fixed, energy=e)


def energies(problems: list[Problem]) -> Table:
    """Return the table of methods that lower the distortion of the first map."""
    columns: dict[str, list[tuple[float, ...]]] = {}
    for problem in problems:
        first, took = clocked(lambda p=problem: solve(afresh(p)))
        for name, run in [("first map", None), *lowered(problem, first.uv)]:
            result, seconds = clocked(run) if run else (first, took)
            if not result.injective:
                raise RuntimeError(f"{name} lost the map")
            found = distortion(problem.V, problem.F, result.uv)
            sizes = np.exp(quantile(np.abs(np.log(found.area_ratio)), found.share))
            isometric = found.statistics("isometric")
            row = seconds, found.statistics("mips").mean, isometric.median, isometric.maximum, sizes
            columns.setdefault(name, []).append(row)
    unit = float(np.median([row[0] for row in columns["first map"]]))
    rows = [["", "time", "MIPS", "isometric, median", "isometric, worst", "areas off by"]]
    for name, values in columns.items():
        seconds, *others = np.median(np.array(values), axis=0)
        rows.append([name, f"{seconds / unit:.0f}", *(f"{value:.2g}" for value in others)])
    return rows


def quantile(values: np.ndarray, share: np.ndarray) -> float:
    """Return the value below which half of the surface's area lies."""
    order = np.argsort(values)
    return float(values[order][np.searchsorted(np.cumsum(share[order]), 0.5)])


TABLES = functionals, parameterisations, pins, methods, strategies, energies


def beside(own: Table, scans: Table | None) -> str:
    """Return a Markdown table with the figures of scans beside those of the project's own surfaces."""
    if scans is not None:
        first = [own[0][0], *own[0][1:], *(f"scans: {scans[0][1]}", *scans[0][2:])]
        own = [first, *([*left, *right[1:]] for left, right in zip(own[1:], scans[1:], strict=True))]
    lines = [own[0], ["---"] * len(own[0]), *own[1:]]
    return "".join(f"| {' | '.join(line)} |\n" for line in lines)


def main() -> None:
    """Measure and write the tables."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("-o", "--output", type=Path, metavar="FOLDER", help="where tables go (else to the screen)")
    parser.add_argument("--size", type=int, default=40, help="height of the surfaces' grid (40)")
    parser.add_argument(
        "--scans", type=Path, nargs="+", default=[], metavar="FOLDER", help="with problem folders, at any depth"
    )
    parser.add_argument(
        "--only", nargs="+", default=[], metavar="TABLE", help=f"of {', '.join(t.__name__ for t in TABLES)} (all)"
    )
    options = parser.parse_args()
    problems = list(seven(options.size).values())
    folders = [path.parent for folder in options.scans for path in sorted(folder.rglob("input.obj"))]
    scans = [Problem(*io.read_problem(folder)) for folder in folders]
    solve(problems[0])  # import all modules before the measurements
    for measure in TABLES:
        if options.only and measure.__name__ not in options.only:
            continue
        text = beside(measure(problems), measure(scans) if scans else None)
        print(f"{measure.__name__}\n{text}", flush=True)
        if options.output:
            options.output.mkdir(parents=True, exist_ok=True)
            (options.output / f"{measure.__name__}.md").write_text(f"% {machine()}\n\n{text}", encoding="utf-8")


if __name__ == "__main__":
    main()
