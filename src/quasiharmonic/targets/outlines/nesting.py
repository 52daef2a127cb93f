"""Nesting of an outline's contours: which are holes, and whether they bound a region, computed exactly."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from quasiharmonic.geometry.exact.loops import LoopEdges, contacts, find_nesting
from quasiharmonic.geometry.exact.predicates import SegmentRelation, orientation
from quasiharmonic.targets.outlines.contours import check_contour, distinct, in_unit, signed_area
from quasiharmonic.util.arrays import FloatArray, check_sequence

# Maximum number of meeting sides to find; the first is reported.
_MAX_MEETINGS = 100


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
    found = [distinct(check_contour(c, f"contour {i}"), 0.0) for i, c in enumerate(contours)]
    if not found:
        return []
    for i, contour in enumerate(found):
        if collinear(contour):
            raise ValueError(f"contour {i} of the outline encloses no area")
    points = np.concatenate(found)
    curves = LoopEdges.of(np.split(np.arange(len(points)), np.cumsum([len(c) for c in found])[:-1]), points)
    _check_simple(curves, points)
    areas = [abs(signed_area(c)) for c in in_unit(found)[0]]
    sense, _, inner = find_nesting(curves)
    depth = np.bincount(inner, minlength=len(found))
    order = sorted(range(len(found)), key=lambda i: -areas[i])
    return [NestedContour(found[i], int(depth[i]), bool(sense[i] < 0)) for i in order]


def collinear(contour: FloatArray) -> bool:
    """Whether all points of a contour lie on one line."""
    one, other = contour[np.lexsort((contour[:, 1], contour[:, 0]))[[0, -1]]]
    return not orientation(np.tile(one, (len(contour), 1)), np.tile(other, (len(contour), 1)), contour).any()


def _check_simple(curves: LoopEdges, points: FloatArray) -> None:
    """Raise if two sides of contours share more than the point that joins them."""
    start, owner, following = curves.start, curves.owner, curves.following
    met = contacts(points, curves.ends, _MAX_MEETINGS)
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
    count = f"{len(met.pairs)} such pairs" if met.complete else f"more than {_MAX_MEETINGS} such pairs"
    more = "" if len(met.pairs) == 1 else f" ({count} in all)" if met.complete else f" ({count})"
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
