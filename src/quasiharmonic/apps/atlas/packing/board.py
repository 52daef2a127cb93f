"""Boards: rectangles of cells with the bitmaps that are placed there, and the best free position of another bitmap."""

from __future__ import annotations

from math import ceil
from typing import Any, NamedTuple

import numpy as np
import scipy.fft
from numpy.typing import NDArray

from quasiharmonic.apps.atlas.packing.rows import fill_rows
from quasiharmonic.util.arrays import BoolArray, ComplexArray, IntArray

# Side, first row and first column.
Window = tuple[int, int, int]

# Largest side of the board of larger cells on which large bitmaps are placed.
_COARSE = 256
# Sides of windows. Windows overlap by half, so that a bitmap of almost half the side is in one window, wherever it is.
_WINDOWS = 64, 128
# A window without a free position is searched again for bitmaps with less than this share of the cells.
_SMALLER = 0.8


class Bitmaps:
    """Bitmaps of a shape in several directions.

    Attributes
    ----------
    directions : (k,) complex128
        Unit vectors that become the x-axis.
    cells : list of (h, w) bool
    side, count : int
        Longest side, and smallest number of cells of a bitmap.
    """

    def __init__(self, directions: ComplexArray, cells: list[BoolArray]) -> None:
        self.directions, self.cells = directions, cells
        self.side = max(max(bitmap.shape) for bitmap in cells)
        self.count = min(int(bitmap.sum()) for bitmap in cells)
        self._spectra: dict[int, NDArray[Any]] = {}

    def spectra(self, size: int) -> NDArray[Any]:
        """Conjugate spectra on squares of a size; (k, size, size // 2 + 1). Bitmaps that do not fit are empty."""
        if size not in self._spectra:
            padded = np.zeros((len(self.cells), size, size), dtype=np.float32)
            for square, bitmap in zip(padded, self.cells, strict=True):
                h, w = bitmap.shape
                if max(h, w) <= size:
                    square[:h, :w] = bitmap
            spectra = scipy.fft.rfft2(padded)
            self._spectra = {size: np.conj(spectra, out=spectra)}
        return self._spectra[size]


class Spot(NamedTuple):
    """Position of a bitmap: number of its direction, and row and column of its lowest left cell."""

    direction: int
    row: int
    column: int


class Board:
    """A rectangle of cells, on which bitmaps do not overlap.

    A bitmap is placed where it has the most contact: the number of its cells that would be in occupied cells or outside
    the board if it was shifted by one cell, in all four directions together, relative to the number of its cells.
    Correlations by FFT count the cells at all positions at once.
    """

    def __init__(self, rows: int, columns: int, frame: int | None) -> None:
        self.rows, self.columns = rows, columns
        # Without a frame, the board is searched window by window.
        self._sizes = _WINDOWS if frame is None else (frame,)
        # Cells outside the board count as occupied.
        largest = self._sizes[-1]
        self._cells = np.ones((rows + 1 + largest, columns + 1 + largest), dtype=np.float32)
        self._cells[1 : rows + 1, 1 : columns + 1] = 0
        self._spectra: dict[Window, NDArray[Any]] = {}
        self._failed: dict[Window, int] = {}

    def put(self, bitmap: BoolArray, row: int, column: int) -> None:
        """Occupy the cells of a bitmap."""
        h, w = bitmap.shape
        self._cells[row + 1 : row + 1 + h, column + 1 : column + 1 + w] += bitmap
        for window in list(self._spectra):
            size, first, left = window
            apart = first > row + h or left > column + w
            if not (apart or first + size <= row or left + size <= column):
                del self._spectra[window]

    def fill_rows(self, boxes: IntArray) -> IntArray:
        """Place boxes into free cells; see `fill_rows`."""
        inner = self._cells[1 : self.rows + 1, 1 : self.columns + 1]
        occupied = inner > 0
        found = fill_rows(occupied, boxes)
        inner[occupied] = 1
        self._spectra.clear()
        return found

    def find(self, bitmaps: Bitmaps) -> Spot | None:
        """Find a free position for one of several bitmaps of a shape."""
        size = next((size for size in self._sizes if bitmaps.side <= size // 2 - 2), self._sizes[-1])
        step = size // 2
        if len(self._sizes) == 1:
            step = size
        elif bitmaps.side > step - 2:
            return self._find_coarsely(bitmaps)
        for first in range(0, max(self.rows + 2 - step, 1), step):
            for left in range(0, max(self.columns + 2 - step, 1), step):
                window = size, first, left
                if bitmaps.count >= self._failed.get(window, np.inf):
                    continue
                if window not in self._spectra:
                    cells = self._cells[first : first + size, left : left + size]
                    self._spectra[window] = scipy.fft.rfft2(cells)
                found = _find_most_contact(self._spectra[window], bitmaps, size)
                if found is not None:
                    k, i, j = found
                    return Spot(k, first + i - 1, left + j - 1)
                self._failed[window] = int(_SMALLER * bitmaps.count)
        return None

    def _find_coarsely(self, bitmaps: Bitmaps) -> Spot | None:
        """Find a position on a board of larger cells, each of several cells."""
        step = ceil((max(self.rows, self.columns) + 2) / _COARSE) + 1
        h, w = (ceil(n / step) for n in self._cells.shape)
        padded = np.ones((h * step, w * step), dtype=np.float32)
        padded[: self._cells.shape[0] - 1, : self._cells.shape[1] - 1] = self._cells[1:, 1:]
        coarse = Board(self.rows // step, self.columns // step, frame_of(max(self.rows, self.columns) // step))
        pooled = padded.reshape(h, step, w, step).max(axis=(1, 3))
        coarse._cells[1 : 1 + coarse.rows, 1 : 1 + coarse.columns] = pooled[: coarse.rows, : coarse.columns]
        found = coarse.find(Bitmaps(bitmaps.directions, [_enlarge_cells(bitmap, step) for bitmap in bitmaps.cells]))
        return None if found is None else Spot(found.direction, found.row * step, found.column * step)


def frame_of(side: int) -> int:
    """Side of a square in which a board with a frame of one cell is transformed quickly."""
    return int(scipy.fft.next_fast_len(side + 2, real=True))


def _enlarge_cells(bitmap: BoolArray, step: int) -> BoolArray:
    """Bitmap of larger cells that contain a cell of a bitmap."""
    h, w = (ceil(n / step) for n in bitmap.shape)
    padded = np.zeros((h * step, w * step), dtype=bool)
    padded[: bitmap.shape[0], : bitmap.shape[1]] = bitmap
    return np.asarray(padded.reshape(h, step, w, step).any(axis=(1, 3)))


def _find_most_contact(occupied: NDArray[Any], bitmaps: Bitmaps, size: int) -> Spot | None:
    """Position in a square of cells with the most contact; None if no position is free."""
    overlap = scipy.fft.irfft2(bitmaps.spectra(size) * occupied, s=(size, size))
    best, found = -1.0, None
    for k, bitmap in enumerate(bitmaps.cells):
        h, w = bitmap.shape
        if max(h, w) > size - 2:
            continue
        inner = overlap[k, 1 : size - h, 1 : size - w]
        i, j = np.nonzero(inner < 0.5)
        if i.size == 0:
            continue
        i, j = i + 1, j + 1
        seen = overlap[k]
        contact = np.rint(seen[i + 1, j]) + np.rint(seen[i - 1, j]) + np.rint(seen[i, j + 1]) + np.rint(seen[i, j - 1])
        most = int(contact.argmax())
        share = float(contact[most]) / (h + w)
        if share > best:
            best, found = share, Spot(k, int(i[most]), int(j[most]))
    return found
