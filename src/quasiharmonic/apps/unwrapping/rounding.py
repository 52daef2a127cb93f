"""Round positions to a grid and keep all triangles positive where the grid allows it."""

from __future__ import annotations

import numpy as np

from quasiharmonic.util.arrays import FloatArray, IntArray
from quasiharmonic.util.progress import heartbeat

# Positions in the unit square are multiples of this unit. Single precision stores these numbers and their differences
# from 1 exactly.
_UNIT = 2.0**-24
# A vertex moves by at most this number of units along each axis at a time.
_REACH = 2
# Maximum number of passes over the triangles that are not positive.
_PASSES = 8
# More triangles than this are not repaired: the surface is too large for the grid.
_MOST = 100_000


def round_positions(F: IntArray, uv: FloatArray) -> FloatArray:
    """Round positions to multiples of a power of two that single precision stores, also if v is replaced by 1 − v.

    Rounding can invert extremely thin triangles. Their vertices then move by a few units, if all triangles around them
    become positive.

    Parameters
    ----------
    F : (k, 3) int64
        Triangles, positive before rounding.
    uv : (n, 2) float64
        Positions in the unit square, or in the squares of several tiles.

    Returns
    -------
    (n, 2) float64
    """
    unit = grid_unit(uv)
    grid = np.rint(uv / unit).astype(np.int64)
    for _ in range(_PASSES):
        wrong = np.flatnonzero(_twice_areas(grid[F]) <= 0)
        if not 0 < wrong.size <= _MOST or not _repair(F, grid, wrong):
            break
    rounded: FloatArray = grid.astype(np.float64) * unit
    return rounded


def grid_unit(uv: FloatArray) -> float:
    """Return the unit of which `round_positions` makes positions (n, 2) multiples."""
    # Numbers beyond 1 need a larger unit.
    return _UNIT * 2.0 ** int(np.ceil(np.log2(np.abs(uv).max(initial=1.0))))


def _repair(F: IntArray, grid: IntArray, wrong: IntArray) -> bool:
    """Move vertices of triangles that are not positive; return whether a vertex moved."""
    moved = False
    steps = np.stack(np.meshgrid(*[np.arange(-_REACH, _REACH + 1)] * 2), axis=2).reshape(-1, 2)
    steps = steps[np.argsort((steps**2).sum(axis=1), kind="stable")]
    incident = _Incidence(F, np.unique(F[wrong]))
    for triangle in wrong.tolist():
        heartbeat()
        best, move = 0, None
        for vertex in F[triangle].tolist():
            if _twice_areas(grid[F[triangle]]) > 0:
                break
            around = incident.around(vertex)
            corners = np.repeat(grid[F[around]][None], len(steps), axis=0)
            here = np.broadcast_to(F[around] == vertex, corners.shape[:3])
            corners[here] += np.repeat(steps, here[0].sum(), axis=0)
            left = np.count_nonzero(_twice_areas(corners) <= 0, axis=1)
            choice = int(np.argmin(left))
            if left[0] - left[choice] > best:
                best, move = int(left[0] - left[choice]), (vertex, steps[choice])
        if move is not None:
            grid[move[0]] += move[1]
            moved = True
    return moved


class _Incidence:
    """The triangles around some vertices (m,), ascending."""

    def __init__(self, F: IntArray, vertices: IntArray) -> None:
        corner = np.flatnonzero(np.isin(F, vertices))
        corner = corner[np.argsort(F.ravel()[corner], kind="stable")]
        self._triangle, self._vertex = corner // 3, F.ravel()[corner]

    def around(self, vertex: int) -> IntArray:
        """Return the triangles around a vertex."""
        begin, end = np.searchsorted(self._vertex, [vertex, vertex + 1])
        return self._triangle[begin:end]


def _twice_areas(corners: IntArray) -> IntArray:
    """Return twice the signed areas (...) of triangles (..., 3, 2) with integer positions, exactly."""
    a, b = corners[..., 1, :] - corners[..., 0, :], corners[..., 2, :] - corners[..., 0, :]
    twice: IntArray = a[..., 0] * b[..., 1] - a[..., 1] * b[..., 0]
    return twice
