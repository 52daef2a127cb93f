"""Search for the largest common scale at which the bitmaps of all charts fit into the tiles."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from math import ceil, hypot, pi, sqrt

import numpy as np

from quasiharmonic.apps.atlas.packing.bitmaps import HALF_DIAGONAL, draw, draw_in_place
from quasiharmonic.apps.atlas.packing.board import Bitmaps, Board
from quasiharmonic.apps.atlas.packing.contact import Spot
from quasiharmonic.apps.atlas.packing.shapes import Shape
from quasiharmonic.util.arrays import ComplexArray, FloatArray, IntArray
from quasiharmonic.util.progress import heartbeat

# Cells along a tile for at most so many charts, and on the finer board for the final layout. More charts get
# proportionally smaller cells, up to a limit.
_CELLS, _FINE_CELLS, _FEW = 128, 384, 36
_CELLS_OF_MANY, _FEW_OF_MANY, _MOST_CELLS = 128, 20, 2048
# Directions of each chart: sixteen for at most so many charts, then eight. More than the second number get four, and
# their boards are searched window by window.
_MOST_DIRECTIONS, _MANY = 20, 50
# Range of the scale on the finer board, relative to that on the coarser one.
_FINE_GAIN, _FINE_LOSS = 1.06, 1.01
#: Charts beyond this number are placed as boxes, the smallest ones.
BITMAPS = 500
# Share of the tiles that charts with half the padding around them are expected to cover.
_EXPECTED = 0.8
# The number of cells along a tile varies between these multiples of the expected number.
_FEWEST_CELLS, _MORE_CELLS = 0.8, 1.25
# Placements tried with other orders of the charts, in all.
_TRIALS = 300
# The same for an estimate.
_ESTIMATED = 100
# Directions compared for the expected scale.
_TURNS = 16
# Angles compared for the direction of a single chart, and the precision of the best one.
_ANGLES, _ANGLE_PRECISION = 256, 1e-6
#: Largest side of a texture in texels: single precision stores no more positions.
MAX_SIZE = 1 << 24
# Cells around charts that stay are first as large as otherwise, then smaller by this factor.
_FINER = 1, 4
# Largest number of times that the scale there is halved, and then bisected.
_HALVINGS, _BISECTIONS = 24, 5
# Relative precision of the scale of many charts.
_COARSE = 0.04
# Relative precision of the sufficient size.
_SIZE_PRECISION = 0.01
# Spread of the logarithm of the areas by which charts are ordered in these trials.
_SPREAD = 0.3


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
    """

    scale: float
    directions: ComplexArray
    centres: ComplexArray
    tiles: IntArray


def find_layout(
    shapes: Sequence[Shape],
    size: tuple[int, int],
    padding: float,
    tiles: int,
    *,
    rotate: bool,
    scale: float | None,
    bitmaps: int = BITMAPS,
) -> Layout | None:
    """Place shapes at the largest common scale that is found, or at a given scale.

    Parameters
    ----------
    shapes : sequence of Shape
        At least one.
    size : two int
        Width and height of each tile in texels.
    padding : float
        Distance between shapes, and twice the distance to the sides of the tile, in texels.
    tiles : int
    rotate : bool
        Allow rotations.
    scale : float or None
        Texels per unit of length.
    bitmaps : int
        Maximum number of shapes that are not placed as boxes.

    Returns
    -------
    Layout
        None if the shapes do not fit, not even with a largest box of one texel.
    """
    if len(shapes) == 1 and rotate and scale is None:
        return _place_one(shapes[0], size, padding)
    if scale is not None:
        if not _may_fit(shapes, size, tiles, scale):
            return None
        search = _Search(shapes, size, padding, tiles, scale, rotate=rotate, bitmaps=bitmaps)
        return search.place_in(search.cells)
    expected, least = _expected_scale(shapes, size, padding, tiles), least_scale(shapes)
    while expected > least:
        search = _Search(shapes, size, padding, tiles, expected, rotate=rotate, bitmaps=bitmaps)
        if len(shapes) > _MANY:
            layout = search.enlarge_coarsely()
            if layout is not None:
                return layout
        elif (found := search.enlarge()) is not None:
            layout, order = found
            fine = _Search(shapes, size, padding, tiles, layout.scale, rotate=rotate, given=layout.directions)
            return fine.enlarge_finely(order) or layout
        expected /= _MORE_CELLS
    return _place_boxes(shapes, size, padding, tiles, rotate=rotate)


