"""Tetrahedra: maps onto a given boundary, moved boundaries, and the certificate against an oracle.

    python benchmarks/tetrahedra.py problems -n 300        fixed boundary; every problem has a hidden injective map
    python benchmarks/tetrahedra.py scenes                 six scenes, how far each method gets
    python benchmarks/tetrahedra.py methods                Newton's method and L-BFGS on turned cavities
    python benchmarks/tetrahedra.py certificate -n 20000   tiny meshes against an oracle in rational numbers

Times are CPU seconds, for Gmsh with the start of its process. If gmsh is installed, its untangler takes part in every
fifth problem of each family and in all scenes. It is stopped after 30 CPU seconds.
"""

from __future__ import annotations

import argparse
import importlib.util
import json
import resource
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
from scipy.interpolate import RBFInterpolator
from scipy.optimize import minimize
from scipy.sparse import coo_array
from scipy.sparse.linalg import cg

from quasiharmonic import certify_tetrahedra, injective_tetrahedra, morph
from quasiharmonic.apps.tetrahedra.descent import TetrahedraDescent
from quasiharmonic.apps.tetrahedra.energy import ShapeEnergy, reduce_epsilon
from quasiharmonic.apps.tetrahedra.placement import check_rest, extend_harmonically
from quasiharmonic.util.arrays import FloatArray, IntArray
from tetrahedral_problems import FAMILIES, VolumeScene, make, scenes, shell, turn

# Steps of a scene per unit of its parameter.
_STEP = 0.1
_MAX_PARAMETER = 6.0
# CPU seconds after which Gmsh is stopped.
_LIMIT = 30
# Evaluations of the energy after which L-BFGS is stopped.
_MAX_EVALUATIONS = 4000
# Gmsh solves one in so many problems of each family.
_GMSH_EVERY = 5


