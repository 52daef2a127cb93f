"""Cost and benefit of the options of a search: functional, parameterisation, descent method, pins, energy.

    OMP_NUM_THREADS=1 python benchmarks/compare_options.py [-o docs/choose] [--only TABLE ...]

Seven generated surfaces are mapped to letters (``examples/sculptures.py``). Each table varies one choice. Numbers are
medians. Times are CPU times relative to the first row. Write searches.md, pins.md and energies.md.
"""

from __future__ import annotations

import argparse
import sys
import time
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path

import numpy as np
from scipy.spatial import KDTree

from quasiharmonic import Descent, MapResult, Problem, distortion, harmonise, polish, solve
from quasiharmonic.solver.methods import LBFGS, Alternating, Newton, Untangling, VectorAdam
from quasiharmonic.util.arrays import FloatArray
from speed import machine

sys.path.append(str(Path(__file__).resolve().parent.parent / "examples"))
from sculptures import seven

#: Rows of cells.
Table = list[list[str]]
#: Maximum number of iterations of a single method, and of a strategy.
LIMIT, LIMIT_OF_STRATEGIES = 600, 2000
RESULTS = "solved", "iterations", "time", "MIPS of those solved"


def copy(problem: Problem) -> Problem:
    """Return the same problem without cached results."""
    return Problem(problem.V, problem.F, problem.fixed, problem.target)


def measured(run: Callable[[], MapResult]) -> tuple[MapResult, float]:
    """Return the result of a call, and its CPU seconds."""
    start = time.process_time()
    return run(), time.process_time() - start


def compared(problems: list[Problem], heads: tuple[str, ...], choices: dict[tuple[str, ...], str | Descent]) -> Table:
    """Return a row for each choice: number solved, median iterations and time of all, median MIPS of those solved."""
    rows: Table = [[*heads, *RESULTS]]
    unit = 0.0
    for labels, choice in choices.items():
        strategy = choice if isinstance(choice, str) else [choice]
        most = LIMIT_OF_STRATEGIES if isinstance(choice, str) else LIMIT
        call = partial(solve, strategy=strategy, max_iterations=most)
        runs = [measured(partial(call, copy(problem))) for problem in problems]
        seconds = float(np.median([seconds for _, seconds in runs]))
        unit = unit or seconds
        solved = [(p, result.uv) for p, (result, _) in zip(problems, runs, strict=True) if result.injective]
        angles = [distortion(p.V, p.F, uv).statistics("mips").mean for p, uv in solved]
        found = [f"{len(solved)} of {len(problems)}", f"{np.median([r.n_iterations for r, _ in runs]):.0f}"]
        rows.append([*labels, *found, f"{seconds / unit:.1f}", f"{np.median(angles):.2g}" if angles else ""])
    return rows


def searches(problems: list[Problem]) -> Table:
    """Return the table of functionals, parameterisations and methods, each from the identity tensor."""
    heads = "method", "functional", "parameterisation", "reference"
    choices: dict[tuple[str, ...], str | Descent] = {
        ("`vector-adam`", "`dirichlet`", f"`{word}`", reference): VectorAdam(
            parameterisation=word, reference=reference, iterations=LIMIT
        )
        for word in ("tanh", "si-log")
        for reference in ("equilateral", "corrected")
    }
    for name in ("sobolev", "neumann", "poisson"):
        choices["`vector-adam`", f"`{name}`", "`si-log`", "corrected"] = VectorAdam(
            functional=name, parameterisation="si-log", reference="corrected", iterations=LIMIT
        )
    for method in (LBFGS, Newton, Alternating):
        choices[f"`{method.label}`", "`dirichlet`", "`tanh`", "equilateral"] = method(iterations=LIMIT)
    choices["`l-bfgs`", "`dirichlet`", "`si-log`", "corrected"] = LBFGS(
        parameterisation="si-log", reference="corrected", iterations=LIMIT
    )
    choices["`untangling`", "", "", ""] = Untangling(iterations=LIMIT)
    return compared(problems, heads, choices)


def exchanged(problem: Problem) -> Problem:
    """Swap two interior vertices: the one farthest from the boundary and one halfway to it."""
    uv = solve(copy(problem)).uv
    inside = np.setdiff1d(np.arange(problem.n), problem.fixed)
    distance, _ = KDTree(uv[problem.fixed]).query(uv[inside])
    first = inside[np.argmax(distance)]
    away = np.linalg.norm(uv[inside] - uv[first], axis=1)
    second = inside[np.argmin(np.abs(away - 0.5 * distance.max()))]
    target = np.vstack([problem.target, uv[second], uv[first]])
    return Problem(problem.V, problem.F, np.append(problem.fixed, [first, second]), target)


def pins(problems: list[Problem]) -> Table:
    """Return the table of problems with two interior vertices swapped."""
    choices: dict[tuple[str, ...], str | Descent] = {
        (f"`vector-adam`, `{word}`",): VectorAdam(parameterisation=word, iterations=LIMIT)
        for word in ("tanh", "si-log")
    }
    choices["strategy `speed`",] = "speed"
    return compared([exchanged(problem) for problem in problems], ("search",), choices)


def lowered(problem: Problem, uv: FloatArray) -> Iterator[tuple[str, Callable[[], MapResult]]]:
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
        first, took = measured(lambda p=problem: solve(copy(p)))
        for name, run in [("first map", None), *lowered(problem, first.uv)]:
            result, seconds = measured(run) if run else (first, took)
            if not result.injective:
                raise RuntimeError(f"{name}: the map is not injective")
            found = distortion(problem.V, problem.F, result.uv)
            sizes = np.exp(weighted_median(np.abs(np.log(found.area_ratio)), found.share))
            isometric = found.statistics("isometric")
            row = seconds, found.statistics("mips").mean, isometric.median, isometric.maximum, sizes
            columns.setdefault(name, []).append(row)
    unit = float(np.median([row[0] for row in columns["first map"]]))
    rows = [["method, energy", "time", "MIPS", "isometric, median", "isometric, worst", "area factor"]]
    for name, values in columns.items():
        seconds, *others = np.median(np.array(values), axis=0)
        rows.append([name, f"{seconds / unit:.0f}", *(f"{value:.2g}" for value in others)])
    return rows


def weighted_median(values: FloatArray, share: FloatArray) -> float:
    """Return the value below which half of the surface's area lies."""
    order = np.argsort(values)
    return float(values[order][np.searchsorted(np.cumsum(share[order]), 0.5)])


TABLES = {"searches": searches, "pins": pins, "energies": energies}


def main() -> None:
    """Measure, print and write the tables."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("-o", "--output", type=Path, metavar="FOLDER", help="write the tables here as well")
    parser.add_argument("--size", type=int, default=40, help="height of the surfaces' grid (%(default)s)")
    parser.add_argument("--only", nargs="+", choices=TABLES, default=list(TABLES), help="these tables (all)")
    options = parser.parse_args()
    problems = list(seven(options.size).values())
    solve(problems[0])  # import all modules before the measurements
    for name in options.only:
        rows = TABLES[name](problems)
        rows.insert(1, ["---"] * len(rows[0]))
        text = f"{machine()}\n\n" + "".join(f"| {' | '.join(row)} |\n" for row in rows)
        print(f"{name}: {text}", flush=True)
        if options.output:
            options.output.mkdir(parents=True, exist_ok=True)
            (options.output / f"{name}.md").write_text(text, encoding="utf-8")


if __name__ == "__main__":
    main()
