"""A free boundary against libigl's SLIM and SCAF, in one process and by turns.

    python benchmarks/flatten.py [FILE.obj | FOLDER …] [--csv FILE] [--scaf N] [--large]

Every OBJ file below the folders, one connected surface with a boundary each; without any, surfaces that the project
makes. ``--large`` adds a million triangles with twelve holes, ours alone, and how far its energy is from that of a
descent to convergence. Needs libigl (the `bench` extra) and its `igl.triangle`.

All start from arrays: ours includes checks, start, layout and certificate; SLIM and SCAF include their start, Tutte's
embedding onto a circle of the surface's area, solved by SciPy. Seconds are those of the processor, on one thread. The
energy is the mean of ``symmetric-dirichlet`` as this package defines it, 0 for an isometry, of the surface in its own
unit; "reached" is when ours is bijective and first has at most 1.005 times SCAF's energy (and 10⁻⁶), or at most SLIM's
after 20 iterations.
"""

from __future__ import annotations

import os

# One thread each, or seconds of the processor count what threads spend waiting.
os.environ.setdefault("OMP_NUM_THREADS", "1")
os.environ.setdefault("MKL_NUM_THREADS", "1")

import argparse
import csv
import platform
import sys
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from importlib.metadata import version
from pathlib import Path

import numpy as np

from quasiharmonic import boundary_loops, certify, distortion, io, surfaces
from quasiharmonic.apps.flattening.flattened import flatten
from quasiharmonic.apps.flattening.start import fans
from quasiharmonic.energies.deformation import DeformationEnergy
from quasiharmonic.energies.energies import SymmetricDirichlet
from quasiharmonic.util.arrays import FloatArray, IntArray

Surface = tuple[str, FloatArray, IntArray]

_SLACK, _LEAST = 1.005, 1e-6


@dataclass
class Found:
    """What a method has made of a surface."""

    seconds: float
    energy: float
    injective: bool
    bijective: bool
    stretch: float


def judged(V: FloatArray, F: IntArray, uv: FloatArray, seconds: float) -> Found:
    """Measure and certify a map."""
    verdict = certify(F, uv)
    if not verdict.injective:
        return Found(seconds, np.inf, False, False, np.inf)
    energy = DeformationEnergy(V, F, SymmetricDirichlet()).value(np.ascontiguousarray(uv).view(np.complex128).ravel())
    stretch = distortion(V, F, uv).summary("isometric").maximum
    return Found(seconds, energy, True, bool(verdict.bijective), stretch)


def ours(V: FloatArray, F: IntArray) -> tuple[Found, list[tuple[float, float]]]:
    """Our map, and seconds and energy at each step of the descent that was kept."""
    began = time.process_time()
    steps: list[tuple[float, float]] = []
    result = flatten(V, F, callback=lambda step: steps.append((time.process_time() - began, step.energy)))
    seconds = time.process_time() - began
    # Of several descents the last is the bijective one.
    kept = [stage for stage in result.stages if "descent" in stage.name][-1].iterations + 1
    return judged(V, F, result.uv, seconds), steps[-kept:]


def tutte(V: FloatArray, F: IntArray) -> FloatArray:
    """Tutte's embedding, holes filled, of the longest loop onto a circle of the surface's area."""
    from scipy.sparse import coo_array, csr_array, diags
    from scipy.sparse.linalg import spsolve

    loops = boundary_loops(F, len(V))
    lengths = [np.linalg.norm(V[np.roll(loop, -1)] - V[loop], axis=1) for loop in loops]
    longest = int(np.argmax([length.sum() for length in lengths]))
    loop, length = loops[longest], lengths[longest]
    cross = np.cross(V[F[:, 1]] - V[F[:, 0]], V[F[:, 2]] - V[F[:, 0]])
    radius = np.sqrt(0.5 * np.linalg.norm(cross, axis=1).sum() / np.pi)
    angle = 2 * np.pi * np.cumsum(length) / length.sum()
    filled = np.concatenate([F, fans([hole for k, hole in enumerate(loops) if k != longest], len(V))])
    n = int(filled.max()) + 1
    uv = np.zeros((n, 2))
    uv[loop] = radius * np.stack([np.cos(angle), np.sin(angle)], axis=1)
    tail, head = filled.ravel(), np.roll(filled, -1, axis=1).ravel()
    graph = coo_array((np.ones(tail.size), (tail, head)), shape=(n, n)).tocsr()
    graph = ((graph + graph.T) > 0).astype(np.float64)
    laplacian = (csr_array(diags(graph @ np.ones(n))) - graph).tocsr()
    free = np.setdiff1d(np.arange(n), loop)
    if free.size:
        uv[free] = spsolve(laplacian[free][:, free].tocsc(), -laplacian[free][:, loop] @ uv[loop]).reshape(-1, 2)
    return uv[: len(V)]


