"""Recorded runs of other programs, and of this one where they take hours: readers and summaries.

    python benchmarks/recorded.py > docs/comparisons/tlc_foldover.md
    OMP_NUM_THREADS=1 python benchmarks/recorded.py --repeat  # run this package again, and replace records/anew.csv

``records/README.md`` has the origin of the records.
"""

from __future__ import annotations

import argparse
import csv
import gzip
import time
from collections.abc import Iterable, Sequence
from itertools import pairwise
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

import problems
from quasiharmonic import Problem, distortion, polish, solve
from quasiharmonic.util.arrays import FloatArray
from speed import machine

RECORDS = Path(__file__).parent / "records"
#: The programs in the order of the tables: those that ran every problem of the first 68.
PROGRAMS = "ours speed", "ours quality", "TLC-PN", "TLC-QN", "SBP", "SBP until first injective"
#: The repeated runs of this package.
ANEW = "anew speed"
#: What the table calls the runs of this package.
LABELS = {
    "ours speed": "quasiharmonic",
    ANEW: "quasiharmonic, repeated",
}
#: Where the records were measured; ``records/README.md`` has the details.
PROVENANCE = "Intel Xeon, 2 cores, 2026-11-22, quasiharmonic 0.1.0 at eb0ed78"
#: Less than a tick of the recording clock; ratios use this value for it.
TICK = 0.004
#: Families of the recorded evaluation, and the limits of its bands of size.
EVALUATED = (
    *("noise", "jam", "flow", "swirl", "adrift", "pins", "spiral", "comb", "maze", "limbs", "carved"),
    *("glyph", "polygon", "star", "sculpture"),
)
SIZES = 100, 300, 1000, 3000, 20_000
#: A row of the evaluation.
Row = dict[str, str]


class Run(NamedTuple):
    """One program on one problem.

    Attributes
    ----------
    problem, program : str
    triangles : int
    seconds : float
        CPU seconds of the solver alone.
    injective, feasible : bool
        By `certify`; whether a solution is known to exist.
    start_flipped : int
        Inverted triangles of Tutte's embedding.
    mips, polished, stretch : float
        Mean MIPS, the same after polishing, largest max(σ₁, 1/σ₂); NaN if the map is not injective.
    """

    problem: str
    program: str
    triangles: int
    seconds: float
    injective: bool
    feasible: bool
    start_flipped: int
    mips: float
    polished: float
    stretch: float


def read_records() -> list[Run]:
    """Return all recorded runs on generated problems."""
    with (RECORDS / "rivals.csv").open(encoding="utf-8", newline="") as file:
        return [
            Run(
                row["problem"],
                row["program"],
                int(row["triangles"]),
                float(row["cpu_seconds"] or "nan"),
                row["injective"] == "1",
                row["known_feasible"] == "yes",
                int(row["start_flipped"]),
                *(float(row[name] or "nan") for name in ("mips_mean", "mips_polished", "isometric_max")),
            )
            for row in csv.DictReader(file)
            if ":" in row["problem"]
        ]


def read_repeated_runs(path: Path = RECORDS / "anew.csv") -> list[Run]:
    """Return this package's repeated runs, as `repeat` writes them."""
    with path.open(encoding="utf-8", newline="") as file:
        file.readline()  # machine and versions
        return [
            Run(
                row["problem"],
                row["program"],
                int(row["triangles"]),
                float(row["seconds"]),
                row["injective"] == "True",
                row["feasible"] == "True",
                int(row["start_flipped"]),
                *(float(row[name]) for name in ("mips", "polished", "stretch")),
            )
            for row in csv.DictReader(file)
        ]


def letters() -> list[dict[str, str]]:
    """Return the time and results of TLC-PN and Foldover-free on seven scans mapped to letters."""
    with (RECORDS / "letters.csv").open(encoding="utf-8", newline="") as file:
        return list(csv.DictReader(file))


def on_common_problems(runs: Iterable[Run]) -> dict[str, dict[str, Run]]:
    """Return, for each problem that all programs ran, the run of each program."""
    by_problem: dict[str, dict[str, Run]] = {}
    for run in runs:
        if run.program in (*PROGRAMS, ANEW):
            by_problem.setdefault(run.problem, {})[run.program] = run
    # If SBP never found an injective map, it has no run "until first injective".
    needed = set(PROGRAMS[:-1])
    return {name: row for name, row in by_problem.items() if needed <= row.keys()}


