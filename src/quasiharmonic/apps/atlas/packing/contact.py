"""The free place on a board where one of several bitmaps has the most contact with occupied cells."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from quasiharmonic.util.arrays import BoolArray, IntArray
from quasiharmonic.util.kernels import compiled


class Spot(NamedTuple):
    """Position of a bitmap: number of its direction, and row and column of its lowest left cell."""

    direction: int
    row: int
    column: int


class Runs(NamedTuple):
    """Bitmaps as runs of cells in rows.

    Attributes
    ----------
    runs : (r, 3) int64
        Row, first column and end of each run; longest runs first for each bitmap.
    starts : (k + 1,) int64
        Where the runs of each bitmap start, and where the last ones end.
    sizes : (k, 2) int64
        Height and width of each bitmap.
    """

    runs: IntArray
    starts: IntArray
    sizes: IntArray


def list_runs(bitmaps: list[BoolArray]) -> Runs:
    """Return bitmaps (h, w), at least one, as runs."""
    runs = []
    for bitmap in bitmaps:
        change = np.diff(bitmap.astype(np.int8), axis=1, prepend=0, append=0)
        row, first = np.nonzero(change > 0)
        found = np.stack([row, first, np.nonzero(change < 0)[1]], axis=1)
        runs.append(found[np.argsort(found[:, 1] - found[:, 2], kind="stable")])
    starts = np.cumsum([0, *(len(each) for each in runs)])
    return Runs(np.concatenate(runs), starts, np.array([bitmap.shape for bitmap in bitmaps], dtype=np.int64))


def find_most_contact(occupied: BoolArray, bitmaps: Runs) -> Spot | None:
    """Place of the most contact in a rectangle of cells (rows, columns); None if no place is free.

    Contact is the number of cells that would be in occupied cells if the bitmap was shifted by one cell, in all four
    directions together, relative to height plus width of the bitmap. All shifted bitmaps are in the rectangle. Of equal
    places, the first bitmap is used, and the lowest and then leftmost place.
    """
    spot = np.empty(3, dtype=np.int64)
    if not find_contact(np.ascontiguousarray(occupied), len(occupied), *bitmaps, spot):
        return None
    return Spot(*spot.tolist())


@compiled
def find_contact(
    occupied: BoolArray, rows: int, runs: IntArray, starts: IntArray, sizes: IntArray, spot: IntArray
) -> int:
    """Fill in number, row and column of `find_most_contact`; return 0 if there is no free place, else 1."""
    import scipy.fft

    # Correlations by FFT count the occupied cells at all places at once.
    cells = occupied.reshape(rows, -1)
    spectrum = scipy.fft.rfft2(cells.astype(np.float64))
    best, found = -1.0, 0
    for k, (h, w) in enumerate(sizes.tolist()):
        if h + 2 > cells.shape[0] or w + 2 > cells.shape[1]:
            continue
        change = np.zeros((cells.shape[0], cells.shape[1] + 1))
        row, first, end = runs[starts[k] : starts[k + 1]].T
        change[row, first] += 1
        change[row, end] -= 1
        bitmap = np.cumsum(change, axis=1)[:, :-1]
        overlap = np.rint(scipy.fft.irfft2(spectrum * scipy.fft.rfft2(bitmap).conj(), s=cells.shape))
        i, j = np.nonzero(overlap[1 : cells.shape[0] - h, 1 : cells.shape[1] - w] == 0)
        if i.size == 0:
            continue
        i, j = i + 1, j + 1
        contact = overlap[i + 1, j] + overlap[i - 1, j] + overlap[i, j + 1] + overlap[i, j - 1]
        most = int(contact.argmax())
        share = float(contact[most]) / (h + w)
        if share > best:
            best, found = share, 1
            spot[:] = k, i[most], j[most]
    return found
