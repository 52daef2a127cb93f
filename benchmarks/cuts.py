"""Cuts: how long they are and how flat a surface lies that is cut along them.

    python benchmarks/cuts.py [FILE.obj | FOLDER …] [--gain G …] [--pictures FOLDER] [--csv FILE] [--large]

Every OBJ file below the folders, one connected surface each; without any, surfaces that the project makes. ``--large``
adds some of 100,000 triangles and more, `find_cuts` alone.

Compared are `find_cuts` at each ``gain``, infinite being cuts that make a disk and no more, and what the library did
before it had `find_cuts`: libigl's ``cut_to_disk``, or a shortest path between two vertices far from each other where
that would cut nothing. Lengths are in square roots of the surface's area; "ends" are ends of cuts inside the surface;
"told" is the energy by which `find_cuts` judges, and "energy" that of `flatten` on the surface so cut, the mean of
``symmetric-dirichlet``, 0 for an isometry. Seconds are those of the processor, on one thread.
"""

from __future__ import annotations

import os

# One thread each, or seconds of the processor count what threads spend waiting.
os.environ.setdefault("OMP_NUM_THREADS", "1")
os.environ.setdefault("MKL_NUM_THREADS", "1")

import argparse
import csv
import itertools
import platform
import sys
import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from quasiharmonic import flatten, io, surfaces
from quasiharmonic.geometry.mesh.opening import opened_along
from quasiharmonic.geometry.mesh.topology import boundary_edges, edges
from quasiharmonic.targets.cuts.find import find_cuts
from quasiharmonic.targets.cuts.graph import edge_graph
from quasiharmonic.targets.cuts.shrinking import Shrinking
from quasiharmonic.ui.plot.shading import lit
from quasiharmonic.util.arrays import FloatArray, IntArray

Surface = tuple[str, FloatArray, IntArray]

# From which sides pictures show a surface: degrees around the upright axis, and from above.
_VIEWS = ((-30, 20), (150, -20))


def former_cuts(V: FloatArray, F: IntArray) -> IntArray:
    """Cuts by libigl, or one path where it has none."""
    import igl
    from scipy.sparse import csr_array
    from scipy.sparse.csgraph import dijkstra

    found = edges(F, len(V))
    if len(V) - len(found.interior) - len(found.boundary) + len(F) < 2:
        paths = igl.cut_to_disk(F)
    else:
        inner = found.interior
        length = np.linalg.norm(V[inner[:, 0]] - V[inner[:, 1]], axis=1)
        first = int(np.argmax(np.linalg.norm(V - V.mean(axis=0), axis=1)))
        graph = csr_array((length, inner.T), shape=(len(V), len(V)))
        away, before = dijkstra(graph, directed=False, indices=first, return_predecessors=True)
        path = [int(np.argmax(away))]
        while path[-1] != first:
            path.append(int(before[path[-1]]))
        paths = [path]
    pairs = np.array([pair for path in paths for pair in itertools.pairwise(path)], dtype=np.int64).reshape(-1, 2)
    pairs = np.unique(np.sort(pairs, axis=1), axis=0)
    on_boundary = {tuple(pair) for pair in np.sort(found.boundary, axis=1).tolist()}
    return np.array([pair for pair in pairs.tolist() if tuple(pair) not in on_boundary], dtype=np.int64).reshape(-1, 2)


def judged(name: str, way: str, V: FloatArray, F: IntArray, cut: IntArray, seconds: float) -> dict[str, object]:
    """A row of the table."""
    graph = edge_graph(V, F)
    number = graph.numbers(cut[:, 0], cut[:, 1])
    degree = np.bincount(cut.ravel(), minlength=len(V))
    shrinking, opened = Shrinking(graph), graph.rim_vertices.copy()
    opened[cut] = True
    FT, origin = opened_along(F, cut, len(V))
    began = time.process_time()
    result = flatten(V[origin], FT)
    return {
        "surface": name,
        "triangles": len(F),
        "cuts": way,
        "length": float(graph.length[number].sum()),
        "ends": int(((degree == 1) & ~graph.rim_vertices).sum()),
        "told": shrinking.energy(shrinking.of(opened)),
        "energy": result.history[-1].energy,
        "bijective": bool(result.certificate.bijective),
        "seconds": seconds,
        "to flatten": time.process_time() - began,
    }


