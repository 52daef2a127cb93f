"""Problems without a map, each for a different reason."""

from __future__ import annotations

import numpy as np

from quasiharmonic import Problem, boundary_loops
from quasiharmonic.surfaces import annulus, disk, grid
from shared.meshes import boundary_of
from shared.polygons import U, circle, spiral, spread
from shared.small_meshes import eared, handle, loose_wheel, two_wheels, wheel


def moved(mesh, at=None, pins=()):
    """A planar mesh with its boundary and pins fixed, some at other positions: ``at`` lists the first or names them."""
    V, F = mesh
    where = np.array(V[:, :2])
    for vertex, position in at.items() if isinstance(at, dict) else enumerate([] if at is None else at):
        where[vertex] = position
    fixed = np.concatenate([boundary_of(F), np.asarray(pins, dtype=int)])
    return Problem(V, F, fixed, where[fixed], reference="equilateral")


def onto(mesh, *targets):
    """Map the loops of a mesh, in the order of `boundary_loops`, onto polygons with as many corners."""
    V, F = mesh
    where = np.full((len(V), 2), np.nan)
    for loop, target in zip(boundary_loops(F, len(V)), targets, strict=True):
        where[loop] = np.asarray(target, dtype=float)
    fixed = boundary_of(F)
    return Problem(V, F, fixed, where[fixed], reference="equilateral")


RING = annulus(4)  # loops of 24 and 8
CELLS = grid(6, 6)  # vertex i + 7 j at (i / 6, j / 6)
HOUSE = [[4, 0], [4, 6], [2, 7], [0, 6], [0, 0]]  # the rest of the outline above the chord of `two_wheels`
SQUARE = [[0, 0], [8, 0], [8, 8], [0, 8]]
LAP = 2 * np.pi * np.arange(18) / 18
BAND = [(1.5 - 0.5 * y) * np.array([np.cos(8 * x), np.sin(8 * x)]) for x, y in grid(12, 2)[0]]
OUTER, HOLE = 4 * circle(24), circle(8)[::-1]

