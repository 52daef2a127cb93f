"""Rate and accuracy of `InverseMap`, from surface to plane and back, on a million points.

    python benchmarks/inverse.py [-n POINTS] [--folder FOLDER …]

For every map, measure the build time, points per second of `locate`, and the distance between points and their round
trip, relative to the size of the surface or of the map. Points are drawn from every triangle with the same probability,
or from the plane. If a map shrinks triangles to 10⁻⁹, doubles resolve points within them to seven digits only. The
error on the surface then is that of the coordinates in the plane.

A folder is a problem (``input.obj`` + ``handles.txt``), which is solved first.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from quasiharmonic import InverseMap, boundary_loops, injective_map, io
from quasiharmonic.results import SurfacePoints
from quasiharmonic.surfaces import cat, grid, random_delaunay
from quasiharmonic.targets import arc_length, letter
from quasiharmonic.util.arrays import FloatArray

Map = tuple[str, FloatArray, NDArray[np.int64], FloatArray]


def maps(folders: list[Path]) -> Iterator[Map]:
    """Yield name, surface, triangles and map."""
    V, F = cat()
    (loop,) = boundary_loops(F, len(V))
    target = arc_length(V[loop], letter("R")[0])
    yield "cat onto R", V, F, injective_map(V, F, loop, target).uv
    yield "the same, polished", V, F, injective_map(V, F, loop, target, polish="symmetric-dirichlet").uv
    V, F = random_delaunay(100_000)
    yield "disk", V, F, V
    yield "areas of 1 : 10¹²", V, F, V * np.hypot(*V.T)[:, None] ** 2.4
    yield "angles of 10⁻⁵", V, F, V * [1.0, 1e-5]
    V, F = grid(1000, 500)
    yield "square", V, F, V
    for folder in folders:
        V, F, fixed, target = io.read_problem(folder)
        yield folder.name, V, F, injective_map(V, F, fixed, target).uv


def seconds(since: float) -> float:
    """Return the CPU seconds since a time; CPU time is comparable on a busy machine."""
    return time.process_time() - since


def main() -> None:
    """Print a table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("-n", "--points", type=int, default=1_000_000)
    parser.add_argument("--folder", nargs="*", type=Path, default=[])
    options = parser.parse_args()
    rng = np.random.default_rng(0)
    print("| map | triangles | area ratio | build s | Mpoints/s by triangle | from the plane | error | in the plane |")
    print("|---|---|---|---|---|---|---|---|")
    for name, V, F, uv in maps(options.folder):
        a, b, c = uv[F].swapaxes(0, 1)
        areas = (b - a)[:, 0] * (c - a)[:, 1] - (b - a)[:, 1] * (c - a)[:, 0]
        began = time.process_time()
        inverse = InverseMap(V, F, uv)
        build = seconds(began)
        start = SurfacePoints(rng.integers(len(F), size=options.points), rng.dirichlet((1, 1, 1), options.points))
        surface, places = inverse.surface(start), inverse.plane(start)
        began = time.process_time()
        at = inverse.locate(places)
        by_triangle = options.points / seconds(began) / 1e6
        # Rounding may move a point of a boundary triangle outside.
        lost = np.count_nonzero(~at.found)
        error = np.nanmax(np.abs(inverse.surface(at) - surface)) / np.ptp(V, axis=0).max()
        low, high = uv.min(axis=0), uv.max(axis=0)
        in_plane = np.nanmax(np.abs(inverse.plane(at) - places)) / (high - low).max()
        anywhere = rng.uniform(low, high, (options.points, 2))
        began = time.process_time()
        inverse.locate(anywhere)
        from_plane = options.points / seconds(began) / 1e6
        print(
            f"| {name} | {len(F)} | {areas.max() / areas.min():.0e} | {build:.2f} | {by_triangle:.2f} "
            f"| {from_plane:.2f} | {error:.0e}{f', {lost} lost' if lost else ''} | {in_plane:.0e} |",
            flush=True,
        )


if __name__ == "__main__":
    main()
