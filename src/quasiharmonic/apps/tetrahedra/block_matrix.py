"""Sparse matrices assembled from blocks of pairs of vertices of tetrahedra."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from quasiharmonic.util.arrays import FloatArray, IntArray, invert_indices

if TYPE_CHECKING:
    from scipy.sparse import bsr_array

# Pairs of vertices of a tetrahedron whose blocks are computed; the others are their transposes.
VERTEX_PAIRS = tuple((i, j) for i in range(4) for j in range(i, 4))


class BlockMatrix:
    """Assembles blocks of pairs of vertices into a sparse matrix of the free coordinates.

    ``free`` (k,) are the free vertices; unknown ``3 i + a`` is coordinate a of vertex ``free[i]``.
    """

    def __init__(self, T: IntArray, n: int, free: IntArray) -> None:
        number = invert_indices(n, free)
        own = number[T]
        rows = np.concatenate([own[:, i] for i, _ in VERTEX_PAIRS] + [own[:, j] for i, j in VERTEX_PAIRS if i != j])
        columns = np.concatenate([own[:, j] for _, j in VERTEX_PAIRS] + [own[:, i] for i, j in VERTEX_PAIRS if i != j])
        inside = (rows >= 0) & (columns >= 0)
        key = np.where(inside, rows * free.size + columns, -1)
        entries, place = np.unique(key, return_inverse=True)
        outside = int(entries.size > 0 and entries[0] < 0)
        self._place = place.ravel() - outside
        self._size = free.size
        self._count = entries.size - outside
        row, self._indices = np.divmod(entries[outside:], max(free.size, 1))
        self._indptr = np.searchsorted(row, np.arange(free.size + 1))
        self.diagonal = np.flatnonzero(row == self._indices)

    def assemble(self, blocks: FloatArray) -> FloatArray:
        """Return the blocks (m, 3, 3) of the matrix of blocks (10, 3, 3, t)."""
        off = [k for k, (i, j) in enumerate(VERTEX_PAIRS) if i != j]
        data = np.empty((self._count, 3, 3))
        place = self._place + 1
        for a in range(3):
            for b in range(3):
                weights = np.concatenate([blocks[:, a, b].ravel(), blocks[off, b, a].ravel()])
                data[:, a, b] = np.bincount(place, weights, minlength=self._count + 1)[1:]
        return data

    def matrix(self, data: FloatArray) -> bsr_array[np.float64]:
        """Return the sparse matrix of assembled blocks."""
        from scipy.sparse import bsr_array

        size = 3 * self._size
        return bsr_array((data, self._indices, self._indptr), shape=(size, size))