def compare(cases: Iterator[Surface], gains: list[float], pictures: Path | None) -> list[dict[str, object]]:
    """The rows of all surfaces."""
    rows = []
    for name, V, F in cases:
        print(name, file=sys.stderr, flush=True)
        ways = {f"gain {gain:g}": gain for gain in [np.inf, *gains]}
        for way in ["before", *ways]:
            began = time.process_time()
            cut = find_cuts(V, F, min_gain=ways[way]) if way in ways else former_cuts(V, F)
            seconds = time.process_time() - began
            rows.append(judged(name, way, V, F, cut, seconds))
            if pictures is not None and way in ways:
                draw(pictures / f"{name} {way}.png", V, F, cut)
    return rows


def draw(path: Path, V: FloatArray, F: IntArray, cut: IntArray) -> None:
    """Two views of a surface with its cuts, and its map."""
    from matplotlib.collections import LineCollection, PolyCollection
    from matplotlib.figure import Figure

    figure = Figure(figsize=(15, 5), layout="tight")
    axes = figure.subplots(1, 3)
    FT, origin = opened_along(F, cut, len(V))
    uv = flatten(V[origin], FT).uv
    graph = edge_graph(V, F)
    marked = np.zeros(len(graph.ends), dtype=bool)
    marked[graph.numbers(cut[:, 0], cut[:, 1])] = True
    for ax, (yaw, pitch) in zip(axes[:2], np.radians(_VIEWS), strict=True):
        from_side = np.array([[np.cos(yaw), 0, np.sin(yaw)], [0, 1, 0], [-np.sin(yaw), 0, np.cos(yaw)]])
        from_above = np.array([[1, 0, 0], [0, np.cos(pitch), -np.sin(pitch)], [0, np.sin(pitch), np.cos(pitch)]])
        seen = graph.V @ (from_above @ from_side).T
        normal = np.cross(seen[F[:, 1]] - seen[F[:, 0]], seen[F[:, 2]] - seen[F[:, 0]])
        normal /= np.maximum(np.linalg.norm(normal, axis=1), np.finfo(float).tiny)[:, None]
        # Painted from behind, lines a little before their triangles, so that what is in front hides them.
        front = np.flatnonzero(normal[:, 2] > 0)
        sides = np.stack([seen[F[front]], seen[np.roll(F[front], -1, axis=1)]], axis=2)[marked[graph.side.T[front]]]
        grey = lit(np.full((front.size, 3), 0.7), normal[front] @ (-0.5, 0.6, 0.62))
        depth = np.concatenate([seen[F[front], 2].mean(axis=1), sides[..., 2].mean(axis=1) + 0.02 * np.ptp(seen)])
        patches = [*seen[F[front], :2], *sides[..., :2]]
        colors = np.concatenate([grey, np.tile([0.85, 0.05, 0.05], (len(sides), 1))])
        widths = np.concatenate([np.full(front.size, 0.3), np.full(len(sides), 1.8)])
        order = np.argsort(depth)
        ax.add_collection(
            PolyCollection([patches[k] for k in order], facecolors=colors[order], edgecolors=colors[order],
                           linewidths=widths[order])
        )  # fmt: skip
    axes[2].add_collection(PolyCollection(uv[FT], facecolors="0.85", edgecolors="0.6", linewidths=0.1))
    axes[2].add_collection(LineCollection(uv[boundary_edges(FT, len(uv))], colors=[(0.85, 0.05, 0.05)], linewidths=0.8))
    for ax in axes:
        ax.autoscale_view()
        ax.set_aspect("equal")
        ax.set_axis_off()
    path.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(path, dpi=80)