def slim(V: FloatArray, F: IntArray, iterations: int) -> FloatArray:
    """SLIM of libigl from Tutte's embedding."""
    import igl

    none, nowhere = np.zeros(0, dtype=np.int32), np.zeros((0, 2), order="F")
    start, space, triangles = np.asfortranarray(tutte(V, F)), np.asfortranarray(V), np.asfortranarray(F, dtype=np.int32)
    kind = igl.MappingEnergyType.SYMMETRIC_DIRICHLET
    data = igl.slim_precompute(space, triangles, start, kind, none, nowhere, 0.0)
    return np.ascontiguousarray(igl.slim_solve(data, iterations)[:, :2])


def scaf(V: FloatArray, F: IntArray, iterations: int) -> FloatArray:
    """SCAF of libigl from Tutte's embedding."""
    import igl
    import igl.triangle

    none, nowhere = np.zeros(0, dtype=np.int32), np.zeros((0, 2), order="F")
    start, space, triangles = np.asfortranarray(tutte(V, F)), np.asfortranarray(V), np.asfortranarray(F, dtype=np.int32)
    data = igl.triangle.SCAFData()
    kind = igl.MappingEnergyType.SYMMETRIC_DIRICHLET
    igl.triangle.scaf_precompute(space, triangles, start, kind, none, nowhere, 0.0, data)
    return np.ascontiguousarray(igl.triangle.scaf_solve(iterations, data)[: len(V), :2])


def peer(
    solve: Callable[[FloatArray, IntArray, int], FloatArray], V: FloatArray, F: IntArray, iterations: int
) -> Found:
    """What a peer makes of a surface."""
    began = time.process_time()
    uv = solve(V, F, iterations)
    return judged(V, F, uv, time.process_time() - began)


def own_surfaces() -> Iterator[Surface]:
    """Surfaces of the project's making: curved, with long limbs, wound up, with holes, of thin triangles."""
    yield ("cat", *surfaces.cat(40))
    V, F = surfaces.disk(40)
    rng = np.random.default_rng(0)
    bumps = sum(
        a * np.exp(-((V - c) ** 2).sum(axis=1) / 0.03)
        for a, c in zip((1, -0.8, 0.9, 1.1), rng.uniform(-0.6, 0.6, (4, 2)), strict=True)
    )
    yield "hills", np.column_stack([V, bumps]), F
    r, turn = np.hypot(*V.T), np.arctan2(V[:, 1], V[:, 0])
    reach = 0.25 + r**2 * (2.2 + 2 * np.cos(5 * turn))
    yield "star of limbs", np.column_stack([reach * V[:, 0], reach * V[:, 1], 0.4 * reach**2]), F
    square, F = surfaces.grid(200, 8)
    angle, radius = 9.0 * square[:, 0], 1 + 0.5 * square[:, 1]
    yield "ring of 516°", np.stack([radius * np.cos(angle), radius * np.sin(angle), 0.03 * angle], axis=1), F
    angle, radius = 12 * square[:, 0], 1 + 2.5 * square[:, 0]
    coil = np.stack([radius * np.cos(angle), radius * np.sin(angle), 0.5 * square[:, 1]], axis=1)
    yield "coil", coil + 0.01 * np.sin(40 * coil[:, [1, 2, 0]]), F
    V, F = surfaces.annulus(48)
    yield "bowl with a hole", np.column_stack([V, 0.8 * (V**2).sum(axis=1) + 0.1 * np.sin(6 * V[:, 0])]), F
    yield ("twelve holes", *with_holes(70))
    square, F = surfaces.grid(16, 300)
    yield "thin triangles", np.column_stack([square, 0.3 * np.sin(7 * square[:, 0]) * np.cos(5 * square[:, 1])]), F


def with_holes(cells: int) -> tuple[FloatArray, IntArray]:
    """A hilly square with twelve round holes and jittered vertices; 2 ``cells²`` triangles less the holes."""
    square, F = surfaces.grid(cells, cells)
    V = 2 * square - 1
    middle = V[F].mean(axis=1)
    solid = np.ones(len(F), dtype=bool)
    for x in (-0.7, -0.25, 0.25, 0.7):
        for y in (-0.6, 0.0, 0.6):
            solid &= np.hypot(middle[:, 0] - x, middle[:, 1] - y) > 0.1
    used, flat = np.unique(F[solid], return_inverse=True)
    V = V[used] + 0.3 / cells * np.random.default_rng(0).uniform(-1, 1, (used.size, 2))
    height = 0.25 * np.sin(3 * V[:, 0] + 1) * np.cos(2.5 * V[:, 1]) + 0.15 * np.exp(-4 * ((V - 0.2) ** 2).sum(axis=1))
    return np.column_stack([V, height]), flat.reshape(-1, 3).astype(np.int64)