def run_problems(options: argparse.Namespace) -> None:
    """Solve generated problems, and print a table by family."""
    rows = []
    for number in range(options.count):
        family, seed = FAMILIES[number % len(FAMILIES)], number // len(FAMILIES)
        rng = np.random.default_rng(number)
        # One in 31 is large, in all families: 10,000 to 100,000 tetrahedra.
        size = int(10 ** (rng.uniform(3, 4) if number % 31 else 4 + number // 31 % 10 / 9))
        case = make(family, seed, size)
        begin = _begin(case.X, case.fixed, case.target)
        given = case.X, case.T, case.fixed, case.target
        row = {"family": family, "seed": seed, "tetrahedra": len(case.T), "inverted": _count_inverted(case.T, begin)}
        start = injective_tetrahedra(*given, start=case.start, polish=False, max_iterations=0)
        began = time.process_time()
        result = injective_tetrahedra(*given, start=case.start, polish=options.polish)
        row |= {
            "at_start": len(start.inverted),
            "seconds": time.process_time() - began,
            "certified": result.success,
            "left": len(result.inverted),
            "iterations": result.iterations,
            "status": result.status.name,
        }
        if options.gmsh and seed % _GMSH_EVERY == 0:
            began = _seconds_of_children()
            found = untangle_by_gmsh(case.T, begin)
            fixed = np.array_equal(found[case.fixed], case.target)
            row |= {
                "gmsh_seconds": _seconds_of_children() - began,
                "gmsh": fixed and bool(certify_tetrahedra(case.T, found).injective),
            }
        rows.append(row)
        print(json.dumps(row), file=sys.stderr, flush=True)
    if options.output:
        options.output.write_text("".join(json.dumps(row) + "\n" for row in rows))
    print("| family | problems | certified | inverted | at the start | median s | largest s | Gmsh | its median s |")
    print("|---" * 9 + "|")
    for family in (*FAMILIES, None):
        some = [row for row in rows if family in (row["family"], None)]
        seconds = [row["seconds"] for row in some]
        line = [family or "all", len(some), sum(row["certified"] for row in some)]
        line += [f"{np.median([row[name] for row in some]):.0f}" for name in ("inverted", "at_start")]
        line += [f"{np.median(seconds):.2f}", f"{max(seconds):.1f}"]
        both = [row for row in some if "gmsh" in row]
        line += [f"{sum(row['gmsh'] for row in both)} of {len(both)}"]
        line += [f"{np.median([row['gmsh_seconds'] for row in both]):.1f}" if both else "–"]
        print("| " + " | ".join(map(str, line)) + " |")
    sizes = [row["tetrahedra"] for row in rows]
    already = sum(row["at_start"] == 0 for row in rows)
    print(f"\n{min(sizes)} to {max(sizes)} tetrahedra; in {already} problems the start is already valid.")


def _count_inverted(T: IntArray, X: FloatArray) -> int:
    certificate = certify_tetrahedra(T, X, boundary=False)
    return len(certificate.inverted) + len(certificate.degenerate)


def _begin(X: FloatArray, fixed: IntArray, target: FloatArray) -> FloatArray:
    there = X.copy()
    there[fixed] = target
    return there


def untangle_by_gmsh(T: IntArray, X: FloatArray) -> FloatArray:
    """Gmsh's untangler of linear meshes; returns all vertices, unchanged ones after `_LIMIT` CPU seconds."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "mesh.npz"
        np.savez(path, T=T, X=X)
        command = [sys.executable, __file__, "gmsh", "-o", str(path)]
        try:
            subprocess.run(command, check=True, capture_output=True)
        except subprocess.CalledProcessError:
            return X
        with np.load(path) as found:
            return np.asarray(found["X"])


def _seconds_of_children() -> float:
    usage = resource.getrusage(resource.RUSAGE_CHILDREN)
    return usage.ru_utime + usage.ru_stime


def run_gmsh(options: argparse.Namespace) -> None:
    """Untangle the mesh of a file, in place, in a process of its own."""
    import gmsh

    resource.setrlimit(resource.RLIMIT_CPU, (_LIMIT, _LIMIT))
    with np.load(options.output) as given:
        T, X = given["T"], given["X"]
    F = certify_tetrahedra(T, X, boundary=False).boundary
    # The untangler mixes up nodes unless those of the boundary come first and all are used.
    boundary = np.unique(F)
    order = np.concatenate([boundary, np.setdiff1d(np.unique(T), boundary)])
    number = np.empty(len(X), dtype=np.int64)
    number[order] = np.arange(1, len(order) + 1)
    gmsh.initialize(interruptible=False)
    gmsh.option.setNumber("General.Terminal", 0)
    tag, wall = gmsh.model.addDiscreteEntity(3), gmsh.model.addDiscreteEntity(2)
    gmsh.model.mesh.addNodes(3, tag, np.arange(1, len(order) + 1), X[order].ravel())
    gmsh.model.mesh.addElementsByType(wall, 2, [], number[F].ravel())
    gmsh.model.mesh.addElementsByType(tag, 4, [], number[T].ravel())
    gmsh.model.mesh.reclassifyNodes()
    gmsh.model.mesh.optimize("UntangleMeshGeometry", force=True)
    tags, found, _ = gmsh.model.mesh.getNodes()
    X[order[np.asarray(tags, dtype=np.int64) - 1]] = found.reshape(-1, 3)
    gmsh.finalize()
    np.savez(options.output, X=X)


Mover = Callable[[VolumeScene, FloatArray, IntArray, FloatArray], FloatArray]


def _harmonic(scene: VolumeScene, here: FloatArray, fixed: IntArray, goal: FloatArray) -> FloatArray:
    return extend_harmonically(ShapeEnergy(scene.T, here), here, fixed, goal)


def _elastic(scene: VolumeScene, here: FloatArray, fixed: IntArray, goal: FloatArray) -> FloatArray:
    """Linear elasticity with a modulus inversely proportional to the volume, Poisson's ratio 0.3."""
    energy = ShapeEnergy(scene.T, here)
    G, T, n = energy.gradients, scene.T, len(here)
    lame, shear = 0.3 / (1.3 * 0.4), 1 / 2.6
    rows, columns, values = [], [], []
    for i in range(4):
        for j in range(4):
            dot = (G[i] * G[j]).sum(axis=0)
            for a in range(3):
                for b in range(3):
                    rows.append(3 * T[:, i] + a)
                    columns.append(3 * T[:, j] + b)
                    values.append(lame * G[i, a] * G[j, b] + shear * (G[i, b] * G[j, a] + (a == b) * dot))
    where = (np.concatenate(rows), np.concatenate(columns))
    matrix = coo_array((np.concatenate(values), where), shape=(3 * n, 3 * n)).tocsr()
    way = np.zeros_like(here)
    way[fixed] = goal - here[fixed]
    free = np.ones((n, 3), dtype=np.bool_)
    free[fixed] = False
    own = np.flatnonzero(free.ravel())
    way.ravel()[own] = cg(matrix[own][:, own], -(matrix[own] @ way.ravel()), rtol=1e-8, maxiter=3000)[0]
    return here + way


def _rbf(scene: VolumeScene, here: FloatArray, fixed: IntArray, goal: FloatArray) -> FloatArray:
    there = here + RBFInterpolator(here[fixed], goal - here[fixed], kernel="thin_plate_spline", neighbors=200)(here)
    there[fixed] = goal
    return there


def _morph(scene: VolumeScene, here: FloatArray, fixed: IntArray, goal: FloatArray) -> FloatArray:
    return morph(here, scene.T, fixed, goal, rest=scene.X, tol=1e-4).points


def _gmsh(scene: VolumeScene, here: FloatArray, fixed: IntArray, goal: FloatArray) -> FloatArray:
    return untangle_by_gmsh(scene.T, _begin(here, fixed, goal))


def run_scenes(options: argparse.Namespace) -> None:
    """Move the body of every scene step by step until a mesh is not valid; print how far each method gets."""
    methods: dict[str, Mover] = {"harmonic": _harmonic, "elasticity": _elastic, "RBF": _rbf, "morph": _morph}
    if options.gmsh:
        methods["Gmsh"] = _gmsh
    print("| scene | tetrahedra | " + " | ".join(methods) + " | CPU s of morph per step |")
    print("|---|---|" + "---|" * (len(methods) + 1))
    for name, scene in scenes(options.size).items():
        walls = np.setdiff1d(np.unique(certify_tetrahedra(scene.T, scene.X).boundary), scene.body)
        fixed = np.concatenate([scene.body, walls])
        reached, seconds = [], 0.0
        for method, move in methods.items():
            here, steps, began = scene.X, 0, time.process_time()
            while steps * _STEP < _MAX_PARAMETER:
                goal = np.concatenate([scene.places((steps + 1) * _STEP), scene.X[walls]])
                there = move(scene, here, fixed, goal)
                if not certify_tetrahedra(scene.T, there).injective:
                    break
                here, steps = there, steps + 1
            reached.append(f"{steps * _STEP:.1f}{'+' if steps * _STEP >= _MAX_PARAMETER else ''}")
            if method == "morph":
                seconds = (time.process_time() - began) / max(steps, 1)
        print(f"| {name} ({scene.unit}) | {len(scene.T)} | {' | '.join(reached)} | {seconds:.2f} |", flush=True)


def run_methods(options: argparse.Namespace) -> None:
    """Untangle turned cavities from the same start by Newton's method and by SciPy's L-BFGS; print a table."""
    print("| tetrahedra | turn | inverted | Newton s | steps | L-BFGS s | evaluations |\n|---|---|---|---|---|---|---|")
    for size in (8, 12, 16, 24):
        X, T, cavity = shell(size, np.random.default_rng(0))
        mesh = check_rest(T, X)
        fixed = mesh.boundary_vertices
        free = np.setdiff1d(np.unique(mesh.T), fixed)
        for degrees in (60, 120, 150):
            goal = X.copy()
            goal[cavity] = turn(X[cavity], np.full(len(cavity), np.radians(degrees)), 2)
            energy = ShapeEnergy(mesh.T, X)
            with np.errstate(all="ignore"):
                start = extend_harmonically(energy, X, fixed, goal[fixed])
                inverted = int((energy.determinants(start) <= 0).sum())
                began = time.process_time()
                descent = TetrahedraDescent(energy, free, start)
                steps = sum(1 for _ in descent.untangle(1000))
                newton = time.process_time() - began
                done = energy.determinants(descent.X).min() > 0
                began = time.process_time()
                evaluations = _untangle_by_lbfgs(energy, free, start)
                lbfgs = time.process_time() - began
            cells = [len(T), f"{degrees}°", inverted, f"{newton:.2f}", steps if done else "–", f"{lbfgs:.2f}"]
            print("| " + " | ".join(map(str, [*cells, evaluations or "–"])) + " |", flush=True)


def _untangle_by_lbfgs(energy: ShapeEnergy, free: IntArray, start: FloatArray) -> int:
    """Minimise by L-BFGS for each regularisation parameter; return the evaluations, 0 if they did not suffice."""
    X, epsilon, evaluations = start.copy(), 1.0, 0

    def evaluate(x: FloatArray, epsilon: float) -> tuple[float, FloatArray]:
        there = X.copy()
        there[free] = x.reshape(-1, 3)
        value, gradient = energy.gradient(there, epsilon)
        return value, gradient[free].ravel()

    while evaluations < _MAX_EVALUATIONS:
        before = energy.value(X, epsilon)
        steps = {"maxiter": 60}
        found = minimize(evaluate, X[free].ravel(), args=(epsilon,), jac=True, method="L-BFGS-B", options=steps)
        evaluations += found.nfev
        X[free] = found.x.reshape(-1, 3)
        least = float(energy.determinants(X).min())
        if least > 0:
            return evaluations
        epsilon = reduce_epsilon(epsilon, least, found.fun / before)
    return 0


def run_certificate(options: argparse.Namespace) -> None:
    """Compare the certificate with the oracle of the tests."""
    sys.path.insert(0, str(Path(__file__).parent.parent / "tests"))
    from test_tetrahedra_certificate import check_tiny_meshes

    good = check_tiny_meshes(range(10**6, 10**6 + options.count))
    print(f"{options.count} meshes, {good} of them injective: no disagreement")


def main() -> None:
    """Run one benchmark."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("what", choices=("problems", "scenes", "methods", "certificate", "gmsh"))
    parser.add_argument("-n", "--count", type=int, default=300)
    parser.add_argument("-o", "--output", type=Path, help="file of JSON lines for the problems")
    parser.add_argument("--size", type=int, default=12, help="cubes along each side of a scene")
    parser.add_argument("--no-gmsh", action="store_true", help="leave Gmsh out")
    parser.add_argument("--polish", action="store_true", help="also lower the distortion")
    options = parser.parse_args()
    options.gmsh = not options.no_gmsh and importlib.util.find_spec("gmsh") is not None
    runs = {
        "problems": run_problems,
        "scenes": run_scenes,
        "methods": run_methods,
        "certificate": run_certificate,
        "gmsh": run_gmsh,
    }
    runs[options.what](options)


if __name__ == "__main__":
    main()
