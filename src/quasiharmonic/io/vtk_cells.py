"""Cells as VTK's formats have them: lists of points, one after another, and a kind for each."""

from __future__ import annotations

import numpy as np

from quasiharmonic.arrays import IntArray

#: Kinds without area: vertices and lines, one or several.
_LOWER = (1, 2, 3, 4)
_TRIANGLE, _POLYGON = 5, 7
_NAMES = {
    6: "triangle strip",
    8: "pixel",
    9: "quadrilateral",
    10: "tetrahedron",
    12: "hexahedron",
    13: "wedge",
    14: "pyramid",
    21: "second-order line",
    22: "second-order triangle",
    23: "second-order quadrilateral",
}


def triangles(connectivity: IntArray, starts: IntArray, kinds: IntArray, points: int) -> IntArray:
    """Pick the triangles; (f, 3) int64.

    Parameters
    ----------
    connectivity : (m,) int64
        Points of all cells, one cell after another.
    starts : (c + 1,) int64
        Where each cell begins, and the end.
    kinds : (c,) int64
        VTK's number of each cell's kind. A polygon with three corners is a triangle.
    points : int
        How many there are.

    Raises
    ------
    ValueError
        When a cell with area is no triangle, or cells refer to points that are not there.
    """
    if len(starts) != len(kinds) + 1 or (np.diff(starts) < 0).any() or starts[-1] > len(connectivity):
        raise ValueError("its lists of cells contradict each other")
    sizes = np.diff(starts)
    wanted = np.isin(kinds, (_TRIANGLE, _POLYGON)) & (sizes == 3)
    other = np.unique(kinds[~wanted & ~np.isin(kinds, _LOWER)])
    if other.size:
        names = (_NAMES.get(kind, "polygon" if kind == _POLYGON else f"number {kind}") for kind in other.tolist())
        raise ValueError(f"there are cells of the kind {', '.join(names)}: three-node triangles are needed")
    F = connectivity[starts[:-1][wanted][:, None] + np.arange(3)]
    if F.size and (F.min() < 0 or F.max() >= points):
        wrong = F.min() if F.min() < 0 else F.max()
        raise ValueError(f"a triangle refers to point {wrong}, but there are {points}")
    return F
