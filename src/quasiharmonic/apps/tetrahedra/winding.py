"""Exact winding numbers of closed surfaces, on both sides of their triangles.

A line parallel to an axis passes through a chosen point of a triangle. The triangles that it crosses, in order, give
the winding number between them, which is 0 far outside. All numbers are rational, so the result is exact.
"""

from __future__ import annotations

from collections.abc import Iterator
from fractions import Fraction
from typing import NamedTuple

import numpy as np

from quasiharmonic.util.arrays import FloatArray, IntArray
from quasiharmonic.util.progress import heartbeat

# Weights of the corners for a point in a triangle: primes, so that lines through it rarely meet an edge.
_WEIGHTS = ((101, 211, 307), (503, 229, 97), (13, 29, 911), (331, 17, 659), (1009, 2003, 31), (7, 5, 11))
_AXES = ((0, 1, 2), (1, 2, 0), (2, 0, 1))


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
    for line in _choices(triangles):
        found = _crossings(boxes, line)
        if found is not None:
            return found
    raise AssertionError("every line through the surface meets an edge")


def _choices(triangles: IntArray) -> Iterator[_Line]:
    for weights in _WEIGHTS:
        for triangle in triangles[:: max(len(triangles) // 20, 1)].tolist():
            for axes in _AXES:
                yield _Line(triangle, weights, axes)
    for k in range(1, 10000):
        yield _Line(int(triangles[k % len(triangles)]), (k * k + 1, 7 * k + 3, 5 * k + 2), _AXES[k % 3])


def _crossings(boxes: _Boxes, line: _Line) -> list[tuple[int, int]] | None:
    """Crossings of a line; None if it meets an edge of a triangle."""
    (corners, lo, hi), (triangle, weights, axes) = boxes, line
    total = sum(weights)
    own = _rational(corners[triangle])
    q = [sum(w * p[a] for w, p in zip(weights, own, strict=True)) / total for a in axes[:2]]
    near = np.ones(len(corners), dtype=np.bool_)
    for value, a in zip(q, axes[:2], strict=True):
        below, above = np.nextafter(float(value), -np.inf), np.nextafter(float(value), np.inf)
        near &= (lo[:, a] <= above) & (hi[:, a] >= below)
    found = []
    for k in np.flatnonzero(near).tolist():
        p = _rational(corners[k])
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


def _rational(points: FloatArray) -> list[list[Fraction]]:
    return [[Fraction(value) for value in point] for point in points.tolist()]
