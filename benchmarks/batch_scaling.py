"""Overhead of `qhm batch`: rate by number of processes, time between problems, memory of the driver.

    python benchmarks/batch_scaling.py [-n 400] [-w 1,2,4] [-r 3]

The problems are small and similar. Runs with different numbers of processes are interleaved; the table has medians. The
start of the processes is excluded. Run it on an otherwise idle machine.
"""

from __future__ import annotations

import argparse
import os
import shutil
import statistics
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import numpy as np

from quasiharmonic import batch, boundary_loops, io
from quasiharmonic.surfaces import disk


def write_set(root: Path, count: int, rings: int) -> None:
    """Write problems that map disks to stars."""
    V, F = disk(rings)
    (loop,) = boundary_loops(F, len(V))
    angle = np.linspace(0, 2 * np.pi, len(loop), endpoint=False)
    uv = np.zeros((len(V), 2))
    radius = 0.5 + 0.5 * np.abs((angle * 5 / np.pi) % 2 - 1)
    uv[loop] = radius[:, None] * np.stack([np.cos(angle), np.sin(angle)], axis=1)
    first = root / "00000"
    first.mkdir(parents=True)
    io.write_obj(first / "input.obj", io.MeshData(V, F).with_map(uv))
    (first / "handles.txt").write_text("".join(f"{i}\n" for i in loop))
    for i in range(1, count):
        (root / f"{i:05d}").mkdir()
        for name in ("input.obj", "handles.txt"):
            os.link(first / name, root / f"{i:05d}" / name)


def timed(source: Path, output: Path, workers: int) -> tuple[float, float]:
    """Return problems per second once all processes work, and seconds per problem in excess of its record."""
    shutil.rmtree(output, ignore_errors=True)
    ends: list[float] = []

    def note(progress: batch.Progress) -> None:
        if progress.done > len(ends):
            ends.append(time.perf_counter())

    batch.run(source, output, jobs=workers, callback=note)
    warm = 10 * workers
    wall = (ends[-1] - ends[warm]) / (len(ends) - 1 - warm)
    busy = statistics.fmean(record["seconds"] for record in batch.read_table(output / "records.csv"))
    return 1 / wall, workers * wall - busy


def driver_memory(source: Path, output: Path) -> float:
    """Return the peak resident memory of a driver, in MiB."""
    code = (
        "import resource, sys; from quasiharmonic import batch; batch.run(sys.argv[1], sys.argv[2], jobs=1); "
        "print(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024)"
    )
    done = subprocess.run([sys.executable, "-c", code, source, output], stdout=subprocess.PIPE, text=True, check=True)
    return float(done.stdout)


def main() -> None:
    """Measure and print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("-n", "--count", type=int, default=400)
    parser.add_argument("--rings", type=int, default=8, help="6 rings² triangles in each problem (default: 384)")
    parser.add_argument("-w", "--workers", default="1,2")
    parser.add_argument("-r", "--runs", type=int, default=3)
    parser.add_argument("--memory", type=int, default=0, metavar="N", help="driver's memory for up to N problems")
    options = parser.parse_args()
    workers = [int(w) for w in options.workers.split(",")]
    with tempfile.TemporaryDirectory() as folder:
        root = Path(folder)
        write_set(root / "set", options.count, options.rings)
        rates: dict[int, list[float]] = {w: [] for w in workers}
        between: dict[int, list[float]] = {w: [] for w in workers}
        for _ in range(options.runs):
            for w in workers:
                rate, rest = timed(root / "set", root / "out", w)
                rates[w].append(rate)
                between[w].append(rest)
        one = statistics.median(rates[workers[0]]) / workers[0]
        print(f"{options.count} problems of {6 * options.rings**2} triangles, {os.cpu_count()} cores")
        print("| processes | problems/s | of perfect scaling | ms between problems |")
        print("|---|---|---|---|")
        for w in workers:
            rate = statistics.median(rates[w])
            print(f"| {w} | {rate:.1f} | {rate / one / w:.2f} | {1000 * statistics.median(between[w]):.2f} |")
        count = 100
        while count <= options.memory:
            write_set(root / f"set{count}", count, 2)
            print(f"driver with {count} problems: {driver_memory(root / f'set{count}', root / f'out{count}'):.1f} MiB")
            count *= 5


if __name__ == "__main__":
    main()
