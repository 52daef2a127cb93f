"""Contribution of each stage of a strategy, on generated problems that have a solution.

    OMP_NUM_THREADS=1 MKL_NUM_THREADS=1 python benchmarks/stages.py -n 440 -o docs/choose/stages.md

The problems are the first ones of a campaign that are made from a solution, mostly of 50 to 1,000 triangles. For each
strategy, report how many problems each stage ran on, how many it solved, and its share of the time.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np

import campaign
import problems
from quasiharmonic import MapResult, Problem, distortion, solve
from quasiharmonic.problem.result import Stage
from quasiharmonic.solver.search.stages import STRATEGIES
from speed import machine

FEASIBLE = "noise", "jam", "flow", "swirl", "adrift", "pins", "spiral", "comb", "maze", "limbs", "carved"


class Outcome(NamedTuple):
    """The result for a problem: the map, CPU seconds, and MIPS, which is NaN if no map was found."""

    result: MapResult
    seconds: float
    mips: float


def outcomes(names: Iterable[str], strategy: str) -> list[Outcome]:
    """Solve the problems one by one."""
    found = []
    for name in names:
        case = problems.make(*problems.parse(name))
        start = time.process_time()
        result = solve(Problem(case.V, case.F, case.fixed, case.target), strategy=strategy)
        seconds = time.process_time() - start
        mips = distortion(case.V, case.F, result.uv).statistics("mips").mean if result.injective else np.nan
        found.append(Outcome(result, seconds, float(mips)))
    return found


def strategies(runs: dict[str, list[Outcome]]) -> str:
    """Return a table with a row for each strategy."""
    shared = np.all([[run.result.injective for run in found] for found in runs.values()], axis=0)
    lines = ["| strategy | solved | CPU s: 50, 95, 100 % | MIPS where all solved |", "|---|---|---|---|"]
    for name, found in runs.items():
        times = ", ".join(f"{s:.2g}" for s in np.percentile([run.seconds for run in found], (50, 95, 100)))
        mips = np.median(np.array([run.mips for run in found])[shared])
        lines.append(f"| `{name}` | {solved(found)} of {len(found)} | {times} | {mips:.2g} |")
    return "\n".join(lines)


def solved(found: Sequence[Outcome]) -> int:
    """Return how many problems were solved."""
    return sum(run.result.injective for run in found)


def kind(stage: Stage) -> str:
    """Return a stage's method and parameterisation, without V₃ and the size of a coarse mesh."""
    return ", ".join(part for part in stage.name.split(", ") if part != "dirichlet" and not part.endswith("triangles"))


def stages(strategy: str, found: Sequence[Outcome]) -> str:
    """Return a table with a row for each kind of stage, in the order of first use."""
    deepest_first = sorted(found, key=lambda run: -len(run.result.stages))
    in_all = sum(stage.seconds for run in found for stage in run.result.stages)
    lines = [f"| stage of `{strategy}` | ran on | solved | share of the time |", "|---|---|---|---|"]
    for name in dict.fromkeys(kind(stage) for run in deepest_first for stage in run.result.stages):
        met = [run for run in found if any(kind(stage) == name for stage in run.result.stages)]
        brought = sum(run.result.injective and kind(run.result.stages[-1]) == name for run in met)
        seconds = sum(stage.seconds for run in met for stage in run.result.stages if kind(stage) == name)
        lines.append(f"| {name} | {len(met)} | {brought} | {seconds / in_all:.0%} |")
    return "\n".join(lines)


def main() -> None:
    """Measure and write the tables."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("-n", "--count", type=int, default=440, help="problems (%(default)s)")
    parser.add_argument("-o", "--output", type=Path, help="a file for the tables (else to the screen)")
    options = parser.parse_args()
    names = list(campaign.names(options.count, FEASIBLE))
    runs = {strategy: outcomes(names, strategy) for strategy in STRATEGIES}
    text = "\n\n".join([machine(), strategies(runs), *(stages(name, found) for name, found in runs.items())]) + "\n"
    print(text)
    if options.output:
        options.output.write_text(text, encoding="utf-8")


if __name__ == "__main__":
    main()
