"""The paper's evaluation (Figures 14 and 16) on problems of every size: distortion and time, by size and by family.

    OMP_NUM_THREADS=1 MKL_NUM_THREADS=1 python benchmarks/evaluation.py -n 2100 -o evaluation.csv
    python benchmarks/evaluation.py --summary benchmarks/records/evaluation.csv.gz

100 to 20,000 triangles, spread evenly in their logarithm: the families of `problems` of which a solution is known, three
that are laid along outlines, and surfaces of ``examples/sculptures.py`` onto letters. On each run the paper's strategy,
tanh alone on the same triangles where si-log found the map, and ``speed``. A row a problem, written as soon as it is done;
the same command goes on where it was stopped.
"""

from __future__ import annotations

import argparse
import csv
import gzip
import sys
import time
from collections.abc import Iterable, Iterator
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np

from problems import make, parse
from quasiharmonic import MapResult, Problem, distortion, solve, targets
from quasiharmonic.arrays import FloatArray
from quasiharmonic.descent import VectorAdam
from quasiharmonic.result import Step

sys.path.append(str(Path(__file__).resolve().parent.parent / "examples"))
from sculptures import sculpture

RECORDS = Path(__file__).parent / "records" / "evaluation.csv.gz"
FEASIBLE = "noise", "jam", "flow", "swirl", "adrift", "pins", "spiral", "comb", "maze", "limbs", "carved"
OUTLINES = "glyph", "polygon", "star"
FAMILIES = *FEASIBLE, *OUTLINES, "sculpture"
#: Triangles at least and at most.
LEAST, MOST = 100, 20_000
#: CPU seconds for one run; what takes longer is ended.
LIMIT = 20.0
#: Of the generator's difficulties the lower part, as in ``dataset.py``.
HARDEST = 0.7
SURFACES, LETTERS, HEIGHTS = ("angel", "gargoyle", "rabbit", "bust", "hand"), "GSRAPH", (20, 26, 33, 41, 50, 61)
RUNS = "paper", "tanh", "speed"
COLUMNS = (
    "problem",
    "triangles",
    "feasible",
    "thin",
    "start_flipped",
    *(f"{run}_{what}" for run in RUNS for what in ("stage", "iterations", "seconds", "mips", "median")),
)
Row = dict[str, str]


def names(count: int) -> Iterator[str]:
    """Names of the first problems: families in turn, sizes and difficulties spread evenly."""
    cells = len(SURFACES) * len(LETTERS) * len(HEIGHTS)
    for i in range(count):
        turn, family = divmod(i, len(FAMILIES))
        if FAMILIES[family] == "sculpture":
            # A step that has no factor in common with their number visits all of them.
            surface, rest = divmod(turn * 97 % cells, len(LETTERS) * len(HEIGHTS))
            letter, height = divmod(rest, len(HEIGHTS))
            yield f"sculpture:{SURFACES[surface]}:{LETTERS[letter]}:{HEIGHTS[height]}"
            continue
        # Multiples of these fill the unit square evenly, however many there are (Roberts' sequence).
        size, hard = (0.5 + turn * np.array((0.7548776662466927, 0.5698402909980532))) % 1.0
        triangles = round(LEAST * (MOST / LEAST) ** size)
        yield f"{FAMILIES[family]}:{2_000_000 + turn}:{round(HARDEST * hard, 3)} triangles={triangles}"


@lru_cache(maxsize=4)
def problem_named(name: str) -> tuple[Problem, bool]:
    """A problem, and whether a solution is known to exist."""
    if name.startswith("sculpture:"):
        _, surface, letter, height = name.split(":")
        V, F = sculpture(surface, int(height))
        return Problem(V, F, *targets.boundary_to(V, F, targets.filled(targets.letter(letter)))), False
    made, _, triangles = name.partition(" triangles=")
    case = make(*parse(made), triangles=int(triangles))
    return Problem(case.V, case.F, case.fixed, case.target), case.feasible


def family_of(name: str) -> str:
    """The first word of a problem's name."""
    return name.partition(":")[0]


def thin(problem: Problem) -> float:
    """The share of rest triangles with an angle below 25°, which the paper corrects (§10)."""
    V = np.column_stack([problem.V, np.zeros((problem.n, 3 - problem.V.shape[1]))])
    a, b, c = V[problem.F].transpose(1, 0, 2)
    area = np.linalg.norm(np.cross(b - a, c - a), axis=1)
    sides = np.sort([np.linalg.norm(p - q, axis=1) for p, q in ((a, b), (b, c), (c, a))], axis=0)
    # The least angle is between the two longer sides.
    return float(np.mean(area < np.sin(np.deg2rad(25)) * sides[1] * sides[2]))


def limited(problem: Problem, strategy: Any) -> tuple[MapResult, float]:
    """A search, ended when its CPU time is over, and the CPU time it took."""
    fresh = Problem(problem.V, problem.F, problem.fixed, problem.target)
    start = time.process_time()

    def watch(_: Step) -> None:
        if time.process_time() - start > LIMIT:
            raise KeyboardInterrupt

    result = solve(fresh, strategy=strategy, callback=watch)
    return result, time.process_time() - start


def measured(name: str) -> dict[str, Any]:
    """One row."""
    problem, feasible = problem_named(name)
    row: dict[str, Any] = {"problem": name, "triangles": len(problem.F), "feasible": int(feasible)}
    row["thin"] = f"{thin(problem):.3f}"
    for run, strategy in zip(
        RUNS, ("paper", [VectorAdam(reference="corrected", iterations=1000)], "speed"), strict=True
    ):
        # Where si-log did not get through, the paper's second stage is tanh alone.
        if run == "tanh" and row["paper_stage"] != 1:
            continue
        result, seconds = limited(problem, strategy)
        if run == "paper":
            row["start_flipped"] = result.history[0].flipped
        row[f"{run}_stage"] = len(result.stages) if result.injective else 0
        row[f"{run}_iterations"] = result.iterations
        row[f"{run}_seconds"] = f"{seconds:.4f}"
        if result.injective:
            found = distortion(problem.V, problem.F, result.uv).summary("mips")
            row[f"{run}_mips"], row[f"{run}_median"] = f"{found.mean:.5g}", f"{found.median:.5g}"
    return row


def read(path: Path) -> list[Row]:
    """The rows of a table, compressed or not; none if it does not exist."""
    if not path.exists():
        return []
    with gzip.open(path, "rt", encoding="utf-8") if path.suffix == ".gz" else path.open(encoding="utf-8") as file:
        return [row for row in csv.DictReader(file) if row["speed_seconds"]]


def number(rows: Iterable[Row], column: str) -> FloatArray:
    """A column; NaN where there is nothing."""
    return np.array([float(row[column] or "nan") for row in rows])


def main() -> None:
    """Run what is missing, or summarise."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("-n", "--count", type=int, default=2100, help="problems (%(default)s)")
    parser.add_argument("-o", "--output", type=Path, default=Path("evaluation.csv"), help="table (%(default)s)")
    parser.add_argument("--summary", type=Path, metavar="TABLE", help="summarise a table and end")
    options = parser.parse_args()
    if options.summary:
        print(summary(read(options.summary)))
        return
    done = {row["problem"] for row in read(options.output)}
    new = not options.output.exists()
    with options.output.open("a", encoding="utf-8", newline="") as file:
        table = csv.DictWriter(file, COLUMNS)
        if new:
            table.writeheader()
        for name in names(options.count):
            if name not in done:
                table.writerow(measured(name))
                file.flush()


if __name__ == "__main__":
    main()
