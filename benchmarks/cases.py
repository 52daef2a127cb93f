"""Time every problem folder against one harmonic map of libigl in the same process.

    pip install '.[bench]'
    python benchmarks/cases.py FOLDER [FOLDER …] [--strategy speed|quality] [-r RUNS]

A folder is a problem (``input.obj`` + ``handles.txt``) or holds problems at any depth. Runs of the two are
interleaved and medians are taken; ours are from arrays to the certified map, everything included.
"""

from __future__ import annotations

import argparse
import platform
import time
from importlib.metadata import version
from pathlib import Path

import igl
import numpy as np

from quasiharmonic import injective_map, io


def problems(folders: list[Path]) -> list[Path]:
    """Problem folders below some folders."""
    return [path.parent for folder in folders for path in sorted(folder.rglob("input.obj"))]


def main() -> None:
    """Print a table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folders", nargs="+", type=Path)
    parser.add_argument("--strategy", default="speed")
    parser.add_argument("-r", "--runs", type=int, default=3)
    options = parser.parse_args()
    names = ("quasiharmonic", "libigl", "numpy", "scipy")
    print(platform.processor() or platform.machine(), *(f"{name} {version(name)}" for name in names), sep=", ")
    print("| case | triangles | iterations | injective | seconds | igl.harmonic | ratio |")
    print("|---|---|---|---|---|---|---|")
    for folder in problems(options.folders):
        V, F, fixed, target = io.read_problem(folder)
        ours, theirs = [], []
        for _ in range(options.runs):
            began = time.perf_counter()
            result = injective_map(V, F, fixed, target, strategy=options.strategy)
            ours.append(time.perf_counter() - began)
            began = time.perf_counter()
            igl.harmonic(V, F, fixed, target, 1)
            theirs.append(time.perf_counter() - began)
        a, b = float(np.median(ours)), float(np.median(theirs))
        print(
            f"| {folder.parent.name}/{folder.name} | {len(F)} | {result.iterations} | {result.injective} "
            f"| {a:.3f} | {b:.4f} | {a / b:.1f} |",
            flush=True,
        )


if __name__ == "__main__":
    main()
