"""The paper's evaluation (Figures 14 and 16) on problems of every size: distortion and time, by size and by family.

    OMP_NUM_THREADS=1 MKL_NUM_THREADS=1 python benchmarks/evaluation.py -n 2100 -o evaluation.csv
    python benchmarks/evaluation.py --summary benchmarks/records/evaluation.csv.gz

The problems have 100 to 20,000 triangles, evenly spread in the logarithm. They come from the families of `problems`
with a known solution, three families mapped to outlines, and surfaces of ``examples/sculptures.py`` mapped to letters.
Each is solved by the paper's strategy, by ``speed``, and, if si-log found the map, by tanh alone on the same triangles.
A row is written after each problem; the same command resumes an interrupted run.
"""

from __future__ import annotations

import argparse
import csv
import gzip
import sys
import time
from collections.abc import Iterable, Iterator, Sequence
from functools import lru_cache
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np

from problems import make, parse
from quasiharmonic import MapResult, Problem, distortion, solve, targets
from quasiharmonic.problem.result import Step
from quasiharmonic.solver.methods import VectorAdam
from quasiharmonic.util.arrays import FloatArray

sys.path.append(str(Path(__file__).resolve().parent.parent / "examples"))
from sculptures import sculpture

RECORDS = Path(__file__).parent / "records" / "evaluation.csv.gz"
FEASIBLE = "noise", "jam", "flow", "swirl", "adrift", "pins", "spiral", "comb", "maze", "limbs", "carved"
OUTLINES = "glyph", "polygon", "star"
FAMILIES = *FEASIBLE, *OUTLINES, "sculpture"
#: Minimum and maximum number of triangles.
LEAST, MOST = 100, 20_000
#: CPU seconds for one run; longer runs are stopped.
LIMIT = 20.0
#: The lower part of the generator's difficulties, as in ``dataset.py``.
HARDEST = 0.7
SURFACES, LETTERS, HEIGHTS = ("angel", "gargoyle", "rabbit", "bust", "hand"), "GSRAPH", (20, 26, 33, 41, 50, 61)
#: Limits of the bands of size and of effort in the tables.
SIZES, EFFORTS = (100, 300, 1000, 3000, 20_000), (0, 3, 30, 100, 300, 1000)
#: Limits of the bands of the share of triangles that Tutte's embedding inverts.
INVERTED = 0, 0.01, 0.03, 0.1, 1
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
    """Yield names of the first problems: families in turn, sizes and difficulties spread evenly."""
    cells = len(SURFACES) * len(LETTERS) * len(HEIGHTS)
    for i in range(count):
        turn, family = divmod(i, len(FAMILIES))
        if FAMILIES[family] == "sculpture":
            # A step coprime to their number visits all of them.
            surface, rest = divmod(turn * 97 % cells, len(LETTERS) * len(HEIGHTS))
            letter, height = divmod(rest, len(HEIGHTS))
            yield f"sculpture:{SURFACES[surface]}:{LETTERS[letter]}:{HEIGHTS[height]}"
            continue
        # Multiples of these fill the unit square evenly for any count (Roberts' sequence).
        size, hard = (0.5 + turn * np.array((0.7548776662466927, 0.5698402909980532))) % 1.0
        triangles = round(LEAST * (MOST / LEAST) ** size)
        yield f"{FAMILIES[family]}:{2_000_000 + turn}:{round(HARDEST * hard, 3)} triangles={triangles}"


@lru_cache(maxsize=4)
def problem_named(name: str) -> tuple[Problem, bool]:
    """Return a problem, and whether a solution is known to exist."""
    if name.startswith("sculpture:"):
        _, surface, letter, height = name.split(":")
        V, F = sculpture(surface, int(height))
        return Problem(V, F, *targets.boundary_to(V, F, targets.filled(targets.letter(letter)))), False
    made, _, triangles = name.partition(" triangles=")
    case = make(*parse(made), triangles=int(triangles))
    return Problem(case.V, case.F, case.fixed, case.target), case.feasible


def family_of(name: str) -> str:
    """Return the first word of a problem's name."""
    return name.partition(":")[0]


