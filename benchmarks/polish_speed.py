"""Time until a polish is within 2 % of its converged energy, and the phases of its steps.

    OMP_NUM_THREADS=1 python benchmarks/polish_speed.py [FOLDER …] --solvers mkl rslab

A folder is a problem (``input.obj`` and ``handles.txt``) or contains problems at any depth; by default, a cat's head is
mapped to the letter R. Each first map is polished by the symmetric Dirichlet energy. The converged energy is that at a
tolerance of 1e-10. By solver, the first table has the seconds and steps to within 2 % of it, and to the default end of
the polish, with the shares of the phases. The second table has the results at other tolerances. Seconds are CPU
seconds, the minimum over the interleaved repetitions.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

import phases
from quasiharmonic import Problem, io, solve
from quasiharmonic.energies import polishing
from quasiharmonic.energies.deformation import DeformationEnergy
from quasiharmonic.energies.newton import map_model
from quasiharmonic.energies.newton.newton_system import NewtonSystem
from quasiharmonic.linsolve import available, base
from quasiharmonic.problem.result import Step
from quasiharmonic.util.arrays import FloatArray
from speed import cat, machine

SIZES = 4_000, 16_000, 64_000
TOLERANCES = 1e-2, 1e-3, 1e-4
# Energy relative to the converged energy that counts as near.
NEAR = 1.02
# Tolerance that defines convergence, and maximum number of steps until then.
_REST, _MOST = 1e-10, 2000

_CLOCKED = (
    (base.LinearSolver, "__init__", "analysis"),
    (NewtonSystem, "__init__", "set-up"),
    (NewtonSystem, "assemble", "assembly"),
    (DeformationEnergy, "curvature_of", "assembly"),
    (DeformationEnergy, "gradient_of", "gradient"),
    (base.LinearSolver, "factor", "factor"),
    (base.LinearSolver, "solve", "solve"),
    (map_model.MapModel, "search", "line search"),
)
PHASES = tuple(dict.fromkeys(phase for *_, phase in _CLOCKED))


class PolishRun(NamedTuple):
    """One polish: CPU seconds and energy after each step, total seconds, and seconds by phase."""

    seconds: list[float]
    energies: list[float]
    whole: float
    by_phase: dict[str, float]

    def near(self, rest: float) -> tuple[float, int] | None:
        """Return seconds and steps to within 2 % of the converged energy, or None if the polish did not reach it."""
        for step, (seconds, energy) in enumerate(zip(self.seconds, self.energies, strict=True)):
            if energy <= NEAR * rest:
                return seconds, step
        return None


def measure(problem: Problem, uv: FloatArray, solver: str, *, tolerance: float = 1e-4, most: int = 200) -> PolishRun:
    """Polish a first map and record its steps."""
    seconds: list[float] = []
    energies: list[float] = []

    def record(step: Step) -> None:
        # The callback may report the last step again.
        if step.iteration == len(seconds):
            seconds.append(phases.clock() - began)
            energies.append(step.energy)

    clock = phases.Phases(_CLOCKED)
    with clock.clocking():
        began = phases.clock()
        polishing.polish_map(
            problem.domain,
            uv,
            polishing.PolishOptions(tol=tolerance, max_iterations=most, linear_solver=solver, callback=record),
        )
        whole = phases.clock() - began
    return PolishRun(seconds, energies, whole, clock.seconds)


def cases(folders: list[Path], sizes: list[int]) -> Iterator[tuple[str, Problem]]:
    """Yield every problem below the folders, or generated ones."""
    for folder in folders:
        for path in sorted(folder.rglob("input.obj")):
            yield path.parent.name, Problem(*io.read_problem(path.parent))
    if not folders:
        for size in sizes:
            yield "cat on R", Problem(*cat(size, "R"))


def main(arguments: list[str] | None = None) -> None:
    """Print both tables, the first row by row, and write them."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folders", nargs="*", type=Path)
    parser.add_argument("--triangles", nargs="*", type=int, default=list(SIZES), help="sizes of the project's surfaces")
    parser.add_argument("--solvers", nargs="+", choices=available(), default=[available()[0]])
    parser.add_argument("-r", "--runs", type=int, default=2, help="turns (%(default)s)")
    parser.add_argument("-o", "--output", type=Path)
    options = parser.parse_args(arguments)
    phases.clock = time.process_time
    lines = [
        f"{machine()}\n",
        "| problem | triangles | solver | within 2 %: s | steps | at its end: s | steps | above rest | "
        f"{' | '.join(f'{phase}, %' for phase in PHASES)} |",
        "|---" * (8 + len(PHASES)) + "|",
    ]
    ends = [
        f"| s, above rest, by tolerance | {' | '.join(f'{tolerance:g}' for tolerance in TOLERANCES)} |",
        "|---" * (1 + len(TOLERANCES)) + "|",
    ]
    print("\n".join(lines), flush=True)
    for name, problem in cases(options.folders, options.triangles):
        first = solve(problem)
        if not first.injective:
            continue
        best = options.solvers[0]
        rest = measure(problem, first.uv, best, tolerance=_REST, most=_MOST).energies[-1]
        for solver in options.solvers:
            turns = [measure(problem, first.uv, solver) for _ in range(options.runs)]
            one = min(turns, key=lambda turn: turn.whole)
            near = one.near(rest)
            shares = " | ".join(f"{100 * one.by_phase[phase] / one.whole:.0f}" for phase in PHASES)
            lines.append(
                f"| {name} | {len(problem.F):,} | {solver} | {f'{near[0]:.2f} | {near[1]}' if near else '– | –'} "
                f"| {one.whole:.2f} | {len(one.energies) - 1} | {one.energies[-1] / rest - 1:.1%} | {shares} |"
            )
            print(lines[-1], flush=True)
        found = [measure(problem, first.uv, best, tolerance=tolerance) for tolerance in TOLERANCES]
        cells = " | ".join(f"{one.whole:.2f}, {one.energies[-1] / rest - 1:.1%}" for one in found)
        ends.append(f"| {name} | {cells} |")
    lines += ["", *ends]
    print("\n".join(["", *ends]))
    if options.output:
        options.output.write_text("\n".join(lines) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
