"""Blender's own unwraps and ours, on surfaces that are disks: inverted and overlapping faces, stretch, seconds.

    python benchmarks/blender_unwraps.py [FILE.obj | FOLDER …]

Needs Blender as a module (``pip install bpy`` with Python 3.11) and this package beside it. Every OBJ file below the
folders; without any, surfaces that the project makes. Blender unwraps in its three ways, with nothing pinned and with
the two vertices of the border that are farthest apart pinned as far apart as they are in space, the surface's area
taken for 1; ours is `flatten`, the same two held or none. Flipped triangles and overlap are judged exactly, on what
Blender holds, in single precision; ours after the same rounding. Stretch is the mean symmetric Dirichlet energy at the
surface's area, 4 for an isometry, "∞" where a triangle is inverted. Seconds are of the wall.
"""

from __future__ import annotations

import argparse
import platform
import sys
import time
from collections.abc import Iterator
from pathlib import Path

import bpy
import numpy as np

from quasiharmonic import boundary_loops, certify, flatten, io, surfaces
from quasiharmonic.util.arrays import FloatArray, IntArray

Surface = tuple[str, FloatArray, IntArray]

# Blender's names, and how often its minimum stretch iterates: as many times as leaves little to gain.
WAYS = {"ANGLE_BASED": {}, "CONFORMAL": {}, "MINIMUM_STRETCH": {"iterations": 100}}


def unwrapped(V: FloatArray, F: IntArray, method: str, pins: dict[int, tuple[float, float]]) -> FloatArray:
    """Blender's unwrap; places of the vertices (n, 2)."""
    data = bpy.data.meshes.new("surface")
    data.from_pydata(V.tolist(), [], F.tolist())
    thing = bpy.data.objects.new("surface", data)
    bpy.context.collection.objects.link(thing)
    bpy.context.view_layer.objects.active = thing
    data.uv_layers.new()
    corner = F.ravel()
    if pins:
        uv = np.zeros((len(corner), 2), dtype=np.float32)
        for vertex, place in pins.items():
            uv[corner == vertex] = place
        data.attributes[data.uv_layers[0].name].data.foreach_set("vector", uv.ravel())
        data.uv_layers[0].pin_ensure()
        data.uv_layers[0].pin.foreach_set("value", np.isin(corner, list(pins)))
    bpy.ops.object.mode_set(mode="EDIT")
    bpy.ops.mesh.select_all(action="SELECT")
    bpy.ops.uv.unwrap(method=method, **WAYS[method])
    bpy.ops.object.mode_set(mode="OBJECT")
    places = np.empty(2 * len(corner), dtype=np.float32)
    data.uv_layers[0].uv.foreach_get("vector", places)
    uv = np.zeros((len(V), 2))
    uv[corner] = places.reshape(-1, 2)
    bpy.data.objects.remove(thing)
    bpy.data.meshes.remove(data)
    return uv


def stretch(V: FloatArray, F: IntArray, uv: FloatArray) -> float:
    """Mean symmetric Dirichlet energy at the surface's area."""
    along, across = V[F[:, 1]] - V[F[:, 0]], V[F[:, 2]] - V[F[:, 0]]
    length = np.linalg.norm(along, axis=1)
    area = np.linalg.norm(np.cross(along, across), axis=1) / 2
    rest = np.stack([length, 0 * length, (along * across).sum(axis=1) / length, 2 * area / length], 1).reshape(-1, 2, 2)
    images = np.stack([uv[F[:, 1]] - uv[F[:, 0]], uv[F[:, 2]] - uv[F[:, 0]]], axis=1)
    images *= np.sqrt(2 * area.sum() / np.linalg.det(images).sum())
    jacobian = np.linalg.solve(rest, images)
    density = (jacobian**2).sum(axis=(1, 2)) + (np.linalg.inv(jacobian) ** 2).sum(axis=(1, 2))
    return float((area * density).sum() / area.sum())


def row(name: str, way: str, V: FloatArray, F: IntArray, uv: FloatArray, seconds: float) -> str:
    """A line of the table."""
    verdict = certify(F, uv.astype(np.float32).astype(np.float64))
    wrong = len(verdict.inverted) + len(verdict.degenerate)
    told = "∞" if wrong else f"{stretch(V, F, uv):.3f}"
    overlap = "no" if verdict.bijective else "yes"
    return f"| {name} | {len(F):,} | {way} | {wrong} | {overlap} | {told} | {seconds:.2f} |"


def compare(name: str, V: FloatArray, F: IntArray) -> Iterator[str]:
    """The lines of a surface."""
    border = np.concatenate(boundary_loops(F, len(V)))
    apart = np.linalg.norm(V[border][:, None] - V[border], axis=2)
    ends = border[list(np.unravel_index(np.argmax(apart), apart.shape))]
    length = float(apart.max())
    normal = np.cross(V[F[:, 1]] - V[F[:, 0]], V[F[:, 2]] - V[F[:, 0]])
    side = float(np.sqrt(np.linalg.norm(normal, axis=1).sum() / 2))
    for pinned in (False, True):
        said = ", two pins" if pinned else ""
        pins = {int(ends[0]): (0.0, 0.0), int(ends[1]): (length / side, 0.0)} if pinned else {}
        for method in WAYS:
            began = time.perf_counter()
            uv = unwrapped(V, F, method, pins)
            yield row(name, f"Blender, {method.lower().replace('_', ' ')}{said}", V, F, uv, time.perf_counter() - began)
        began = time.perf_counter()
        held = {"fixed": ends, "target": np.array([[0.0, 0.0], [length, 0.0]])} if pinned else {}
        uv = flatten(V, F, **held).uv
        yield row(name, f"ours{said}", V, F, uv, time.perf_counter() - began)


def cases(paths: list[Path]) -> Iterator[Surface]:
    """The surfaces of the files, or the project's own."""
    for path in paths:
        for file in sorted(path.rglob("*.obj")) if path.is_dir() else [path]:
            mesh = io.read_mesh(file)
            yield file.stem, mesh.V, mesh.F
    if not paths:
        yield ("head of a cat", *surfaces.cat(30))


def main() -> None:
    """Print the table as Markdown."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("paths", nargs="*", type=Path)
    options = parser.parse_args()
    # Without the cube, which would be unwrapped too.
    bpy.ops.wm.read_factory_settings(use_empty=True)
    print(f"{platform.machine()}, Blender {bpy.app.version_string}, Python {platform.python_version()}\n")
    print("| surface | triangles | way | inverted | overlap | stretch | seconds |\n|---|---|---|---|---|---|---|")
    for name, V, F in cases(options.paths):
        print(name, file=sys.stderr, flush=True)
        for line in compare(name, V, F):
            print(line, flush=True)


if __name__ == "__main__":
    main()
