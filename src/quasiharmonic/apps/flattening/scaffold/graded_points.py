"""Points whose spacing follows the lengths of given edges and grows away from them: the leaves of a quadtree.

Squares are split until those that meet an edge are about as large as the edge is long, and then wherever a square
would have a neighbour less than half its size. So there are a few points to every edge, whatever the range of lengths.
Squares of one size are shifted by half, row against row, which makes their middles' triangles nearly equilateral.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from quasiharmonic.util.arrays import FloatArray, IntArray

# Times the squares may be halved.
_DEEPEST = 40
# Squares across a level are counted by one integer a square: room for this many bits of each coordinate.
_BITS = 31


@dataclass(frozen=True)
class Quadtree:
    """A rectangle of squares, split into quarters where that is asked for, next to each other by halves at most.

    Attributes
    ----------
    corner : (2,) float64
        The lower left one.
    side : float
        Of the largest squares.
    shape : (int, int)
        Numbers of largest squares along x and y.
    split : list of (k,) int64
        Squares that are split, level by level, as ascending integers ``y · 2³¹ + x``.
    """

    corner: FloatArray
    side: float
    shape: tuple[int, int]
    split: list[IntArray]

    @classmethod
    def around(
        cls, places: FloatArray, sizes: FloatArray, corner: FloatArray, side: float, shape: tuple[int, int]
    ) -> Quadtree:
        """Split until squares at given places (k, 2) have at most given sizes (k,)."""
        # As deep as the integers reach: what is smaller still gets squares larger than asked for.
        lowest_energy = min(_DEEPEST, _BITS - 1 - int(np.ceil(np.log2(max(shape)))))
        with np.errstate(divide="ignore"):
            level = np.clip(np.ceil(np.log2(side / sizes)), 0, lowest_energy).astype(np.int64)
        split: list[IntArray] = []
        below = np.empty(0, dtype=np.int64)
        for depth in range(int(level.max(initial=0)) - 1, -1, -1):
            here = places[level == depth + 1]
            asked = np.floor((here - corner) / (side * 0.5**depth)).astype(np.int64)
            # Squares beside a split one must be there, so the squares that these are quarters of are split.
            x, y = below & (1 << _BITS) - 1, below >> _BITS
            beside = [(np.clip(x + dx, 0, None) >> 1, np.clip(y + dy, 0, None) >> 1) for dx, dy in _BESIDE]
            x, y = (np.concatenate([asked[:, k], *(pair[k] for pair in beside)]) for k in range(2))
            inside = (x >= 0) & (y >= 0) & (x < shape[0] << depth) & (y < shape[1] << depth)
            below = np.unique((y[inside] << _BITS) + x[inside])
            split.append(below)
        return cls(corner, side, shape, split[::-1])

    def leaves(self) -> tuple[IntArray, IntArray, IntArray]:
        """Level and integer place along x and y of every square that is not split; each (k,) int64."""
        x, y = (axis.ravel() for axis in np.meshgrid(*map(np.arange, self.shape)))
        there = (y << _BITS) + x
        levels, kept = [], []
        for depth, split in enumerate([*self.split, np.empty(0, dtype=np.int64)]):
            kept.append(np.setdiff1d(there, split, assume_unique=True))
            levels.append(np.full(kept[-1].size, depth))
            x, y = (split & (1 << _BITS) - 1) * 2, (split >> _BITS) * 2
            there = np.concatenate([(y + dy << _BITS) + x + dx for dx in (0, 1) for dy in (0, 1)])
        keys = np.concatenate(kept)
        return np.concatenate(levels), keys & (1 << _BITS) - 1, keys >> _BITS

    def points(self) -> tuple[FloatArray, FloatArray]:
        """A point in every leaf, (k, 2), and the leaves' sides (k,)."""
        level, x, y = self.leaves()
        size = np.asarray(self.side * 0.5**level, dtype=np.float64)
        shifted = x + np.where(y % 2, 0.75, 0.25)
        points: FloatArray = self.corner + size[:, None] * np.stack([shifted, y + 0.5], axis=1)
        return points, size

    def sizes_at(self, places: FloatArray) -> FloatArray:
        """The sides of the leaves that hold given places (k, 2) within the rectangle; (k,) float64."""
        size = np.full(len(places), self.side)
        for depth, split in enumerate(self.split):
            x, y = np.floor((places - self.corner) / (self.side * 0.5**depth)).astype(np.int64).T
            key = (y << _BITS) + x
            found = split[np.minimum(np.searchsorted(split, key), split.size - 1)] == key
            size[found] = self.side * 0.5 ** (depth + 1)
        return size


_BESIDE = (0, 0), (1, 0), (-1, 0), (0, 1), (0, -1)