def own_surfaces() -> Iterator[Surface]:
    """Surfaces of the project's making: balls with arms, tubes around circles, a head, a hilly square with holes."""
    for arms in (3, 5, 8):
        yield (f"starfish of {arms}", *surfaces.starfish(arms, 40))
    for radius in (1.3, 4.0):
        yield (f"torus, 1 to {radius:g}", *torus(60, 30, radius))
    yield ("head of a cat", *surfaces.cat(30))
    V, F = surfaces.grid(40, 40)
    middle = V[F].mean(axis=1)
    solid = np.ones(len(F), dtype=bool)
    for x, y in itertools.product((0.25, 0.75), repeat=2):
        solid &= np.hypot(middle[:, 0] - x, middle[:, 1] - y) > 0.1
    used, F = np.unique(F[solid], return_inverse=True)
    V = V[used]
    yield "four holes", np.column_stack([V, 0.2 * np.sin(7 * V[:, 0]) * np.cos(5 * V[:, 1])]), F.reshape(-1, 3)


def torus(around: int, across: int, radius: float) -> tuple[FloatArray, IntArray]:
    """A tube of radius 1 around a circle."""
    i, j = np.divmod(np.arange(around * across), across)
    u, v = 2 * np.pi * i / around, 2 * np.pi * j / across
    V = np.stack([(radius + np.cos(v)) * np.cos(u), (radius + np.cos(v)) * np.sin(u), np.sin(v)], axis=1)
    ahead, beside = (i + 1) % around * across, (j + 1) % across
    a, b, c, d = i * across + j, ahead + j, ahead + beside, i * across + beside
    return V, np.concatenate([np.stack([a, b, c], axis=1), np.stack([a, c, d], axis=1)])


def given_surfaces(paths: list[Path]) -> Iterator[Surface]:
    """The surfaces of OBJ files."""
    for path in paths:
        for file in sorted(path.rglob("*.obj")) if path.is_dir() else [path]:
            mesh = io.read_mesh(file)
            yield file.stem, mesh.V, mesh.F


def large() -> Iterator[str]:
    """Seconds for large surfaces, on all threads that there are."""
    for arms, rings in ((5, 100), (8, 100), (5, 300)):
        V, F = surfaces.starfish(arms, rings)
        began, clock = time.process_time(), time.perf_counter()
        cut = find_cuts(V, F)
        used = time.process_time() - began
        yield (
            f"starfish of {arms}, {len(F):,} triangles: {len(cut):,} edges in {time.perf_counter() - clock:.1f} s, "
            f"{used:.1f} s of the processor"
        )


def main() -> None:
    """Print the table as Markdown; with ``--csv`` write it too."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("paths", nargs="*", type=Path)
    parser.add_argument("--gain", nargs="+", type=float, default=[0.1], metavar="G", help="default: 0.1")
    parser.add_argument("--pictures", type=Path, metavar="FOLDER")
    parser.add_argument("--csv", type=Path, metavar="FILE")
    parser.add_argument("--large", action="store_true")
    options = parser.parse_args()
    print(f"{platform.processor() or platform.machine()}, Python {platform.python_version()}\n")
    cases = given_surfaces(options.paths) if options.paths else own_surfaces()
    rows = compare(cases, options.gain, options.pictures)
    print("| " + " | ".join(rows[0]) + " |\n" + "|---" * len(rows[0]) + "|")
    for row in rows:
        print("| " + " | ".join(_shown(value) for value in row.values()) + " |")
    if options.csv is not None:
        with options.csv.open("w", newline="", encoding="utf-8") as file:
            writer = csv.DictWriter(file, list(rows[0]))
            writer.writeheader()
            writer.writerows(rows)
    for line in large() if options.large else ():
        print(f"\n{line}")


def _shown(value: object) -> str:
    if isinstance(value, bool):
        return "yes" if value else "no"
    return f"{value:.3g}" if isinstance(value, float) else str(value)


if __name__ == "__main__":
    main()
