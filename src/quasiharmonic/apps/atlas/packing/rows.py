"""Boxes in rows, for charts that are too many or too small for bitmaps."""

from __future__ import annotations

import numpy as np

from quasiharmonic.util.arrays import BoolArray, IntArray


def fill_rows(occupied: BoolArray, boxes: IntArray) -> IntArray:
    """Place boxes into the free cells of a rectangle, in rows from the lowest up.

    Parameters
    ----------
    occupied : (rows, columns) bool
        The cells of the boxes are marked.
    boxes : (k, 2) int
        Height and width of each box in cells.

    Returns
    -------
    (k, 2) int64
        Row and column of the lowest left cell of each box; -1 for boxes that do not fit.
    """
    found = np.full((len(boxes), 2), -1)
    order = np.lexsort((-boxes[:, 1], -boxes[:, 0]))
    heights, widths = boxes[order, 0].tolist(), boxes[order, 1].tolist()
    row, k = 0, 0
    while k < len(order):
        height, begun = heights[k], k
        if row + height > len(occupied):
            break
        change = np.diff(occupied[row : row + height].any(axis=0), prepend=True, append=True)
        for first, end in np.flatnonzero(change).reshape(-1, 2).tolist():
            while k < len(order) and first + widths[k] <= end:
                found[order[k]] = row, first
                occupied[row : row + heights[k], first : first + widths[k]] = True
                first += widths[k]
                k += 1
        row += height if k > begun else 1
    return found
