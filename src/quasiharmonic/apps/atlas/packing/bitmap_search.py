"""Bitmaps of all charts, placed one after another on boards of variable size, largest charts first.

Bitmaps are drawn once, with cells of a fixed size in units of length. A board with fewer cells stands for a tile at a
larger scale. So the search for the largest scale is a search for the smallest board on which all bitmaps fit.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from math import ceil, pi, sqrt
from typing import NamedTuple

import numpy as np

from quasiharmonic.apps.atlas.packing.board import HALF_DIAGONAL, Bitmaps, Board, Occupied, Spot, count_cells, draw
from quasiharmonic.apps.atlas.packing.shapes import Shape
from quasiharmonic.util.arrays import BoolArray, ComplexArray, IntArray
from quasiharmonic.util.progress import heartbeat

#: More charts than this have four directions each, and are placed once; their boards are searched window by window.
MANY = 50
#: Charts beyond this number are placed as boxes, the smallest ones.
BITMAPS = 500
#: Placements tried with other orders of the charts, in all.
TRIALS = 80
#: Largest number of cells along a tile.
MOST_CELLS = 2048
#: The number of cells along a tile is at most this multiple of the expected number.
MORE_CELLS = 1.25


class BitmapTuning(NamedTuple):
    """Numbers that tune the boards; charts are few up to `MANY`, and many above."""

    # Expected number of cells along a tile for few charts.
    cells: int = 128
    # The same on the finer board, which is for the final layout of few charts.
    fine_cells: int = 384
    # Number of few charts on a tile from which cells are proportionally smaller.
    charts_per_tile: int = 36
    # Expected number of cells along a tile for many charts.
    cells_of_many: int = 128
    # Number of many charts on a tile from which cells are proportionally smaller.
    many_per_tile: int = 20
    # The number of cells along a tile is at least this multiple of the expected number.
    fewest_cells: float = 0.8
    # At most this many cells along a texel; with smaller ones the padding would have many cells.
    cells_per_texel: int = 4
    # Few charts have sixteen directions each up to this number, and eight above.
    sixteen_directions: int = 20
    # Relative precision of the first scale of few charts.
    precision: float = 0.03
    # Relative precision of the scale of many charts.
    precision_of_many: float = 0.04
    # Spread of the logarithm of the areas by which charts are ordered in the trials.
    spread: float = 0.3
    # Largest scale on the finer board, relative to that on the coarser one.
    fine_gain: float = 1.06
    # Smallest scale on the finer board: the scale on the coarser one divided by this.
    fine_loss: float = 1.01


_TUNING = BitmapTuning()


class Textures(NamedTuple):
    """The tiles into which shapes are packed."""

    size: tuple[int, int]  # Width and height of each tile in texels
    padding: float  # Distance between shapes, and twice the distance to the sides of the tile, in texels
    tiles: int
    rotate: bool  # Whether shapes may be rotated

    @property
    def texels(self) -> int:
        """Number of texels of all tiles."""
        return self.tiles * self.size[0] * self.size[1]


@dataclass(frozen=True, eq=False)
class Layout:
    """Where shapes are placed.

    Attributes
    ----------
    scale : float
        Texels per unit of length.
    directions : (n,) complex128
        Unit vector of each shape that becomes the x-axis.
    centres : (n,) complex128
        Centre of each rotated shape's box in its tile, in texels.
    tiles : (n,) int64
    least : float
        Smallest scale to which the layout can shrink about the centres of the tiles without less than the padding.
    """

    scale: float
    directions: ComplexArray
    centres: ComplexArray
    tiles: IntArray
    least: float

    def shrink(self, scale: float, size: tuple[int, int]) -> Layout | None:
        """Return the layout at another scale, in tiles of a size; None if the scale is too large or too small."""
        if not self.least <= scale <= self.scale:
            return None
        middle = complex(*size) / 2
        return replace(self, scale=scale, centres=middle + (self.centres - middle) * (scale / self.scale))


class BitmapSearch:
    """Bitmaps of all shapes with cells of a fixed size in units of length, and boards of variable size."""

    def __init__(
        self,
        shapes: Sequence[Shape],
        into: Textures,
        scale: float,
        *,
        bitmaps: int = BITMAPS,
        given: ComplexArray | None = None,
        skewed: bool = True,
        occupied: Occupied | None = None,
        finer: int = 1,
    ) -> None:
        size, padding, tiles, rotate = self._into = into
        few = len(shapes) <= MANY
        cells = finer * ((_TUNING.cells if given is None else _TUNING.fine_cells) if few else _TUNING.cells_of_many)
        number = _TUNING.charts_per_tile if few else _TUNING.many_per_tile
        most = min(MOST_CELLS, _TUNING.cells_per_texel * max(size))
        self.cells = ceil(min(cells * max(1.0, sqrt(len(shapes) / tiles / number)), most))
        # Length of a cell's side.
        self._cell = max(size) / self.cells / scale
        radius = MORE_CELLS * padding / 2 * self.cells / max(size) + HALF_DIAGONAL
        self._windows = not few
        self._occupied, self._radius = occupied, radius
        self.areas = np.array([shape.area for shape in shapes])
        # Shapes of equal area stay in their order, whatever the rounding.
        self._order = np.argsort(-np.round(self.areas / (self.areas.max() or 1.0), 9), kind="stable")
        self._drawn = bitmaps
        large, small = self._order[:bitmaps], self._order[bitmaps:]
        step = 1 if len(shapes) <= _TUNING.sixteen_directions else 2
        turns = np.exp(0.125j * pi * np.arange(0, 4, step))
        turns = turns if few and skewed else turns[:1]
        self._bitmaps: dict[int, Bitmaps] = {}
        self._halves: dict[tuple[int, int], Bitmaps] = {}
        # Where the last of several shapes was placed, by the number of cells and the shapes so far with their halves.
        # These determine the boards, so the place is the same in each trial.
        self._spots: dict[tuple[int, ...], tuple[int, Spot] | None] = {}
        for i in large.tolist():
            if given is not None or not rotate:
                directions = np.ones(1, dtype=complex) if given is None else given[i : i + 1]
                self._bitmaps[i] = Bitmaps(directions, [draw(shapes[i], directions[0], 1 / self._cell, radius)])
            else:
                self._bitmaps[i] = self._draw(shapes[i], turns, radius)
        self._least_cells = sum(bitmaps.count for bitmaps in self._bitmaps.values())
        # Small shapes lie in their smallest boxes.
        self._lying = np.array([shapes[i].lying if rotate else 1 + 0j for i in small.tolist()])
        sides = [shapes[i].extent(direction)[::-1] for i, direction in zip(small, self._lying, strict=True)]
        self._boxes = np.array(sides).reshape(-1, 2) / self._cell

    def _draw(self, shape: Shape, turns: ComplexArray, radius: float) -> Bitmaps:
        """Draw a shape with each of its sides up, after each of several rotations of its smallest box."""
        directions, cells = [], []
        for direction in shape.direction * (turns[:1] if shape.straight else turns):
            bitmap = draw(shape, direction, 1 / self._cell, radius)
            for quarters in range(4):
                directions.append(direction * 1j**quarters)
                cells.append(np.rot90(bitmap, quarters))
        return Bitmaps(np.array(directions), cells)

    def _select(self, i: int, part: int) -> Bitmaps:
        """Return the bitmaps of a shape in all directions, 0, or in one half of them, 1 or 2."""
        if part == 0:
            return self._bitmaps[i]
        if (i, part) not in self._halves:
            self._halves[i, part] = self._bitmaps[i].half(part - 1)
        return self._halves[i, part]

    def enlarge(self, least: float, trials: int) -> tuple[Layout, IntArray] | None:
        """Find a small board on which few bitmaps fit, at a larger scale than the least.

        Return the layout on it, and the order of the shapes that are not placed as boxes.
        """
        best, high = self._scan(least, _TUNING.precision)
        if best is None:
            return None
        while (found := self.place_in(high - 1)) is not None:
            best, high = found, high - 1
        drawn = self._order[: self._drawn]
        generator, best_order = np.random.default_rng(0), drawn
        for _ in range(trials // len(self.areas)):
            factors = np.exp(generator.normal(0, _TUNING.spread, len(self.areas)))
            order = np.argsort(-self.areas * factors, kind="stable")
            order = order[np.isin(order, drawn)]
            parts = generator.integers(0, 3, len(self.areas))
            while (found := self.place_in(high - 1, order, parts)) is not None:
                high, best, best_order = high - 1, found, order
        return best, best_order

    def enlarge_finely(self, order: IntArray) -> Layout | None:
        """Find a small board for bitmaps in a given order that fit at about the expected scale."""
        best = None
        low, high = int(self.cells / _TUNING.fine_gain), ceil(self.cells * _TUNING.fine_loss)
        while high - low > 1:
            middle = (low + high) // 2
            found = self.place_in(middle, order)
            low, high, best = (middle, high, best) if found is None else (low, middle, found)
        return best

    def enlarge_coarsely(self, least: float) -> Layout | None:
        """Find a small board for many bitmaps."""
        return self._scan(least, _TUNING.precision_of_many)[0]

    def _scan(self, least: float, precision: float) -> tuple[Layout | None, int]:
        """Find a small board on which the bitmaps fit; return the layout and the number of cells.

        On a larger board, they may not fit: the first ones then lie elsewhere. So all sizes are tried, smallest first.
        """
        cells = int(_TUNING.fewest_cells * self.cells)
        last = int(min(MORE_CELLS * self.cells, max(self._into.size) / (self._cell * least)))
        while (best := self.place_in(cells)) is None and cells < last:
            cells = min(cells + max(1, int(precision * cells)), last)
        return best, cells

    def place_in(self, cells: int, order: IntArray | None = None, parts: IntArray | None = None) -> Layout | None:
        """Place the bitmaps on boards with a number of cells along the longer side; None if one does not fit.

        ``parts`` (n,) restricts the directions of each shape to one half, 1 or 2, or not, 0.
        """
        size, padding, most, _ = self._into
        # Shapes without extent fit on every board.
        if cells < 1:
            return None
        texels = max(size) / cells
        columns, rows = count_cells(size, texels)
        if self._least_cells > most * columns * rows:
            return None
        boards = _Boards(rows, columns, most, windows=self._windows)
        if self._occupied is not None:
            for tile in range(most):
                boards.open().put(self._occupied.draw(tile, cells, self._radius), 0, 0)
        n = len(self.areas)
        scale, tiles = texels / self._cell, np.empty(n, dtype=np.int64)
        # Bitmaps have space for the padding on boards of so many cells, boxes on this board only.
        least = scale if len(self._boxes) else max(size) / (MORE_CELLS * self.cells * self._cell)
        layout = Layout(scale, np.empty(n, complex), np.empty(n, complex), tiles, least)
        drawn, boxes = self._order[: self._drawn] if order is None else order, self._order[self._drawn :]
        if not self._place_bitmaps(boards, layout, (cells,), drawn, parts):
            return None
        sides = np.ceil(self._boxes + padding / texels).astype(np.int64)
        tiles, corners = boards.fill_rows(sides)
        if (tiles < 0).any():
            return None
        layout.directions[boxes], layout.tiles[boxes] = self._lying, tiles
        layout.centres[boxes] = (corners + sides / 2) @ [1j, 1] * texels
        return layout

    def _place_bitmaps(
        self, boards: _Boards, layout: Layout, placed: tuple[int, ...], order: IntArray, parts: IntArray | None
    ) -> bool:
        """Place shapes on boards in an order, and fill in their layout; return whether all fit."""
        texels = layout.scale * self._cell
        for i in order.tolist():
            heartbeat()
            part = 0 if parts is None else int(parts[i])
            bitmaps = self._select(i, part)
            # Orders of few shapes often begin alike.
            placed = (*placed, i, part)
            if placed not in self._spots:
                self._spots[placed] = boards.find(bitmaps)
            found = self._spots[placed]
            if found is None:
                return False
            tile, spot = found
            bitmap = bitmaps.cells[spot.direction]
            boards.put(tile, bitmap, spot)
            layout.directions[i], layout.tiles[i] = bitmaps.directions[spot.direction], tile
            layout.centres[i] = complex(spot.column + bitmap.shape[1] / 2, spot.row + bitmap.shape[0] / 2) * texels
        return True


class _Boards:
    """Boards of the tiles, at most ``most``. A board is opened where nothing fits on those before."""

    def __init__(self, rows: int, columns: int, most: int, *, windows: bool) -> None:
        self._sides, self._most, self._windows = (rows, columns), most, windows
        self._boards: list[Board] = []

    def open(self) -> Board:
        """Return a further board, which is empty."""
        self._boards.append(Board(*self._sides, windows=self._windows))
        return self._boards[-1]

    def find(self, bitmaps: Bitmaps) -> tuple[int, Spot] | None:
        """Find the first tile with a free position for one of several bitmaps of a shape, and the position."""
        for tile, board in enumerate(self._boards):
            if spot := board.find(bitmaps):
                return tile, spot
        spot = self.open().find(bitmaps) if len(self._boards) < self._most else None
        return None if spot is None else (len(self._boards) - 1, spot)

    def put(self, tile: int, bitmap: BoolArray, spot: Spot) -> None:
        """Occupy the cells of a bitmap at a position that `find` has returned, now or for equal boards."""
        while tile >= len(self._boards):
            self.open()
        self._boards[tile].put(bitmap, spot.row, spot.column)

    def fill_rows(self, boxes: IntArray) -> tuple[IntArray, IntArray]:
        """Place boxes (k, 2) into free cells; return tiles (k,), -1 for those that do not fit, and corners (k, 2)."""
        tiles, corners = np.full(len(boxes), -1), np.zeros((len(boxes), 2), dtype=np.int64)
        for tile in range(self._most):
            waiting = np.flatnonzero(tiles < 0)
            if not waiting.size:
                break
            board = self._boards[tile] if tile < len(self._boards) else self.open()
            found = board.fill_rows(boxes[waiting])
            done = found[:, 0] >= 0
            tiles[waiting[done]], corners[waiting[done]] = tile, found[done]
            if tile + 1 == len(self._boards) and not done.any():
                break
        return tiles, corners
