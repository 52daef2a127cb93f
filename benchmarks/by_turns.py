"""Compare today's version with 0.1.0 on small problems, interleaved, and with the recorded times of TLC-QN.

    git archive 0.1.0's-commit src | tar -x -C OLD
    OMP_NUM_THREADS=1 MKL_NUM_THREADS=1 python benchmarks/by_turns.py OLD/src [--new src] [-r 9] [-o runs.json]

The records (`records/README.md`) contain the seconds of TLC-QN and of version 0.1.0, measured on one other machine.
This program runs 0.1.0 again on the same problems, interleaved with another version. Each version has its own warm
process; the least CPU seconds of the repetitions count. *Scaled* seconds estimate TLC-QN on this machine: its recorded
ratio to 0.1.0, times the seconds of 0.1.0 here. Only problems that both solve and Tutte's embedding does not count.
"""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

import problems
import rivals

Record = dict[str, Any]

#: Code of a process that solves the problems of a file of arrays; a source folder comes first on its path.
_SERVE = """
import json, sys, time
sys.path.insert(0, sys.argv[1])
import numpy as np
import quasiharmonic
assert quasiharmonic.__file__.startswith(sys.argv[1]), quasiharmonic.__file__
data = np.load(sys.argv[2])
for line in sys.stdin:
    V, F, fixed, target = (data[f"{line.strip()}/{name}"] for name in ("V", "F", "fixed", "target"))
    start = time.process_time()
    result = quasiharmonic.injective_map(V, F, fixed, target)
    seconds = time.process_time() - start
    print(json.dumps([seconds, bool(result.injective), [s.name for s in result.stages]]), flush=True)
"""


class Server:
    """A version of the package in its own process."""

    def __init__(self, source: Path, arrays: Path) -> None:
        self._process = subprocess.Popen(
            [sys.executable, "-c", _SERVE, str(source.resolve()), str(arrays)],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            text=True,
        )

    def solve(self, name: str) -> tuple[float, bool, list[str]]:
        """Return CPU seconds, whether a map was found, and the stages that ran."""
        assert self._process.stdin is not None
        assert self._process.stdout is not None
        print(name, file=self._process.stdin, flush=True)
        seconds, injective, stages = json.loads(self._process.stdout.readline())
        return seconds, injective, stages

    def stop(self) -> None:
        """End the process."""
        self._process.communicate()


def common() -> dict[str, tuple[rivals.Run, rivals.Run]]:
    """Return the runs of TLC-QN and 0.1.0 on problems that both solved and Tutte's embedding does not solve."""
    rows = rivals.on_common_problems(rivals.recorded())
    pairs = {name: (row["TLC-QN"], row["ours speed"]) for name, row in rows.items()}
    return {
        name: (theirs, ours)
        for name, (theirs, ours) in pairs.items()
        if theirs.injective and ours.injective and ours.start_flipped
    }


def measured(old: Path, new: Path, turns: int, arrays: Path) -> Iterator[Record]:
    """Run both versions, interleaved, on each problem; yield the records."""
    chosen, made = common(), {}
    for name in chosen:
        plain, _, triangles = name.partition(" triangles=")
        case = problems.make(*problems.parse(plain), triangles=int(triangles))
        made |= {f"{name}/{k}": getattr(case, k) for k in ("V", "F", "fixed", "target")}
    np.savez(arrays, **made)
    servers = Server(old, arrays), Server(new, arrays)
    for name, (theirs, ours) in chosen.items():
        runs = [[server.solve(name) for server in servers] for _ in range(turns)]
        before, now = (min(run[k][0] for run in runs) for k in (0, 1))
        scaled = max(theirs.seconds, rivals.TICK) / max(ours.seconds, rivals.TICK) * before
        yield {
            "problem": name,
            "TLC-QN scaled": scaled,
            "0.1.0": before,
            "now": now,
            "over TLC-QN": now / scaled,
            "injective": runs[0][1][1],
            "stages": runs[0][1][2],
        }
    for server in servers:
        server.stop()


def summary(records: list[Record]) -> str:
    """Return how often TLC-QN is faster, and the problems where it is faster by the largest factors."""
    ratio = np.array([record["over TLC-QN"] for record in records])
    speedup = np.median([record["0.1.0"] / record["now"] for record in records])
    lines = [
        f"{len(records)} problems, {sum(record['injective'] for record in records)} solved; ours over TLC-QN's scaled "
        f"seconds: {', '.join(f'{q:.2g}' for q in np.percentile(ratio, (10, 50, 90, 100)))} at 10, 50, 90, 100 %; "
        f"TLC-QN quicker on {(ratio > 1).sum()}, by more than half on {(ratio > 1.5).sum()}; "
        f"0.1.0 takes {speedup:.2f} times as long in the median",
        "",
        "| problem | TLC-QN, scaled | 0.1.0 | now | over TLC-QN |",
        "|---|---|---|---|---|",
    ]
    for record in sorted(records, key=lambda record: -record["over TLC-QN"])[:10]:
        times = " | ".join(f"{1000 * record[k]:.3g} ms" for k in ("TLC-QN scaled", "0.1.0", "now"))
        lines.append(f"| {record['problem']} | {times} | {record['over TLC-QN']:.2f} |")
    return "\n".join(lines)


def main() -> None:
    """Measure, or summarise earlier measurements."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("old", type=Path, help="folder with the package of version 0.1.0")
    parser.add_argument("--new", type=Path, default=Path("src"), help="folder with the other version (%(default)s)")
    parser.add_argument("-r", "--turns", type=int, default=9, help="turns (%(default)s)")
    parser.add_argument("-o", "--output", type=Path, default=Path("by_turns.json"), help="records (%(default)s)")
    options = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        records = list(measured(options.old, options.new, options.turns, Path(folder) / "problems.npz"))
    options.output.write_text(json.dumps(records, indent=1), encoding="utf-8")
    print(summary(records))


if __name__ == "__main__":
    main()
