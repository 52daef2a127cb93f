"""Sparsity pattern of ``Sᵀ Gᵀ A G S``, and assembly lists for the edge stiffnesses of triangles."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from quasiharmonic.geometry.mesh.topology import edge_keys
from quasiharmonic.util.arrays import IntArray, check_range, own_triangles
from quasiharmonic.util.kernels import compiled


class StiffnessPattern(NamedTuple):
    """The entries of a Laplacian among the free vertices, and the half-edges summed into each entry.

    Half-edge e·f + t is edge e of triangle t, the layout of `ReferenceMesh.edge_stiffness`.

    Attributes
    ----------
    indptr, indices : (size + 1,), (size + e,) int32
        The upper triangle in compressed sparse rows; each row has its diagonal entry first.
    row, column : (e,) int64
        The entries above the diagonal, row by row.
    halves, offsets : (m,), (e + 1,) int32
        Ascending half-edges of each entry above the diagonal, and the start of each list.
    border, border_row, border_fixed : (b,) int64
        Ascending half-edges between a free and a fixed vertex, the row of the free vertex, and the fixed vertex.
    """

    indptr: NDArray[np.int32]
    indices: NDArray[np.int32]
    row: IntArray
    column: IntArray
    halves: NDArray[np.int32]
    offsets: NDArray[np.int32]
    border: IntArray
    border_row: IntArray
    border_fixed: IntArray


def stiffness_pattern(F: IntArray, unknown: NDArray[np.int32], size: int) -> StiffnessPattern:
    """Find the pattern of the Laplacian of a mesh among its ``size`` free vertices.

    ``unknown`` (n,) int32 has the row of every free vertex, and -1 at fixed ones.
    """
    F = own_triangles(F)
    check_range("F", F, unknown.size)
    capacity = F.size
    pattern = StiffnessPattern(
        indptr=np.empty(size + 1, dtype=np.int32),
        indices=np.empty(size + capacity, dtype=np.int32),
        row=np.empty(capacity, dtype=np.int64),
        column=np.empty(capacity, dtype=np.int64),
        halves=np.empty(capacity, dtype=np.int32),
        offsets=np.empty(capacity + 1, dtype=np.int32),
        border=np.empty(capacity, dtype=np.int64),
        border_row=np.empty(capacity, dtype=np.int64),
        border_fixed=np.empty(capacity, dtype=np.int64),
    )
    sizes = np.empty(3, dtype=np.int64)
    find_pattern(F, unknown, *pattern, sizes)
    entries, inner, border = sizes.tolist()
    # Release the unused memory, which was never touched.
    lengths = size + 1, size + entries, entries, entries, inner, entries + 1, border, border, border
    arrays: list[NDArray[Any]] = list(pattern)
    for array, length in zip(arrays, lengths, strict=True):
        array.resize(length, refcheck=False)
    return pattern


@compiled
def find_pattern(
    F: IntArray,
    unknown: NDArray[np.int32],
    indptr: NDArray[np.int32],
    indices: NDArray[np.int32],
    row: IntArray,
    column: IntArray,
    halves: NDArray[np.int32],
    offsets: NDArray[np.int32],
    border: IntArray,
    border_row: IntArray,
    border_fixed: IntArray,
    sizes: IntArray,
) -> None:
    """Fill in a `StiffnessPattern`, in arrays of sufficient length, and the numbers e, m and b (3,)."""
    size = indptr.size - 1
    tail = unknown[F.T]
    tail, head = tail.ravel(), tail[(1, 2, 0), :].ravel()
    inner = np.flatnonzero((tail >= 0) & (head >= 0))
    key = edge_keys(tail[inner], head[inner], size)
    sorting = np.argsort(key, kind="stable")
    key = key[sorting]
    starts = np.ones(key.size, dtype=bool)
    np.not_equal(key[1:], key[:-1], out=starts[1:])
    first = np.flatnonzero(starts)
    e, m = first.size, inner.size
    halves[:m], offsets[:e], offsets[e] = inner[sorting], first, m
    np.divmod(key[first], max(size, 1), out=(row[:e], column[:e]))
    indptr[0] = 0
    np.cumsum(np.bincount(row[:e], minlength=size) + 1, out=indptr[1:])
    indices[indptr[:-1]] = np.arange(size)
    indices[np.arange(e) + row[:e] + 1] = column[:e]
    at = np.flatnonzero((tail >= 0) != (head >= 0))
    b = at.size
    border[:b], border_row[:b] = at, np.maximum(tail[at], head[at])
    edge, triangle = np.divmod(at, len(F))
    border_fixed[:b] = np.where(tail[at] < 0, F[triangle, edge], F[triangle, (edge + 1) % 3])
    sizes[:] = e, m, b
