"""Exact tests of triangles and polygons in the plane: orientation, winding around vertices, overlaps, convexity."""

from __future__ import annotations

import numpy as np

from quasiharmonic.geometry.exact.box_pairs import box_pairs
from quasiharmonic.geometry.exact.predicates import orientation, orientation_or_nonfinite, sure_orientation
from quasiharmonic.geometry.mesh.polygons import Polygons
from quasiharmonic.util.arrays import BoolArray, FloatArray, IntArray, SignArray, check_range, morton_order, repeat_each
from quasiharmonic.util.kernels import compiled
from quasiharmonic.util.progress import heartbeat

# Triangles per block: bounds the memory, and is large enough to hide the overhead of a block.
TRIANGLE_CHUNK = 1 << 16


def triangle_signs(F: IntArray, uv: FloatArray) -> tuple[SignArray, IntArray]:
    """Exact orientations (f,) int8 of triangles, and the ascending indices of those with a non-finite coordinate.

    An orientation is 1 if counterclockwise, -1 if clockwise, 0 if the area is zero or a coordinate is not finite.
    Raises a ValueError if ``F`` refers to vertices that do not exist.
    """
    F, uv = np.ascontiguousarray(F), np.ascontiguousarray(uv)
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


def find_multiply_wound(F: IntArray, uv: FloatArray, sign: SignArray, loops: list[IntArray]) -> IntArray:
    """Find the vertices with only positive triangles around them whose angles add up to more than 2π, exactly.

    ``sign`` (f,) are the orientations, as returned by `triangle_signs`; ``loops`` have the surface to their left.

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
    boundary = np.concatenate(loops)
    wound_once = turns[boundary] == 1
    here, begin, end = (
        boundary[wound_once],
        *(np.concatenate([np.roll(loop, by) for loop in loops])[wound_once] for by in (-1, 1)),
    )
    turns[here[_has_smaller_angle(uv[here], uv[begin], uv[end])]] = 2
    return np.flatnonzero(turns > 1)


def _has_smaller_angle(centre: FloatArray, one: FloatArray, other: FloatArray) -> BoolArray:
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


def find_overlapping(F: IntArray, uv: FloatArray) -> IntArray:
    """Find the triangles that overlap another one with positive area, (k,) int64 ascending; all are counterclockwise.

    Two convex sets have no common area if and only if a line separates them. For two triangles, the line through a
    side of one of them then does. Triangles that only touch do not count.

    Examples
    --------
    >>> uv = np.array([[0.0, 0.0], [1.0, 0.0], [0.0, 1.0], [0.3, 0.3], [1.0, 1.0]])
    >>> find_overlapping(np.array([[0, 1, 2], [1, 4, 2], [3, 4, 2]]), uv).tolist()
    [0, 1, 2]
    """
    found = np.zeros(len(F), dtype=np.bool_)
    # Trees of boxes are tight only if consecutive triangles are close to each other.
    order = morton_order(uv[F[:, 0]])
    corners = uv[F[order]]
    for i, j in box_pairs(corners.min(axis=1), corners.max(axis=1)):
        heartbeat()
        one, other = corners[i], corners[j]
        apart = _is_separated_by_side(one, other)
        apart[~apart] = _is_separated_by_side(other[~apart], one[~apart])
        found[order[i[~apart]]] = found[order[j[~apart]]] = True
    return np.flatnonzero(found)


def _is_separated_by_side(one: FloatArray, other: FloatArray) -> BoolArray:
    """Whether the second triangle of each pair (k, 3, 2) lies to the right of a side of the first, or on it."""
    tail, head = one[:, :, None], one[:, (1, 2, 0), None]
    right = np.asarray(orientation(tail, head, other[:, None]) <= 0)
    return np.asarray(np.any(np.all(right, axis=2), axis=1))


def find_concave(polygons: Polygons, F: IntArray, uv: FloatArray) -> IntArray:
    """Find polygons that are not strictly convex or not counterclockwise, (k,) int64 ascending.

    A polygon is strictly convex and winds once if and only if two conditions hold. It turns left at every corner, and
    every edge lies to the left as seen from the first corner. The second condition excludes polygons that wind several
    times. Then all triangulations of the polygon have only positive triangles.
    """
    ring = F.ravel()[polygons.corners]
    face = repeat_each(np.arange(len(polygons)), polygons.sizes)
    first, last = polygons.starts[:-1][face], polygons.starts[1:][face] - 1
    at = np.arange(len(ring))
    ahead = np.where(at == last, first, at + 1)
    behind = np.where(at == first, last, at - 1)
    turns = orientation_or_nonfinite(uv[ring[behind]], uv[ring], uv[ring[ahead]])[0] > 0
    # Fan triangles from the first corner. The two that contain it twice are no triangles and count as positive.
    fan = orientation_or_nonfinite(uv[ring[first]], uv[ring], uv[ring[ahead]])[0] > 0
    fan |= (at == first) | (at == last)
    return np.unique(face[~(turns & fan)])


def find_inverted_fans(polygons: Polygons, F: IntArray, uv: FloatArray) -> IntArray:
    """Find polygons that get an inverted or degenerate triangle if they are split at their first corner, ascending.

    A triangle is inverted if its orientation differs from that of the polygon's own triangles.
    """
    ring = F.ravel()[polygons.corners]
    face = repeat_each(np.arange(len(polygons)), polygons.sizes)
    inner = np.ones(len(ring), dtype=bool)
    inner[polygons.starts[:-1]] = inner[polygons.starts[1:] - 1] = False
    at = np.flatnonzero(inner)
    own = np.zeros(len(polygons), dtype=np.int64)
    own[polygons.of_triangle] = orientation_or_nonfinite(*uv[F].swapaxes(0, 1))[0]
    fan = orientation_or_nonfinite(uv[ring[polygons.starts[:-1]][face[at]]], uv[ring[at]], uv[ring[at + 1]])[0]
    return np.unique(face[at[fan != own[face[at]]]])
