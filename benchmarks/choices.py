"""What each choice costs and brings: functional, parameterisation, method of descent, strategy, energy.

    OMP_NUM_THREADS=1 python benchmarks/choices.py -o docs/choose

Seven surfaces go onto letters (``examples/sculptures.py``), everything the same but for the one choice. Writes a table
for each choice, in Markdown, which the page *How to choose* includes. Figures are medians over the seven; times are
relative to the first row, since machines differ.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np

from quasiharmonic import MapResult, Problem, distortion, harmonise, polish, solve
from quasiharmonic.descent import LBFGS, Alternating, Descent, Newton, VectorAdam

sys.path.append(str(Path(__file__).resolve().parent.parent / "examples"))
from figure_17 import swapped
from sculptures import seven

Row = list[str]
LIMIT = 600


def afresh(problem: Problem) -> Problem:
    """The same problem with nothing worked out in advance."""
    return Problem(problem.V, problem.F, problem.fixed, problem.target)


def mips(problem: Problem, uv: np.ndarray) -> float:
    """Mean over the surface."""
    return float(distortion(problem.V, problem.F, uv).summary("mips").mean)


def searched(problems: list[Problem], *stages: Descent, **options: Any) -> list[MapResult]:
    """Each problem from scratch."""
    return [solve(afresh(problem), strategy=list(stages), max_iterations=LIMIT, **options) for problem in problems]


def outcome(problems: list[Problem], results: list[MapResult], unit: float) -> Row:
    """How many were solved; of all, medians of iterations and time; of those solved, of MIPS."""
    good = [k for k, result in enumerate(results) if result.injective]
    angles = [mips(problems[k], results[k].uv) for k in good]
    return [
        f"{len(good)} of {len(results)}",
        f"{np.median([result.iterations for result in results]):.0f}",
        f"{np.median([result.seconds for result in results]) / unit:.1f}",
        f"{np.median(angles):.2g}" if angles else "",
    ]


def table(head: Row, rows: list[Row]) -> str:
    """In Markdown."""
    lines = [head, ["---"] * len(head), *rows]
    return "".join(f"| {' | '.join(line)} |\n" for line in lines)


def compared(problems: list[Problem], choices: dict[str, Descent]) -> list[Row]:
    """A row for each choice."""
    runs = {name: searched(problems, stage) for name, stage in choices.items()}
    unit = float(np.median([result.seconds for result in next(iter(runs.values()))]))
    return [[name, *outcome(problems, results, unit)] for name, results in runs.items()]


HEAD = ["solved", "iterations", "time", "MIPS of those solved"]


def functionals(problems: list[Problem]) -> str:
    """The four functionals, si-log on the rest mesh's triangles."""
    names = {
        "V₃ `dirichlet`": "dirichlet",
        "V₂ `sobolev`": "sobolev",
        "V₁ `neumann`": "neumann",
        "V₄ `poisson`": "poisson",
    }
    choices = {
        name: VectorAdam(functional=word, parameterisation="si-log", reference="corrected", iterations=LIMIT)
        for name, word in names.items()
    }
    return table(["functional", *HEAD], compared(problems, choices))


def parameterisations(problems: list[Problem]) -> str:
    """Both parameterisations, each on two kinds of triangles."""
    choices = {
        f"`{word}`, {reference}": VectorAdam(parameterisation=word, reference=reference, iterations=LIMIT)
        for word in ("tanh", "si-log")
        for reference in ("equilateral", "corrected")
    }
    return table(["parameterisation, reference", *HEAD], compared(problems, choices))


def pins(_: list[Problem]) -> str:
    """Two points of a square that change places, 40 × 40 cells."""
    problem = swapped(40)
    rows = []
    for word in ("tanh", "si-log"):
        result = solve(problem, strategy=[VectorAdam(parameterisation=word, iterations=LIMIT)], max_iterations=LIMIT)
        rows.append([f"`{word}`", str(len(result.certificate.flipped)), str(result.iterations)])
    return table(["two points swapped", "inverted at last", "iterations"], rows)


