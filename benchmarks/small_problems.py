"""Many small problems: `injective_maps`, `qhm batch`, and one call of `injective_map` or `qhm map` per problem.

    python benchmarks/small_problems.py [-n 10000] [--triangles 500] [-j 1,2] [--each 1000] [--files 200] [-o TABLE]

Three sets: one mesh with many outlines, a separate mesh for each outline, and generated problems that are hard for
their size (`problems.py`). Methods for arrays are interleaved, portion by portion. Single calls are made for ``--each``
problems only, spread over the portions; files are written for the first ``--files``. Rates are problems per second of
wall time and of CPU time. The ratio compares CPU time with that of single calls, so a busy machine does not affect it.
Single calls use one core, so the gain of two threads in wall time comes in addition. For files, the baseline is a loop
that reads, maps, writes, reads back and certifies; `qhm batch` also measures distortion and keeps records.
"""

from __future__ import annotations

import argparse
import os
import resource
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from itertools import islice
from pathlib import Path

import numpy as np

import problems
from quasiharmonic import batch, boundary_loops, certify, injective_map, injective_maps, io
from quasiharmonic.surfaces import disk, random_delaunay
from quasiharmonic.util.arrays import FloatArray, IntArray
from speed import machine

Arrays = tuple[FloatArray, IntArray, IntArray, FloatArray]

# Problems in one portion.
_PORTION = 1000
_CALLS, _FILES = "`injective_map` for each", "files: `injective_map` for each"
_HARD = "noise", "flow", "swirl", "polygon", "star", "glyph"


def blob(V: FloatArray, F: IntArray, seed: int) -> Arrays:
    """Return a problem that maps a disk-like mesh to its own smooth outline, with radii from 0.25."""
    rng = np.random.default_rng(seed)
    (loop,) = boundary_loops(F, len(V))
    angle = np.linspace(0, 2 * np.pi, len(loop), endpoint=False)
    radius = 1 + sum(rng.uniform(-0.25, 0.25) * np.cos(k * angle + rng.uniform(0, 2 * np.pi)) for k in range(2, 7))
    return V, F, loop, np.maximum(radius, 0.25)[:, None] * np.stack([np.cos(angle), np.sin(angle)], axis=1)


def one_mesh(triangles: int) -> Iterator[Arrays]:
    """Yield problems of one mesh, without end."""
    V, F = disk(round(np.sqrt(triangles / 6)))
    return (blob(V, F, seed) for seed in range(1 << 31))


