"""Write a data set of generated problems with the composition of the Locally Injective Mappings Benchmark.

    python benchmarks/dataset.py FOLDER -n 2000
    qhm batch FOLDER -o OUT --report

Every problem is a folder with ``input.obj`` (the rest mesh, and Tutte's embedding as a first guess) and
``handles.txt``. As in the benchmark, there are three kinds:

- ``simple``: small textbook shapes, one problem in a hundred,
- ``letters``: thousands of triangles onto a glyph's outline, one problem in fifty, whose maps differ from the first
  guess everywhere,
- ``surfaces``: all others, planar and curved meshes with a boundary that is difficult in some parts. They are made from
  a bijective solution, so each of them has one.

A set with more problems starts with the problems of a smaller set. Existing problems are not written again.
"""

from __future__ import annotations

import argparse
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from problems import Case, make
from quasiharmonic import Problem, io, quasi_harmonic_map
from quasiharmonic.linsolve import NotPositiveDefinite

SIMPLE = "star", "swirl", "polygon", "comb", "spiral"
SURFACES = "flow", "noise", "carved", "jam"


def plan(count: int) -> Iterator[tuple[str, str, int, float, int | None]]:
    """Yield kind, family, seed, difficulty and size of the first problems of the set, in order."""
    for i in range(count):
        # Multiples of the golden ratio fill the unit interval evenly for any count.
        share = (0.5 + i * 0.6180339887498949) % 1.0
        if i % 100 == 0:
            yield "simple", SIMPLE[i // 100 % len(SIMPLE)], i, round(0.4 * share, 3), 200
        elif i % 50 == 25:
            yield "letters", "glyph", i, round(share, 3), 5000 + int(10000 * share)
        else:
            yield "surfaces", SURFACES[i % len(SURFACES)], i, round(0.7 * share, 3), None


def drawn(family: str, seed: int, difficulty: float, triangles: int | None) -> Case:
    """Return a problem whose target does not overlap itself, like the benchmark's letters and surfaces."""
    while True:
        case = make(family, seed, difficulty, triangles=triangles)
        if case.simple is not False:
            return case
        # Targets of carved meshes in strong flows almost always overlap.
        seed, difficulty = seed + 1_000_000, round(0.8 * difficulty, 3)


def write(folder: Path, case: Case) -> None:
    """Write one problem; ``handles.txt`` comes last, so its presence means that the problem is complete."""
    problem = Problem(case.V, case.F, case.fixed, case.target, reference="equilateral")
    try:
        guess = quasi_harmonic_map(problem)
    except NotPositiveDefinite:
        guess = np.zeros((len(case.V), 2))
        guess[case.fixed] = case.target
    folder.mkdir(parents=True, exist_ok=True)
    io.write_obj(folder / "input.obj", io.MeshData(case.V, case.F).with_map(guess))
    io.write_whole(folder / "handles.txt", "".join(f"{vertex}\n" for vertex in case.fixed).encode())


def main() -> None:
    """Write the missing problems."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path)
    parser.add_argument("-n", "--count", type=int, default=2000)
    options = parser.parse_args()
    made = 0
    for kind, family, seed, difficulty, triangles in plan(options.count):
        folder = options.folder / kind / f"{seed:05d}_{family}"
        if not (folder / "handles.txt").exists():
            write(folder, drawn(family, seed, difficulty, triangles))
            made += 1
    print(f"{options.count} problems in {options.folder}, {made} of them new")


if __name__ == "__main__":
    main()
