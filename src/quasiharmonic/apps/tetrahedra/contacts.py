"""Exact search for triangles in space that meet outside their common vertices and edges.

Candidates are pairs of triangles whose boxes meet. For two triangles there are three cases:

- Two common vertices. They meet elsewhere only if they lie in a plane, on the same side of the common edge.
- One common vertex. They meet elsewhere if and only if the edge of one that is opposite the vertex meets the other:
  a ray from the vertex in both triangles leaves one of them there.
- No common vertex. They meet if and only if an edge of one meets the other.

Pairs in a common plane are decided in a projection in which the plane does not become a line.

Winding numbers of closed surfaces are exact too, on both sides of their triangles. A line parallel to an axis passes
through a chosen point of a triangle. The triangles that it crosses, in order, give the winding number between them,
which is 0 far outside. All numbers are rational, so the result is exact.
"""

from __future__ import annotations

from collections.abc import Iterator
from fractions import Fraction
from typing import NamedTuple

import numpy as np

from quasiharmonic.apps.tetrahedra.elements import ExactSigns, SignArray
from quasiharmonic.geometry.exact.box_pairs import box_pairs, box_pairs_between
from quasiharmonic.geometry.exact.predicates import orientation
from quasiharmonic.util.arrays import BoolArray, FloatArray, IntArray, morton_order
from quasiharmonic.util.progress import heartbeat

#: Maximum number of pairs of triangles that are found.
MAX_LISTED = 1000
_SIDES = ((0, 1), (1, 2), (2, 0))
# Weights of the corners for a point in a triangle: primes, so that lines through it rarely meet an edge.
_WEIGHTS = ((101, 211, 307), (503, 229, 97), (13, 29, 911), (331, 17, 659), (1009, 2003, 31), (7, 5, 11))
_AXES = ((0, 1, 2), (1, 2, 0), (2, 0, 1))


def find_contacts(F: IntArray, X: FloatArray, signs: ExactSigns) -> IntArray:
    """Find pairs (k, 2) of non-degenerate triangles (f, 3) that meet outside their common vertices and edges.

    The search ends after `MAX_LISTED` pairs.
    """
    corners = X[F]
    lo, hi = corners.min(axis=1), corners.max(axis=1)
    order = morton_order(0.5 * lo + 0.5 * hi)
    found, count = [np.empty((0, 2), dtype=np.int64)], 0
    for i, j in box_pairs(lo[order], hi[order]):
        heartbeat()
        one, other = order[i], order[j]
        meet = _triangles_meet(F[one], F[other], X, signs)
        found.append(np.sort(np.stack([one[meet], other[meet]], axis=1), axis=1))
        count += int(np.count_nonzero(meet))
        if count >= MAX_LISTED:
            break
    pairs = np.concatenate(found)[:MAX_LISTED]
    return pairs[np.lexsort(pairs.T[::-1])]


def edges_meeting_triangles(edges: IntArray, F: IntArray, X: FloatArray) -> IntArray:
    """Find pairs (k, 2) of edges and non-degenerate triangles that meet outside their common vertices."""
    ends, corners = X[edges], X[F]
    order, other_order = morton_order(0.5 * ends.sum(axis=1)), morton_order(corners.mean(axis=1))
    boxes = (
        (part[place].min(axis=1), part[place].max(axis=1)) for part, place in ((ends, order), (corners, other_order))
    )
    signs = ExactSigns(X)
    found = [np.empty((0, 2), dtype=np.int64)]
    for i, j in box_pairs_between(*(box for pair in boxes for box in pair)):
        heartbeat()
        edge, triangle = order[i], other_order[j]
        one, other = edges[edge], F[triangle]
        # From a common vertex, an edge meets the triangle again only if it lies in its plane.
        common = (one[:, :, None] == other[:, None, :]).any(axis=2)
        side = _plane_signs(other, one, signs)
        meet = np.zeros(len(one), dtype=np.bool_)
        apart = np.flatnonzero(~common.any(axis=1) & (side[:, 0] * side[:, 1] <= 0))
        meet[apart] = _edge_meets(one[apart], other[apart], side[apart, 0], side[apart, 1], X, signs)
        touching = np.flatnonzero((common.sum(axis=1) == 1) & (side == 0).all(axis=1))
        if touching.size:
            meet[touching] = _starts_inside(one[touching], other[touching], common[touching, 1], X)
        found.append(np.stack([edge[meet], triangle[meet]], axis=1))
    return np.concatenate(found)


