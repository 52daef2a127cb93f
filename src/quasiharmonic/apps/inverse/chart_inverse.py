"""The inverse of texture coordinates with seams."""

from __future__ import annotations

import numpy as np

from quasiharmonic.apps.inverse.inverse_map import InverseMap
from quasiharmonic.geometry.exact.predicates import orientation
from quasiharmonic.util.arrays import FloatArray, IntArray, list_others


class ChartInverse(InverseMap):
    """The inverse of texture coordinates with seams, as `quasiharmonic.UnwrapResult.inverse` makes it.

    All methods are those of `InverseMap`. Points and values belong to the vertices and triangles of the model. Normals
    are on the side on which the triangles of the model are counterclockwise.

    Parameters
    ----------
    V : (n, 2) or (n, 3) float64
    F : (f, 3) int64
        The model.
    uv : (m, 2) float64
        Texture coordinates.
    FT : (f, 3) int64
        Row of ``uv`` of each corner. Triangles may be reversed in the plane.
    leave_out : (k,) int64
        Triangles without an inverse.

    Attributes
    ----------
    V, F, uv, FT : arrays
        As given.
    certificate : Certificate
        The exact certificate of the triangles that are not left out, turned to be counterclockwise.
    """

    def __init__(self, V: FloatArray, F: IntArray, uv: FloatArray, FT: IntArray, *, leave_out: IntArray) -> None:
        self._triangles = list_others(len(F), leave_out)
        rows = FT[self._triangles]
        self._turned = orientation(*uv[rows].swapaxes(0, 1)) < 0
        rows[self._turned] = rows[self._turned][:, (0, 2, 1)]
        # A position of the model for each row.
        vertex = np.zeros(len(uv), dtype=np.int64)
        vertex[FT] = F
        super().__init__(V[vertex], rows, uv, overlapping=True)
        self.V, self.F, self.FT = V.copy(), F, FT
        self._seal()
        self._located, self._rows = rows, FT

    def _number(self, triangle: IntArray, barycentric: FloatArray) -> tuple[IntArray, FloatArray]:
        turned = self._turned[triangle]
        return self._triangles[triangle], np.where(turned[:, None], barycentric[:, (0, 2, 1)], barycentric)
