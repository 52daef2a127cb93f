"""Validity of triangles, quadrilaterals and second-order triangles around a body with a large motion.

    pip install gmsh
    python benchmarks/moved_elements.py

Gmsh meshes a square around an ellipse, coarsely and finely, as triangles with three and with six nodes and, recombined,
as quadrilaterals. The ellipse is rotated, bent, shifted and scaled; nodes on the walls are fixed or slide. Each line
reports whether the mesh is valid (certified exactly), the quality of its worst element, and CPU seconds.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator

import numpy as np

from quasiharmonic import morph
from quasiharmonic.geometry.mesh.elements import joined, rim
from quasiharmonic.util.arrays import FloatArray, IntArray

#: Gmsh's order, whether it recombines, and its algorithm number.
KINDS = {"triangles": (1, False, 6), "quadrilaterals": (1, True, 8), "six-node triangles": (2, False, 6)}
SIZES = 0.12, 0.05
NODES = {2: 3, 3: 4, 9: 6}


def turned(degrees: float) -> Callable[[FloatArray], FloatArray]:
    """Return a rotation about the origin."""
    angle = np.radians(degrees)
    return lambda points: points @ np.array([(np.cos(angle), np.sin(angle)), (-np.sin(angle), np.cos(angle))])


MOTIONS: dict[str, Callable[[FloatArray], FloatArray]] = {
    "turned by 60°": turned(60),
    "turned by 120°": turned(120),
    "turned by 170°": turned(170),
    "bent": lambda points: points + np.stack([0 * points[:, 0], 2.4 * points[:, 0] ** 2 - 0.2], axis=1),
    "shifted": lambda points: points + np.array([0.4, 0.8]),
    "swollen": lambda points: points * np.array([1.8, 7]),
}


def meshes() -> Iterator[tuple[str, FloatArray, IntArray]]:
    """Yield names, nodes and elements."""
    import gmsh

    gmsh.initialize(interruptible=False)
    gmsh.option.setNumber("General.Terminal", 0)
    for name, (order, recombine, algorithm) in KINDS.items():
        for size in SIZES:
            gmsh.clear()
            square = gmsh.model.occ.addRectangle(-1, -1, 0, 2, 2)
            gmsh.model.occ.cut([(2, square)], [(2, gmsh.model.occ.addDisk(0, 0, 0, 0.5, 0.12))])
            gmsh.model.occ.synchronize()
            gmsh.option.setNumber("Mesh.MeshSizeMax", size)
            gmsh.option.setNumber("Mesh.Algorithm", algorithm)
            if recombine:
                gmsh.model.mesh.setRecombine(2, gmsh.model.getEntities(2)[0][1])
            gmsh.model.mesh.generate(2)
            gmsh.model.mesh.setOrder(order)
            tags, places, _ = gmsh.model.mesh.getNodes()
            row = np.zeros(tags.max() + 1, dtype=np.int64)
            row[tags] = np.arange(len(tags))
            kinds, _, nodes = gmsh.model.mesh.getElements(2)
            blocks = [row[of].reshape(-1, NODES[int(kind)]) for kind, of in zip(kinds, nodes, strict=True)]
            yield name, places.reshape(-1, 3)[:, :2].copy(), joined(blocks)
    gmsh.finalize()


def main() -> None:
    valid = count = 0
    for name, points, F in meshes():
        print(f"{len(F)} {name}")
        boundary = rim(F)
        body = boundary[np.abs(points[boundary]).max(axis=1) < 0.9]
        for what, motion in MOTIONS.items():
            for slide in (False, True):
                began = time.process_time()
                morphed = morph(points, F, body, motion(points[body]), slide=slide)
                seconds = time.process_time() - began
                verdict = "valid" if morphed.valid else f"{morphed.inverted.size} inverted"
                walls = "sliding" if slide else "held"
                print(f"  {what:15} {walls:8} {verdict:10} worst {morphed.quality_after.min():9.2g}  {seconds:6.2f} s")
                valid, count = valid + morphed.valid, count + 1
    print(f"{valid} of {count} valid")


if __name__ == "__main__":
    main()