def thin(problem: Problem) -> float:
    """Return the share of rest triangles with an angle below 25°, which the paper corrects (§10)."""
    V = np.column_stack([problem.V, np.zeros((problem.n, 3 - problem.V.shape[1]))])
    a, b, c = V[problem.F].transpose(1, 0, 2)
    area = np.linalg.norm(np.cross(b - a, c - a), axis=1)
    sides = np.sort([np.linalg.norm(p - q, axis=1) for p, q in ((a, b), (b, c), (c, a))], axis=0)
    # The smallest angle is between the two longer sides.
    return float(np.mean(area < np.sin(np.deg2rad(25)) * sides[1] * sides[2]))


def limited(problem: Problem, strategy: Any) -> tuple[MapResult, float]:
    """Run a search within the CPU time limit; return the result and its CPU seconds."""
    fresh = Problem(problem.V, problem.F, problem.fixed, problem.target)
    start = time.process_time()

    def watch(_: Step) -> None:
        if time.process_time() - start > LIMIT:
            raise KeyboardInterrupt

    result = solve(fresh, strategy=strategy, callback=watch)
    return result, time.process_time() - start


def measured(name: str) -> dict[str, Any]:
    """Return the row of a problem."""
    problem, feasible = problem_named(name)
    row: dict[str, Any] = {"problem": name, "triangles": len(problem.F), "feasible": int(feasible)}
    row["thin"] = f"{thin(problem):.3f}"
    for run, strategy in zip(
        RUNS, ("paper", [VectorAdam(reference="corrected", iterations=1000)], "speed"), strict=True
    ):
        # If si-log failed, the paper's second stage already was tanh alone.
        if run == "tanh" and row["paper_stage"] != 1:
            continue
        result, seconds = limited(problem, strategy)
        if run == "paper":
            row["start_flipped"] = result.history[0].inverted
        row[f"{run}_stage"] = len(result.stages) if result.injective else 0
        row[f"{run}_iterations"] = result.n_iterations
        row[f"{run}_seconds"] = f"{seconds:.4f}"
        if result.injective:
            found = distortion(problem.V, problem.F, result.uv).statistics("mips")
            row[f"{run}_mips"], row[f"{run}_median"] = f"{found.mean:.5g}", f"{found.median:.5g}"
    return row


def read(path: Path) -> list[Row]:
    """Return the rows of a table, compressed or not; an empty list if the file does not exist."""
    if not path.exists():
        return []
    with gzip.open(path, "rt", encoding="utf-8") if path.suffix == ".gz" else path.open(encoding="utf-8") as file:
        return [row for row in csv.DictReader(file) if row["speed_seconds"]]


def number(rows: Iterable[Row], column: str) -> FloatArray:
    """Return a column; empty cells become NaN."""
    return np.array([float(row[column] or "nan") for row in rows])


def by_si_log(rows: Iterable[Row]) -> list[Row]:
    """Return problems for comparing si-log and tanh: both found a map, and Tutte's embedding is not injective."""
    return [
        row for row in rows if row["paper_stage"] == "1" and row["tanh_mips"] and int(row["start_flipped"] or 0) > 0
    ]


def in_bands(rows: Iterable[Row], column: str, edges: Sequence[float]) -> dict[str, list[Row]]:
    """Return rows by band of a column's number, with the band's label as key."""
    bands: dict[str, list[Row]] = {f"{low:,} to {high:,}": [] for low, high in pairwise(edges)}
    for row in rows:
        k = int(np.searchsorted(edges, float(row[column]), side="right")) - 1
        list(bands.values())[min(max(k, 0), len(bands) - 1)].append(row)
    return bands


def by_family(rows: Iterable[Row]) -> dict[str, list[Row]]:
    """Return the rows of each family."""
    families: dict[str, list[Row]] = {family: [] for family in FAMILIES}
    for row in rows:
        families[family_of(row["problem"])].append(row)
    return families


def strategies(rows: Sequence[Row]) -> str:
    """Return the problems solved, time and distortion of the paper's strategy and of ``speed``."""
    lines = ["| strategy | solved | CPU s: 50, 95, 100 % | MIPS: 25, 50, 75 % |", "|---|---|---|---|"]
    both = [row for row in rows if row["paper_mips"] and row["speed_mips"]]
    for run in ("paper", "speed"):
        solved = int((number(rows, f"{run}_stage") > 0).sum())
        seconds, mips = (
            ", ".join(f"{q:.2g}" for q in np.percentile(values, shares))
            for values, shares in (
                (number(rows, f"{run}_seconds"), (50, 95, 100)),
                (number(both, f"{run}_mips"), (25, 50, 75)),
            )
        )
        lines.append(f"| `{run}` | {solved} of {len(rows)} | {seconds} | {mips} |")
    return "\n".join(lines)