def summary(rows: dict[str, dict[str, Run]], programs: Sequence[str]) -> dict[str, dict[str, Any]]:
    """Return for each program: problems solved, its time relative to the first program, distortion where all solved.

    ``least`` counts the polished maps that are within 1 % of the least distorted one.

    The time of repeated runs is not compared, since they belong to another machine.
    """
    first = programs[0]
    lasting = [row for row in rows.values() if row[first].start_flipped]
    shared = [row for row in lasting if all(name in row and row[name].injective for name in programs)]
    lowest = [np.nanmin([row[name].polished for name in programs]) for row in shared]
    table: dict[str, dict[str, Any]] = {}
    for name in programs:
        ran = [row[name] for row in rows.values() if name in row]
        pairs = [row for row in lasting if name in row and row[name].injective and row[first].injective]
        pairs = [] if name == ANEW else pairs
        ratio = np.array([max(row[name].seconds, TICK) / max(row[first].seconds, TICK) for row in pairs])
        table[name] = {
            "feasible solved": sum(run.injective for run in ran if run.feasible),
            "feasible": sum(row[first].feasible for row in rows.values()),
            "unknown solved": sum(run.injective for run in ran if not run.feasible),
            "unknown": sum(not row[first].feasible for row in rows.values()),
            "ratio": [float(f"{q:.2g}") for q in np.percentile(ratio, (10, 50, 90))] if ratio.size else [],
            "quicker": int((ratio < 1).sum()),
            "of": int(ratio.size),
            "MIPS": median([row[name].mips for row in shared]),
            "polished": median([row[name].polished for row in shared]),
            "least": int(sum(row[name].polished <= 1.01 * least for row, least in zip(shared, lowest, strict=True))),
            "of all": len(shared),
        }
    return table


def median(values: Sequence[float]) -> float:
    """Return the median to four digits; NaN if there are no values."""
    known: FloatArray = np.array(values)[np.isfinite(values)]
    return float(f"{np.median(known):.4g}") if known.size else float("nan")


def table_text(table: dict[str, dict[str, Any]]) -> str:
    """Return the table in Markdown."""
    lines = [
        "| program | known map: solved | unknown: solved | ratio of CPU seconds: 10, 50, 90 % | quicker | "
        "first map's MIPS | polished |",
        "|---|---|---|---|---|---|---|",
    ]
    for name, row in table.items():
        ratio = ", ".join(f"{q:g}" for q in row["ratio"])
        solved = f"{row['feasible solved']} of {row['feasible']} | {row['unknown solved']} of {row['unknown']}"
        quicker = f"{row['quicker']} of {row['of']}" if row["of"] else ""
        lines.append(
            f"| {LABELS.get(name, name)} | {solved} | {ratio} | {quicker} | {row['MIPS']:.3g} | {row['polished']:.3g} |"
        )
    return "\n".join(lines) + "\n"


def table_of_records() -> str:
    """Return the table of all recorded and repeated runs, without a strategy that no longer exists."""
    programs = [name for name in (*PROGRAMS, ANEW) if name != "ours quality"]
    table = table_text(summary(on_common_problems([*read_records(), *read_repeated_runs()]), programs))
    with (RECORDS / "anew.csv").open(encoding="utf-8") as file:
        return f"{PROVENANCE}; repeated: {file.readline().strip()}\n\n{table}"


def repeat(path: Path = RECORDS / "anew.csv") -> None:
    """Run this package again on the problems of the records, certify and polish the maps, and write the runs."""
    runs = []
    for name, row in on_common_problems(read_records()).items():
        made, _, triangles = name.partition(" triangles=")
        case = problems.make(*problems.parse(made), triangles=int(triangles))
        problem = Problem(case.V, case.F, case.fixed, case.target)
        start = time.process_time()
        result = solve(problem, max_iterations=2000)
        seconds = time.process_time() - start
        figures = [np.nan] * 3
        if result.injective:
            polished = polish(case.V, case.F, result.uv, fixed=case.fixed, energy="mips")
            before, after = (distortion(case.V, case.F, uv) for uv in (result.uv, polished.uv))
            means = [found.statistics("mips").mean for found in (before, after)]
            figures = [*means, before.statistics("isometric").maximum]
        inverted = row[PROGRAMS[0]].start_flipped
        runs.append(Run(name, ANEW, len(case.F), seconds, result.injective, case.feasible, inverted, *figures))
        print(f"{name}: {seconds:.3g} s, {'injective' if result.injective else 'no map'}", flush=True)
    with path.open("w", encoding="utf-8", newline="") as file:
        file.write(f"{machine()}\n")
        csv.writer(file, lineterminator="\n").writerows([Run._fields, *runs])


def read_evaluation() -> list[Row]:
    """Return the rows of `evaluation.csv.gz`, one for each problem."""
    with gzip.open(RECORDS / "evaluation.csv.gz", "rt", encoding="utf-8", newline="") as file:
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
    families: dict[str, list[Row]] = {family: [] for family in EVALUATED}
    for row in rows:
        families[row["problem"].partition(":")[0]].append(row)
    return families


def main() -> None:
    """Print the table, or run this package again."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--repeat", action="store_true", help="run this package again instead")
    if parser.parse_args().repeat:
        repeat()
    else:
        print(table_of_records(), end="")


if __name__ == "__main__":
    main()