def _starts_inside(edge: IntArray, F: IntArray, second: BoolArray, X: FloatArray) -> BoolArray:
    """Whether edges (k, 2) in the planes of triangles (k, 3) start into them from a common vertex."""
    edge = np.where(second[:, None], edge[:, ::-1], edge)
    place = np.argmax(edge[:, :1] == F, axis=1)
    F = np.take_along_axis(F, (place[:, None] + np.arange(3)) % 3, axis=1)
    axes, turn = _project(F, X)
    f, end = _flatten(F, axes, X), _flatten(edge[:, 1:], axes, X)[:, 0]
    one = orientation(f[:, 0], f[:, 1], end) * turn
    other = orientation(f[:, 0], end, f[:, 2]) * turn
    return np.asarray((one >= 0) & (other >= 0))


def _triangles_meet(F: IntArray, G: IntArray, X: FloatArray, signs: ExactSigns) -> BoolArray:
    """Whether pairs of triangles (k, 3) meet outside their common vertices and edges."""
    same = F[:, :, None] == G[:, None, :]
    shared = same.sum(axis=(1, 2))
    meet = np.zeros(len(F), dtype=np.bool_)
    for count in range(3):
        some = np.flatnonzero(shared == count)
        if some.size:
            one, other = _align(F[some], G[some], same[some], count)
            meet[some] = _aligned_triangles_meet(one, other, count, X, signs)
    return meet


def _align(F: IntArray, G: IntArray, same: BoolArray, count: int) -> tuple[IntArray, IntArray]:
    """Order the vertices of triangles such that common ones come first, in the same order."""
    if not count:
        return F, G
    order = np.argsort(~same.any(axis=2), axis=1, kind="stable")
    F = np.take_along_axis(F, order, axis=1)
    equal = F[:, :count, None] == G[:, None, :]
    place = np.argmax(equal, axis=2)
    rest = np.argsort(equal.any(axis=1), axis=1, kind="stable")[:, : 3 - count]
    return F, np.take_along_axis(G, np.concatenate([place, rest], axis=1), axis=1)


def _aligned_triangles_meet(F: IntArray, G: IntArray, count: int, X: FloatArray, signs: ExactSigns) -> BoolArray:
    """`_triangles_meet` for triangles whose first ``count`` vertices are the same."""
    meet = np.zeros(len(F), dtype=np.bool_)
    # Signs of the other vertices of G relative to the plane of F. If all are on one side, the triangles do not meet.
    of_g = _plane_signs(F, G[:, count:], signs)
    some = np.flatnonzero(~(np.all(of_g > 0, axis=1) | np.all(of_g < 0, axis=1)))
    F, G, of_g = F[some], G[some], of_g[some]
    flat = np.all(of_g == 0, axis=1)
    if flat.any():
        meet[some[flat]] = _coplanar_triangles_meet(F[flat], G[flat], count, X)
    if count == 2 or flat.all():
        return meet
    some, F, G, of_g = some[~flat], F[~flat], G[~flat], of_g[~flat]
    of_f = _plane_signs(G, F[:, count:], signs)
    near = ~(np.all(of_f > 0, axis=1) | np.all(of_f < 0, axis=1))
    if not near.any():
        return meet
    some, F, G, of_f, of_g = some[near], F[near], G[near], of_f[near], of_g[near]
    for one, other, sign in ((F, G, of_f), (G, F, of_g)):
        for p, q in _SIDES if not count else ((0, 1),):
            edge = one[:, (p + count, q + count)]
            meet[some] |= _edge_meets(edge, other, sign[:, p], sign[:, q], X, signs)
    return meet


