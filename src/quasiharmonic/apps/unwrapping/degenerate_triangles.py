"""Degenerate triangles: thin ones are widened, which gives them a shape in the plane; others are excluded.

Thin triangles have three positions on a line, or almost. They stand between a long edge and several short ones. Without
them, the surface would have a slit there. Repeated triangles are excluded, too.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from quasiharmonic.geometry.mesh.reference import flat_triangles, rest_frames
from quasiharmonic.geometry.mesh.topology import edge_keys, find_twins, label_components
from quasiharmonic.util.arrays import BoolArray, FloatArray, IntArray, mark


class WideningTuning(NamedTuple):
    """Numbers that tune which triangles are thin, and how far their vertices move."""

    # A triangle is thin if its height is smaller than this multiple of its longest side: flattening fails for these.
    thin: float = 1e-7
    # It is also thin if its height is smaller than this multiple of the root of the surface's area, which is a few
    # units of the precision of texture coordinates,
    thin_by_area: float = 2.0**-22
    # unless its height is larger than this multiple of its longest side: then the triangle is only small.
    small: float = 1e-3
    # The vertex of a thin triangle moves by about this multiple of the shortest edge there.
    shift: float = 1e-3
    # The new height is at least this multiple of the root of the area, except where the longest side is small.
    shift_by_area: float = 2.0**-17


_TUNING = WideningTuning()


class Widened(NamedTuple):
    """A mesh whose thin triangles have a height.

    Attributes
    ----------
    points : (n, 3) float64
        Positions.
    moved : (n,) bool
        Vertices whose positions have changed.
    thin : (f,) bool
        Triangles that are widened.
    degenerate : (f,) bool
        Triangles that have no area, before or after.
    twice_area : (f,) float64
        Areas before, times two.
    """

    points: FloatArray
    moved: BoolArray
    thin: BoolArray
    degenerate: BoolArray
    twice_area: FloatArray


def widen(points: FloatArray, F: IntArray, dimension: int) -> Widened:
    """Move vertices of thin triangles away from the longest sides.

    A triangle without area is widened only if it joins others: an edge of it and the longest one have exactly one more
    triangle each, and no edge has more.

    Parameters
    ----------
    points : (n, 3) float64
        Positions, at most about 1 in size.
    F : (f, 3) int64
    dimension : int
        If it is 2, vertices stay in the plane of the first two coordinates.
    """
    base, tip = rest_frames(points, F)
    twice_area = base * tip.imag
    sides = np.stack([base, np.abs(tip - base), np.abs(tip)], axis=1)
    flat = (base == 0) | (tip.imag == 0)
    size, longest = np.sqrt(np.abs(twice_area).sum() / 2), sides.max(axis=1)
    thin_height = np.maximum(_TUNING.thin * longest, np.minimum(_TUNING.thin_by_area * size, _TUNING.small * longest))
    thin = flat | (twice_area < thin_height * longest)
    if not thin.any():
        return Widened(points, mark(len(points)), thin, flat, twice_area)
    degenerate = _find_degenerate(points, F, sides, flat)
    thin &= ~degenerate
    rows = np.flatnonzero(thin)
    longest, side = longest[rows], sides[rows].argmax(axis=1)
    # Side k runs from corner k to the next, so the corner before k is opposite.
    start, end, apex = F[rows, side], F[rows, (side + 1) % 3], F[rows, side - 1]
    moved = mark(len(points), apex)
    near = np.flatnonzero(moved[F].any(axis=1) & ~degenerate)
    # More than the height of a thin triangle, so that none is thin afterwards.
    least = np.maximum(
        4 * _TUNING.thin * longest, np.minimum(_TUNING.shift_by_area * size, 4 * _TUNING.small * longest)
    )
    length = np.maximum(_TUNING.shift * _shortest_sides(len(points), F[near], sides[near])[apex], least)
    across = _find_directions(points, F[~thin & ~degenerate], start, end, apex, dimension)
    # Random shifts do not put several vertices on one line again. The seed is fixed, so that results are reproducible.
    points = points.copy()
    points[apex] += across * (length * np.random.default_rng(0).uniform(0.5, 1, rows.size))[:, None]
    degenerate[near[flat_triangles(points, F[near])]] = True
    return Widened(points, moved, thin & ~degenerate, degenerate, twice_area)


def _find_degenerate(points: FloatArray, F: IntArray, sides: FloatArray, flat: BoolArray) -> BoolArray:
    """Return which of the flat triangles (f,) have two corners at one position, or do not join others."""
    degenerate = np.zeros(len(F), dtype=bool)
    some = np.flatnonzero(flat)
    corners = points[F[some]]
    degenerate[some] = (corners == corners[:, (1, 2, 0)]).all(axis=2).any(axis=1)
    proper = flat & ~degenerate
    if proper.any():
        degenerate |= proper & ~_joins(F, sides, proper, ~degenerate)
    return degenerate


def _joins(F: IntArray, sides: FloatArray, flat: BoolArray, present: BoolArray) -> BoolArray:
    """Return for each triangle (f,) whether it is a flat one that joins others."""
    touched = mark(int(F.max()) + 1, F[flat])
    near = np.flatnonzero((touched[F].sum(axis=1) > 1) & present)
    keys = edge_keys(F[near], F[near][:, (1, 2, 0)], touched.size)
    _, edge, count = np.unique(keys, return_inverse=True, return_counts=True)
    count = count[edge].reshape(-1, 3)
    longest = sides[near].argmax(axis=1)
    good = (count == 2).sum(axis=1) > 1
    good &= (count < 3).all(axis=1) & (count[np.arange(near.size), longest] == 2)
    good |= ~flat[near]
    # Flat triangles that are joined only to each other are no surface.
    edge = np.where(good[:, None], edge.reshape(-1, 3), -1).ravel()
    order = np.argsort(edge, kind="stable")
    same = (edge[order[1:]] == edge[order[:-1]]) & (edge[order[1:]] >= 0)
    part = label_components(order[:-1][same] // 3, order[1:][same] // 3, near.size)
    has_area = mark(near.size, part[~flat[near]])
    joins = np.zeros(len(F), dtype=bool)
    joins[near] = good & has_area[part] & flat[near]
    return joins


def _shortest_sides(n: int, F: IntArray, sides: FloatArray) -> FloatArray:
    """Return the length of the shortest side (k, 3) of the triangles at each vertex (n,); inf without triangles."""
    shortest = np.full(n, np.inf)
    for k in range(3):
        np.minimum.at(shortest, F[:, k], np.minimum(sides[:, k], sides[:, k - 1]))
    return shortest


def _find_directions(
    points: FloatArray, ordinary: IntArray, start: IntArray, end: IntArray, apex: IntArray, dimension: int
) -> FloatArray:
    """Return the unit vectors (k, 3) along which the vertices ``apex`` move away from the sides ``start → end``.

    They point away from the ordinary triangle at the longest side, or towards that at another side. They are in the
    plane of this triangle, so that flat faces stay flat.
    """
    across = -_towards_tips(points, ordinary, start, end)
    for one, other in ((end, apex), (apex, start)):
        across = np.where(np.isnan(across), _towards_tips(points, ordinary, one, other), across)
    return np.where(np.isnan(across), _direction_across(points[end] - points[start], dimension), across)


def _towards_tips(points: FloatArray, F: IntArray, start: IntArray, end: IntArray) -> FloatArray:
    """Return unit vectors perpendicular to edges (k,), each to the tip of a triangle of F; NaN where there is none."""
    keys = edge_keys(F, F[:, (1, 2, 0)], len(points)).ravel()
    wanted = edge_keys(start, end, len(points))
    few = np.flatnonzero(np.isin(keys, wanted))
    few = few[np.argsort(keys[few], kind="stable")]
    found = np.isin(wanted, keys[few])
    side = few[np.searchsorted(keys[few], wanted[found])]
    along = points[end[found]] - points[start[found]]
    along /= np.linalg.norm(along, axis=1)[:, None]
    ahead = points[F[side // 3, side % 3 - 1]] - points[start[found]]
    ahead -= (ahead * along).sum(axis=1)[:, None] * along
    towards = np.full((len(wanted), 3), np.nan)
    towards[found] = ahead / np.linalg.norm(ahead, axis=1)[:, None]
    return towards


def _direction_across(along: FloatArray, dimension: int) -> FloatArray:
    """Return unit vectors perpendicular to others (k, 3), which are not zero, in random directions."""
    along = along / np.abs(along).max(axis=1, keepdims=True)
    along /= np.linalg.norm(along, axis=1, keepdims=True)
    if dimension == 2:
        return np.stack([-along[:, 1], along[:, 0], 0 * along[:, 0]], axis=1)
    random = np.random.default_rng(1).normal(size=along.shape)
    across: FloatArray = np.cross(along, random)
    return across / np.linalg.norm(across, axis=1, keepdims=True)


class Exclusion(NamedTuple):
    """Which triangles of a mesh stay, and what replaces the others.

    Attributes
    ----------
    triangles : (f',) int64
        Triangles that stay, ascending.
    excluded : (k,) int64
        The other triangles, ascending.
    repeated : (k,) bool
        Whether the excluded triangle has the vertices of an earlier triangle. The others are degenerate.
    substitutes : (k,) int64
        For each excluded triangle a row of ``triangles``.
    substitute_corners : (k, 3) int64
        For each of its corners the nearest corner, 0 … 2, of that row.
    """

    triangles: IntArray
    excluded: IntArray
    repeated: BoolArray
    substitutes: IntArray
    substitute_corners: IntArray


def exclude(points: FloatArray, F: IntArray, degenerate: BoolArray) -> Exclusion:
    """Exclude degenerate and repeated triangles, and find a substitute for each.

    The substitute of a repeated triangle is the first one with its vertices. That of a degenerate triangle has a common
    edge with it, else a common vertex, else the nearest vertex.

    Parameters
    ----------
    points : (n, 3) float64
    F : (f, 3) int64
        Triangles with equal indices where positions are to be the same.
    degenerate : (f,) bool
        At least one triangle is not degenerate.
    """
    good = np.flatnonzero(~degenerate)
    twin = good[find_twins(F[good])]
    stays = mark(len(F), twin)
    row = np.cumsum(stays) - 1
    substitute = np.full(len(F), -1)
    substitute[good] = row[twin]
    triangles, excluded = np.flatnonzero(stays), np.flatnonzero(~stays)
    flat = np.flatnonzero(degenerate)
    if flat.size:
        substitute[flat] = _find_neighbours(points, F[triangles], F[flat])
    substitutes = substitute[excluded]
    return Exclusion(
        triangles,
        excluded,
        ~degenerate[excluded],
        substitutes,
        _match_corners(points, F[excluded], F[triangles[substitutes]]),
    )


def _find_neighbours(points: FloatArray, F: IntArray, flat: IntArray) -> IntArray:
    """Return the row of F that is nearest to each of the degenerate triangles (k, 3)."""
    n = len(points)
    touched = mark(n, flat)
    touches = touched[F]
    row_of_vertex = np.full(n, -1)
    rows, corner = np.nonzero(touches)
    # Of several rows, the first one counts.
    row_of_vertex[F[rows[::-1], corner[::-1]]] = rows[::-1]
    around = row_of_vertex[flat]
    neighbour = around.max(axis=1)

    rows = np.flatnonzero(touches.sum(axis=1) > 1)
    keys = edge_keys(F[rows], np.roll(F[rows], -1, axis=1), n).ravel()
    order = np.argsort(keys, kind="stable")
    wanted = edge_keys(flat, np.roll(flat, -1, axis=1), n)
    at = np.searchsorted(keys[order], wanted)
    found = at < keys.size
    found[found] = keys[order[at[found]]] == wanted[found]
    by_edge, side = np.nonzero(found)
    neighbour[by_edge] = rows[order[at[by_edge, side]] // 3]

    alone = np.flatnonzero(neighbour < 0)
    if alone.size:
        from scipy.spatial import KDTree

        distance, corner_number = KDTree(points[F].reshape(-1, points.shape[1])).query(points[flat[alone]])
        neighbour[alone] = corner_number[np.arange(alone.size), distance.argmin(axis=1)] // 3
    return neighbour


def _match_corners(points: FloatArray, F: IntArray, substitutes: IntArray) -> IntArray:
    """Return for each corner of F (k, 3) the nearest corner, 0 … 2, of its substitute (k, 3)."""
    apart = points[F][:, :, None] - points[substitutes][:, None]
    return np.where(F[:, :, None] == substitutes[:, None], -1.0, (apart**2).sum(axis=3)).argmin(axis=2)
