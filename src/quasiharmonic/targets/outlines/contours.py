"""Closed contours in the plane: area, corners, and conversion of curves to contours.

A contour is a (k, 2) float64 array of distinct points; the last is joined to the first. An outline is a list of
contours, outer ones counterclockwise and holes clockwise. So the region lies to the left, like the triangles along the
boundary loops of a mesh.

The nesting of an outline's contours is computed exactly: which are holes, and whether they bound a region.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from quasiharmonic.geometry.exact.loops import LoopEdges, contacts, find_nesting
from quasiharmonic.geometry.exact.predicates import SegmentRelation, orientation
from quasiharmonic.util.arrays import FloatArray, IntArray, check_finite, check_sequence, find_exponent, real_array

# A path of lines and Bézier curves, joined end to start, as control points (degree + 1, 2) of each piece.
Pieces = list[FloatArray]

# Limit that protects against malicious files; no real outline needs more.
MAX_POINTS = 1_000_000


def signed_area(contour: ArrayLike) -> float:
    """Return the area inside a contour, positive if it is counterclockwise.

    Parameters
    ----------
    contour : (k, 2) float

    Returns
    -------
    float
    """
    points = check_contour(contour, "contour")
    x, y = (points - points[0]).T
    return float(x @ np.roll(y, -1) - y @ np.roll(x, -1)) / 2


def in_unit(contours: Sequence[FloatArray]) -> tuple[list[FloatArray], int]:
    """Scale contours to coordinates of at most about 1, so that squares neither overflow nor underflow.

    The scale is a power of two, which causes no rounding; the second result is its exponent.
    """
    exponent = max(find_exponent(c) for c in contours)
    return [np.ldexp(c, -exponent) for c in contours], exponent


def check_contour(curve: ArrayLike, name: str, widths: tuple[int, ...] = (2,)) -> FloatArray:
    """Return a closed curve as float64; raise ValueError unless it has at least three points, all finite."""
    points = real_array(name, curve)
    if points.ndim != 2 or points.shape[1] not in widths or len(points) < 3:
        wanted = " or ".join(f"(k, {w})" for w in widths)
        raise ValueError(f"{name} must be {wanted} with k at least 3, not {points.shape}")
    check_finite(name, "point", "points", points)
    return points


def turns(contour: FloatArray) -> FloatArray:
    """Turning angle of a contour at each point, (k,) radians in [-π, π], positive to the left."""
    ahead = np.roll(contour, -1, axis=0) - contour
    before = np.roll(ahead, 1, axis=0)
    cross = before[:, 0] * ahead[:, 1] - before[:, 1] * ahead[:, 0]
    return np.asarray(np.arctan2(cross, (before * ahead).sum(axis=1)))


def corners(contour: FloatArray, angle: float) -> IntArray:
    """Indices of the points where a contour turns by at least ``angle`` degrees, ascending."""
    return np.flatnonzero(np.abs(turns(contour)) >= np.radians(angle))


def from_corner(contour: FloatArray, angle: float, backwards: bool = False) -> FloatArray:
    """Rotate a contour's points to start at its first corner, so that no side is split at the start.

    Set ``backwards`` if the contour was reversed with its first point kept. The start is then the corner that was the
    first before the reversal.
    """
    marks = corners(contour, angle)
    if not marks.size:
        return contour
    first = marks[-1] if backwards and marks[0] > 0 else marks[0]
    return np.roll(contour, -int(first), axis=0)


def flatten(pieces: Pieces, tolerance: float) -> FloatArray:
    """Convert a closed path of lines and Bézier curves to a contour; a straight line closes an open path.

    The contour deviates from the path by at most the tolerance, and points closer than it to the one before are
    dropped. ValueError when the contour would have more than a million points.
    """
    steps = [_steps(control, tolerance) for control in pieces]
    if sum(steps) > MAX_POINTS:
        raise ValueError(
            f"the outline has more than {MAX_POINTS:,} points at a tolerance of {tolerance:.3g}: raise the tolerance"
        )
    points = [pieces[0][:1], *(_bezier(control, n) for control, n in zip(pieces, steps, strict=True))]
    return drop_close_points(np.concatenate(points), tolerance)


def _steps(control: FloatArray, tolerance: float) -> float:
    """Number of equal parameter steps for which a polyline stays within a tolerance of a Bézier curve.

    A polyline of n steps deviates by at most max |b''| / (8 n²). The second derivative of a curve of degree d is at
    most d (d - 1) times the largest second difference of its control points.
    """
    degree = len(control) - 1
    if degree == 1:
        return 1
    bend = np.linalg.norm(np.diff(control, n=2, axis=0), axis=1).max()
    return float(max(1, np.ceil(np.sqrt(degree * (degree - 1) * bend / (8 * tolerance)))))


def _bezier(control: FloatArray, steps: float) -> FloatArray:
    """Points at equal parameter steps on a Bézier curve, without its first point."""
    if len(control) == 2:
        return control[1:]
    t = (np.arange(1, steps + 1) / steps)[:, None]
    # De Casteljau's algorithm, for all parameters at once.
    points = np.repeat(control[:, None, :], int(steps), axis=1)
    while len(points) > 1:
        points = (1 - t) * points[:-1] + t * points[1:]
    return np.asarray(points[0])


def drop_close_points(contour: FloatArray, min_distance: float) -> FloatArray:
    """Drop points within ``min_distance`` of the last kept point, cyclically; the first point is always kept."""
    kept = [0]
    # Python floats, because reading array elements one by one is several times slower.
    x, y = contour[:, 0].tolist(), contour[:, 1].tolist()
    for i in range(1, len(x)):
        if abs(x[i] - x[kept[-1]]) > min_distance or abs(y[i] - y[kept[-1]]) > min_distance:
            kept.append(i)
    while len(kept) > 1 and max(abs(x[kept[-1]] - x[0]), abs(y[kept[-1]] - y[0])) <= min_distance:
        kept.pop()
    return contour[kept]


class NestedContour(NamedTuple):
    """A contour and its nesting among the others."""

    points: FloatArray  # (k, 2): as given, without consecutive duplicates
    depth: int  # Number of other contours around it; odd for a hole
    clockwise: bool  # Its orientation

    @property
    def reversed(self) -> bool:
        """Whether its orientation is wrong for its depth: outer contours are counterclockwise, holes clockwise."""
        return self.clockwise == (self.depth % 2 == 0)

    @property
    def oriented(self) -> FloatArray:
        """Its points in the correct orientation, with the same first point."""
        return np.roll(self.points[::-1], 1, axis=0) if self.reversed else self.points


def nested(contours: Sequence[ArrayLike]) -> list[FloatArray]:
    """Order contours by decreasing area and orient them: outer ones counterclockwise, holes clockwise.

    A contour inside an odd number of others is a hole (the even-odd rule). Input contours may have either orientation.
    A point equal to the one before it is dropped.

    Parameters
    ----------
    contours : sequence of (k, 2) float

    Returns
    -------
    list of (k, 2) float64
        Each starts at its first given point.

    Raises
    ------
    ValueError
        When a contour is not an array of at least three finite points, or encloses no area; when a contour crosses,
        touches or doubles back on itself or another one.
    """
    return [one.oriented for one in arrange(contours)]


def filled(contours: Sequence[ArrayLike]) -> list[FloatArray]:
    """Return an outline without its holes: the contours not inside another one, in their given orientation.

    Parameters
    ----------
    contours : sequence of (k, 2) float
        As in `nested`.

    Returns
    -------
    list of (k, 2) float64

    Raises
    ------
    ValueError
        As `nested`.
    """
    return [one.points for one in arrange(contours) if one.depth == 0]


def arrange(contours: Sequence[ArrayLike]) -> list[NestedContour]:
    """Return contours by decreasing area with their nesting; raises as `nested`."""
    check_sequence("contours", contours, "contours (k, 2)")
    found = [drop_close_points(check_contour(c, f"contour {i}"), 0.0) for i, c in enumerate(contours)]
    if not found:
        return []
    for i, contour in enumerate(found):
        if is_collinear(contour):
            raise ValueError(f"contour {i} of the outline encloses no area: remove it")
    points = np.concatenate(found)
    curves = LoopEdges.of(np.split(np.arange(len(points)), np.cumsum([len(c) for c in found])[:-1]), points)
    _check_simple(curves, points)
    areas = [abs(signed_area(c)) for c in in_unit(found)[0]]
    sense, _, inner = find_nesting(curves)
    depth = np.bincount(inner, minlength=len(found))
    order = sorted(range(len(found)), key=lambda i: -areas[i])
    return [NestedContour(found[i], int(depth[i]), bool(sense[i] < 0)) for i in order]


def is_collinear(contour: FloatArray) -> bool:
    """Whether all points of a contour lie on one line."""
    one, other = contour[np.lexsort((contour[:, 1], contour[:, 0]))[[0, -1]]]
    return not orientation(np.tile(one, (len(contour), 1)), np.tile(other, (len(contour), 1)), contour).any()


def _check_simple(curves: LoopEdges, points: FloatArray) -> None:
    """Raise if two sides of contours share more than the point that joins them."""
    # Maximum number of meeting sides to find; the first is reported.
    max_meetings = 100
    start, owner, following = curves.start, curves.owner, curves.following
    met = contacts(points, curves.ends, max_meetings)
    if not len(met.pairs):
        return
    # A side that doubles back also touches neighbouring sides, so report spikes first.
    spike = (following[met.pairs] == met.pairs[:, ::-1]).any(axis=1)
    first = int(np.lexsort((*met.pairs.T[::-1], ~spike))[0])
    (i, j), relation = met.pairs[first].tolist(), met.relation[first]

    def side(k: int) -> str:
        (x0, y0), (x1, y1) = points[k].tolist(), points[following[k]].tolist()
        a, b = k - start[owner[k]], following[k] - start[owner[k]]
        return f"side from point {a} ({x0:.6g}, {y0:.6g}) to point {b} ({x1:.6g}, {y1:.6g})"

    how = {SegmentRelation.CROSSING: "crosses", SegmentRelation.TOUCHING: "touches"}.get(relation, "runs along")
    one, other = int(owner[i]), int(owner[j])
    count = f"{len(met.pairs)} such pairs in all" if met.complete else f"more than {max_meetings} such pairs"
    more = f" ({count})" if len(met.pairs) > 1 else ""
    if spike[first]:
        at = j if following[i] == j else i
        x, y = points[at].tolist()
        raise ValueError(
            f"contour {one} of the outline folds back onto itself at point {at - start[one]} ({x:.6g}, {y:.6g}){more}: "
            "remove the spike"
        )
    if one == other:
        raise ValueError(
            f"contour {one} of the outline meets itself: its {side(i)} {how} its {side(j)}{more}: an outline must not "
            "cross or touch itself"
        )
    raise ValueError(
        f"contours {one} and {other} of the outline meet: the first one's {side(i)} {how} the other's "
        f"{side(j)}{more}: holes must be disjoint and lie inside the contour around them"
    )
