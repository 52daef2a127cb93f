"""Widening: triangles with three positions on a line, or almost, get a height and so a shape in the plane.

Such triangles stand between a long edge and several short ones. Without them, the surface would have a slit there.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from quasiharmonic.geometry.mesh.reference import flat_triangles, rest_frames
from quasiharmonic.geometry.mesh.topology import edge_keys, label_components
from quasiharmonic.util.arrays import BoolArray, FloatArray, IntArray, mark

# A triangle is thin if its height is smaller than this multiple of its longest side, which flattening cannot cope with,
# or of the root of the surface's area, which is a few units of the precision of texture coordinates.
_THIN, _LOW = 1e-7, 2.0**-22
# Its vertex moves by about this multiple of the shortest edge there. The new height is at least this multiple of the
# root of the area, except where the longest side is small.
_SHIFT, _HIGH = 1e-3, 2.0**-17
# Triangles with a larger height, relative to their longest side, are small and not thin.
_SMALL = 1e-3


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
    area : (f,) float64
        Areas before, times two.
    """

    points: FloatArray
    moved: BoolArray
    thin: BoolArray
    degenerate: BoolArray
    area: FloatArray


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
    area = base * tip.imag
    sides = np.stack([base, np.abs(tip - base), np.abs(tip)], axis=1)
    flat = (base == 0) | (tip.imag == 0)
    size = np.sqrt(np.abs(area).sum() / 2)
    longest = sides.max(axis=1)
    thin = flat | (area < np.maximum(_THIN * longest, np.minimum(_LOW * size, _SMALL * longest)) * longest)
    moved = np.zeros(len(points), dtype=bool)
    if not thin.any():
        return Widened(points, moved, thin, flat, area)
    degenerate, proper = np.zeros(len(F), dtype=bool), flat.copy()
    some = np.flatnonzero(flat)
    corners = points[F[some]]
    degenerate[some] = (corners == corners[:, (1, 2, 0)]).all(axis=2).any(axis=1)
    proper &= ~degenerate
    if proper.any():
        degenerate |= proper & ~_joins(F, sides, proper, ~degenerate)
    thin &= ~degenerate
    rows = np.flatnonzero(thin)
    side = sides[rows].argmax(axis=1)
    # Side k runs from corner k to the next, so the corner before k is opposite.
    apex = F[rows, side - 1]
    moved[apex] = True
    near = np.flatnonzero(moved[F].any(axis=1) & ~degenerate)
    shortest = np.full(len(points), np.inf)
    for k in range(3):
        np.minimum.at(shortest, F[near, k], np.minimum(sides[near, k], sides[near, k - 1]))
    # More than the height of a thin triangle, so that none is thin afterwards.
    base = longest[rows]
    length = np.maximum(
        _SHIFT * shortest[apex], np.maximum(4 * _THIN * base, np.minimum(_HIGH * size, 4 * _SMALL * base))
    )
    start, end = F[rows, side], F[rows, (side + 1) % 3]
    along = points[end] - points[start]
    points = points.copy()
    # Away from the triangle at the longest side, or towards that at another side: in their planes, so flat faces stay
    # flat.
    ordinary = F[~thin & ~degenerate]
    across = -_towards_tips(points, ordinary, start, end)
    for one, other in ((end, apex), (apex, start)):
        across = np.where(np.isnan(across), _towards_tips(points, ordinary, one, other), across)
    across = np.where(np.isnan(across), _direction_across(along, dimension), across)
    # Random shifts do not put several vertices on one line again. The seed is fixed, so that results are reproducible.
    points[apex] += across * (length * np.random.default_rng(0).uniform(0.5, 1, rows.size))[:, None]
    degenerate[near[flat_triangles(points, F[near])]] = True
    return Widened(points, moved, thin & ~degenerate, degenerate, area)


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