def methods(problems: list[Problem]) -> str:
    """The methods of descent, tanh on equilateral triangles, each from ξ = 0."""
    methods = VectorAdam, LBFGS, Newton, Alternating
    choices = {f"`{method.word}`": method(iterations=LIMIT) for method in methods}
    return table(["method", *HEAD], compared(problems, choices))


def strategies(problems: list[Problem]) -> str:
    """Both strategies, as they are."""
    rows, unit = [], 0.0
    for name in ("speed", "quality"):
        results = [solve(afresh(problem), strategy=name) for problem in problems]
        seconds = float(np.median([result.seconds for result in results]))
        unit = unit or seconds
        angles = np.median([mips(p, r.uv) for p, r in zip(problems, results, strict=True)])
        solved = sum(result.injective for result in results)
        rows.append([f"`{name}`", f"{solved} of {len(results)}", f"{seconds / unit:.1f}", f"{angles:.2g}"])
    return table(["strategy", "solved", "time", "MIPS of the map"], rows)


def lowered(problem: Problem, uv: np.ndarray) -> Iterator[tuple[str, Callable[[], MapResult]]]:
    """Every way to lower distortion that has a name, not yet run."""
    given = problem.V, problem.F, uv
    for energy in ("symmetric-dirichlet", "arap", "blend", "mips"):
        yield f'`polish`, "{energy}"', lambda e=energy: polish(*given, fixed=problem.fixed, energy=e)
    for energy in ("symmetric-dirichlet", "arap", "springs", "area"):
        yield f'`harmonise`, "{energy}"', lambda e=energy: harmonise(*given, fixed=problem.fixed, energy=e)


def energies(problems: list[Problem]) -> str:
    """What becomes of the first map."""
    columns: dict[str, list[tuple[float, ...]]] = {}
    for problem in problems:
        first = solve(afresh(problem))
        for name, run in [("first map", lambda found=first: found), *lowered(problem, first.uv)]:
            result = run()
            if not result.injective:
                raise RuntimeError(f"{name} lost the map")
            found = distortion(problem.V, problem.F, result.uv)
            sizes = np.exp(quantile(np.abs(np.log(found.area_ratio)), found.share))
            isometric = found.summary("isometric")
            row = result.seconds, found.summary("mips").mean, isometric.median, isometric.maximum, sizes
            columns.setdefault(name, []).append(row)
    unit = float(np.median([row[0] for row in columns["first map"]]))
    rows = []
    for name, values in columns.items():
        seconds, *others = np.median(np.array(values), axis=0)
        rows.append([name, f"{seconds / unit:.0f}", *(f"{value:.2g}" for value in others)])
    return table(["", "time", "MIPS", "isometric, median", "isometric, worst", "areas off by"], rows)


def quantile(values: np.ndarray, share: np.ndarray) -> float:
    """The value below which half of the surface lies."""
    order = np.argsort(values)
    return float(values[order][np.searchsorted(np.cumsum(share[order]), 0.5)])


TABLES = functionals, parameterisations, pins, methods, strategies, energies


def main() -> None:
    """Measure and write."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("-o", "--output", type=Path, metavar="FOLDER", help="where tables go (else to the screen)")
    parser.add_argument("--size", type=int, default=40, help="height of the surfaces' grid (40)")
    parser.add_argument("only", nargs="*", metavar="TABLE", help=f"of {', '.join(t.__name__ for t in TABLES)} (all)")
    options = parser.parse_args()
    problems = list(seven(options.size).values())
    solve(problems[0])  # whatever has to be imported is
    for measure in TABLES:
        if options.only and measure.__name__ not in options.only:
            continue
        text = measure(problems)
        print(f"{measure.__name__}\n{text}", flush=True)
        if options.output:
            options.output.mkdir(parents=True, exist_ok=True)
            (options.output / f"{measure.__name__}.md").write_text(text, encoding="utf-8")


if __name__ == "__main__":
    main()
