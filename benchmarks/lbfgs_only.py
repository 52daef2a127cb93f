"""Solve thirty problems by L-BFGS alone, with each functional and parameterisation (the paper's Figure 10).

    python benchmarks/lbfgs_only.py TABLE.csv [--scans FOLDER] [--size 64] [-n 600] [--columns "V₃ tanh" …]
    python benchmarks/lbfgs_only.py --summary

Five surfaces are mapped to the six letters of the figure, by arc length along the outer outline. The surfaces are the
gallery's; with scans, they are the first problem of each name in a folder (``FOLDER/lucy_G/input.obj``). Each run adds
a row to the table; the same command resumes an interrupted run. `records/letters_alone.csv` has the results. Each run
starts at ξ = 0 and uses no other method.
"""

from __future__ import annotations

import argparse
import csv
import sys
import time
from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path
from typing import NamedTuple

from quasiharmonic import Problem, distortion, io, solve, targets
from quasiharmonic.solver.methods import LBFGS
from quasiharmonic.util.arrays import FloatArray, IntArray

RECORDS = Path(__file__).parent / "records" / "letters_alone.csv"
LETTERS = "GSRAPH"
#: Maximum number of triangles of the gallery's surfaces at size 24; at size 64 they have more.
SMALL = 5000
#: Objectives by name: functional, parameterisation and reference triangles. The paper uses the last three.
COLUMNS = {
    "V₃ tanh": ("dirichlet", "tanh", "equilateral"),
    "V₁ tanh": ("neumann", "tanh", "equilateral"),
    "V₄ tanh": ("poisson", "tanh", "equilateral"),
    "V₄ by edges tanh": ("edge-poisson", "tanh", "equilateral"),
    "V₃ si-log": ("dirichlet", "si-log", "equilateral"),
    "V₁ si-log": ("neumann", "si-log", "equilateral"),
    "V₄ si-log": ("poisson", "si-log", "equilateral"),
    "V₃ si-log, rest": ("dirichlet", "si-log", "rest"),
    "V₁ si-log, rest": ("neumann", "si-log", "rest"),
    "V₄ si-log, rest": ("poisson", "si-log", "rest"),
}


class Run(NamedTuple):
    """One run, as stored in the table."""

    surface: str
    letter: str
    triangles: int
    column: str
    iterations: int
    flips: int
    mips: str
    cpu_seconds: float


def made(size: int) -> Iterator[tuple[str, FloatArray, IntArray]]:
    """Yield the gallery's five surfaces."""
    sys.path.append(str(Path(__file__).parent.parent / "examples"))
    from sculptures import sculpture

    for name in ("angel", "gargoyle", "rabbit", "bust", "hand"):
        yield name, *sculpture(name, size)


def scanned(folder: Path) -> Iterator[tuple[str, FloatArray, IntArray]]:
    """Yield the surfaces of problem folders named after surface and letter."""
    done = set()
    for path in sorted(folder.glob("*_?/input.obj")):
        name = path.parent.name[:-2]
        if name not in done:
            done.add(name)
            V, F, _, _ = io.read_problem(path.parent)
            yield f"scan of {name}", V, F


def measure(surface: str, V: FloatArray, F: IntArray, letter: str, column: str, iterations: int) -> Run:
    """Measure one run."""
    problem = Problem(V, F, *targets.boundary_to(V, F, targets.filled(targets.letter(letter))))
    functional, parameterisation, reference = COLUMNS[column]
    stage = LBFGS(functional=functional, parameterisation=parameterisation, reference=reference, iterations=iterations)
    began = time.process_time()
    result = solve(problem, strategy=[stage], max_iterations=iterations)
    seconds = time.process_time() - began
    flips = len(result.certificate.inverted) + len(result.certificate.degenerate)
    mips = f"{distortion(V, F, result.uv).statistics('mips').mean:.3g}" if result.injective else ""
    return Run(surface, letter, len(F), column, result.n_iterations, flips, mips, round(seconds, 2))


def read(path: Path) -> list[Run]:
    """Return the rows of the table."""
    if not path.exists():
        return []
    with path.open(newline="", encoding="utf-8") as file:
        return [
            Run(surface, letter, int(triangles), column, int(iterations), int(flips), mips, float(seconds))
            for surface, letter, triangles, column, iterations, flips, mips, seconds in [*csv.reader(file)][1:]
        ]


def summary(runs: Iterable[Run]) -> dict[str, dict[str, int | float]]:
    """Return for each column the problems solved, their total, the maximum iterations and the CPU seconds."""
    found: dict[str, dict[str, int | float]] = {}
    for run in runs:
        column = found.setdefault(run.column, {"of": 0, "solved": 0, "most iterations": 0, "CPU seconds": 0})
        column["of"] += 1
        column["CPU seconds"] = round(column["CPU seconds"] + run.cpu_seconds, 1)
        if run.flips == 0:
            column["solved"] += 1
            column["most iterations"] = max(column["most iterations"], run.iterations)
    return found


def by_kind(runs: Sequence[Run]) -> dict[str, dict[str, dict[str, int | float]]]:
    """Return the summary separately for small and large gallery surfaces and for scans."""
    scans = [run for run in runs if run.surface.startswith("scan of ")]
    large = [run for run in runs if run not in scans and run.triangles > SMALL]
    small = [run for run in runs if run not in scans and run.triangles <= SMALL]
    return {"gallery": summary(large), "gallery, small": summary(small), "scans": summary(scans)}


def main() -> None:
    """Add rows to a table, or summarise one."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("table", type=Path, nargs="?", default=RECORDS)
    parser.add_argument("--scans", type=Path, metavar="FOLDER")
    parser.add_argument("--size", type=int, default=64, help="of the gallery's surfaces (64)")
    parser.add_argument("--columns", nargs="+", choices=COLUMNS, default=list(COLUMNS))
    parser.add_argument("-n", "--iterations", type=int, default=600)
    parser.add_argument("--summary", action="store_true", help="of the table as it is")
    options = parser.parse_args()
    runs = read(options.table)
    if not options.summary:
        done = {(run.surface, run.triangles, run.letter, run.column) for run in runs}
        surfaces = [*(scanned(options.scans) if options.scans else made(options.size))]
        with options.table.open("a", newline="", encoding="utf-8") as file:
            table = csv.writer(file, lineterminator="\n")
            if not runs:
                table.writerow(Run._fields)
            for column in options.columns:
                for surface, V, F in surfaces:
                    for letter in LETTERS:
                        if (surface, len(F), letter, column) not in done:
                            table.writerow(measure(surface, V, F, letter, column, options.iterations))
                            file.flush()
        runs = read(options.table)
    for kind, columns in by_kind(runs).items():
        for column, row in columns.items():
            print(f"{kind}, {column}: {row}")


if __name__ == "__main__":
    main()
