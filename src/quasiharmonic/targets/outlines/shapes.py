"""Outlines of simple shapes: disks, rectangles, polygons, stars, rings."""

from __future__ import annotations

import numpy as np

from quasiharmonic.util.arrays import FloatArray, check_integer, check_numbers, check_positive


def disk(radius: float = 1.0, points: int = 256) -> FloatArray:
    """Outline of a disk around the origin: an `ellipse` with equal axes.

    Parameters
    ----------
    radius : float
    points : int
        Number of evenly spaced points.

    Returns
    -------
    (points, 2) float64
        Counterclockwise from ``(radius, 0)``.

    Raises
    ------
    ValueError
        When the radius is not positive, or ``points`` is less than three.
    """
    check_positive(radius=radius)
    return ellipse(radius, radius, points)


def ellipse(a: float, b: float, points: int = 256) -> FloatArray:
    """Outline of an ellipse around the origin.

    Parameters
    ----------
    a, b : float
        Half axes along x and y.
    points : int
        Number of points, evenly spaced in the ellipse's parameter.

    Returns
    -------
    (points, 2) float64
        Counterclockwise from ``(a, 0)``.

    Raises
    ------
    ValueError
        When a half axis is not positive, or ``points`` is less than three.
    """
    check_positive(a=a, b=b)
    return _polar(points) * (a, b)


def rectangle(width: float, height: float) -> FloatArray:
    """Outline of the rectangle from the origin to ``(width, height)``.

    Parameters
    ----------
    width, height : float

    Returns
    -------
    (4, 2) float64
        Counterclockwise from the origin.

    Raises
    ------
    ValueError
        When a side is not positive.
    """
    check_positive(width=width, height=height)
    return np.array([(0, 0), (width, 0), (width, height), (0, height)], dtype=np.float64)


def regular_polygon(corners: int, radius: float = 1.0) -> FloatArray:
    """Outline of a regular polygon around the origin.

    Parameters
    ----------
    corners : int
    radius : float
        Distance of the corners from the origin.

    Returns
    -------
    (corners, 2) float64
        Counterclockwise from the corner at the top.

    Raises
    ------
    ValueError
        When there are fewer than three corners or the radius is not positive.
    """
    check_positive(radius=radius)
    return _polar(corners, start=np.pi / 2) * radius


def star(tips: int, inner: float = 0.5) -> FloatArray:
    """Outline of a star around the origin, with its tips on the unit circle.

    Parameters
    ----------
    tips : int
    inner : float
        Distance from the origin of the corners between the tips, below 1.

    Returns
    -------
    (2 tips, 2) float64
        Counterclockwise from the tip at the top.

    Raises
    ------
    ValueError
        When there are fewer than three tips or ``inner`` is not between 0 and 1.
    """
    _check_inner(inner)
    check_integer("tips", tips, minimum=3)
    outline = _polar(2 * tips, start=np.pi / 2)
    outline[1::2] *= inner
    return outline


def ring(inner: float = 0.5, points: int = 256) -> list[FloatArray]:
    """Outline of the unit disk around the origin with a concentric circular hole.

    Parameters
    ----------
    inner : float
        Radius of the hole, below 1.
    points : int
        Points on each circle.

    Returns
    -------
    list of two (points, 2) float64
        The outer circle counterclockwise, the inner one clockwise.

    Raises
    ------
    ValueError
        When ``inner`` is not between 0 and 1, or ``points`` is less than three.
    """
    _check_inner(inner)
    circle = _polar(points)
    return [circle, inner * circle[::-1]]


def _check_inner(inner: float) -> None:
    check_numbers(inner=inner)
    if not 0 < inner < 1:
        raise ValueError(f"inner must be between 0 and 1, not {inner}")


def _polar(points: int, start: float = 0.0) -> FloatArray:
    """Points evenly spaced on the unit circle, counterclockwise from the angle ``start`` in radians."""
    check_integer("points", points, minimum=3)
    angle = start + np.arange(points) * (2 * np.pi / points)
    return np.stack([np.cos(angle), np.sin(angle)], axis=1)