def find_layout_around(
    occupied: Shape,
    shapes: Sequence[Shape],
    size: tuple[int, int],
    padding: float,
    tiles: int,
    *,
    rotate: bool,
    scale: float | None,
) -> Layout | None:
    """Place shapes into the free part of tiles, at a given scale or at the largest one that is found.

    Parameters
    ----------
    occupied : Shape
        What is in the tiles, in texels. Tile ``k`` starts at ``(k % 10, k // 10)`` times ``size``.
    shapes, size, padding, tiles, rotate, scale
        See `find_layout`.

    Returns
    -------
    Layout
        None if the shapes do not fit.
    """

    def place(scale: float) -> Layout | None:
        if not _may_fit(shapes, size, tiles, scale):
            return None
        for finer in _FINER:
            search = _Search(shapes, size, padding, tiles, scale, rotate=rotate, occupied=occupied, finer=finer)
            if (found := search.place_in(search.cells)) is not None:
                return found
        return None

    if scale is not None:
        return place(scale)
    high = max(size) * max(1.0, sqrt(tiles)) / min(sum(shape.area for shape in shapes) ** 0.5, 1 / least_scale(shapes))
    best, low = None, high
    for _ in range(_HALVINGS):
        high, low = low, low / 2
        best = place(low)
        if best is not None:
            break
    for _ in range(_BISECTIONS if best is not None else 0):
        middle = sqrt(low * high)
        found = place(middle)
        low, high, best = (low, middle, best) if found is None else (middle, high, found)
    return best


def estimate_use(shapes: Sequence[Shape], size: tuple[int, int], padding: float, tiles: int, *, rotate: bool) -> float:
    """Part of the tiles that shapes cover if they are placed quickly; 0 if they do not fit well."""
    expected = _expected_scale(shapes, size, padding, tiles)
    if expected <= least_scale(shapes):
        return 0.0
    search = _Search(shapes, size, padding, tiles, expected, rotate=rotate, skewed=False)
    if len(shapes) > _MANY:
        layout = search.enlarge_coarsely()
    else:
        found = search.enlarge(_ESTIMATED)
        layout = None if found is None else found[0]
    return 0.0 if layout is None else sum(search.areas) * layout.scale**2 / (tiles * size[0] * size[1])


def _may_fit(shapes: Sequence[Shape], size: tuple[int, int], tiles: int, scale: float) -> bool:
    """Whether neither the areas nor a length of shapes exclude that they fit into tiles at a scale."""
    area = sum(shape.area for shape in shapes) * scale * scale
    longest = max(max(shape.extent(shape.direction)) for shape in shapes) * scale
    return area <= tiles * size[0] * size[1] and longest <= hypot(*size)


def _place_one(shape: Shape, size: tuple[int, int], padding: float) -> Layout | None:
    """Place one shape in the middle of a tile, in the direction in which it can be largest."""
    room = np.array([size[0] - padding, size[1] - padding])

    def scales(angles: FloatArray) -> FloatArray:
        seen = np.exp(-1j * angles)[:, None] * shape.hull
        sides = np.stack([np.ptp(seen.real, axis=1), np.ptp(seen.imag, axis=1)], axis=1)
        return np.asarray((room / np.maximum(sides, np.finfo(float).tiny)).min(axis=1))

    if room.min() <= 0:
        return None
    width = pi / _ANGLES
    angles = np.angle(shape.direction) + pi / 2 * np.arange(2)
    if not shape.straight:
        angles = np.concatenate([angles, width * np.arange(_ANGLES)])
    best = float(angles[np.argmax(scales(angles))])
    while not shape.straight and width > _ANGLE_PRECISION:
        near = best + width * np.linspace(-1, 1, 9)[[4, 0, 1, 2, 3, 5, 6, 7, 8]]
        best, width = float(near[np.argmax(scales(near))]), width / 4
    scale, least = float(scales(np.array([best]))[0]), least_scale([shape])
    if scale < least:
        return None
    if not max(shape.extent(1)):
        scale = least
    return Layout(scale, np.exp(1j * np.array([best])), np.array([complex(*size) / 2]), np.zeros(1, dtype=np.int64))


def find_sufficient_size(
    shapes: Sequence[Shape], size: tuple[int, int], padding: float, tiles: int, *, rotate: bool, scale: float | None
) -> tuple[int, int]:
    """Width and height of tiles, of the same ratio, into which shapes fit that do not fit into tiles of a size.

    A side above `MAX_SIZE` means that none was found.
    """

    def enlarge(factor: float) -> tuple[int, int]:
        return ceil(size[0] * factor), ceil(size[1] * factor)

    def fits(size: tuple[int, int]) -> bool:
        if scale is None:
            return _place_boxes(shapes, size, padding, tiles, rotate=rotate) is not None
        return find_layout(shapes, size, padding, tiles, rotate=rotate, scale=scale) is not None

    low, high = 1.0, 2.0
    while not fits(enlarge(high)):
        low, high = high, 2 * high
        if high * max(size) > MAX_SIZE:
            return enlarge(high)
    while enlarge(low) != enlarge(high) and high - low > _SIZE_PRECISION * high:
        middle = (low + high) / 2
        low, high = (low, middle) if fits(enlarge(middle)) else (middle, high)
    return enlarge(high)


