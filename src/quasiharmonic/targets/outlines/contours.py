"""Closed contours in the plane: area, corners, and curves flattened into them.

A contour is a (k, 2) float64 array of points, the last joined to the first, none repeated. An
outline is a list of contours, the outer ones counterclockwise and holes clockwise: the filled side
lies to the left, as the triangles do along the boundary loops of a mesh.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import ArrayLike

from quasiharmonic.util.arrays import ComplexArray, FloatArray, IntArray, check_finite, real_array

# A path of lines and Bézier curves: the control points (degree + 1, 2) of each piece, joined end to start.
Pieces = list[FloatArray]

# No outline needs more, and a hostile file must not ask for more.
MOST_POINTS = 1_000_000


def signed_area(contour: ArrayLike) -> float:
    """Area within a contour, positive when it runs counterclockwise.

    Parameters
    ----------
    contour : (k, 2) float

    Returns
    -------
    float
    """
    contour = np.asarray(contour, dtype=np.float64)
    x, y = (contour - contour[0]).T
    return float(x @ np.roll(y, -1) - y @ np.roll(x, -1)) / 2


def as_complex(points: FloatArray) -> ComplexArray:
    """Points (k, 2) as complex numbers x + iy, (k,)."""
    return np.ascontiguousarray(points).view(np.complex128).ravel()


def in_unit(contours: Sequence[FloatArray]) -> tuple[list[FloatArray], int]:
    """Contours shrunk or blown up to coordinates of about 1 at most, so that no square of theirs over- or underflows.

    Returns
    -------
    contours : list of (k, 2) float64
        The same divided by a power of two, which rounds nothing.
    exponent : int
        Of that power.
    """
    exponent = max(int(np.frexp(np.abs(c).max())[1]) for c in contours)
    return [np.ldexp(c, -exponent) for c in contours], exponent


def checked(curve: ArrayLike, name: str, widths: tuple[int, ...] = (2,)) -> FloatArray:
    """A closed curve as float64; `ValueError` unless it has at least three points, all finite."""
    points = real_array(name, curve)
    if points.ndim != 2 or points.shape[1] not in widths or len(points) < 3:
        wanted = " or ".join(f"(k, {w})" for w in widths)
        raise ValueError(f"{name} must be {wanted} with k at least 3, not {points.shape}")
    check_finite(name, "point", "points", points)
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


def from_corner(contour: FloatArray, angle: float, backwards: bool = False) -> FloatArray:
    """The same contour from its first corner on, so that no side is cut in two where it happens to begin.

    ``backwards`` if the contour was turned around, its first point left where it is: the first corner
    is then the one that was the first before.
    """
    marks = corners(contour, angle)
    if not marks.size:
        return contour
    first = marks[-1] if backwards and marks[0] > 0 else marks[0]
    return np.roll(contour, -int(first), axis=0)


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
        raise ValueError(
            f"the outline has more than {MOST_POINTS:,} points at a tolerance of {tolerance:.3g}: raise the tolerance"
        )
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
