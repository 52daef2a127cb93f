"""Tetrahedra: maps onto a given boundary, moved boundaries, and the certificate against an oracle.

    python benchmarks/tetrahedra.py problems -n 300        fixed boundary; every problem has a hidden injective map
    python benchmarks/tetrahedra.py scenes                 six scenes, how far each method gets
    python benchmarks/tetrahedra.py certificate -n 20000   tiny meshes against an oracle in rational numbers

Times are CPU seconds; for Gmsh, wall seconds with its start. Gmsh's untangler takes part if gmsh is installed, and is
stopped after 60 s.
"""

from __future__ import annotations

import argparse
import importlib.util
import json
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
from scipy.interpolate import RBFInterpolator
from scipy.sparse import coo_array
from scipy.sparse.linalg import cg

from quasiharmonic import certify_tetrahedra, injective_tetrahedra, morph
from quasiharmonic.apps.tetrahedra.energy import ShapeEnergy
from quasiharmonic.apps.tetrahedra.placement import extend_harmonically
from quasiharmonic.util.arrays import FloatArray, IntArray
from tetrahedral_problems import FAMILIES, VolumeScene, make, scenes

# Steps of a scene per unit of its parameter.
_STEP = 0.1
_MAX_PARAMETER = 6.0
# Wall seconds after which Gmsh is stopped.
_LIMIT = 60


def run_problems(options: argparse.Namespace) -> None:
    """Solve generated problems, and print a table by family."""
    rows = []
    for number in range(options.count):
        family, seed = FAMILIES[number % len(FAMILIES)], number // len(FAMILIES)
        rng = np.random.default_rng(number)
        size = int(10 ** rng.uniform(3, 4)) if number % 30 else int(10 ** rng.uniform(4, 5))
        case = make(family, seed, size)
        inverted = len(certify_tetrahedra(case.T, _begin(case.X, case.fixed, case.target), boundary=False).inverted)
        row = {"family": family, "seed": seed, "tetrahedra": len(case.T), "inverted": inverted}
        began = time.process_time()
        result = injective_tetrahedra(case.X, case.T, case.fixed, case.target, start=case.start, polish=options.polish)
        row |= {
            "seconds": time.process_time() - began,
            "certified": result.success,
            "left": len(result.inverted),
            "iterations": result.iterations,
            "status": result.status.name,
        }
        if options.gmsh:
            began = time.perf_counter()
            found = untangle_by_gmsh(case.T, _begin(case.X, case.fixed, case.target))
            fixed = np.array_equal(found[case.fixed], case.target)
            row |= {
                "gmsh_seconds": time.perf_counter() - began,
                "gmsh": fixed and bool(certify_tetrahedra(case.T, found).injective),
            }
        rows.append(row)
        print(json.dumps(row), file=sys.stderr, flush=True)
    if options.output:
        options.output.write_text("".join(json.dumps(row) + "\n" for row in rows))
    print(
        "| family | problems | certified | median s | largest s | " + ("Gmsh | its median s |" if options.gmsh else "")
    )
    print("|---|---|---|---|---|" + ("---|---|" if options.gmsh else ""))
    for family in (*FAMILIES, None):
        some = [row for row in rows if family in (row["family"], None)]
        seconds = [row["seconds"] for row in some]
        line = [family or "all", len(some), sum(row["certified"] for row in some)]
        line += [f"{np.median(seconds):.2f}", f"{max(seconds):.1f}"]
        if options.gmsh:
            line += [sum(row["gmsh"] for row in some), f"{np.median([row['gmsh_seconds'] for row in some]):.2f}"]
        print("| " + " | ".join(map(str, line)) + " |")


def _begin(X: FloatArray, fixed: IntArray, target: FloatArray) -> FloatArray:
    there = X.copy()
    there[fixed] = target
    return there