def _place_boxes(
    shapes: Sequence[Shape], size: tuple[int, int], padding: float, tiles: int, *, rotate: bool
) -> Layout | None:
    """Place shapes as boxes at the least scale."""
    search = _Search(shapes, size, padding, tiles, least_scale(shapes), rotate=rotate, bitmaps=0)
    return search.place_in(min(4 * max(size), _MOST_CELLS))


def least_scale(shapes: Sequence[Shape]) -> float:
    """Scale at which the longest side of all boxes is one texel."""
    return 1 / (max(max(shape.extent(shape.direction)) for shape in shapes) or 1.0)


def _expected_scale(shapes: Sequence[Shape], size: tuple[int, int], padding: float, tiles: int) -> float:
    """Scale at which the shapes with half the padding around them cover the expected share of the tiles."""
    area = sum(shape.area for shape in shapes)
    length = sum(float(np.abs(shape.heads - shape.tails).sum()) for shape in shapes)
    free = _EXPECTED * tiles * size[0] * size[1] - len(shapes) * pi * padding**2 / 4
    b = length * padding / 2
    # The largest shape must fit in the tile, in its best direction of a few.
    turns = np.exp(0.5j * pi * np.arange(_TURNS) / _TURNS)
    sides = [_least_length(shape, turns) for shape in shapes]
    fits = (max(size) - padding) / (max(sides) or 1.0)
    if free <= 0:
        return 0.0
    return min(2 * free / (b + sqrt(b**2 + 4 * area * free)), fits) if area > 0 else fits


def _least_length(shape: Shape, turns: ComplexArray) -> float:
    """Longest side of a shape's box in the best of several directions."""
    seen = shape.hull * turns.conj()[:, None]
    return float(np.maximum(np.ptp(seen.real, axis=1), np.ptp(seen.imag, axis=1)).min())


