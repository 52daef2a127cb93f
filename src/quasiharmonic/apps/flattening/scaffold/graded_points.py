"""Points whose spacing follows the lengths of given edges and grows away from them, from the leaves of a quadtree.

Squares are split until those at an edge are about as large as the edge's length. Neighbouring squares differ in size by
at most a factor of two. So each edge has a few points near it for any range of lengths. In rows of squares of one size,
points are shifted alternately, so that they form nearly equilateral triangles.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from quasiharmonic.util.arrays import FloatArray, IntArray

# Maximum number of times that squares are halved.
_DEEPEST = 40
# A square is encoded as one integer with this number of bits per coordinate.
_BITS = 31


@dataclass(frozen=True)
class Quadtree:
    """A rectangle of squares, split into quarters where requested; neighbours differ by at most one level."""

    corner: FloatArray  # (2,): lower left corner
    side: float  # Side of the largest squares
    shape: tuple[int, int]  # Numbers of largest squares along x and y
    split: list[IntArray]  # each (k,): split squares of each level, as ascending integers ``y · 2³¹ + x``

    @classmethod
    def around(
        cls, positions: FloatArray, sizes: FloatArray, corner: FloatArray, side: float, shape: tuple[int, int]
    ) -> Quadtree:
        """Split until squares at given positions (k, 2) have at most given sizes (k,)."""
        # The depth is limited by the integers; smaller sizes get squares that are too large.
        deepest = min(_DEEPEST, _BITS - 1 - int(np.ceil(np.log2(max(shape)))))
        with np.errstate(divide="ignore"):
            level = np.clip(np.ceil(np.log2(side / sizes)), 0, deepest).astype(np.int64)
        split: list[IntArray] = []
        below = np.empty(0, dtype=np.int64)
        for depth in range(int(level.max(initial=0)) - 1, -1, -1):
            here = positions[level == depth + 1]
            asked = np.floor((here - corner) / (side * 0.5**depth)).astype(np.int64)
            # Neighbours of a split square must exist, so their parent squares are split.
            x, y = below & (1 << _BITS) - 1, below >> _BITS
            beside = [(np.clip(x + dx, 0, None) >> 1, np.clip(y + dy, 0, None) >> 1) for dx, dy in _BESIDE]
            x, y = (np.concatenate([asked[:, k], *(pair[k] for pair in beside)]) for k in range(2))
            inside = (x >= 0) & (y >= 0) & (x < shape[0] << depth) & (y < shape[1] << depth)
            below = np.unique((y[inside] << _BITS) + x[inside])
            split.append(below)
        return cls(corner, side, shape, split[::-1])

    def leaves(self) -> tuple[IntArray, IntArray, IntArray]:
        """Return level and integer position along x and y of every square that is not split; each (k,) int64."""
        x, y = (axis.ravel() for axis in np.indices(self.shape[::-1], dtype=np.int64)[::-1])
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
        """Return a point in every leaf, (k, 2), and the leaves' sides (k,)."""
        level, x, y = self.leaves()
        size = np.asarray(self.side * 0.5**level, dtype=np.float64)
        shifted = x + np.where(y % 2, 0.75, 0.25)
        points: FloatArray = self.corner + size[:, None] * np.stack([shifted, y + 0.5], axis=1)
        return points, size

    def sizes_at(self, positions: FloatArray) -> FloatArray:
        """Return the sides of the leaves at given positions (k, 2) in the rectangle; (k,) float64."""
        size = np.full(len(positions), self.side)
        for depth, split in enumerate(self.split):
            x, y = np.floor((positions - self.corner) / (self.side * 0.5**depth)).astype(np.int64).T
            key = (y << _BITS) + x
            found = split[np.minimum(np.searchsorted(split, key), split.size - 1)] == key
            size[found] = self.side * 0.5 ** (depth + 1)
        return size


_BESIDE = (0, 0), (1, 0), (-1, 0), (0, 1), (0, -1)