def compared(groups: dict[str, list[Row]], what: str) -> str:
    """Compare si-log's map with tanh's on the same triangles, one row per group."""
    head = f"| {what} | si-log got through | compared | MIPS, si-log / tanh: 10, 50, 90 % | lower | half the surface |"
    lines = [head, "|---|---|---|---|---|---|"]
    for name, rows in groups.items():
        pairs = by_si_log(rows)
        if not pairs:
            continue
        mean, median = (number(pairs, f"paper_{word}") / number(pairs, f"tanh_{word}") for word in ("mips", "median"))
        first = np.mean([row["paper_stage"] == "1" for row in rows])
        spread = ", ".join(f"{q:.2f}" for q in np.percentile(mean, (10, 50, 90)))
        cells = (
            f"{first:.0%} of {len(rows)}",
            len(pairs),
            spread,
            f"{np.mean(mean < 1):.0%}",
            f"{np.median(median):.2f}",
        )
        lines.append(f"| {name} | {' | '.join(map(str, cells))} |")
    return "\n".join(lines)


def summary(rows: Sequence[Row]) -> str:
    """Return all tables."""
    return "\n\n".join(
        [
            strategies(rows),
            compared({"all": list(rows)} | in_bands(rows, "triangles", SIZES), "triangles"),
            compared(by_family(rows), "family"),
            compared(in_bands(rows, "paper_iterations", EFFORTS), "si-log's iterations"),
        ]
    )


def spread(problem: Problem, parameterisation: str) -> FloatArray:
    """Return MIPS of one method's first map: the 50, 90 and 99 % quantiles over the surface, and the mean."""
    stage = VectorAdam(parameterisation=parameterisation, reference="corrected", iterations=1000)
    found = distortion(problem.V, problem.F, limited(problem, [stage])[0].uv)
    order = np.argsort(found.mips)
    mips, share = found.mips[order], found.share[order]
    return np.array([*mips[np.searchsorted(np.cumsum(share), (0.5, 0.9, 0.99))], mips @ share])


def explained(rows: Iterable[Row], count: int) -> str:
    """Compare si-log's and tanh's distortion by quantiles, on some problems that both solve; solves them again."""
    pairs = [row for row in by_si_log(rows) if int(row["triangles"]) <= 3000]
    inverted = number(pairs, "start_flipped") / number(pairs, "triangles")
    words = "half the surface", "90 % of it", "99 % of it", "mean"
    lines = [f"| inverted at the start | problems | {' | '.join(f'{word}: 50 %, lower' for word in words)} |"]
    lines.append("|---" * (2 + len(words)) + "|")
    for low, high in pairwise(INVERTED):
        some = [row for row, share in zip(pairs, inverted, strict=True) if low <= share < high]
        some = some[:: max(1, len(some) // count)][:count]
        made = [problem_named(row["problem"])[0] for row in some]
        ratios = np.array([spread(problem, "si-log") / spread(problem, "tanh") for problem in made])
        cells = [f"{np.median(ratio):.2f}, {np.mean(ratio < 1):.0%}" for ratio in ratios.T]
        lines.append(f"| {low:.0%} to {high:.0%} | {len(some)} | {' | '.join(cells)} |")
    return "\n".join(lines)


def main() -> None:
    """Run the missing problems, or summarise."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("-n", "--count", type=int, default=2100, help="problems (%(default)s)")
    parser.add_argument("-o", "--output", type=Path, default=Path("evaluation.csv"), help="table (%(default)s)")
    parser.add_argument("--summary", type=Path, metavar="TABLE", help="summarise a table and end")
    parser.add_argument(
        "--why", type=int, metavar="N", help="of that table, quantiles of some N problems of a kind solved again"
    )
    options = parser.parse_args()
    if options.summary:
        rows = read(options.summary)
        print(explained(rows, options.why) if options.why else summary(rows))
        return
    done = {row["problem"] for row in read(options.output)}
    before = options.output.read_bytes() if options.output.exists() else b""
    with options.output.open("a", encoding="utf-8", newline="") as file:
        table = csv.DictWriter(file, COLUMNS)
        if not before:
            table.writeheader()
        elif not before.endswith(b"\n"):
            # A line truncated by a kill stays on its own and is not read.
            file.write("\n")
        for name in names(options.count):
            if name not in done:
                table.writerow(measured(name))
                file.flush()


if __name__ == "__main__":
    main()