# name: (problem, (kind, property that it excludes, elements expected in the obstruction))
OBSTRUCTED = {
    "collapsed boundary edge": (
        moved(wheel(5), {1: circle(5)[0]}),
        ("COLLAPSED_EDGE", "INJECTIVE", {"edges": [[0, 1]]}),
    ),
    "collapsed pinned edge": (
        moved(CELLS, {16: [0.4, 0.4], 17: [0.4, 0.4]}, pins=[16, 17]),
        ("COLLAPSED_EDGE", "INJECTIVE", {"edges": [[16, 17]]}),
    ),
    "inverted ear": (
        moved(eared(), {1: [1, 2]}),
        ("INVERTED_TRIANGLE", "INJECTIVE", {"triangles": [0], "split": [[2, 0]]}),
    ),
    "flat ear": (
        moved(eared(), {1: [2, 2]}),
        ("INVERTED_TRIANGLE", "INJECTIVE", {"triangles": [0], "split": [[2, 0]]}),
    ),
    "chord over a notch": (
        moved(two_wheels(), [[0, 0], [1, 3], [2, 4], [3, 3], *HOUSE]),
        ("CHORD", "INJECTIVE", {"edges": [[0, 4]], "split": [[0, 4]]}),
    ),
    "patch inside out": (
        moved(two_wheels(), [[0, 0], [1, 3], [2, 4], [3, 3], *HOUSE]),
        ("INVERTED_PATCH", "INJECTIVE", {"triangles": [0, 1, 2, 3, 4], "split": [[4, 0]]}),
    ),
    "chord touches a corner": (
        moved(two_wheels(), [[0, 0], [1, -1], [2, 0], [3, -1], *HOUSE]),
        ("CHORD", "INJECTIVE", {"split": [[0, 4]]}),
    ),
    "chord along the boundary": (
        moved(two_wheels(), [[0, 0], [1, -1], [2, 0], [3, 0], *HOUSE]),
        ("CHORD", "INJECTIVE", {"split": [[0, 4]]}),
    ),
    "pinned edges cross": (
        moved(CELLS, {15: [0.4, 0.4], 16: [0.6, 0.6], 31: [0.4, 0.6], 32: [0.6, 0.4]}, pins=[15, 16, 31, 32]),
        ("CHORD", "INJECTIVE", {"edges": [[31, 32], [15, 16]], "split": [[31, 32]]}),
    ),
    "pin on a pinned edge": (
        moved(CELLS, {15: [0.25, 0.5], 16: [0.75, 0.5], 32: [0.5, 0.5]}, pins=[15, 16, 32]),
        ("CHORD", "INJECTIVE", {"vertices": [15, 16, 32], "split": [[15, 16]]}),
    ),
    "pin outside": (
        moved(CELLS, {24: [1.5, 0.5]}, pins=[24]),
        ("PIN", "INJECTIVE", {"vertices": [24]}),
    ),
    "pin on the boundary": (
        moved(CELLS, {24: [1.0, 0.3]}, pins=[24]),
        ("PIN", "INJECTIVE", {"vertices": [24]}),
    ),
    "pins together": (
        moved(CELLS, {16: [0.5, 0.4], 32: [0.5, 0.4]}, pins=[16, 32]),
        ("PIN", "INJECTIVE", {"vertices": [16, 32]}),
    ),
    "pin in the hole": (
        moved(annulus(8), {10: [0.1, 0.1]}, pins=[10]),
        ("PIN", "INJECTIVE", {"vertices": [10]}),
    ),
    "no kernel": (
        moved(wheel(8), U),
        ("HALF_PLANES", "INJECTIVE", {"vertices": [8]}),
    ),
    "no kernel, target crossed": (
        moved(wheel(8), [[0, 0], [3, 0], [3, 3], [2, 3], [2, 1], [1, 1], [1, -2], [0, -2]]),
        ("HALF_PLANES", "INJECTIVE", {"vertices": [8]}),
    ),
    "nothing sees all": (
        moved(loose_wheel(8), U),
        ("HIDDEN", "INJECTIVE", {}),
    ),
    "too few edges across": (
        onto(disk(3), spiral(9, 1.5)),
        ("LINK_DISTANCE", "INJECTIVE", {}),
    ),
    "mirrored": (
        onto(disk(3), circle(18)[::-1]),
        ("REVERSED", "INJECTIVE", {"loops": [0]}),
    ),
    "mirrored, with a hole": (
        onto(RING, OUTER[::-1], HOLE[::-1]),
        ("REVERSED", "INJECTIVE", {"loops": [0, 1]}),
    ),
    "figure of eight": (
        onto(disk(3), np.stack([np.sin(LAP + 0.1), np.sin(2 * LAP + 0.2)], axis=1)),
        ("TURNING_NUMBER", "INJECTIVE", {"loops": [0]}),
    ),
    "twisted pocket": (
        onto(disk(3), spread([[0, 0], [8, 0], [8, 8], [5, 8], [3, 10], [5, 10], [3, 8], [0, 8]], 18)),
        ("NEGATIVE_WINDING", "INJECTIVE", {"loops": [0]}),
    ),
    "on a line": (
        onto(disk(3), np.stack([np.cos(np.arange(18)), np.zeros(18)], axis=1)),
        ("SIGNED_AREA", "INJECTIVE", {"loops": [0]}),
    ),
    "whisker": (
        onto(disk(3), spread([[0, 0], [8, 0], [8, 8], [4, 8], [4, 10], [4, 8], [0, 8]], 18)),
        ("TURNING_NUMBER", "INJECTIVE", {"loops": [0]}),
    ),
    "slit": (
        onto(disk(3), spread([[0, 0], [8, 0], [8, 8], [4, 8], [4, 3], [4, 8], [0, 8]], 18)),
        ("FOLD", "BIJECTIVE", {}),
    ),
    "handle": (
        onto(handle(), circle(4)),
        ("GENUS", "INJECTIVE", {}),
    ),
    "hole outside": (
        onto(RING, OUTER, HOLE + np.array([9, 0])),
        ("NESTING", "INJECTIVE", {"loops": [1]}),
    ),
    "two outer loops": (
        onto(RING, OUTER, HOLE[::-1] + np.array([9, 0])),
        ("NESTING", "INJECTIVE", {"loops": [0, 1]}),
    ),
    "hole wound as an island": (
        onto(RING, OUTER, HOLE[::-1]),
        ("NESTING", "UNBRANCHED", {"loops": [1]}),
    ),
    "hole across the outer loop": (
        onto(RING, OUTER, HOLE + np.array([4, 0.1])),
        ("NEGATIVE_WINDING", "INJECTIVE", {"loops": [0, 1]}),
    ),
    "loops cross": (
        onto(RING, OUTER, HOLE + np.array([4, 0.1])),
        ("CROSSING", "BIJECTIVE", {"loops": [0, 1]}),
    ),
    "loops touch": (
        onto(RING, spread(SQUARE, 24), HOLE + np.array([1, 4])),
        ("CROSSING", "BIJECTIVE", {"loops": [0, 1]}),
    ),
    "wound twice": (
        onto(disk(3), circle(18, turns=2) * (2 + np.cos(LAP + 0.1))[:, None]),
        ("TURNING_NUMBER", "UNBRANCHED", {"loops": [0]}),
    ),
    "band over itself": (
        moved(grid(12, 2), BAND),
        ("CROSSING", "BIJECTIVE", {"loops": [0]}),
    ),
}
