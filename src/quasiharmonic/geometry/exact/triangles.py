"""All triangles of a mesh at once: which way they turn, and how often they wind around a vertex, decided exactly."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from quasiharmonic.geometry.exact.predicates import orientation_or_nonfinite, sure_orientation
from quasiharmonic.util.arrays import BoolArray, FloatArray, IntArray, check_range
from quasiharmonic.util.kernels import compiled

SignArray = NDArray[np.int8]

# Triangles judged at a time: bounds the memory, and is large enough for the overhead not to show.
TRIANGLE_CHUNK = 1 << 16


def triangle_signs(F: IntArray, uv: FloatArray) -> tuple[SignArray, IntArray]:
    """Decide the orientations of triangles (f, 3) int64 among places (n, 2) float64, both contiguous, exactly.

    Returns
    -------
    sign : (f,) int8
        1 for counterclockwise, -1 for clockwise, 0 for no area or a coordinate that is NaN or infinite.
    nonfinite : (m,) int64
        Ascending indices of the triangles with such a coordinate.

    Raises
    ------
    ValueError
        When ``F`` names vertices that are not there.
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
    """Fill in orientations (f,), 0 where floating point is not sure; how many of these, -1 for ``F`` out of range."""
    if F.size and (F.min() < 0 or F.max() >= len(uv)):
        return -1
    for start in range(0, len(F), TRIANGLE_CHUNK):
        chunk = slice(start, start + TRIANGLE_CHUNK)
        corners = uv.take(F[chunk], axis=0)
        sign[chunk] = sure_orientation(corners[:, 0], corners[:, 1], corners[:, 2])
    return sign.size - int(np.count_nonzero(sign))


def overwound_vertices(F: IntArray, uv: FloatArray, sign: SignArray, loops: list[IntArray]) -> IntArray:
    """Find the vertices, all triangles around them positive, whose angles add up to more than 2π, exactly.

    Parameters
    ----------
    F : (f, 3) int64
    uv : (n, 2) float64
    sign : (f,) int8
        Orientations, as `triangle_signs` has them.
    loops : list of (l,) int64
        The boundary loops, the surface to their left.

    Returns
    -------
    (k,) int64
        Ascending.

    Notes
    -----
    Around a vertex the angles add up to ``2π t`` where it is interior, and to ``2π t + φ₁ − φ₀`` where it is on the
    boundary: t is how often triangles pass the direction of the x axis (`count_turns`), φ₀ and φ₁, from 0 to below 2π,
    are the directions of the edges to the next vertex of the loop and to the last one, where the fan begins and ends.
    So at the boundary they add up to more than 2π if t is 2 or more, or t is 1 and φ₁ > φ₀.
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
    """Whether the direction from a centre to one place is smaller than to another, as angles from 0 to below 2π."""
    lower_one, lower_other = (
        (to[:, 1] < centre[:, 1]) | ((to[:, 1] == centre[:, 1]) & (to[:, 0] < centre[:, 0])) for to in (one, other)
    )
    turn, _ = orientation_or_nonfinite(centre, one, other)
    return np.where(lower_one == lower_other, turn > 0, lower_other)


@compiled
def count_turns(F: IntArray, uv: FloatArray, turns: IntArray) -> None:
    """Add to every vertex (n,) how often the triangles around it wind around it, if they are positive.

    Positive triangles turn counterclockwise around their vertex by less than half a turn each, so one
    of them passes the direction of the x axis exactly if its next corner lies below the vertex and
    its last does not; as many do as there are turns.
    """
    y = uv[:, 1].copy()
    for start in range(0, len(F), TRIANGLE_CHUNK):
        chunk = F[start : start + TRIANGLE_CHUNK]
        level = y.take(chunk)
        for corner, following, last in ((0, 1, 2), (1, 2, 0), (2, 0, 1)):
            passing = (level[:, following] < level[:, corner]) & (level[:, last] >= level[:, corner])
            np.add.at(turns, chunk[:, corner].compress(passing), 1)
