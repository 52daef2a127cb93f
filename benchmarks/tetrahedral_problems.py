"""Tetrahedra: maps onto a given boundary with a hidden injective map, and the certificate against an oracle.

    python benchmarks/tetrahedral_problems.py problems -n 300 [--table docs/mesh_motion/tetrahedra.md]
    python benchmarks/tetrahedral_problems.py certificate -n 20000   tiny meshes against an oracle in rational numbers

A problem has a mesh and the boundary of a hidden map. Both are made from one mesh: the hidden map by a
diffeomorphism, the rest mesh by the same with a negative strength. Each strength is raised until a tetrahedron is
inverted; the problem takes 95 % of it, or less if the boundary crosses itself. So the worst tetrahedra are nearly flat
in both. Times are CPU seconds.
"""

from __future__ import annotations

import argparse
import json
import sys
import time
from collections.abc import Callable
from dataclasses import dataclass
from itertools import permutations
from pathlib import Path

import numpy as np
from scipy.spatial import Delaunay

from quasiharmonic import certify_tetrahedra, injective_tetrahedra
from quasiharmonic.util.arrays import FloatArray, IntArray
from speed import machine

FAMILIES = ("flow", "twist", "bend", "spin", "folded")
#: Positions (n, 3) after a deformation of positions (n, 3) with a strength.
Move = Callable[[FloatArray, float], FloatArray]


@dataclass(frozen=True)
class VolumeProblem:
    """A mesh, its fixed boundary, a hidden injective map, and an initial mesh, None for the harmonic map."""

    X: FloatArray
    T: IntArray
    fixed: IntArray
    hidden: FloatArray
    start: FloatArray | None

    @property
    def target(self) -> FloatArray:
        """Target positions of the fixed vertices."""
        return self.hidden[self.fixed]


def box(k: int, jitter: float, rng: np.random.Generator) -> tuple[FloatArray, IntArray]:
    """A cube of side 2 around the origin of 6 k³ tetrahedra, with jittered inner vertices."""
    X = np.stack(np.meshgrid(*[2 * np.arange(k + 1) / k - 1] * 3, indexing="ij"), axis=-1).reshape(-1, 3)
    step = np.array([(k + 1) ** 2, k + 1, 1])
    first = np.stack(np.meshgrid(*[np.arange(k)] * 3, indexing="ij"), axis=-1).reshape(-1, 3) @ step
    T = np.concatenate([first[:, None] + np.cumsum([0, *step[list(p)]]) for p in permutations(range(3))])
    inner = (np.abs(X) < 1).all(axis=1)
    X[inner] += jitter / k * rng.uniform(-1, 1, (inner.sum(), 3))
    return X, _positive(T, X)


def ball(points: int, rng: np.random.Generator) -> tuple[FloatArray, IntArray]:
    """A Delaunay mesh of random points in a ball, with slivers."""
    count = max(int(3.4 * points ** (2 / 3)), 30)
    z = 1 - (2 * np.arange(count) + 1) / count
    angle = np.pi * (1 + 5**0.5) * np.arange(count)
    r = np.sqrt(1 - z * z)
    surface = np.stack([r * np.cos(angle), r * np.sin(angle), z], axis=1)
    inside = rng.normal(size=(points, 3))
    inside *= (0.93 * rng.random(points) ** (1 / 3) / np.linalg.norm(inside, axis=1))[:, None]
    X = np.concatenate([surface, inside])
    return X, _positive(Delaunay(X).simplices.astype(np.int64), X)


