"""Time and memory of maps, polishing and flattening by linear solver.

    OMP_NUM_THREADS=1 python benchmarks/solvers.py FOLDER … --memory -o docs/choose/solvers.md

Run on generated surfaces of several sizes, and on the problems (``input.obj`` and ``handles.txt``) and surfaces (other
``.obj`` files) of the folders. Solvers are interleaved in one process and measured on the whole call, from arrays to
certificate. Times are CPU seconds, the minimum of the repetitions; those of other solvers are relative to MKL's. "base"
is the choice of ``auto`` if neither MKL nor CHOLMOD is installed. Peak memory is that of a separate process that maps a
million triangles.
"""

from __future__ import annotations

import argparse
import gc
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

from quasiharmonic import flatten, injective_map, io, polish
from quasiharmonic.linsolve import BACKENDS, available
from speed import OURS, Arrays, cat, machine, peak_megabytes

SIZES = 1_000, 4_000, 16_000, 64_000, 100_000
BASE, MKL = "base", "mkl"
MILLION = 1_000_000

Task = tuple[str, int, Callable[[str], object]]


@contextmanager
def base_only() -> Iterator[None]:
    """Hide the solvers that the base installation does not include."""
    every = dict(BACKENDS)
    for name in (MKL, "cholmod"):
        BACKENDS.pop(name, None)
    try:
        yield
    finally:
        BACKENDS.clear()
        BACKENDS.update(every)


def seconds(work: Callable[[str], object], solver: str) -> float:
    """Return the CPU seconds of one call with one solver."""
    gc.collect()
    began = time.process_time()
    if solver == BASE:
        with base_only():
            work("auto")
    else:
        work(solver)
    return time.process_time() - began


def mapped(name: str, arrays: Arrays) -> Iterator[Task]:
    """Yield a map, and its polishing until convergence."""
    V, F, fixed, _ = arrays
    yield f"map, {name}", len(F), lambda solver: injective_map(*arrays, linear_solver=solver)
    uv = injective_map(*arrays).uv
    yield f"polish, {name}", len(F), lambda solver: polish(V, F, uv, fixed=fixed, linear_solver=solver)


def tasks(sizes: list[int], folders: list[Path]) -> Iterator[Task]:
    """Yield the tasks, one at a time."""
    for size in sizes:
        arrays = cat(size, "R")
        yield from mapped("cat on R", arrays)
        V, F = arrays[:2]
        yield "flatten, cat", len(F), lambda solver, V=V, F=F: flatten(V, F, linear_solver=solver)
    for folder in folders:
        for path in sorted(folder.rglob("*.obj")):
            if path.name == "input.obj":
                problem = io.read_problem(path.parent)
                yield from mapped(path.parent.name, (problem.V, problem.F, problem.fixed, problem.target))
            else:
                mesh = io.read_mesh(path)
                V, F = mesh.V, mesh.F
                yield f"flatten, {path.stem}", len(F), lambda solver, V=V, F=F: flatten(V, F, linear_solver=solver)


def main(arguments: list[str] | None = None) -> None:
    """Print the table row by row, and write it."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folders", nargs="*", type=Path, help="problem folders, and folders of surfaces")
    parser.add_argument("--triangles", nargs="*", type=int, default=list(SIZES), help="sizes of the project's surfaces")
    parser.add_argument("-r", "--runs", type=int, default=3, help="turns of every solver (%(default)s)")
    parser.add_argument("--limit", type=float, default=10, help="seconds, past which a solver gets one turn only")
    parser.add_argument("--memory", action="store_true", help="peak memory of a million triangles too")
    parser.add_argument("-o", "--output", type=Path)
    options = parser.parse_args(arguments)
    if MKL not in available():
        parser.error("MKL is what the others are compared with: pip install 'quasiharmonic[mkl]'")
    solvers = [MKL, BASE, *(name for name in available() if name != MKL)]
    lines = [
        f"{machine()}\n",
        f"| | triangles | MKL, s | {' | '.join(solvers[1:])} |",
        "|---" * (len(solvers) + 2) + "|",
    ]
    print("\n".join(lines), flush=True)
    for solver in solvers:
        seconds(lambda name: injective_map(*cat(500, "R"), linear_solver=name), solver)  # load libraries once
    for name, triangles, work in tasks(options.triangles, options.folders):
        least: dict[str, float] = {}
        for _ in range(options.runs):
            for solver in solvers:
                if least.get(solver, 0) <= options.limit:
                    least[solver] = min(seconds(work, solver), least.get(solver, float("inf")))
        unit = least[MKL]
        ratios = " | ".join(f"{least[solver] / unit:.2f}" for solver in solvers[1:])
        lines.append(f"| {name} | {triangles:,} | {unit:.3g} | {ratios} |")
        print(lines[-1], flush=True)
    if options.memory:
        arrays = cat(MILLION, "R")
        lines += [f"\n| peak memory, {len(arrays[1]):,} triangles | MB |", "|---|---|"]
        for solver in available():
            megabytes = peak_megabytes(arrays, OURS, solver)
            lines.append(f"| `{solver}` | {'fails' if megabytes is None else f'{megabytes:.0f}'} |")
            print(lines[-1], flush=True)
    if options.output:
        options.output.write_text("\n".join(lines) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
