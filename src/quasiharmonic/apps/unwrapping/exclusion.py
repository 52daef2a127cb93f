"""Triangles that texture coordinates leave out: degenerate and repeated ones, and the triangles that replace them."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from quasiharmonic.geometry.mesh.topology import edge_keys, find_twins
from quasiharmonic.util.arrays import BoolArray, FloatArray, IntArray, mark


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

        _, nearest = KDTree(points[F[:, 0]]).query(points[flat[alone, 0]])
        neighbour[alone] = nearest
    return neighbour


def _match_corners(points: FloatArray, F: IntArray, substitutes: IntArray) -> IntArray:
    """Return for each corner of F (k, 3) the nearest corner, 0 … 2, of its substitute (k, 3)."""
    apart = points[F][:, :, None] - points[substitutes][:, None]
    nearest: IntArray = np.where(F[:, :, None] == substitutes[:, None], -1.0, (apart**2).sum(axis=3)).argmin(axis=2)
    return nearest
