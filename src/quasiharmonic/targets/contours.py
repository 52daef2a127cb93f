"""Closed contours in the plane: area, nesting, corners, and curves flattened into them.

A contour is a (k, 2) float64 array of points, the last joined to the first, none repeated. An
outline is a list of contours, the outer ones counterclockwise and holes clockwise: the filled side
lies to the left, as the triangles do along the boundary loops of a mesh.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import ArrayLike, NDArray

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]
ComplexArray = NDArray[np.complex128]
# A path of lines and Bézier curves: the control points (degree + 1, 2) of each piece, joined end to start.
Pieces = list[FloatArray]

# No outline needs more, and a hostile file must not ask for more.
MOST_POINTS = 1_000_000


def signed_area(contour: ArrayLike) -> float:
    """Area within a contour, positive when it runs counterclockwise.

    Parameters
    ----------
    contour : (k, 2) float
    """
    contour = np.asarray(contour, dtype=np.float64)
    x, y = (contour - contour[0]).T
    return float(x @ np.roll(y, -1) - y @ np.roll(x, -1)) / 2


def as_complex(points: FloatArray) -> ComplexArray:
    """Points (k, 2) as complex numbers x + iy, (k,)."""
    return np.ascontiguousarray(points).view(np.complex128).ravel()


def contains(contour: FloatArray, point: FloatArray) -> bool:
    """Whether a ray from the point to the right crosses the contour an odd number of times."""
    (x0, y0), (x1, y1) = contour.T, np.roll(contour, -1, axis=0).T
    spans = (y0 > point[1]) != (y1 > point[1])
    x = x0[spans] + (point[1] - y0[spans]) / (y1 - y0)[spans] * (x1 - x0)[spans]
    return bool(np.count_nonzero(x > point[0]) % 2)


def nested(contours: Sequence[ArrayLike]) -> list[FloatArray]:
    """Order contours by decreasing area and wind them: counterclockwise outside, clockwise around holes.

    What lies within an odd number of others is a hole (the even-odd rule). The contours may be wound
    as they like, but must not cross.

    Parameters
    ----------
    contours : sequence of (k, 2) float

    Returns
    -------
    list of (k, 2) float64

    Raises
    ------
    ValueError
        When a contour is no array of at least three finite points, or encloses no area.
    """
    found = sorted((checked(c, f"contour {i}") for i, c in enumerate(contours)), key=lambda c: -abs(signed_area(c)))
    for i, contour in enumerate(found):
        if signed_area(contour) == 0:
            raise ValueError("a contour of the outline encloses no area")
        # Only a larger contour can contain this one, and those come before it.
        if (signed_area(contour) > 0) == _is_hole(contour, found[:i]):
            # The first point stays the first.
            found[i] = np.roll(contour[::-1], 1, axis=0)
    return found


def filled(contours: Sequence[ArrayLike]) -> list[FloatArray]:
    """An outline without its holes: the contours that no other one contains, counterclockwise.

    Parameters
    ----------
    contours : sequence of (k, 2) float
        As `nested` takes them.

    Returns
    -------
    list of (k, 2) float64
    """
    ordered = nested(contours)
    return [c for i, c in enumerate(ordered) if not any(contains(other, c[0]) for other in ordered[:i])]


def _is_hole(contour: FloatArray, larger: list[FloatArray]) -> bool:
    return sum(contains(other, contour[0]) for other in larger) % 2 == 1


def checked(curve: ArrayLike, name: str, widths: tuple[int, ...] = (2,)) -> FloatArray:
    """A closed curve as float64; `ValueError` unless it has at least three points, all finite."""
    points = np.asarray(curve, dtype=np.float64)
    if points.ndim != 2 or points.shape[1] not in widths or len(points) < 3:
        wanted = " or ".join(f"(k, {w})" for w in widths)
        raise ValueError(f"{name} must be {wanted} with k at least 3, not {points.shape}")
    if not np.isfinite(points).all():
        raise ValueError(f"point {int(np.argmin(np.isfinite(points).all(axis=1)))} of {name} is not finite")
    return points


def turns(contour: FloatArray) -> FloatArray:
    """Angle by which a contour turns at each point, (k,) radians in [-π, π], positive to the left."""
    ahead = np.roll(contour, -1, axis=0) - contour
    before = np.roll(ahead, 1, axis=0)
    cross = before[:, 0] * ahead[:, 1] - before[:, 1] * ahead[:, 0]
    return np.asarray(np.arctan2(cross, (before * ahead).sum(axis=1)))


def corners(contour: FloatArray, angle: float) -> IntArray:
    """Indices of the points where a contour turns by at least so many degrees, ascending."""
    return np.flatnonzero(np.abs(turns(contour)) >= np.radians(angle))


def from_corner(contour: FloatArray, angle: float) -> FloatArray:
    """The same contour from its first corner on, so that no side is cut in two where it happens to begin."""
    first = corners(contour, angle)[:1].sum()
    return np.roll(contour, -first, axis=0)


def flatten(pieces: Pieces, tolerance: float) -> FloatArray:
    """Turn a closed path of lines and Bézier curves into a contour.

    Parameters
    ----------
    pieces : list of (degree + 1, 2) float64
        Each begins where the one before ends; a straight line closes the path if need be.
    tolerance : float
        How far the contour may stray from the path. Points nearer than this to the one before are left out.

    Raises
    ------
    ValueError
        When that takes a million points.
    """
    steps = [_steps(control, tolerance) for control in pieces]
    if sum(steps) > MOST_POINTS:
        raise ValueError(f"an outline of more than {MOST_POINTS:,} points at a tolerance of {tolerance:.3g}")
    points = [pieces[0][:1], *(_bezier(control, n) for control, n in zip(pieces, steps, strict=True))]
    return distinct(np.concatenate(points), tolerance)


def _steps(control: FloatArray, tolerance: float) -> float:
    """Equal steps in the parameter that a Bézier curve takes to stay within a tolerance.

    A polyline of n of them strays at most max |b''| / (8 n²), and the second derivative of a curve of
    degree d is bounded by d (d - 1) times the second differences of its control points.
    """
    degree = len(control) - 1
    if degree == 1:
        return 1
    bend = np.linalg.norm(np.diff(control, n=2, axis=0), axis=1).max()
    return float(max(1, np.ceil(np.sqrt(degree * (degree - 1) * bend / (8 * tolerance)))))


def _bezier(control: FloatArray, steps: float) -> FloatArray:
    """Points at equal steps on a Bézier curve, its first one left out."""
    if len(control) == 2:
        return control[1:]
    t = (np.arange(1, steps + 1) / steps)[:, None]
    # de Casteljau's construction, for all parameters at once.
    points = np.repeat(control[:, None, :], int(steps), axis=1)
    while len(points) > 1:
        points = (1 - t) * points[:-1] + t * points[1:]
    return np.asarray(points[0])


def distinct(contour: FloatArray, least: float) -> FloatArray:
    """Drop points that lie within ``least`` of the last one kept, going around; the first one stays."""
    kept = [0]
    # Plain doubles: one element of an array at a time takes several times as long.
    x, y = contour[:, 0].tolist(), contour[:, 1].tolist()
    for i in range(1, len(x)):
        if abs(x[i] - x[kept[-1]]) > least or abs(y[i] - y[kept[-1]]) > least:
            kept.append(i)
    while len(kept) > 1 and max(abs(x[kept[-1]] - x[0]), abs(y[kept[-1]] - y[0])) <= least:
        kept.pop()
    return contour[kept]
