"""Distortion against seconds for first maps, quasi-harmonised maps and polished maps.

    python benchmarks/distortion.py [FOLDER …] [--unasked]

A folder is a problem (``input.obj`` + ``handles.txt``) or contains problems at any depth; by default, generated
surfaces are mapped to letters. The first table has the MIPS energy as defined in §10. The second has the worst stretch
max(σ₁, 1/σ₂) of any triangle after scaling the map to the surface's area, and its lower bound from the boundary edges'
lengths. Parentheses contain seconds from arrays to the certified map, everything included. A dash means that no
injective map was found.

``--unasked`` instead measures the effect of a few polishing steps, which ``qhm map`` runs by default. It prints
geometric means over the problems, relative to the first map.
"""

from __future__ import annotations

import argparse
import platform
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np

from quasiharmonic import Problem, boundary_loops, distortion, harmonise, io, polish, solve, surfaces, targets
from quasiharmonic.energies.polishing import ENERGIES
from quasiharmonic.geometry.mesh.reference import rest_shapes
from quasiharmonic.util.arrays import FloatArray

Found = tuple[FloatArray, float]

LETTERS = "GSRAPH"
METHODS: dict[str, Callable[[Problem, FloatArray], FloatArray]] = {
    "harmonised, MIPS": lambda problem, uv: harmonise(problem.V, problem.F, uv, fixed=problem.fixed, energy="mips").uv,
    "polished, MIPS": lambda problem, uv: polish(problem.V, problem.F, uv, fixed=problem.fixed, energy="mips").uv,
    "polished, blend": lambda problem, uv: polish(problem.V, problem.F, uv, fixed=problem.fixed, energy="blend").uv,
    "polished, sym. Dirichlet": lambda problem, uv: (
        polish(problem.V, problem.F, uv, fixed=problem.fixed, energy="symmetric-dirichlet").uv
    ),
}
STEPS = 5, 10, 20, 40


def cases(folders: list[Path]) -> Iterator[tuple[str, Problem]]:
    """Yield every problem below the folders, or generated ones."""
    for folder in folders:
        for path in sorted(folder.rglob("input.obj")):
            yield f"{path.parent.parent.name}/{path.parent.name}", Problem(*io.read_problem(path.parent))
    if not folders:
        V, F = surfaces.cat()
        (loop,) = boundary_loops(F, len(V))
        for letter in LETTERS:
            outline = targets.letter(letter)[0]
            yield f"cat onto {letter}", Problem(V, F, loop, targets.arc_length(V[loop], outline))


def first_map(problem: Problem, strategy: str) -> Found | None:
    """Return the first injective map of a strategy and the seconds from arrays, or None if no map was found."""
    began = time.perf_counter()
    result = solve(Problem(problem.V, problem.F, problem.fixed, problem.target), strategy=strategy)
    return (result.uv, time.perf_counter() - began) if result.injective else None


def forced(problem: Problem) -> float:
    """Return a lower bound of max(σ₁, 1/σ₂) from the length ratios of edges between two fixed vertices.

    A map stretches an edge by a factor between its triangles' σ₂ and σ₁. The target is scaled to the surface's area.
    """
    tails, heads = problem.F.T.ravel(), problem.F.T[(1, 2, 0), :].ravel()
    place = np.full(problem.n, -1)
    place[problem.fixed] = np.arange(problem.fixed.size)
    held = (place[tails] >= 0) & (place[heads] >= 0)
    tails, heads = tails[held], heads[held]
    ratio = np.linalg.norm(problem.target[place[heads]] - problem.target[place[tails]], axis=1)
    ratio /= np.linalg.norm(problem.V[heads] - problem.V[tails], axis=1)
    shapes = rest_shapes(problem.V, problem.F)
    rest = float(shapes.m.sum()) * shapes.unit**2
    w = np.zeros(problem.n, dtype=np.complex128)
    w[problem.fixed] = problem.target @ (1, 1j)
    area = sum(0.5 * float((w[loop].conj() * np.roll(w[loop], -1)).imag.sum()) for loop in problem.domain.loops)
    ratio *= np.sqrt(rest / area)
    return float(max(ratio.max(), 1 / ratio.min()))


def measured(problem: Problem, uv: FloatArray) -> tuple[float, float]:
    """Return the MIPS energy and the worst stretch."""
    found = distortion(problem.V, problem.F, uv)
    return found.statistics("mips").mean, found.statistics("isometric").maximum


def compare(folders: list[Path]) -> None:
    """Print both tables."""
    columns = ["first, tanh", "first, si-log", *METHODS]
    mips = [f"| MIPS | triangles | {' | '.join(columns)} |", "|---" * (len(columns) + 2) + "|"]
    stretch = [f"| max(σ₁, 1/σ₂) | forced | {' | '.join(columns)} |", mips[1]]
    for name, problem in cases(folders):
        print(name, file=sys.stderr, flush=True)
        first = first_map(problem, "speed")
        if first is None:
            mips.append(f"| {name} | {len(problem.F)} |" + " – |" * len(columns))
            stretch.append(f"| {name} | {forced(problem):.3g} |" + " – |" * len(columns))
            continue
        found = {columns[0]: first, columns[1]: first_map(problem, "paper")}
        for method, lower in METHODS.items():
            began = time.perf_counter()
            uv = lower(problem, first[0])
            found[method] = uv, first[1] + time.perf_counter() - began
        values = [(*measured(problem, of[0]), of[1]) if of else None for of in found.values()]
        cells = [f"{value[0]:.3g} ({value[2]:.2g})" if value else "–" for value in values]
        mips.append(f"| {name} | {len(problem.F)} | {' | '.join(cells)} |")
        cells = [f"{value[1]:.3g}" if value else "–" for value in values]
        stretch.append(f"| {name} | {forced(problem):.3g} | {' | '.join(cells)} |")
    print("\n".join([*mips, "", *stretch]))


def unasked(folders: list[Path]) -> None:
    """Print the effect of a few steps of each energy, relative to the first map."""
    gains: dict[tuple[str, int], list[tuple[float, float, float]]] = {}
    for name, problem in cases(folders):
        print(name, file=sys.stderr, flush=True)
        first = first_map(problem, "speed")
        if first is None:
            continue
        before = np.array([first[1], *measured(problem, first[0])])
        for energy in ENERGIES:
            for steps in STEPS:
                began = time.perf_counter()
                uv = polish(problem.V, problem.F, first[0], fixed=problem.fixed, energy=energy, max_iterations=steps).uv
                after = np.array([time.perf_counter() - began, *measured(problem, uv)])
                gains.setdefault((energy, steps), []).append(tuple(after / before))
    print("| energy | steps | seconds | MIPS | worst in | max(σ₁, 1/σ₂) | worst in |\n" + "|---" * 7 + "|")
    for (energy, steps), rows in gains.items():
        seconds, mips, stretch = np.array(rows).T
        print(
            f"| {energy} | {steps} | × {np.exp(np.log(seconds).mean()):.2g} | × {np.exp(np.log(mips).mean()):.2g} "
            f"| × {mips.max():.2g} | × {np.exp(np.log(stretch).mean()):.2g} | × {stretch.max():.2g} |"
        )


def main() -> None:
    """Parse the command line and run."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folders", nargs="*", type=Path)
    parser.add_argument("--unasked", action="store_true")
    options = parser.parse_args()
    print(f"{platform.processor() or platform.machine()}\n")
    (unasked if options.unasked else compare)(options.folders)


if __name__ == "__main__":
    main()