def _plane_signs(F: IntArray, points: IntArray, signs: ExactSigns) -> SignArray:
    """The side of the plane of each triangle (k, 3) on which points (k, m) lie; (k, m) int8."""
    m = points.shape[1]
    corners = np.concatenate([np.repeat(F, m, axis=0), points.reshape(-1, 1)], axis=1)
    return signs(corners).reshape(-1, m)


def _edge_meets(
    edge: IntArray, F: IntArray, p_side: SignArray, q_side: SignArray, X: FloatArray, signs: ExactSigns
) -> BoolArray:
    """Whether closed edges (k, 2) meet closed triangles (k, 3), given on which sides of the planes their ends lie."""
    meet = np.zeros(len(edge), dtype=np.bool_)
    flat = (p_side == 0) & (q_side == 0)
    if flat.any():
        meet[flat] = ~_apart_in_plane(edge[flat], F[flat], X)
    through = np.flatnonzero((p_side * q_side <= 0) & ~flat)
    if through.size:
        turns = np.stack([signs(np.concatenate([edge[through], F[through][:, side]], axis=1)) for side in _SIDES])
        meet[through] = np.all(turns >= 0, axis=0) | np.all(turns <= 0, axis=0)
    return meet


def _project(F: IntArray, X: FloatArray) -> tuple[IntArray, FloatArray]:
    """Return two axes for each triangle (k, 3) whose projection has an area, and the orientation of the projection."""
    axes, turn = np.zeros((len(F), 2), dtype=np.int64), np.zeros(len(F))
    left = np.arange(len(F))
    for pair in _SIDES:
        a, b, c = X[F[left]][:, :, pair].transpose(1, 0, 2)
        sign = orientation(a, b, c)
        axes[left], turn[left] = pair, sign
        left = left[sign == 0]
        if not left.size:
            break
    return axes, turn


def _flatten(points: IntArray, axes: IntArray, X: FloatArray) -> FloatArray:
    """Project points (k, m) to two axes each; (k, m, 2)."""
    return np.take_along_axis(X[points], axes[:, None, :], axis=2)


def _coplanar_triangles_meet(F: IntArray, G: IntArray, count: int, X: FloatArray) -> BoolArray:
    """`_aligned_triangles_meet` for triangles in common planes."""
    axes, turn = _project(F, X)
    f, g = _flatten(F, axes, X), _flatten(G, axes, X)
    other_turn = orientation(g[:, 0], g[:, 1], g[:, 2])
    if count == 2:
        return other_turn == turn
    for one, sign in ((f, turn), (g, other_turn)):
        one[sign < 0] = one[sign < 0][:, (0, 2, 1)]
    if count == 0:
        return ~(_is_separated(f, g) | _is_separated(g, f))
    inside = np.zeros(len(F), dtype=np.bool_)
    for one, other in ((f, g), (g, f)):
        for k in (1, 2):
            left = orientation(one[:, 0], one[:, 1], other[:, k]) >= 0
            inside |= left & (orientation(one[:, 0], other[:, k], one[:, 2]) >= 0)
    return inside


def _is_separated(one: FloatArray, other: FloatArray) -> BoolArray:
    """Whether the second polygon lies strictly to the right of a side of the first, counterclockwise one; (k, m, 2)."""
    apart = np.zeros(len(one), dtype=np.bool_)
    m = one.shape[1]
    for k in range(m):
        tail, head = one[:, k, None], one[:, (k + 1) % m, None]
        apart |= np.all(orientation(tail, head, other) < 0, axis=1)
    return apart


def _apart_in_plane(edge: IntArray, F: IntArray, X: FloatArray) -> BoolArray:
    """Whether closed edges (k, 2) and closed triangles (k, 3) in common planes do not meet."""
    axes, turn = _project(F, X)
    f, segment = _flatten(F, axes, X), _flatten(edge, axes, X)
    f[turn < 0] = f[turn < 0][:, (0, 2, 1)]
    return _is_separated(f, segment) | _is_separated(segment, f)