def shell(k: int, rng: np.random.Generator) -> tuple[FloatArray, IntArray, IntArray]:
    """A jittered cube with a cubic cavity of a third of its width, and the vertices of the cavity."""
    X, T = box(k, 0.3, rng)
    half = round(k / 6) * 2 / k if k % 2 == 0 else (2 * round((k / 3 - 1) / 2) + 1) / k
    lattice = 2 * np.stack(np.meshgrid(*[np.arange(k + 1)] * 3, indexing="ij"), axis=-1).reshape(-1, 3) / k - 1
    T = T[np.abs(lattice[T].mean(axis=1)).max(axis=1) > half]
    cavity = np.flatnonzero(np.abs(np.abs(lattice).max(axis=1) - half) < 1e-9)
    X[cavity] = lattice[cavity]
    return X, T, cavity


def make(family: str, seed: int, tetrahedra: int) -> VolumeProblem:
    """Make a problem of a family with about this number of tetrahedra."""
    rng = np.random.default_rng([FAMILIES.index(family), seed])
    if family == "spin":
        X, T, _ = shell(max(round((tetrahedra / 6) ** (1 / 3)), 7), rng)
    elif seed % 3 == 0:
        X, T = ball(max(tetrahedra // 7, 30), rng)
    elif seed % 3 == 1:
        X, T = box(max(round((tetrahedra / 6) ** (1 / 3)), 3), 0.3, rng)
    else:
        X, T, _ = shell(max(round((tetrahedra / 6) ** (1 / 3)), 5), rng)
    move = _family(family, rng)
    hidden = _deform(X, T, move)
    X = _deform(X, T, lambda Y, s: move(Y, -s))
    fixed = np.unique(certify_tetrahedra(T, X).boundary)
    start = None
    if family == "folded":
        start = hidden + 0.5 * rng.normal(size=X.shape)
    return VolumeProblem(X, T, fixed, hidden, start)


def _deform(X: FloatArray, T: IntArray, move: Move) -> FloatArray:
    """Deform a mesh by 95 % of the largest strength that keeps it positive, or less so that it is injective."""
    low, high = 0.0, 4.0
    for _ in range(9):
        strength = 0.5 * (low + high)
        if certify_tetrahedra(T, move(X, strength), boundary=False).positive:
            low = strength
        else:
            high = strength
    there = move(X, 0.95 * low)
    while not certify_tetrahedra(T, there).injective:
        low *= 0.9
        there = move(X, low)
    return there


def _family(family: str, rng: np.random.Generator) -> Move:
    if family == "twist":
        axis = int(rng.integers(3))
        return lambda X, s: turn(X, 1.5 * s * X[:, axis], axis)
    if family == "bend":

        def bend(X: FloatArray, s: float) -> FloatArray:
            angle, radius = s * X[:, 0], 1 / s + 0.8 * X[:, 1]
            return np.stack([radius * np.sin(angle), radius * np.cos(angle) - 1 / s, X[:, 2]], axis=1)

        return bend
    if family == "spin":
        axis = int(rng.integers(3))

        def spin(X: FloatArray, s: float) -> FloatArray:
            return turn(X, s * np.clip((1 - np.abs(X).max(axis=1)) / (2 / 3), 0, 1), axis)

        return spin
    waves, phases, ways = rng.normal(size=(6, 3)) * 1.5, rng.uniform(0, 6, 6), rng.normal(size=(6, 3))

    def flow(X: FloatArray, s: float) -> FloatArray:
        Y = X.copy()
        for _ in range(16):
            for wave, phase, way in zip(waves, phases, ways, strict=True):
                # A shear: a displacement across the gradient of its phase.
                across = np.cross(wave, way) / np.linalg.norm(wave)
                Y = Y + s / 64 * np.sin(Y @ wave + phase)[:, None] * across
        return Y

    return flow


def turn(X: FloatArray, angle: FloatArray, axis: int) -> FloatArray:
    """Rotate every point around an axis by its own angle."""
    Y = X.copy()
    a, b = (axis + 1) % 3, (axis + 2) % 3
    Y[:, a] = np.cos(angle) * X[:, a] - np.sin(angle) * X[:, b]
    Y[:, b] = np.sin(angle) * X[:, a] + np.cos(angle) * X[:, b]
    return Y


def _positive(T: IntArray, X: FloatArray) -> IntArray:
    u, v, w = (X[T[:, k]] - X[T[:, 0]] for k in (1, 2, 3))
    return np.where(((u * np.cross(v, w)).sum(axis=1) < 0)[:, None], T[:, [1, 0, 2, 3]], T)


def run_problems(options: argparse.Namespace) -> None:
    """Solve generated problems, and print a table by family."""
    rows = []
    for number in range(options.count):
        family, seed = FAMILIES[number % len(FAMILIES)], number // len(FAMILIES)
        rng = np.random.default_rng(number)
        # One in 31 is large, in all families: 10,000 to 100,000 tetrahedra.
        size = int(10 ** (rng.uniform(3, 4) if number % 31 else 4 + number // 31 % 10 / 9))
        case = make(family, seed, size)
        begin = case.X.copy()
        begin[case.fixed] = case.target
        given = case.X, case.T, case.fixed, case.target
        row = {"family": family, "seed": seed, "tetrahedra": len(case.T), "inverted": _count_inverted(case.T, begin)}
        start = injective_tetrahedra(*given, start=case.start, polish=False, max_iterations=0)
        began = time.process_time()
        result = injective_tetrahedra(*given, start=case.start, polish=False)
        row |= {
            "at_start": len(start.inverted),
            "seconds": time.process_time() - began,
            "certified": result.success,
            "left": len(result.inverted),
            "iterations": result.iterations,
            "status": result.status.name,
        }
        rows.append(row)
        print(json.dumps(row), file=sys.stderr, flush=True)
    if options.output:
        options.output.write_text("".join(json.dumps(row) + "\n" for row in rows))
    heads = "family", "problems", "certified", "inverted at rest", "inverted at the start", "median s", "largest s"
    sizes = [row["tetrahedra"] for row in rows]
    already = sum(row["at_start"] == 0 for row in rows)
    about = f"{min(sizes):,} to {max(sizes):,} tetrahedra; in {already} problems the start is already valid"
    lines = [f"{machine()}; {about}", "", f"| {' | '.join(heads)} |", "|---" * len(heads) + "|"]
    for family in (*FAMILIES, None):
        some = [row for row in rows if family in (row["family"], None)]
        seconds = [row["seconds"] for row in some]
        line = [family or "all", len(some), sum(row["certified"] for row in some)]
        line += [f"{np.median([row[name] for row in some]):.0f}" for name in ("inverted", "at_start")]
        line += [f"{np.median(seconds):.2f}", f"{max(seconds):.1f}"]
        lines.append("| " + " | ".join(map(str, line)) + " |")
    print("\n".join(lines))
    if options.table:
        options.table.write_text("\n".join(lines) + "\n", encoding="utf-8")


def _count_inverted(T: IntArray, X: FloatArray) -> int:
    certificate = certify_tetrahedra(T, X, boundary=False)
    return len(certificate.inverted) + len(certificate.degenerate)


def run_certificate(options: argparse.Namespace) -> None:
    """Compare the certificate with the oracle of the tests."""
    sys.path.insert(0, str(Path(__file__).parent.parent / "tests"))
    from test_tetrahedra_certificate import check_tiny_meshes

    good = check_tiny_meshes(range(10**6, 10**6 + options.count))
    print(f"{options.count} meshes, {good} of them injective: no disagreement")


def main() -> None:
    """Run one benchmark."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    runs = {"problems": run_problems, "certificate": run_certificate}
    parser.add_argument("what", choices=runs)
    parser.add_argument("-n", "--count", type=int, default=300)
    parser.add_argument("-o", "--output", type=Path, help="file of JSON lines for the problems")
    parser.add_argument("--table", type=Path, metavar="FILE", help="write the table of the problems here as well")
    options = parser.parse_args()
    runs[options.what](options)


if __name__ == "__main__":
    main()
