"""The common result of the finite-element readers."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass

import numpy as np

from quasiharmonic.util.arrays import FloatArray, IntArray


@dataclass(frozen=True, eq=False)
class MeshParts:
    """Positions and elements of a file, and a function that changes only the positions.

    Attributes
    ----------
    points : (n, 3) float64
        Positions, converted to double.
    F : (f, 3), (f, 4) or (f, 6) int64
        Elements in the format of `quasiharmonic.geometry.mesh.elements`.
    precision : dtype
        Precision of the positions in the file.
    fields : mapping of str to callable
        Each callable returns values at all points, (n, k) float64, NaN at points without value. It raises `ValueError`
        if the data are damaged.
    replaced : callable
        Returns the bytes of the file with the first two coordinates of its points replaced by (n, 2) float64.
    """

    points: FloatArray
    F: IntArray
    precision: np.dtype[np.floating]
    fields: Mapping[str, Callable[[], FloatArray]]
    replaced: Callable[[FloatArray], bytes]