class _Search:
    """Bitmaps of all shapes with cells of a fixed size in units of length, and boards of variable size."""

    def __init__(
        self,
        shapes: Sequence[Shape],
        size: tuple[int, int],
        padding: float,
        tiles: int,
        scale: float,
        *,
        rotate: bool,
        bitmaps: int = BITMAPS,
        given: ComplexArray | None = None,
        skewed: bool = True,
        occupied: Shape | None = None,
        finer: int = 1,
    ) -> None:
        self._size, self._tiles, self._padding = size, tiles, padding
        few = len(shapes) <= _MANY
        cells = finer * ((_CELLS if given is None else _FINE_CELLS) if few else _CELLS_OF_MANY)
        number = _FEW if few else _FEW_OF_MANY
        self.cells = ceil(min(cells * max(1.0, sqrt(len(shapes) / tiles / number)), _MOST_CELLS))
        # Length of a cell's side.
        self._cell = max(size) / self.cells / scale
        radius = _MORE_CELLS * padding / 2 * self.cells / max(size) + HALF_DIAGONAL
        self._windows = not few
        self._occupied, self._radius = occupied, radius
        self.areas = np.array([shape.area for shape in shapes])
        # Shapes of equal area stay in their order, whatever the rounding.
        self._order = np.argsort(-np.round(self.areas / (self.areas.max() or 1.0), 9), kind="stable")
        self._few = bitmaps
        large, small = self._order[:bitmaps], self._order[bitmaps:]
        turns = np.exp(0.125j * pi * (np.arange(4) if len(shapes) <= _MOST_DIRECTIONS else np.arange(0, 4, 2)))
        turns = turns if few and skewed else turns[:1]
        self._bitmaps: dict[int, Bitmaps] = {}
        self._halves: dict[tuple[int, int], Bitmaps] = {}
        # Where the last of several shapes was placed, by the number of cells and the order of these shapes.
        self._spots: dict[tuple[int, ...], tuple[int, Spot] | None] = {}
        for i in large.tolist():
            if given is not None or not rotate:
                directions = np.ones(1, dtype=complex) if given is None else given[i : i + 1]
                self._bitmaps[i] = Bitmaps(directions, [draw(shapes[i], directions[0], 1 / self._cell, radius)])
            else:
                self._bitmaps[i] = self._draw(shapes[i], turns, radius)
        # Small shapes lie in their smallest boxes.
        self._lying = np.array([_find_lying(shapes[i]) if rotate else 1 + 0j for i in small.tolist()])
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

    def enlarge(self, trials: int = _TRIALS) -> tuple[Layout, IntArray] | None:
        """Find the smallest board on which few bitmaps fit; the layout on it, and the order of the shapes."""
        low, high = int(_FEWEST_CELLS * self.cells), int(_MORE_CELLS * self.cells)
        best = self.place_in(high)
        if best is None:
            return None
        while high - low > 1:
            middle = (low + high) // 2
            found = self.place_in(middle)
            low, high, best = (middle, high, best) if found is None else (low, middle, found)
        generator, best_order = np.random.default_rng(0), self._order
        for _ in range(trials // len(self.areas)):
            order = np.argsort(-self.areas * np.exp(generator.normal(0, _SPREAD, len(self.areas))), kind="stable")
            parts = generator.integers(0, 3, len(self.areas))
            while (found := self.place_in(high - 1, order, parts)) is not None:
                high, best, best_order = high - 1, found, order
        return best, best_order

    def enlarge_finely(self, order: IntArray) -> Layout | None:
        """Find a small board for bitmaps in a given order that fit at about the expected scale."""
        best = None
        low, high = int(self.cells / _FINE_GAIN), ceil(self.cells * _FINE_LOSS)
        while high - low > 1:
            middle = (low + high) // 2
            found = self.place_in(middle, order)
            low, high, best = (middle, high, best) if found is None else (low, middle, found)
        return best

    def enlarge_coarsely(self) -> Layout | None:
        """Find a small board for many bitmaps."""
        low, high, best = int(_FEWEST_CELLS * self.cells), int(_MORE_CELLS * self.cells), None
        while best is None or high - low > _COARSE * high:
            middle = (low + high) // 2
            found = self.place_in(middle)
            low, high, best = (middle, high, best) if found is None else (low, middle, found)
            if best is None and high - low <= 1:
                return None
        return best

    def place_in(self, cells: int, order: IntArray | None = None, parts: IntArray | None = None) -> Layout | None:
        """Place the bitmaps on boards with a number of cells along the longer side; None if one does not fit.

        ``parts`` (n,) restricts the directions of each shape to one half, 1 or 2, or not, 0.
        """
        texels = max(self._size) / cells
        columns, rows = (int(side / texels * (1 + 1e-12)) for side in self._size)
        boards: list[Board] = []

        def open_board() -> Board:
            board = Board(rows, columns, windows=self._windows)
            if self._occupied is not None:
                tile = len(boards)
                corner = complex(tile % 10 * self._size[0], tile // 10 * self._size[1])
                board.put(draw_in_place(self._occupied.move(-corner, 1 / texels), rows, columns, self._radius), 0, 0)
            boards.append(board)
            return board

        while self._occupied is not None and len(boards) < self._tiles:
            open_board()

        def find(bitmaps: Bitmaps) -> tuple[int, Spot] | None:
            for tile, board in enumerate(boards):
                if spot := board.find(bitmaps):
                    return tile, spot
            spot = open_board().find(bitmaps) if len(boards) < self._tiles else None
            return None if spot is None else (len(boards) - 1, spot)

        n = len(self.areas)
        directions, centres, tiles = np.empty(n, complex), np.empty(n, complex), np.empty(n, dtype=np.int64)
        placed: tuple[int, ...] = (cells,)
        for i in (self._order[: self._few] if order is None else order).tolist():
            heartbeat()
            part = 0 if parts is None else int(parts[i])
            bitmaps = self._select(i, part)
            # Orders of few shapes often begin alike.
            placed = (*placed, i, part)
            if placed not in self._spots:
                self._spots[placed] = find(bitmaps)
            found = self._spots[placed]
            if found is None:
                return None
            tile, spot = found
            while tile >= len(boards):
                open_board()
            bitmap = bitmaps.cells[spot.direction]
            boards[tile].put(bitmap, spot.row, spot.column)
            directions[i], tiles[i] = bitmaps.directions[spot.direction], tile
            centres[i] = complex(spot.column + bitmap.shape[1] / 2, spot.row + bitmap.shape[0] / 2) * texels
        rest = self._order[self._few :]
        directions[rest] = self._lying
        boxes = np.ceil(self._boxes + self._padding / texels).astype(np.int64)
        waiting = np.arange(len(rest))
        for tile in range(self._tiles):
            if not waiting.size:
                break
            board = boards[tile] if tile < len(boards) else open_board()
            corners = board.fill_rows(boxes[waiting])
            done = waiting[corners[:, 0] >= 0]
            tiles[rest[done]] = tile
            centres[rest[done]] = (corners[corners[:, 0] >= 0] + boxes[done] / 2) @ [1j, 1] * texels
            if tile + 1 == len(boards) and not done.size:
                break
            waiting = waiting[corners[:, 0] < 0]
        return None if waiting.size else Layout(texels / self._cell, directions, centres, tiles)


def _find_lying(shape: Shape) -> complex:
    """Direction of the longer side of the smallest box."""
    direction = shape.direction
    width, height = shape.extent(direction)
    return direction if width >= height else direction * 1j