def untangle_by_gmsh(T: IntArray, X: FloatArray) -> FloatArray:
    """Gmsh's untangler of linear meshes; returns all vertices, unchanged ones after `_LIMIT` seconds."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "mesh.npz"
        np.savez(path, T=T, X=X)
        command = [sys.executable, __file__, "gmsh", "-o", str(path)]
        try:
            subprocess.run(command, check=True, timeout=_LIMIT, capture_output=True)
        except (subprocess.TimeoutExpired, subprocess.CalledProcessError):
            return X
        with np.load(path) as found:
            return np.asarray(found["X"])


def run_gmsh(options: argparse.Namespace) -> None:
    """Untangle the mesh of a file, in place, in a process of its own."""
    import gmsh

    with np.load(options.output) as given:
        T, X = given["T"], given["X"]
    gmsh.initialize(interruptible=False)
    gmsh.option.setNumber("General.Terminal", 0)
    tag, wall = gmsh.model.addDiscreteEntity(3), gmsh.model.addDiscreteEntity(2)
    gmsh.model.mesh.addNodes(3, tag, np.arange(1, len(X) + 1), X.ravel())
    F = certify_tetrahedra(T, X, boundary=False).boundary
    gmsh.model.mesh.addElementsByType(wall, 2, [], (F + 1).ravel())
    gmsh.model.mesh.addElementsByType(tag, 4, [], (T + 1).ravel())
    gmsh.model.mesh.reclassifyNodes()
    gmsh.model.mesh.optimize("UntangleMeshGeometry", force=True)
    tags, found, _ = gmsh.model.mesh.getNodes()
    X[np.asarray(tags, dtype=np.int64) - 1] = found.reshape(-1, 3)
    gmsh.finalize()
    np.savez(options.output, X=X)


Mover = Callable[[VolumeScene, FloatArray, FloatArray, IntArray, FloatArray], FloatArray]


def _harmonic(scene: VolumeScene, base: FloatArray, here: FloatArray, fixed: IntArray, goal: FloatArray) -> FloatArray:
    return extend_harmonically(ShapeEnergy(scene.T, base), base, fixed, goal)


def _elastic(scene: VolumeScene, base: FloatArray, here: FloatArray, fixed: IntArray, goal: FloatArray) -> FloatArray:
    """Linear elasticity with a modulus inversely proportional to the volume, Poisson's ratio 0.3."""
    energy = ShapeEnergy(scene.T, base)
    G, T, n = energy.gradients, scene.T, len(base)
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
    way = np.zeros_like(base)
    way[fixed] = goal - base[fixed]
    free = np.ones((n, 3), dtype=np.bool_)
    free[fixed] = False
    own = np.flatnonzero(free.ravel())
    way.ravel()[own] = cg(matrix[own][:, own], -(matrix[own] @ way.ravel()), rtol=1e-8, maxiter=3000)[0]
    return base + way


def _rbf(scene: VolumeScene, base: FloatArray, here: FloatArray, fixed: IntArray, goal: FloatArray) -> FloatArray:
    there = base + RBFInterpolator(base[fixed], goal - base[fixed], kernel="thin_plate_spline", neighbors=200)(base)
    there[fixed] = goal
    return there


def _morph(scene: VolumeScene, base: FloatArray, here: FloatArray, fixed: IntArray, goal: FloatArray) -> FloatArray:
    return morph(here, scene.T, fixed, goal, rest=scene.X, tol=1e-4).points


def _gmsh(scene: VolumeScene, base: FloatArray, here: FloatArray, fixed: IntArray, goal: FloatArray) -> FloatArray:
    return untangle_by_gmsh(scene.T, _begin(here, fixed, goal))


def run_scenes(options: argparse.Namespace) -> None:
    """Move the body of every scene step by step until a mesh is not valid; print how far each method gets."""
    methods: dict[str, tuple[Mover, bool]] = {
        "harmonic": (_harmonic, False),
        "elasticity": (_elastic, False),
        "RBF": (_rbf, False),
        "morph": (_morph, False),
    }
    if options.gmsh:
        methods["Gmsh"] = _gmsh, False
    print("| scene | tetrahedra | " + " | ".join(methods) + " | CPU s of morph per step |")
    print("|---|---|" + "---|" * (len(methods) + 1))
    for name, scene in scenes(options.size).items():
        walls = np.setdiff1d(np.unique(certify_tetrahedra(scene.T, scene.X).boundary), scene.body)
        fixed = np.concatenate([scene.body, walls])
        reached, seconds = [], 0.0
        for method, (move, from_rest) in methods.items():
            here, steps, began = scene.X, 0, time.process_time()
            while steps * _STEP < _MAX_PARAMETER:
                goal = np.concatenate([scene.places((steps + 1) * _STEP), scene.X[walls]])
                there = move(scene, scene.X if from_rest else here, here, fixed, goal)
                if not certify_tetrahedra(scene.T, there).injective:
                    break
                here, steps = there, steps + 1
            reached.append(f"{steps * _STEP:.1f}{'+' if steps * _STEP >= _MAX_PARAMETER else ''}")
            if method == "morph":
                seconds = (time.process_time() - began) / max(steps, 1)
        print(f"| {name} ({scene.unit}) | {len(scene.T)} | {' | '.join(reached)} | {seconds:.2f} |", flush=True)


def run_certificate(options: argparse.Namespace) -> None:
    """Compare the certificate with the oracle of the tests."""
    sys.path.insert(0, str(Path(__file__).parent.parent / "tests"))
    from test_tetrahedra_certificate import check_tiny_meshes

    good = check_tiny_meshes(range(10**6, 10**6 + options.count))
    print(f"{options.count} meshes, {good} of them injective: no disagreement")


def main() -> None:
    """Run one benchmark."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("what", choices=("problems", "scenes", "certificate", "gmsh"))
    parser.add_argument("-n", "--count", type=int, default=300)
    parser.add_argument("-o", "--output", type=Path, help="file of JSON lines for the problems")
    parser.add_argument("--size", type=int, default=12, help="cubes along each side of a scene")
    parser.add_argument("--no-gmsh", action="store_true", help="leave Gmsh out")
    parser.add_argument("--polish", action="store_true", help="also lower the distortion")
    options = parser.parse_args()
    options.gmsh = not options.no_gmsh and importlib.util.find_spec("gmsh") is not None
    {"problems": run_problems, "scenes": run_scenes, "certificate": run_certificate, "gmsh": run_gmsh}[options.what](
        options
    )


if __name__ == "__main__":
    main()