def own_meshes(triangles: int) -> Iterator[Arrays]:
    """Yield problems with random vertices each, without end."""
    for seed in range(1 << 31):
        yield blob(*random_delaunay(triangles // 2, seed=seed), seed)


def generated(triangles: int) -> Iterator[Arrays]:
    """Yield problems of six families with about this size, at difficulties from 0 to 0.5, without end."""
    for seed in range(1 << 31):
        for family in _HARD:
            case = problems.make(family, seed, (seed % 11) / 20)
            if 0.6 * triangles <= len(case.F) <= 1.4 * triangles:
                yield case.V, case.F, case.fixed, case.target


SETS = {"one mesh": one_mesh, "a mesh each": own_meshes, "generated": generated}


class Clock:
    """Counts problems, wall seconds and CPU seconds, including those of child processes that have ended."""

    def __init__(self) -> None:
        self.done, self.solved, self.wall, self.processor = 0, 0, 0.0, 0.0

    def time(self, solve: Callable[[], tuple[int, int]]) -> None:
        """Time a call that returns the numbers of problems done and solved."""
        wall, processor = time.perf_counter(), _processor()
        done, solved = solve()
        self.wall += time.perf_counter() - wall
        self.processor += _processor() - processor
        self.done, self.solved = self.done + done, self.solved + solved


def _processor() -> float:
    own, others = resource.getrusage(resource.RUSAGE_SELF), resource.getrusage(resource.RUSAGE_CHILDREN)
    return own.ru_utime + own.ru_stime + others.ru_utime + others.ru_stime


def together(some: list[Arrays], jobs: int) -> tuple[int, int]:
    """Solve all problems in one call."""
    return len(some), sum(result.injective for result in injective_maps(some, jobs=jobs))


def one_by_one(some: list[Arrays]) -> tuple[int, int]:
    """Solve each problem in its own call."""
    return len(some), sum(injective_map(*arrays).injective for arrays in some)


def write_files(root: Path, some: list[Arrays]) -> None:
    """Write a data set of problem folders."""
    for number, (V, F, fixed, target) in enumerate(some):
        folder = root / f"{number:05d}"
        folder.mkdir(parents=True)
        uv = np.zeros((len(V), 2))
        uv[fixed] = target
        io.write_obj(folder / "input.obj", io.MeshData(V, F).with_map(uv), durable=False)
        (folder / "handles.txt").write_text("".join(f"{i}\n" for i in fixed))


def data_set(root: Path, output: Path, jobs: int) -> tuple[int, int]:
    """Run `qhm batch`."""
    progress = batch.run(root, output, jobs=jobs)
    return progress.done, progress.solved


def file_by_file(root: Path, output: Path) -> tuple[int, int]:
    """Process the files in a loop; certify the written maps."""
    folders, solved = sorted(root.iterdir()), 0
    output.mkdir()
    for folder in folders:
        mesh = io.read_mesh(folder / "input.obj")
        fixed = io.read_handles(folder / "handles.txt", len(mesh.V))
        result = injective_map(mesh.V, mesh.F, fixed, io.map_of(mesh)[fixed])
        path = output / f"{folder.name}.obj"
        io.write_obj(path, mesh.with_map(result.uv), durable=False)
        written = io.read_mesh(path)
        solved += certify(written.F, io.map_of(written)).injective
    return len(folders), solved


def commands(root: Path, output: Path, most: int) -> tuple[int, int]:
    """Run `qhm map` on each of the first few problems."""
    folders = sorted(root.iterdir())[:most]
    output.mkdir()
    codes = [
        subprocess.run(
            [sys.executable, "-m", "quasiharmonic", "map", folder, "--no-polish", "-o", output / f"{folder.name}.obj"],
            capture_output=True,
            check=False,
        ).returncode
        for folder in folders
    ]
    return len(folders), codes.count(0)


def measure(name: str, options: argparse.Namespace, jobs: list[int]) -> list[str]:
    """Return the table's rows for one set."""
    endless = SETS[name](options.triangles)
    clocks: dict[str, Clock] = {_CALLS: Clock()}
    clocks |= {f"`injective_maps`, {n} {'thread' if n == 1 else 'threads'}": Clock() for n in jobs}
    left, sizes = options.count, []
    first = list(islice(endless, _PORTION))
    one_by_one(first[:5])  # loads libraries before the measurements
    while left > 0:
        some = (first or list(islice(endless, _PORTION)))[:left]
        first = []
        left -= len(some)
        sizes += [len(F) for _, F, _, _ in some]
        for label, clock in clocks.items():
            if "maps" in label:
                number = int(label.split(", ")[1].split()[0])
                clock.time(lambda some=some, number=number: together(some, number))
            else:
                each = min(round(len(some) * options.each / options.count), len(some))
                clock.time(lambda some=some[:each]: one_by_one(some))
    if options.files:
        with tempfile.TemporaryDirectory() as folder:
            root = Path(folder)
            write_files(root / "set", list(islice(SETS[name](options.triangles), options.files)))
            clocks[_FILES] = Clock()
            clocks[_FILES].time(lambda: file_by_file(root / "set", root / "loop"))
            clocks["`qhm map` for each"] = Clock()
            clocks["`qhm map` for each"].time(lambda: commands(root / "set", root / "maps", 10))
            for n in jobs:
                clocks[f"`qhm batch -j {n}`"] = clock = Clock()
                clock.time(lambda n=n: data_set(root / "set", root / f"out{n}", n))
    rows = []
    for label, clock in clocks.items():
        against = clocks[_FILES if "qhm" in label or label == _FILES else _CALLS]
        ratio = (clock.done / clock.processor) / (against.done / against.processor)
        rows.append(
            f"| {name} | {label} | {clock.done:,} | {clock.solved:,} | {clock.done / clock.wall:.0f} | "
            f"{1000 * clock.processor / clock.done:.3g} | {ratio:.2g} |"
        )
        print(rows[-1], flush=True)
    print(f"{name}: {np.mean(sizes):.0f} triangles on average", flush=True)
    return rows


def main() -> None:
    """Measure, print and write the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("-n", "--count", type=int, default=10_000)
    parser.add_argument("--triangles", type=int, default=500)
    parser.add_argument("-j", "--jobs", default="1,2")
    parser.add_argument("--each", type=int, default=1000, help="problems that a call for each is made for")
    parser.add_argument("--files", type=int, default=200, help="problems that are written as files; 0 for none")
    parser.add_argument("--sets", nargs="+", choices=SETS, default=list(SETS))
    parser.add_argument("-o", "--output", type=Path)
    options = parser.parse_args()
    jobs = [int(number) for number in options.jobs.split(",")]
    load = f"{os.getloadavg()[0]:.0f} processes waiting for {os.cpu_count()} cores"
    lines = [f"{machine()} (busy with other work: {load}); {options.triangles} triangles\n"]
    lines.append("| set | call | problems | solved | per second | CPU ms each | ratio of CPU rates |")
    lines.append("|---|---|---|---|---|---|---|")
    for name in options.sets:
        lines += measure(name, options, jobs)
    if options.output is not None:
        options.output.write_text("\n".join(lines) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
