"""Compare with records of TLC and Foldover-free: problems solved, time and distortion.

    python benchmarks/tlc_foldover.py > docs/comparisons/tlc_foldover.md  # from the records
    python benchmarks/tlc_foldover.py --anew speed untangling [-n 20] [-o ANEW.csv]

``--anew`` runs this package again on the same problems, in their order, and certifies the maps in the same way. It runs
strategies, or `Untangling` alone, which descends Foldover-free's regularised energy with this package's own method.
These seconds belong to the current machine and version. Compare them with each other; compare them with the records
only qualitatively. ``records/README.md`` has the origin of the records.
"""

from __future__ import annotations

import argparse
import csv
import sys
import time
from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

import problems
from quasiharmonic import Problem, distortion, polish, solve
from quasiharmonic.solver.methods import Untangling
from quasiharmonic.solver.search.stages import STRATEGIES
from quasiharmonic.util.arrays import FloatArray

RECORDS = Path(__file__).parent / "records"
#: The programs in the order of the tables: those that ran every problem of the first 68.
PROGRAMS = "ours speed", "ours quality", "TLC-PN", "TLC-QN", "SBP", "SBP until first injective"
#: The methods that can be run again, and the names of their stored runs.
WAYS = *STRATEGIES, "untangling"
ANEW = tuple(f"anew {way}" for way in WAYS)
#: What the table calls the runs of this package.
LABELS = {
    "ours speed": "quasiharmonic, `speed`",
    "anew speed": "quasiharmonic repeated, `speed`",
    "anew paper": "quasiharmonic repeated, `paper`",
    "anew untangling": "quasiharmonic repeated, `Untangling` alone",
}
#: Where the runs were measured; ``records/README.md`` has the details.
PROVENANCE = (
    "Intel Xeon, 2 cores, 2026-11-22, quasiharmonic 0.1.0 at eb0ed78; repeated: AMD EPYC, 2 cores, 2026-11-23, "
    "quasiharmonic 0.1.0 (development)"
)
#: Less than a tick of the recording clock; ratios use this value for it.
TICK = 0.004


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
    """Return this package's repeated runs, as written with ``-o``."""
    with path.open(encoding="utf-8", newline="") as file:
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
        if run.program in PROGRAMS + ANEW:
            by_problem.setdefault(run.problem, {})[run.program] = run
    # If SBP never found an injective map, it has no run "until first injective".
    needed = set(PROGRAMS[:-1])
    return {name: row for name, row in by_problem.items() if needed <= row.keys()}


def anew(rows: dict[str, dict[str, Run]], way: str) -> Iterator[Run]:
    """Run this package again on the problems of some records, by a strategy or by untangling alone."""
    strategy = [Untangling(iterations=2000)] if way == "untangling" else way
    for name in rows:
        made, _, triangles = name.partition(" triangles=")
        case = problems.make(*problems.parse(made), triangles=int(triangles))
        problem = Problem(case.V, case.F, case.fixed, case.target)
        start = time.process_time()
        result = solve(problem, strategy=strategy, max_iterations=2000)
        seconds = time.process_time() - start
        before = rows[name][PROGRAMS[0]].start_flipped
        row: list[float] = [np.nan] * 3
        if result.injective:
            better = polish(case.V, case.F, result.uv, fixed=case.fixed, energy="mips")
            found, after = (distortion(case.V, case.F, uv) for uv in (result.uv, better.uv))
            row = [found.statistics("mips").mean, after.statistics("mips").mean, found.statistics("isometric").maximum]
        yield Run(name, f"anew {way}", len(case.F), seconds, result.injective, case.feasible, before, *row)


def summary(rows: dict[str, dict[str, Run]], programs: Sequence[str]) -> dict[str, dict[str, Any]]:
    """Return for each program: problems solved, its time relative to the first program, distortion where all solved.

    ``least`` counts the polished maps that are within 1 % of the least distorted one.

    Repeated runs are compared with the first repeated program, since they share a machine.
    """
    first = programs[0]
    first_now = next((name for name in programs if name.startswith("anew ")), first)
    lasting = [row for row in rows.values() if row[first].start_flipped]
    shared = [row for row in lasting if all(name in row and row[name].injective for name in programs)]
    lowest = [np.nanmin([row[name].polished for name in programs]) for row in shared]
    table: dict[str, dict[str, Any]] = {}
    for name in programs:
        ran = [row[name] for row in rows.values() if name in row]
        unit = first_now if name.startswith("anew ") else first
        pairs = [row for row in lasting if name in row and row[name].injective and row[unit].injective]
        ratio = np.array([max(row[name].seconds, TICK) / max(row[unit].seconds, TICK) for row in pairs])
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
        quicker = f"{row['quicker']} of {row['of']}"
        lines.append(
            f"| {LABELS.get(name, name)} | {solved} | {ratio} | {quicker} | {row['MIPS']:.3g} | {row['polished']:.3g} |"
        )
    return "\n".join(lines) + "\n"


def table_of_records() -> str:
    """Return the table of all recorded and repeated runs, without a strategy that no longer exists."""
    programs = [name for name in (*PROGRAMS, *ANEW) if name != "ours quality"]
    table = table_text(summary(on_common_problems([*read_records(), *read_repeated_runs()]), programs))
    return f"{PROVENANCE}\n\n{table}"


def main() -> None:
    """Print the tables; with ``--anew`` solve first."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--anew", nargs="+", default=[], choices=WAYS, help="run our side again on the same problems")
    parser.add_argument("-n", type=int, default=68, metavar="N", help="the first N problems (68)")
    parser.add_argument("-o", "--output", type=Path, metavar="CSV", help="rows of what was run anew")
    options = parser.parse_args()
    if not options.anew:
        print(table_of_records(), end="")
        return
    rows = dict(list(on_common_problems(read_records()).items())[: options.n])
    programs = [*PROGRAMS]
    runs = []
    for way in options.anew:
        for run in anew(rows, way):
            runs.append(run)
            rows[run.problem][run.program] = run
            story = f"{run.seconds:.3g} s, {'injective' if run.injective else 'no map'}"
            print(f"{run.program}, {run.problem}: {story}", file=sys.stderr)
        programs.append(f"anew {way}")
    if runs and options.output:
        with options.output.open("w", encoding="utf-8", newline="") as file:
            csv.writer(file).writerows([Run._fields, *runs])
    print(table_text(summary(rows, programs)), end="")


if __name__ == "__main__":
    main()
