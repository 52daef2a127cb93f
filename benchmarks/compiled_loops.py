"""CPU time with and without compiled loops, for the same calls in interleaved processes.

    OMP_NUM_THREADS=1 python benchmarks/compiled_loops.py [FOLDER …]

Generated problems map a cat's head to the letters C, R and S. A folder is a problem (``input.obj`` and
``handles.txt``) or contains problems at any depth. Measure CPU seconds from arrays to the certified map, and of ten
Newton steps of a polish from there; take the minimum of the repetitions. Write ``compiled_loops.md`` to ``--output``.
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from quasiharmonic import injective_map, polish
from quasiharmonic.util import kernels
from speed import LETTERS, machine, problems

_STEPS = 10
SWITCH = "QUASIHARMONIC_PURE"


def timed(
    sizes: list[int], letters: str, folders: list[Path], repetitions: int
) -> Iterator[tuple[str, int, float, float]]:
    """Yield name, triangles, and seconds of mapping and polishing of each problem; the minimum of the repetitions."""
    for name, arrays in problems(sizes, letters, folders):
        V, F, fixed, _ = arrays
        mapping, polishing = [], []
        # The first call loads libraries, so it is not measured.
        for _ in range(repetitions + 1):
            began = time.process_time()
            found = injective_map(*arrays)
            mapping.append(time.process_time() - began)
            began = time.process_time()
            polish(V, F, found, fixed=fixed, max_iterations=_STEPS)
            polishing.append(time.process_time() - began)
        yield name, len(F), min(mapping[1:]), min(polishing[1:])


def in_turns(arguments: list[str], turns: int) -> list[list[list[float]]]:
    """Return rows of `timed` from interleaved processes without and with compiled loops; (turns, 2, rows)."""
    found = []
    for _ in range(turns):
        both = []
        for pure in ("1", ""):
            command = [sys.executable, __file__, *arguments, "--alone"]
            done = subprocess.run(
                command, env=os.environ | {SWITCH: pure}, stdout=subprocess.PIPE, text=True, check=True
            )
            both.append([json.loads(line) for line in done.stdout.splitlines()])
        found.append(both)
    return found


def table(found: list[list[list[float]]]) -> str:
    """Return a Markdown table with milliseconds and speed-up."""
    lines = [
        "| problem | triangles | map, ms: NumPy | compiled | gain | ten steps, ms: NumPy | compiled | gain |",
        "|---|---|---|---|---|---|---|---|",
    ]
    gains = []
    for row, (name, triangles, *_) in enumerate(found[0][0]):
        seconds = np.array([[[*each[row][2:]] for each in both] for both in found]).min(axis=0)
        gain = seconds[0] / seconds[1]
        gains.append(gain)
        cells = (f"{1e3 * seconds[0, k]:.3g} | {1e3 * seconds[1, k]:.3g} | {gain[k]:.1f}" for k in (0, 1))
        lines.append(f"| {name} | {triangles:,} | {' | '.join(cells)} |")
    mean = np.exp(np.log(gains).mean(axis=0))
    lines.append(f"| geometric mean | | | | **{mean[0]:.1f}** | | | **{mean[1]:.1f}** |")
    return "\n".join(lines)


def main(arguments: list[str] | None = None) -> None:
    arguments = sys.argv[1:] if arguments is None else arguments
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folders", nargs="*", type=Path)
    parser.add_argument("--triangles", nargs="*", type=int, default=[1000, 4000, 16000, 64000])
    parser.add_argument("--letters", default=LETTERS, help="their targets (%(default)s)")
    parser.add_argument("-r", "--repetitions", type=int, default=3, help="in a process, and processes of each kind")
    parser.add_argument("-o", "--output", type=Path, default=Path())
    parser.add_argument("--alone", action="store_true", help=argparse.SUPPRESS)
    options = parser.parse_args(arguments)
    if options.alone:
        for row in timed(options.triangles, options.letters, options.folders, options.repetitions):
            print(json.dumps(row), flush=True)
        return
    if kernels.extension is None:
        sys.exit("the extension is not built, or switched off: there is nothing to compare")
    found = in_turns(arguments, options.repetitions)
    text = f"{machine()}\n\n{table(found)}\n"
    options.output.mkdir(parents=True, exist_ok=True)
    (options.output / "compiled_loops.md").write_text(text, encoding="utf-8")
    print(text)


if __name__ == "__main__":
    main()
