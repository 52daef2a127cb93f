"""Exact orientation of the triangles of a mesh, and exact winding around vertices."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from quasiharmonic.geometry.exact.predicates import orientation_or_nonfinite, sure_orientation
from quasiharmonic.util.arrays import BoolArray, FloatArray, IntArray, check_range
from quasiharmonic.util.kernels import compiled

SignArray = NDArray[np.int8]

# Triangles per block: bounds the memory, and is large enough to hide the overhead of a block.
TRIANGLE_CHUNK = 1 << 16


def triangle_signs(F: IntArray, uv: FloatArray) -> tuple[SignArray, IntArray]:
    """Exact orientations of triangles (f, 3) int64 with positions (n, 2) float64; both arrays are contiguous.

    Returns
    -------
    sign : (f,) int8
        1 if counterclockwise, -1 if clockwise, 0 if the area is zero or a coordinate is NaN or infinite.
    nonfinite : (m,) int64
        Ascending indices of the triangles with a NaN or infinite coordinate.

    Raises
    ------
    ValueError
        If ``F`` refers to vertices that do not exist.
    """
    sign, nonfinite = np.empty(len(F), dtype=np.int8), np.empty(0, dtype=np.int64)
    number = sure_signs(F, uv, sign)
    if number < 0:
        check_range("F", F, len(uv))
    if number:
        open_ = np.flatnonzero(sign == 0)
        found = [nonfinite]
        for start in range(0, open_.size, TRIANGLE_CHUNK):
            chunk = open_[start : start + TRIANGLE_CHUNK]
            corners = uv.take(F.take(chunk, axis=0), axis=0)
            sign[chunk], undefined = orientation_or_nonfinite(corners[:, 0], corners[:, 1], corners[:, 2])
            found.append(chunk[undefined])
        nonfinite = np.concatenate(found)
    return sign, nonfinite


@compiled
def sure_signs(F: IntArray, uv: FloatArray, sign: SignArray) -> int:
    """Fill in orientations (f,), 0 if floating point cannot decide; return the number of 0, -1 if F is out of range."""
    if F.size and (F.min() < 0 or F.max() >= len(uv)):
        return -1
    for start in range(0, len(F), TRIANGLE_CHUNK):
        chunk = slice(start, start + TRIANGLE_CHUNK)
        corners = uv.take(F[chunk], axis=0)
        sign[chunk] = sure_orientation(corners[:, 0], corners[:, 1], corners[:, 2])
    return sign.size - int(np.count_nonzero(sign))


def overwound_vertices(F: IntArray, uv: FloatArray, sign: SignArray, loops: list[IntArray]) -> IntArray:
    """Find the vertices with only positive triangles around them whose angles add up to more than 2π, exactly.

    Parameters
    ----------
    F : (f, 3) int64
    uv : (n, 2) float64
    sign : (f,) int8
        Orientations, as returned by `triangle_signs`.
    loops : list of (l,) int64
        The boundary loops, the surface to their left.

    Returns
    -------
    (k,) int64
        Ascending indices.

    Notes
    -----
    The angles around an interior vertex add up to ``2π t``, and around a boundary vertex to ``2π t + φ₁ − φ₀``. Here t
    is the number of triangles that contain the direction of the x axis (`count_turns`). φ₀ and φ₁ in [0, 2π) are the
    directions to the next and to the previous vertex of the loop, where the fan begins and ends. So at the boundary the
    sum exceeds 2π if t is at least 2, or if t is 1 and φ₁ > φ₀.
    """
    turns = np.zeros(len(uv), dtype=np.int64)
    count_turns(F, uv, turns)
    turns[F[sign <= 0]] = 0
    rim = np.concatenate(loops)
    once = turns[rim] == 1
    here, begin, end = rim[once], *(np.concatenate([np.roll(loop, by) for loop in loops])[once] for by in (-1, 1))
    turns[here[_comes_before(uv[here], uv[begin], uv[end])]] = 2
    return np.flatnonzero(turns > 1)


def _comes_before(centre: FloatArray, one: FloatArray, other: FloatArray) -> BoolArray:
    """Whether the direction from a centre to ``one`` has a smaller angle in [0, 2π) than the direction to ``other``."""
    lower_one, lower_other = (
        (to[:, 1] < centre[:, 1]) | ((to[:, 1] == centre[:, 1]) & (to[:, 0] < centre[:, 0])) for to in (one, other)
    )
    turn, _ = orientation_or_nonfinite(centre, one, other)
    return np.where(lower_one == lower_other, turn > 0, lower_other)


@compiled
def count_turns(F: IntArray, uv: FloatArray, turns: IntArray) -> None:
    """Add to every vertex (n,) the winding number of its triangles, provided that they are positive.

    A positive triangle spans an angle of less than π at its vertex. It contains the direction of the x axis
    if and only if its next corner lies below the vertex and its last corner does not. The number of such
    triangles is the winding number.
    """
    y = uv[:, 1].copy()
    for start in range(0, len(F), TRIANGLE_CHUNK):
        chunk = F[start : start + TRIANGLE_CHUNK]
        level = y.take(chunk)
        for corner, following, last in ((0, 1, 2), (1, 2, 0), (2, 0, 1)):
            passing = (level[:, following] < level[:, corner]) & (level[:, last] >= level[:, corner])
            np.add.at(turns, chunk[:, corner].compress(passing), 1)
