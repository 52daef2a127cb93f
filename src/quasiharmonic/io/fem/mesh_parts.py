"""What every reader of finite-element files returns: `MeshParts`; with its elements and named sets, from VTK's cells.

In VTK's format, cells are one list of the points of all cells, one cell after another, and VTK's kind of each cell.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass

import numpy as np

from quasiharmonic.geometry.mesh.elements import join_elements, join_solids
from quasiharmonic.util.arrays import FloatArray, IntArray

#: Arrays of points or cells by name; each callable returns (n, k) values.
Fields = Mapping[str, Callable[[], FloatArray]]
#: Kinds without area: vertices, lines, lists of them, and second-order lines.
_POINTS_AND_LINES = (1, 2, 3, 4, 21)
# Number of nodes of the kinds that are elements. Polygons of three or four corners are elements too.
_ELEMENTS = {5: 3, 9: 4, 22: 6}
_POLYGON = 7
# The same for meshes in space, and the kinds with area that these meshes may have on their boundary.
_SOLIDS = {10: 4, 12: 8}
_SURFACES = (5, 6, 7, 8, 9, 22, 23, 28)
#: What can be used instead of other cells, in the plane and in space.
SUPPORTED = "triangles of three or six nodes or quadrilaterals", "tetrahedra of four nodes or hexahedra of eight"
# Maximum number of different values of an array that defines sets.
_MAX_SETS = 1000
_NAMES = {
    6: "triangle strip",
    8: "pixel",
    10: "tetrahedron",
    11: "voxel",
    12: "hexahedron",
    13: "wedge",
    14: "pyramid",
    23: "second-order quadrilateral",
    24: "second-order tetrahedron",
    25: "second-order hexahedron",
}


@dataclass(frozen=True, eq=False)
class MeshParts:
    """Positions and elements of a file, and a function that changes only the positions."""

    points: FloatArray  # (n, 3): positions, converted to double
    # (f, 3), (f, 4) or (f, 6): elements in the format of `geometry.mesh.elements`. Of a mesh in space (t, 4) or (t, 8):
    # tetrahedra and hexahedra; a tetrahedron among hexahedra repeats its last node.
    F: IntArray
    precision: np.dtype[np.floating]  # Precision of the positions in the file
    # Each callable returns values at all points, (n, k) float64, NaN at points without value. It raises `ValueError`
    # if the data are damaged.
    fields: Fields
    # Returns the bytes of the file with the first coordinates of its points replaced, by (n, 2) or (n, 3) float64
    replace_points: Callable[[FloatArray], bytes]
    # Returns the nodes of each named set of the file, ascending, by what the set belongs to and its name, as in
    # "curve:walls". It raises `ValueError` if the sets are damaged.
    find_sets: Callable[[], dict[str, IntArray]]


def find_counts(numbers: IntArray) -> IntArray | None:
    """Return the indices of the counts in a list (count, points, count, …); None for other numbers."""
    step = int(numbers[0]) + 1 if len(numbers) else 0
    if step > 0 and len(numbers) % step == 0 and (numbers[::step] == step - 1).all():
        return np.arange(0, len(numbers), step)
    found, at, values = [], 0, numbers.tolist()
    while at < len(values):
        if values[at] < 0:
            return None
        found.append(at)
        at += 1 + values[at]
    return np.array(found, dtype=np.int64) if at == len(values) else None


def find_sets_in_fields(points: Fields, cells: Fields, connectivity: IntArray, starts: IntArray) -> dict[str, IntArray]:
    """Return the sets of points that arrays of integers at points or cells define.

    ``NAME`` has the points, or the points of the cells, where the array NAME is not zero, ``NAME=VALUE`` those where it
    has this value. Arrays of more than `_MAX_SETS` values define none.
    """
    sets: dict[str, IntArray] = {}
    for fields, of in ((points, "point"), (cells, "cell")):
        for name, find in fields.items():
            values = find()
            if values.shape[1] != 1 or not len(values) or (values != np.rint(values)).any():
                continue
            values = values[:, 0]
            nodes = np.arange(len(values))
            if of == "cell":
                nodes, values = connectivity[: starts[-1]], np.repeat(values, np.diff(starts))
            found = np.unique(values)
            if len(found) <= _MAX_SETS:
                sets[f"{of}:{name}"] = np.unique(nodes[values != 0])
                sets |= {f"{of}:{name}={value:.0f}": np.unique(nodes[values == value]) for value in found}
    return sets


def select_elements(
    connectivity: IntArray, starts: IntArray, kinds: IntArray, points: int, solid: bool = False
) -> IntArray:
    """Return the triangles and quadrilaterals; (f, 3), (f, 4) or (f, 6) int64, as in `geometry.mesh.elements`.

    ``connectivity`` (m,) has the points of all cells, one cell after another. Cell i begins at ``starts[i]``, and
    ``kinds[i]`` is VTK's kind of it. A polygon with three corners is a triangle, one with four a quadrilateral.
    ValueError for a cell with area of another kind, six-node triangles with other elements, or a point out of range. If
    ``solid``, return the tetrahedra and hexahedra instead (`MeshParts.F`), and skip cells without volume.
    """
    if len(starts) != len(kinds) + 1 or (np.diff(starts) < 0).any() or starts[-1] > len(connectivity):
        raise ValueError("its lists of cells contradict each other")
    sizes = np.diff(starts)
    wanted = (kinds == _POLYGON) & np.isin(sizes, (3, 4)) & (not solid)
    for kind, size in (_SOLIDS if solid else _ELEMENTS).items():
        wanted |= (kinds == kind) & (sizes == size)
    skipped = (*_POINTS_AND_LINES, *(_SURFACES if solid else ()))
    other = np.unique(kinds[~wanted & ~np.isin(kinds, skipped)])
    if other.size:
        names = (_NAMES.get(kind, "polygon" if kind == _POLYGON else f"number {kind}") for kind in other.tolist())
        raise ValueError(f"cells of type {', '.join(names)} are not supported: use {SUPPORTED[solid]}")
    begins, sizes = starts[:-1][wanted], sizes[wanted]
    changes = np.flatnonzero(np.diff(sizes)) + 1
    F = (join_solids if solid else join_elements)(
        [
            connectivity[block[:, None] + np.arange(size[0])]
            for block, size in zip(np.split(begins, changes), np.split(sizes, changes), strict=True)
            if len(block)
        ]
    )
    if F.size and (F.min() < 0 or F.max() >= points):
        wrong = F.min() if F.min() < 0 else F.max()
        raise ValueError(f"an element refers to point {wrong}, but there are {points}")
    return F
