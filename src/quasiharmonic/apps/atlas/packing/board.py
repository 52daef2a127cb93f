"""Boards: rectangles of cells with the bitmaps that are placed there, and the best free position of another bitmap."""

from __future__ import annotations

from math import ceil, sqrt
from typing import NamedTuple

import numpy as np

from quasiharmonic.apps.atlas.packing.shapes import Shape
from quasiharmonic.util.arrays import BoolArray, ComplexArray, IntArray, enumerate_each
from quasiharmonic.util.kernels import compiled

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
    # Number of cells along a tile, from which a bound of the free area is found.
    bound_cells: int = 512


_TUNING = BoardTuning()


class Bitmaps:
    """Bitmaps of a shape in several directions. Of equal bitmaps, only the first is kept.

    Attributes
    ----------
    kept : list of int
        Their numbers among all bitmaps.
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
        self.kept = sorted(first.values())
        self.directions, self.cells = directions[self.kept], [cells[k] for k in self.kept]
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
        larger = Bitmaps(bitmaps.directions, [_enlarge_cells(bitmap, step) for bitmap in bitmaps.cells])
        found = coarse.find(larger)
        # Different bitmaps can be equal in larger cells.
        return None if found is None else Spot(larger.kept[found.direction], found.row * step, found.column * step)


def _enlarge_cells(bitmap: BoolArray, step: int) -> BoolArray:
    """Bitmap of larger cells that contain a cell of a bitmap."""
    h, w = (ceil(n / step) for n in bitmap.shape)
    padded = np.zeros((h * step, w * step), dtype=bool)
    padded[: bitmap.shape[0], : bitmap.shape[1]] = bitmap
    return np.asarray(padded.reshape(h, step, w, step).any(axis=(1, 3)))


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
    sizes = np.array([bitmap.shape for bitmap in bitmaps], dtype=np.int64)
    # All rows one after another, with a free cell before each row and after the last one.
    row_ends = np.cumsum(np.repeat(sizes[:, 1] + 1, sizes[:, 0]))
    cells = np.zeros(row_ends[-1] + 1, dtype=np.int8)
    begins = np.cumsum((sizes[:, 1] + 1) * sizes[:, 0])
    for bitmap, (h, w), end in zip(bitmaps, sizes.tolist(), begins.tolist(), strict=True):
        cells[end - h * (w + 1) : end].reshape(h, w + 1)[:, 1:] = bitmap
    change = np.diff(cells)
    first, end = np.flatnonzero(change > 0), np.flatnonzero(change < 0)
    row = np.searchsorted(row_ends, first, side="right")
    before = np.append(0, row_ends)[row]
    bottom = np.append(0, np.cumsum(sizes[:, 0]))
    number = np.searchsorted(bottom, row, side="right") - 1
    order = np.lexsort((first - end, number))
    runs = np.stack([row - bottom[number], first - before, end - before], axis=1)[order]
    return Runs(runs, np.searchsorted(number, np.arange(len(bitmaps) + 1)), sizes)


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


# If the cells of two bitmaps with this radius plus half a distance are disjoint, the shapes are at least this distance
# apart: the centre of some cell is within half a diagonal of the middle between the closest points.
HALF_DIAGONAL = sqrt(0.5)
# Maximum distance between samples of an edge, in cells.
_SPACING = 0.5


def draw(shape: Shape, direction: complex, scale: float, radius: float) -> BoolArray:
    """Cells whose centres are within a distance of a shape.

    Parameters
    ----------
    shape : Shape
    direction : complex
        Unit vector that becomes the x-axis.
    scale : float
        Cells per unit of length.
    radius : float
        Distance in cells, at least `HALF_DIAGONAL`.

    Returns
    -------
    (h, w) bool
        Rows are from the lowest up. The centre of the shape's box is the centre of the bitmap.
    """
    turn = scale * direction.conjugate()
    hull = shape.hull * turn
    low, high = (complex(f(hull.real), f(hull.imag)) for f in (np.min, np.max))
    w, h = (max(int(side + 2 * radius), 1) for side in ((high - low).real, (high - low).imag))
    shift = complex(w, h) / 2 - (low + high) / 2
    return _draw_edges(shape.tails * turn + shift, shape.heads * turn + shift, (h, w), radius)


def draw_in_place(shape: Shape, rows: int, columns: int, radius: float) -> BoolArray:
    """Cells (rows, columns) of a rectangle at the origin within a distance of a shape; the unit is a cell."""
    return _draw_edges(shape.tails, shape.heads, (rows, columns), radius)


def _draw_edges(tails: ComplexArray, heads: ComplexArray, size: tuple[int, int], radius: float) -> BoolArray:
    """Cells (h, w) within a distance of the edges (e,) of a shape, or inside of it."""
    found = np.empty(size, dtype=np.bool_)
    fill_cells(tails, heads, found)
    mark_near(tails, heads, radius, _SPACING, found)
    return found


class Occupied:
    """What is in tiles of a size (w, h): a shape in texels. Tile k starts at ``(k % 10, k // 10)`` times the size."""

    def __init__(self, shape: Shape, size: tuple[int, int]) -> None:
        self._shape, self._size = shape, size
        self._drawn: dict[tuple[int, int, float], BoolArray] = {}

    def draw(self, tile: int, cells: int, radius: float) -> BoolArray:
        """Return the cells of a tile within a distance of the shape, with ``cells`` along its longer side.

        The unit of ``radius`` is a cell.
        """
        key = tile, cells, radius
        if key not in self._drawn:
            texels = max(self._size) / cells
            columns, rows = count_cells(self._size, texels)
            corner = complex(tile % 10 * self._size[0], tile // 10 * self._size[1])
            self._drawn[key] = draw_in_place(self._shape.move(-corner, 1 / texels), rows, columns, radius)
        return self._drawn[key]

    def free_area(self, tiles: int, padding: float) -> float:
        """Return an upper bound of the area of tiles at half the padding from the shape, in square texels."""
        cells = min(max(self._size), _TUNING.bound_cells)
        texels = max(self._size) / cells
        radius = max(padding / 2 / texels - HALF_DIAGONAL, 0.0)
        return texels**2 * sum(np.count_nonzero(~self.draw(tile, cells, radius)) for tile in range(tiles))


def count_cells(size: tuple[int, int], texels: float) -> tuple[int, int]:
    """Return the numbers of whole cells of some texels along the sides of a tile."""
    return int(size[0] / texels * (1 + 1e-12)), int(size[1] / texels * (1 + 1e-12))


@compiled
def fill_cells(tails: ComplexArray, heads: ComplexArray, cells: BoolArray) -> None:
    """Set the cells (h, w) to whether the edges (e,) wind around their centres."""
    h, w = cells.shape
    up = heads.imag > tails.imag
    lower, upper = np.where(up, tails, heads), np.where(up, heads, tails)
    # Rows of centres y with lower ≤ y < upper.
    first, end = (np.clip(np.ceil(ends.imag - 0.5), 0, h).astype(np.int64) for ends in (lower, upper))
    edge, step = enumerate_each(end - first)
    row = first[edge] + step
    ahead = upper[edge] - lower[edge]
    x = lower.real[edge] + (row + 0.5 - lower.imag[edge]) * (ahead.real / ahead.imag)
    column = np.clip(np.ceil(x - 0.5), 0, w).astype(np.int64)
    change = np.bincount(row * (w + 1) + column, np.where(up[edge], 1.0, -1.0), h * (w + 1))
    cells[:] = np.cumsum(change.reshape(h, w + 1), axis=1)[:, :w] != 0


@compiled
def mark_near(tails: ComplexArray, heads: ComplexArray, radius: float, spacing: float, cells: BoolArray) -> None:
    """Mark the cells (h, w) whose centres are within a distance of an edge, by samples at most ``spacing`` apart."""
    h, w = cells.shape
    # Every point of an edge is at most half the spacing from a sample.
    reach = radius**2 + spacing**2 / 4
    k = int(sqrt(reach)) + 2
    beyond = np.zeros(tails.size, dtype=np.bool_)
    for one, other, side in ((tails.real, heads.real, w), (tails.imag, heads.imag, h)):
        beyond |= (np.maximum(one, other) < -k) | (np.minimum(one, other) > side + k)
    tails, heads = tails[~beyond], heads[~beyond]
    count = np.maximum(np.ceil(np.abs(heads - tails) / spacing), 1).astype(np.int64)
    edge, step = enumerate_each(count)
    samples = tails[edge] + (heads - tails)[edge] * (step / count[edge])
    inside = (samples.imag > -k) & (samples.imag < h + k) & (samples.real > -k) & (samples.real < w + k)
    samples = samples[inside]
    i, j = np.floor(samples.imag).astype(np.int64), np.floor(samples.real).astype(np.int64)
    y, x = samples.imag - i, samples.real - j
    padded = np.zeros((h + 4 * k, w + 4 * k), dtype=bool)
    flat, place = padded.ravel(), (i + 2 * k) * padded.shape[1] + j + 2 * k
    offset = np.arange(-k + 1, k)[:, None]
    across = (offset + 0.5 - x) ** 2
    for di in range(-k + 1, k):
        near = (di + 0.5 - y) ** 2 + across <= reach
        flat[(place + offset + di * padded.shape[1])[near]] = True
    cells |= padded[2 * k : 2 * k + h, 2 * k : 2 * k + w]
