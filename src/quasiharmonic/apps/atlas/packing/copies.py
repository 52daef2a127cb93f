"""Congruent charts, which may use the same part of a texture."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from scipy.spatial import KDTree

from quasiharmonic.util.arrays import ComplexArray, FloatArray, IntArray, to_complex, to_points

# Largest distance between vertices of congruent charts, relative to the chart's radius.
_TOLERANCE = 1e-4


class Motion(NamedTuple):
    """A motion of the plane: change the sign of x if mirrored, multiply by a unit complex number, then shift."""

    mirrored: bool
    turn: complex
    shift: complex

    def move(self, z: ComplexArray) -> ComplexArray:
        """Move points."""
        return np.asarray((-z.conj() if self.mirrored else z) * self.turn + self.shift)


class Copy(NamedTuple):
    """A chart that a motion moves onto an earlier one, and the largest remaining distance of their vertices."""

    original: int
    motion: Motion
    deviation: float


def find_copies(charts: list[tuple[FloatArray, IntArray]], kinds: Sequence[int] | None = None) -> dict[int, Copy]:
    """Find the charts that are congruent to an earlier one of their kind, with vertices and triangles in any order."""
    originals: defaultdict[tuple[int, int, int], list[_Original]] = defaultdict(list)
    copies = {}
    for i, (uv, F) in enumerate(charts):
        z = to_complex(uv)
        z = z - z.mean()
        same_sizes = originals[len(uv), len(F), kinds[i] if kinds is not None else 0]
        for original in same_sizes:
            found = _align(z, F, original.z, charts[original.chart][1], original.tree)
            if found is not None:
                motion, deviation = found
                # The motion is relative to the mean of the vertices.
                here = complex(*uv.mean(axis=0))
                there = complex(*charts[original.chart][0].mean(axis=0))
                shift = motion.shift + there - complex(motion._replace(shift=0).move(np.array([here]))[0])
                copies[i] = Copy(original.chart, motion._replace(shift=shift), deviation)
                break
        else:
            same_sizes.append(_Original(i, z, KDTree(to_points(z))))
    return copies


class _Original(NamedTuple):
    """A chart with its vertices, relative to their mean."""

    chart: int
    z: ComplexArray
    tree: KDTree


def _align(
    z: ComplexArray, F: IntArray, goal: ComplexArray, goal_F: IntArray, tree: KDTree
) -> tuple[Motion, float] | None:
    """Motion of vertices with mean zero onto those of another chart, if the charts are congruent."""
    # Vertices of a chart compared with the most distant vertex of another.
    most_anchors = 64
    radius = float(np.abs(goal).max())
    tolerance = _TOLERANCE * radius
    if abs(float(np.abs(z).max()) - radius) > tolerance:
        return None
    anchor = goal[np.argmax(np.abs(goal))]
    near = np.flatnonzero(np.abs(np.abs(z) - radius) <= tolerance)[:most_anchors]
    for mirrored in (False, True):
        for vertex in near.tolist():
            start = Motion(mirrored, 1, 0).move(z)
            turn = complex(anchor * start[vertex].conj())
            moved = start * (turn / abs(turn)) if turn else start
            distance, match = tree.query(to_points(moved))
            if distance.max() > tolerance or len(np.unique(match)) < len(match):
                continue
            if not np.array_equal(_sorted_triangles(match[F]), _sorted_triangles(goal_F)):
                continue
            # The best rotation for all vertices.
            best = complex(np.vdot(start, goal[match]))
            motion = Motion(mirrored, best / abs(best) if best else 1, 0)
            return motion, float(np.abs(motion.move(z) - goal[match]).max())
    return None


def _sorted_triangles(F: IntArray) -> IntArray:
    """Triangles in an order that depends neither on their rows nor on their corners."""
    rows = np.sort(F, axis=1)
    return np.asarray(rows[np.lexsort(rows.T)])
