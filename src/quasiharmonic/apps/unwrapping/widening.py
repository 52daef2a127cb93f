"""Widening: triangles with three positions on a line, or almost, get a height and so a shape in the plane.

Such triangles stand between a long edge and several short ones. Without them, the surface would have a slit there.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from quasiharmonic.geometry.mesh.reference import flat_triangles, rest_frames
from quasiharmonic.geometry.mesh.topology import edge_keys, label_components
from quasiharmonic.util.arrays import BoolArray, FloatArray, IntArray

# A triangle is thin if its height is smaller than this multiple of its longest side. Flattening copes with larger ones.
_THIN = 1e-7

# A vertex moves by about this multiple of the shortest edge there.
_SHIFT = 1e-3


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
    thin = flat | (area < _THIN * (sides**2).max(axis=1))
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
    longest = sides[rows].argmax(axis=1)
    # Side k runs from corner k to the next, so the corner before k is opposite.
    apex = F[rows, (longest + 2) % 3]
    moved[apex] = True
    near = np.flatnonzero(moved[F].any(axis=1) & ~degenerate)
    shortest = np.full(len(points), np.inf)
    for k in range(3):
        np.minimum.at(shortest, F[near, k], np.minimum(sides[near, k], sides[near, k - 1]))
    # At least twice the height of a thin triangle, so that none is thin afterwards.
    length = np.maximum(_SHIFT * shortest[apex], 4 * _THIN * sides[rows].max(axis=1))
    along = points[F[rows, (longest + 1) % 3]] - points[F[rows, longest]]
    points = points.copy()
    # Random shifts do not put several vertices on one line again. The seed is fixed, so that results are reproducible.
    points[apex] += _across(along, dimension) * (length * np.random.default_rng(0).uniform(0.5, 1, rows.size))[:, None]
    degenerate[near[flat_triangles(points, F[near])]] = True
    return Widened(points, moved, thin & ~degenerate, degenerate, area)


def _joins(F: IntArray, sides: FloatArray, flat: BoolArray, present: BoolArray) -> BoolArray:
    """Return for each triangle (f,) whether it is a flat one that joins others."""
    touched = np.zeros(int(F.max()) + 1, dtype=bool)
    touched[F[flat]] = True
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
    has_area = np.zeros(near.size, dtype=bool)
    has_area[part[~flat[near]]] = True
    joins = np.zeros(len(F), dtype=bool)
    joins[near] = good & has_area[part] & flat[near]
    return joins


def _across(along: FloatArray, dimension: int) -> FloatArray:
    """Return unit vectors perpendicular to others (k, 3), which are not zero, in random directions."""
    along = along / np.abs(along).max(axis=1, keepdims=True)
    along /= np.linalg.norm(along, axis=1, keepdims=True)
    if dimension == 2:
        return np.stack([-along[:, 1], along[:, 0], 0 * along[:, 0]], axis=1)
    random = np.random.default_rng(1).normal(size=along.shape)
    across: FloatArray = np.cross(along, random)
    return across / np.linalg.norm(across, axis=1, keepdims=True)
