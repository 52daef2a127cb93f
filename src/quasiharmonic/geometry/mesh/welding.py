"""Weld: find vertices that are to count as one, because their positions are equal or close."""

from __future__ import annotations

import numpy as np

from quasiharmonic.geometry.mesh.topology import are_collapsed
from quasiharmonic.util.arrays import FloatArray, IntArray, mark, names_of, scale_to_unit


def find_representatives(V: FloatArray, F: IntArray, weld: bool | float, meshes: IntArray | None = None) -> IntArray:
    """Return for each vertex the one that represents it, which has the lowest index; the vertex itself if not welded.

    A vertex becomes a representative if no earlier representative is within the distance. Otherwise the first such
    representative represents it. So a chain of close vertices is not welded beyond the distance.

    Parameters
    ----------
    V : (n, 2) or (n, 3) float64
        Finite positions.
    F : (f, 3) int64
        Triangles. Vertices that they do not use represent themselves.
    weld : bool or float
        False welds no vertices. True and 0 weld equal positions. Other numbers are the maximum distance of a vertex
        from its representative, relative to the diagonal of the bounding box of the triangles.
    meshes : (n,) int64, optional
        Mesh of each vertex. Vertices of different meshes are not welded.

    Returns
    -------
    (n,) int64
        At most the vertex's own index.
    """
    joint = np.arange(len(V))
    if isinstance(weld, bool | np.bool_) and not weld:
        return joint
    used = np.flatnonzero(mark(len(V), F))
    of = np.zeros(len(used)) if meshes is None else meshes[used].astype(np.float64)
    first = _find_equal(np.column_stack([V[used], of]))
    distinct = np.flatnonzero(first == np.arange(len(first)))
    if not isinstance(weld, bool | np.bool_) and len(distinct):
        # In this unit, the diagonal neither overflows nor underflows.
        points = scale_to_unit(V[used[distinct]])
        distance = float(weld) * float(np.linalg.norm(np.ptp(points, axis=0)))
        close = _find_close(np.column_stack([points, 2 * distance * of[distinct]]), distance)
        first = distinct[close][np.searchsorted(distinct, first)]
    joint[used] = used[first]
    return joint


def weld_triangles(V: FloatArray, F: IntArray, weld: bool | float) -> tuple[IntArray, IntArray]:
    """Return triangles (f, 3) of the representatives of their vertices, and these (n,); see `find_representatives`.

    ValueError if welding merges corners of a triangle; the message names the triangles.
    """
    joint = find_representatives(V, F, weld)
    collapsed = np.flatnonzero(are_collapsed(joint[F]) & ~are_collapsed(F))
    if collapsed.size:
        raise ValueError(
            f"welding at distance {float(weld):g} merges corners of {names_of('triangle', 'triangles', collapsed)}: "
            "choose a smaller distance, or remove these triangles"
        )
    return joint[F], joint


def _find_equal(V: FloatArray) -> IntArray:
    """Return for each vertex the first one at the same position."""
    order = np.lexsort(V.T)
    starts = np.ones(len(V), dtype=bool)
    starts[1:] = (V[order[1:]] != V[order[:-1]]).any(axis=1)
    first = np.empty(len(V), dtype=np.int64)
    first[order] = order[starts][np.cumsum(starts) - 1]
    return first


def _find_close(points: FloatArray, distance: float) -> IntArray:
    """Return for each of several distinct points the first representative within a distance."""
    from scipy.spatial import cKDTree

    first = np.arange(len(points))
    if not distance > 0:
        return first
    tree = cKDTree(points)
    # The maximum norm needs no squares, which would underflow.
    box, _ = tree.query(points, k=[2], p=np.inf, distance_upper_bound=np.nextafter(distance, np.inf))
    waiting = box[:, 0] <= distance
    for i in np.flatnonzero(waiting).tolist():
        if waiting[i]:
            near = np.array(tree.query_ball_point(points[i], distance, p=np.inf))
            near = near[waiting[near]]
            near = near[(((points[near] - points[i]) / distance) ** 2).sum(axis=1) <= 1]
            first[near], waiting[near] = i, False
    return first


def weld_points(points: FloatArray) -> tuple[FloatArray, IntArray]:
    """Return the distinct points of (k, d), in the order of their first occurrence, and the row of each point (k,)."""
    first = _find_equal(points)
    distinct = np.flatnonzero(first == np.arange(len(points)))
    return points[distinct], np.searchsorted(distinct, first)
