"""Run every functional, parameterisation and first-order method on every problem folder (§7.3, §8, §9).

    python benchmarks/combinations.py FOLDER [FOLDER …] [-n ITERATIONS] [--newton STEPS] [-o TABLE.csv]

A folder is a problem (``input.obj`` + ``handles.txt``) or contains problems at any depth. Each combination runs alone
from ξ = 0, with si-log on the rest mesh's corrected triangles and tanh on equilateral triangles. It stops at the first
injective map or after the given number of iterations.
"""

from __future__ import annotations

import argparse
import csv
import itertools
import sys
from pathlib import Path

import numpy as np

from quasiharmonic import Problem, io, solve
from quasiharmonic.energies.measures import distortion
from quasiharmonic.solver.field.functionals import FUNCTIONALS
from quasiharmonic.solver.field.tensor import PARAMETERISATIONS
from quasiharmonic.solver.methods import LBFGS, Descent, Newton, VectorAdam

METHODS = {"vector-adam": VectorAdam, "l-bfgs": LBFGS}


def main() -> None:
    """Run the combinations and write a table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folders", nargs="+", type=Path)
    parser.add_argument("-n", "--iterations", type=int, default=300)
    parser.add_argument("--newton", type=int, default=0, help="Newton steps on V₃ for what flips are left after that")
    parser.add_argument("-o", "--output", type=argparse.FileType("w"), default=sys.stdout)
    options = parser.parse_args()
    table = csv.writer(options.output)
    table.writerow(
        ["case", "triangles", "functional", "parameterisation", "method", "flips", "iterations", "seconds", "mips"]
    )
    folders = [path.parent for folder in options.folders for path in sorted(folder.rglob("input.obj"))]
    for folder in folders:
        problem = Problem(*io.read_problem(folder))
        for functional, parameterisation, method in itertools.product(FUNCTIONALS, PARAMETERISATIONS, METHODS):
            reference = "equilateral" if parameterisation == "tanh" else "corrected"
            stage = METHODS[method](
                parameterisation=parameterisation,
                functional=functional,
                reference=reference,
                iterations=options.iterations,
            )
            stages: list[Descent] = [stage]
            if options.newton:
                stages.append(
                    Newton(
                        parameterisation=parameterisation, reference=reference, iterations=options.newton, resume=True
                    )
                )
            result = solve(problem, strategy=stages)
            flips = len(result.certificate.inverted) + len(result.certificate.degenerate)
            mips = distortion(problem.V, problem.F, result.uv).summary("mips").mean if result.injective else np.nan
            row = [f"{folder.parent.name}/{folder.name}", len(problem.F), functional, parameterisation, method]
            table.writerow([*row, flips, result.iterations, f"{result.seconds:.3f}", f"{mips:.3f}"])
            options.output.flush()


if __name__ == "__main__":
    main()
