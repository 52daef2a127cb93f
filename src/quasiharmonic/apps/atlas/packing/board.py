"""Boards: rectangles of cells with the bitmaps that are placed there, and the best free position of another bitmap."""

from __future__ import annotations

from math import ceil
from typing import NamedTuple

import numpy as np

from quasiharmonic.apps.atlas.packing.contact import Spot, find_most_contact, list_runs
from quasiharmonic.apps.atlas.packing.rows import fill_rows
from quasiharmonic.util.arrays import BoolArray, ComplexArray, IntArray

# Side, first row and first column.
Window = tuple[int, int, int]


class BoardTuning(NamedTuple):
    """Sizes of the boards and windows of the search."""

    # Largest side of the board of larger cells on which large bitmaps are placed.
    coarse: int = 256
    # Sides of windows. Windows overlap by half, so that a bitmap of almost half the side is in one window, wherever it
    # is.
    windows: tuple[int, ...] = (64, 128)
    # A window without a free position is searched again for bitmaps with less than this share of the cells.
    smaller: float = 0.8


_TUNING = BoardTuning()


class Bitmaps:
    """Bitmaps of a shape in several directions. Of equal bitmaps, only the first is kept.

    Attributes
    ----------
    directions : (k,) complex128
        Unit vectors that become the x-axis.
    cells : list of (h, w) bool
    runs : Runs
        The same bitmaps.
    side, count : int
        Longest side, and smallest number of cells of a bitmap.
    """

    def __init__(self, directions: ComplexArray, cells: list[BoolArray]) -> None:
        first = {(bitmap.shape, bitmap.tobytes()): k for k, bitmap in reversed(list(enumerate(cells)))}
        kept = sorted(first.values())
        self.directions, self.cells = directions[kept], [cells[k] for k in kept]
        self.runs = list_runs(self.cells)
        self.side = max(max(bitmap.shape) for bitmap in cells)
        self.count = min(int(bitmap.sum()) for bitmap in cells)

    def half(self, which: int) -> Bitmaps:
        """Return every second bitmap, from the first or second one; all if there is only one."""
        some = slice(which, None, 2) if len(self.cells) > 1 else slice(None)
        return Bitmaps(self.directions[some], self.cells[some])


class Board:
    """A rectangle of cells, on which bitmaps do not overlap.

    A bitmap is placed where it has the most contact; see `find_most_contact`. A board is searched as a whole, or window
    by window.
    """

    def __init__(self, rows: int, columns: int, *, windows: bool) -> None:
        self.rows, self.columns = rows, columns
        self._sizes = _TUNING.windows if windows else ()
        # Cells outside the board count as occupied.
        outside = _TUNING.windows[-1] if windows else 1
        self._cells = np.ones((rows + 1 + outside, columns + 1 + outside), dtype=bool)
        self._cells[1 : rows + 1, 1 : columns + 1] = False
        self._failed: dict[Window, int] = {}

    def put(self, bitmap: BoolArray, row: int, column: int) -> None:
        """Occupy the cells of a bitmap."""
        h, w = bitmap.shape
        self._cells[row + 1 : row + 1 + h, column + 1 : column + 1 + w] |= bitmap

    def fill_rows(self, boxes: IntArray) -> IntArray:
        """Place boxes into free cells; see `fill_rows`."""
        return fill_rows(self._cells[1 : self.rows + 1, 1 : self.columns + 1], boxes)

    def find(self, bitmaps: Bitmaps) -> Spot | None:
        """Find a free position for one of several bitmaps of a shape."""
        if not self._sizes:
            found = find_most_contact(self._cells, bitmaps.runs)
            return None if found is None else Spot(found.direction, found.row - 1, found.column - 1)
        size = next((size for size in self._sizes if bitmaps.side <= size // 2 - 2), self._sizes[-1])
        step = size // 2
        if bitmaps.side > step - 2:
            return self._find_coarsely(bitmaps)
        for first in range(0, max(self.rows + 2 - step, 1), step):
            for left in range(0, max(self.columns + 2 - step, 1), step):
                window = size, first, left
                if bitmaps.count >= self._failed.get(window, np.inf):
                    continue
                found = find_most_contact(self._cells[first : first + size, left : left + size], bitmaps.runs)
                if found is not None:
                    return Spot(found.direction, first + found.row - 1, left + found.column - 1)
                self._failed[window] = int(_TUNING.smaller * bitmaps.count)
        return None

    def _find_coarsely(self, bitmaps: Bitmaps) -> Spot | None:
        """Find a position on a board of larger cells, each of several cells."""
        step = ceil((max(self.rows, self.columns) + 2) / _TUNING.coarse) + 1
        h, w = (ceil(n / step) for n in self._cells.shape)
        padded = np.ones((h * step, w * step), dtype=bool)
        padded[: self._cells.shape[0] - 1, : self._cells.shape[1] - 1] = self._cells[1:, 1:]
        coarse = Board(self.rows // step, self.columns // step, windows=False)
        # Rows first: this is several times as fast as both axes at once.
        pooled = np.asarray(padded.reshape(h, step, w * step).any(axis=1).reshape(h, w, step).any(axis=2))
        coarse._cells[1 : 1 + coarse.rows, 1 : 1 + coarse.columns] = pooled[: coarse.rows, : coarse.columns]
        found = coarse.find(Bitmaps(bitmaps.directions, [_enlarge_cells(bitmap, step) for bitmap in bitmaps.cells]))
        return None if found is None else Spot(found.direction, found.row * step, found.column * step)


def _enlarge_cells(bitmap: BoolArray, step: int) -> BoolArray:
    """Bitmap of larger cells that contain a cell of a bitmap."""
    h, w = (ceil(n / step) for n in bitmap.shape)
    padded = np.zeros((h * step, w * step), dtype=bool)
    padded[: bitmap.shape[0], : bitmap.shape[1]] = bitmap
    return np.asarray(padded.reshape(h, step, w, step).any(axis=(1, 3)))
