"""What a file in another program's format has of a planar mesh."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass

import numpy as np

from quasiharmonic.util.arrays import FloatArray, IntArray


@dataclass(frozen=True, eq=False)
class MeshParts:
    """Positions and elements of a file, and a way to change the positions alone.

    Attributes
    ----------
    points : (n, 3) float64
        As a reader gets them.
    F : (f, 3), (f, 4) or (f, 6) int64
        As `quasiharmonic.geometry.mesh.elements` has them.
    precision : dtype
        Of the positions in the file.
    fields : mapping of str to callable
        Each reads values at all points, (n, k) float64, NaN where there are none; `ValueError` where it cannot.
    replaced : callable
        The file with the first two coordinates of its points, (n, 2) float64, changed and all else as it was.
    """

    points: FloatArray
    F: IntArray
    precision: np.dtype[np.floating]
    fields: Mapping[str, Callable[[], FloatArray]]
    replaced: Callable[[FloatArray], bytes]
