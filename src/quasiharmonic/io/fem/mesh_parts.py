"""What every reader of finite-element files returns: `MeshParts`."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass

import numpy as np

from quasiharmonic.util.arrays import FloatArray, IntArray

#: Arrays of points or cells by name; each callable returns (n, k) values.
Fields = Mapping[str, Callable[[], FloatArray]]


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
    # Returns the nodes of each named set of the file, ascending. It raises `ValueError` if the sets are damaged.
    find_sets: Callable[[], dict[str, IntArray]]