def given_surfaces(paths: list[Path]) -> Iterator[Surface]:
    """The surfaces of OBJ files."""
    for path in paths:
        for file in sorted(path.rglob("*.obj")) if path.is_dir() else [path]:
            mesh = io.read_mesh(file)
            yield file.stem, mesh.V, mesh.F


def compare(cases: Iterator[Surface], iterations: int) -> list[dict[str, object]]:
    """A row of the table for each surface."""
    # What is loaded when it is first needed counts for nobody.
    V, F = surfaces.cat(4)
    ours(V, F), peer(slim, V, F, 1), peer(scaf, V, F, 1)
    rows = []
    for name, V, F in cases:
        print(name, file=sys.stderr, flush=True)
        found, steps = ours(V, F)
        rivals = {
            "SLIM 20": peer(slim, V, F, 20),
            "SLIM 200": peer(slim, V, F, 200),
            f"SCAF {iterations}": peer(scaf, V, F, iterations),
        }
        row: dict[str, object] = {"surface": name, "triangles": len(F)}
        for method, one in {"ours": found, **rivals}.items():
            row.update({f"{method}: {key}": value for key, value in vars(one).items()})
        least = rivals[f"SCAF {iterations}"]
        row["reached SCAF's"] = reached(steps, _SLACK * least.energy + _LEAST)
        row["of SCAF's seconds"] = row["reached SCAF's"] / least.seconds
        row["reached SLIM's"] = reached(steps, rivals["SLIM 20"].energy)
        row["of SLIM's seconds"] = row["reached SLIM's"] / rivals["SLIM 20"].seconds
        rows.append(row)
    return rows


def reached(steps: list[tuple[float, float]], energy: float) -> float:
    """Seconds at the first step with no more than an energy; infinite if there is none."""
    return next((seconds for seconds, value in steps if value <= energy), np.inf)


def large() -> str:
    """A million triangles with holes, on all threads: seconds, and how far from its least the energy is."""
    V, F = with_holes(745)
    began = time.perf_counter()
    result = flatten(V, F)
    seconds = time.perf_counter() - began
    best = flatten(V, F, start=result.uv, tolerance=1e-9).history[-1].energy
    energy = result.history[-1].energy
    return (
        f"{len(F):,} triangles, {len(result.certificate.loops) - 1} holes: {seconds:.1f} s, energy {energy:.5g}, "
        f"{energy / best - 1:.2%} above the least; bijective: {result.certificate.bijective}"
    )


def main() -> None:
    """Print the table as Markdown; with ``--csv`` write it too."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("paths", nargs="*", type=Path)
    parser.add_argument("--csv", type=Path, metavar="FILE")
    parser.add_argument("--scaf", type=int, default=200, metavar="N", help="iterations of SCAF (default: 200)")
    parser.add_argument("--large", action="store_true")
    options = parser.parse_args()
    versions = ", ".join(f"{name} {version(name)}" for name in ("quasiharmonic", "libigl", "numpy", "scipy", "mkl"))
    machine = f"{platform.processor() or platform.machine()}, {os.cpu_count()} cores"
    print(f"{machine}, Python {platform.python_version()}; {versions}\n")
    cases = given_surfaces(options.paths) if options.paths else own_surfaces()
    rows = compare(cases, options.scaf)
    if rows:
        columns = [key for key in rows[0] if "injective" not in key]
        print("| " + " | ".join(columns) + " |\n" + "|---" * len(columns) + "|")
        for row in rows:
            print("| " + " | ".join(_shown(row[key]) for key in columns) + " |")
    if options.csv is not None and rows:
        with options.csv.open("w", newline="", encoding="utf-8") as file:
            writer = csv.DictWriter(file, list(rows[0]))
            writer.writeheader()
            writer.writerows(rows)
    if options.large:
        print(f"\n{large()}")


def _shown(value: object) -> str:
    if isinstance(value, bool):
        return "yes" if value else "no"
    return f"{value:.4g}" if isinstance(value, float) else str(value)


if __name__ == "__main__":
    main()