def outer_winding(F: IntArray, X: FloatArray, patches: IntArray) -> IntArray:
    """Return the winding number on the outer side of each patch of a surface; (p,) int64.

    ``F`` (f, 3) are oriented triangles that meet only in common vertices and edges, and every edge has as many
    triangles on one side as on the other. ``patches`` (f,) has numbers from 0; the winding number is the same along a
    patch.
    """
    count = int(patches.max(initial=-1)) + 1
    result = np.zeros(count, dtype=np.int64)
    known = np.zeros(count, dtype=np.bool_)
    boxes = _Boxes(X[F], X[F].min(axis=1), X[F].max(axis=1))
    order = np.argsort(patches, kind="stable")
    starts = np.searchsorted(patches[order], np.arange(count))
    for patch in range(count):
        heartbeat()
        if known[patch]:
            continue
        stop = starts[patch + 1] if patch + 1 < count else len(order)
        for triangle, outside in _first_line(boxes, order[starts[patch] : stop]):
            own = patches[triangle]
            result[own], known[own] = outside, True
    return result


class _Boxes(NamedTuple):
    """Triangles (f, 3, 3) and the corners (f, 3) of their boxes."""

    corners: FloatArray
    lo: FloatArray
    hi: FloatArray


class _Line(NamedTuple):
    """A line along ``axes[2]`` through the point of a triangle that weights of its corners define."""

    triangle: int
    weights: tuple[int, int, int]
    axes: tuple[int, int, int]


def _first_line(boxes: _Boxes, triangles: IntArray) -> list[tuple[int, int]]:
    """Return the crossings of a line through one of some triangles: the triangle, and the winding number outside."""
    for line in _list_lines(triangles):
        found = _find_line_crossings(boxes, line)
        if found is not None:
            return found
    raise AssertionError("every line through the surface meets an edge")


def _list_lines(triangles: IntArray) -> Iterator[_Line]:
    for weights in _WEIGHTS:
        for triangle in triangles[:: max(len(triangles) // 20, 1)].tolist():
            for axes in _AXES:
                yield _Line(triangle, weights, axes)
    for k in range(1, 10000):
        yield _Line(int(triangles[k % len(triangles)]), (k * k + 1, 7 * k + 3, 5 * k + 2), _AXES[k % 3])


def _find_line_crossings(boxes: _Boxes, line: _Line) -> list[tuple[int, int]] | None:
    """Crossings of a line; None if it meets an edge of a triangle."""
    (corners, lo, hi), (triangle, weights, axes) = boxes, line
    total = sum(weights)
    own = _to_fractions(corners[triangle])
    q = [sum(w * p[a] for w, p in zip(weights, own, strict=True)) / total for a in axes[:2]]
    near = np.ones(len(corners), dtype=np.bool_)
    for value, a in zip(q, axes[:2], strict=True):
        below, above = np.nextafter(float(value), -np.inf), np.nextafter(float(value), np.inf)
        near &= (lo[:, a] <= above) & (hi[:, a] >= below)
    found = []
    for k in np.flatnonzero(near).tolist():
        p = _to_fractions(corners[k])
        flat = [(point[axes[0]] - q[0], point[axes[1]] - q[1]) for point in p]
        areas = [flat[i][0] * flat[j][1] - flat[i][1] * flat[j][0] for i, j in ((1, 2), (2, 0), (0, 1))]
        if all(area > 0 for area in areas) or all(area < 0 for area in areas):
            height = sum(area * point[axes[2]] for area, point in zip(areas, p, strict=True)) / sum(areas)
            found.append((height, 1 if areas[0] > 0 else -1, k))
        elif not (any(area > 0 for area in areas) and any(area < 0 for area in areas)):
            return None
    # From far along the axis, a triangle that faces there is entered from outside.
    found.sort(key=lambda crossing: -crossing[0])
    winding, result = 0, []
    for _, facing, k in found:
        result.append((k, winding if facing > 0 else winding - 1))
        winding += facing
    return result


def _to_fractions(points: FloatArray) -> list[list[Fraction]]:
    return [[Fraction(value) for value in point] for point in points.tolist()]
