"""Experiments on the paper's future work: hyperbolic steps, asymmetric weights, determinants, other starts.

    python benchmarks/future_work.py [hyperbolic] [weights] [determinants] [starts] [-o TABLE.json]

Each method runs alone on small problems, from its start to the first injective map.
`docs/development/open_questions.md` has the results.
``starts`` requires libigl.
"""

from __future__ import annotations

import argparse
import json
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np

import determinants
import positive_weights
import problems
from hyperbolic import HyperbolicAdam
from quasiharmonic import Problem, boundary_loops, solve, targets
from quasiharmonic.geometry.exact.certificate import inverted_triangles
from quasiharmonic.solver.methods import VectorAdam
from quasiharmonic.util.arrays import FloatArray

sys.path.append(str(Path(__file__).parent.parent / "examples"))
from common import ring
from figure_17 import swap_points
from sculptures import sculpture

FAMILIES = "noise", "jam", "flow", "swirl", "adrift", "spiral", "comb", "maze", "limbs", "pins"
ITERATIONS = 600
#: The result of a run: inverted triangles at the end, and iterations.
Outcome = tuple[int, int]


def trials(seeds: int = 1, surfaces: Sequence[str] = ("angel", "rabbit", "hand")) -> Iterator[tuple[str, Problem]]:
    """Yield surfaces mapped to letters, rotated rings, swapped points, and generated problems that have a map."""
    for surface in surfaces:
        V, F = sculpture(surface, 24)
        for letter in "GSH":
            outline = targets.filled(targets.letter(letter))
            yield f"{surface} onto {letter}", Problem(V, F, *targets.boundary_to(V, F, outline))
    for degrees in (90, 135, 180):
        yield f"ring turned by {degrees}°", ring(12, (-0.35, -0.35, 0.35, 0.35), float(np.radians(degrees)))
    for cells in (12, 20, 40):
        yield f"points swapped, {cells}", swap_points(cells)
    for family in FAMILIES:
        for seed in range(seeds):
            case = problems.make(family, seed, 0.6, triangles=500)
            yield f"{family}:{seed}:0.6", Problem(case.V, case.F, case.fixed, case.target)


def outcome(problem: Problem, stage: VectorAdam, start: FloatArray | None = None) -> Outcome:
    """Return the outcome of one method alone."""
    result = solve(problem, strategy=[stage], start=start, max_iterations=stage.iterations)
    return len(result.certificate.inverted) + len(result.certificate.degenerate), result.n_iterations


def hyperbolic(problem: Problem) -> dict[str, Outcome]:
    """Compare steps in ξ with tanh and with si-log, and steps along geodesics of the Poincaré disk."""
    return {
        "ξ, tanh": outcome(problem, VectorAdam(iterations=ITERATIONS)),
        "geodesics": outcome(problem, HyperbolicAdam(iterations=ITERATIONS)),
        "geodesics, steps of 0.5": outcome(problem, HyperbolicAdam(iterations=ITERATIONS, schedule=[(0, 0.5)])),
        "ξ, si-log": outcome(problem, VectorAdam(parameterisation="si-log", iterations=ITERATIONS)),
    }


def weights(problem: Problem) -> dict[str, Any]:
    """Optimise positive weights, one or two per edge, by a smooth inverted area; test which maps have such weights."""
    found: dict[str, Any] = {
        "tensors": outcome(problem, VectorAdam(iterations=ITERATIONS)),
        "one weight an edge": positive_weights.Means(problem, symmetric=True).descend(),
        "two weights an edge": positive_weights.Means(problem, symmetric=False).descend(),
    }
    result = solve(problem)
    if result.injective:
        found["our map has one weight an edge"] = positive_weights.has_symmetric(problem, result.uv)
        found["mean values miss our map by"] = positive_weights.mean_values(problem, result.uv)
    return found


def free_determinants(problem: Problem) -> dict[str, Outcome]:
    """Compare tensors of determinant 1 with tensors of any determinant."""
    return {
        f"{parameterisation}, determinant {what}": determinants.descend(
            problem, iterations=ITERATIONS, free=free, parameterisation=parameterisation
        )
        for parameterisation in ("tanh", "si-log")
        for what, free in (("1", False), ("free", True))
    }


def starts(problem: Problem) -> dict[str, Any]:
    """Run the search from its own start and from libigl's maps."""
    import igl

    V, F, fixed, target = problem.V, problem.F, problem.fixed, problem.target
    (loop,) = boundary_loops(F, problem.n) if len(problem.domain.loops) == 1 else (None,)
    found: dict[str, Any] = {"ξ = 0": outcome(problem, VectorAdam(iterations=ITERATIONS))}
    flat = V if V.shape[1] == 2 else None
    if flat is None and loop is not None and loop.size == fixed.size:
        # Start from the disk, since the function requires a planar mesh.
        flat = igl.harmonic(V, F, loop, igl.map_vertices_to_circle(V, loop), 1)
    began = time.process_time()
    maps = {"libigl's harmonic map": igl.harmonic(V, F, fixed, target, 1)}
    found["libigl's composite map"] = "fails"
    if flat is not None:
        for test in (True, False):
            # The function raises on failure; disabling its check returns the last iterate.
            try:
                composite = igl.bijective_composite_harmonic_mapping(flat, F, fixed, target, test_for_flips=test)
            except RuntimeError:
                continue
            maps["libigl's composite map"] = composite
            found["seconds of the composite map"] = round(time.process_time() - began, 2)
            break
    for name, uv in maps.items():
        if uv.shape != (problem.n, 2) or not np.isfinite(uv).all():
            found[name] = "not finite"
            continue
        uv = np.array(uv, dtype=np.float64)
        uv[fixed] = target
        found[name] = f"{inverted_triangles(F, uv).size} inverted"
        found[f"from {name}"] = outcome(problem, VectorAdam(iterations=ITERATIONS), uv)
    return found


TRIED: dict[str, Callable[[Problem], dict[str, Any]]] = {
    "hyperbolic": hyperbolic,
    "weights": weights,
    "determinants": free_determinants,
    "starts": starts,
}


def main() -> None:
    """Run the named experiments, print a row per problem, and summarise."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("what", nargs="*", choices=[*TRIED, []], default=list(TRIED))
    parser.add_argument("--seeds", type=int, default=1, help="generated problems of each family (1)")
    parser.add_argument("--surfaces", nargs="*", default=["angel", "rabbit", "hand"], help="that go onto letters")
    parser.add_argument("-o", "--output", type=Path)
    options = parser.parse_args()
    table: dict[str, dict[str, Any]] = {}
    for what in options.what:
        rows = table[what] = {}
        for name, problem in trials(options.seeds, options.surfaces):
            rows[name] = {"triangles": len(problem.F), **TRIED[what](problem)}
            print(what, name, json.dumps(rows[name], ensure_ascii=False), flush=True)
        for column in dict.fromkeys(key for row in rows.values() for key in row):
            runs = [row[column] for row in rows.values() if isinstance(row.get(column), (list, tuple))]
            solved = sorted(count for flips, count in runs if flips == 0)
            if runs:
                median = solved[len(solved) // 2] if solved else None
                print(f"{what}: {column}: {len(solved)} of {len(runs)}, median {median}")
    if options.output:
        options.output.write_text(json.dumps(table, indent=1, ensure_ascii=False), encoding="utf-8")


if __name__ == "__main__":
    main()
