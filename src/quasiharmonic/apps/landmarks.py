"""Landmarks of images: points and curves with target positions, and a mesh of the image that contains them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from quasiharmonic.util.arrays import (
    BoolArray,
    FloatArray,
    IntArray,
    check_finite,
    check_sequence,
    map_array,
    names_of,
    real_array,
    reject,
)

#: A polyline (a, 2), a ≥ 2, and its target polyline (b, 2).
CurvePair = tuple[ArrayLike, ArrayLike]


@dataclass(frozen=True, eq=False)
class Landmarks:
    """Points of an image and their target positions."""

    # ``before``, ``after``: (k, 2)
    before: FloatArray
    after: FloatArray
    weights: FloatArray  # (k,): cost of missing the target position; infinite for landmarks that reach it exactly

    @property
    def hard(self) -> BoolArray:
        """Which landmarks reach their target position exactly; (k,) bool."""
        return np.isinf(self.weights)


def make_landmarks(
    landmarks: ArrayLike,
    target: ArrayLike,
    weights: ArrayLike | None,
    curves: Sequence[CurvePair],
    step: float,
    size: IntArray,
) -> Landmarks:
    """Check landmarks, and sample curves as landmarks.

    The arguments are those of `quasiharmonic.warp_by_landmarks`. ``step`` is the maximum spacing of the points on
    curves, and ``size`` (2,) the position of the image's last pixel, x and y. Raises ValueError if landmarks are
    malformed, outside the image, or at the same position.
    """
    before, after = _points(landmarks, "landmarks"), _points(target, "target")
    if before.shape != after.shape:
        raise ValueError(f"target must have as many rows as landmarks, {len(before)}, not {len(after)}")
    weight = _weights(weights, len(before))
    _check_inside("landmarks", before, ((before >= 0) & (before <= size)).all(axis=1), size)
    edge = is_on_border(before, size)
    if np.array_equal(before[edge], after[edge]):
        _check_inside("target", after, ((after > 0) & (after < size)).all(axis=1) | edge, size)
    soft = edge & ~np.isinf(weight)
    reject(
        soft, "landmark", "landmarks", "weights: {} on the border, where landmarks are exact: give them infinite weight"
    )
    # Points at this distance count as one.
    rounding = 1e-9 * float(size.max())
    _check_apart("landmarks", before, rounding)
    _check_apart("target", after[np.isinf(weight)], rounding, np.flatnonzero(np.isinf(weight)))
    check_sequence("curves", curves, "pairs of polylines")
    for number, pair in enumerate(curves):
        if len(pair) != 2:
            raise ValueError(f"curve {number} must be two polylines, before and after, not {len(pair)}")
        one, other = _resample(*pair, f"curve {number}", step)
        for name, points in ((f"curve {number}, before", one), (f"curve {number}, after", other)):
            _check_inside(name, points, ((points > 0) & (points < size)).all(axis=1), size)
        if np.abs(one[0] - one[-1]).max() <= rounding:
            # A closed curve ends at its first point.
            _check_same_target(number, one[-1:], other[-1:], other[:1], rounding)
            one, other = one[:-1], other[:-1]
        # Curves may share points, and landmarks may be on curves, which are exact.
        same = np.abs(one[:, None] - before).max(axis=2) <= rounding
        new = ~same.any(axis=1)
        k, landmark = np.argwhere(same).T
        _check_same_target(number, one[k], other[k], after[landmark], rounding)
        weight[landmark] = np.inf
        before, after = np.concatenate([before, one[new]]), np.concatenate([after, other[new]])
        weight = np.concatenate([weight, np.full(np.count_nonzero(new), np.inf)])
    return Landmarks(before, after, weight)


def _check_same_target(number: int, points: FloatArray, ends: FloatArray, given: FloatArray, rounding: float) -> None:
    """Raise ValueError if points (k, 2) of a curve have two targets, of the curve and of what is at these points."""
    different = np.flatnonzero(np.abs(ends - given).max(axis=1, initial=0.0) > rounding)
    if different.size:
        k = different[0]
        raise ValueError(
            f"curve {number} moves its point {tuple(points[k].tolist())} to {tuple(ends[k].tolist())}, but a landmark, "
            f"a curve or its other end moves it to {tuple(given[k].tolist())}: give both the same target"
        )


def is_on_border(points: FloatArray, size: IntArray) -> BoolArray:
    """Which points (k, 2) are on the image's border."""
    return np.asarray(((points == 0) | (points == size)).any(axis=1))


def _points(points: ArrayLike, name: str) -> FloatArray:
    array = real_array(name, points)
    array = map_array(name, array if array.size else np.empty((0, 2)), finite=False)
    check_finite(name, "point", "points", array)
    return array


def _weights(weights: ArrayLike | None, k: int) -> FloatArray:
    """Check the weights of ``k`` landmarks; infinite by default."""
    array = np.full(k, np.inf) if weights is None else real_array("weights", weights)
    if array.shape != (k,):
        raise ValueError(f"weights must have shape ({k},), one for each landmark, not {array.shape}")
    reject(~(array > 0), "landmark", "landmarks", "the weight is not positive at {}")
    return array


def _check_apart(name: str, array: FloatArray, rounding: float, numbers: IntArray | None = None) -> None:
    """Raise ValueError if two points are at the same position, up to rounding."""
    from scipy.spatial import cKDTree

    if len(array) < 2:
        return
    pairs = cKDTree(array).query_pairs(rounding, p=np.inf, output_type="ndarray")
    if len(pairs):
        place = array[pairs.min()]
        same = np.flatnonzero(np.abs(array - place).max(axis=1) <= rounding)
        which = same if numbers is None else numbers[same]
        raise ValueError(
            f"{name}: {names_of('point', 'points', which)} have the same position, {tuple(place.tolist())}: keep one "
            f"of them"
        )


def _resample(start: ArrayLike, end: ArrayLike, name: str, step: float) -> tuple[FloatArray, FloatArray]:
    """Points on two polylines at equal fractions of their lengths, spaced by at most ``step`` on both."""
    lines = [real_array(name, line) for line in (start, end)]
    for line in lines:
        if line.ndim != 2 or line.shape[1] != 2 or len(line) < 2:
            raise ValueError(
                f"{name} must be two polylines of shape (a, 2), at least two points each, not {line.shape}"
            )
        check_finite(name, "point", "points", line)
    arcs = [np.append(0, np.cumsum(np.hypot(*np.diff(line, axis=0).T))) for line in lines]
    if min(arc[-1] for arc in arcs) == 0:
        raise ValueError(f"{name} has no length: give at least two different points")
    parts = np.linspace(0, 1, int(np.ceil(max(arc[-1] for arc in arcs) / step)) + 1)
    one, other = (
        np.stack([np.interp(parts * arc[-1], arc, line[:, axis]) for axis in (0, 1)], axis=1)
        for line, arc in zip(lines, arcs, strict=True)
    )
    return one, other


def _check_inside(name: str, points: FloatArray, inside: Any, size: IntArray) -> None:
    """Raise ValueError if landmarks are outside the image."""
    outside = np.flatnonzero(~inside)
    if outside.size:
        raise ValueError(
            f"{name}: {names_of('point', 'points', outside)} not inside the image, of {size[0]} to the right and "
            f"{size[1]} down: the first is at {tuple(points[outside[0]].tolist())}"
        )


def interpolate_border(border: FloatArray, before: FloatArray, after: FloatArray, size: IntArray) -> FloatArray:
    """The displacements of border points, interpolated between the landmarks on the border; (m, 2)."""
    corners = np.array([(0, 0), (size[0], 0), size, (0, size[1])], dtype=np.float64)
    given = (corners[:, None] == before).all(axis=2).any(axis=1)
    knots = np.concatenate([corners[~given], before])
    way = np.concatenate([np.zeros((np.count_nonzero(~given), 2)), after - before])
    around = 2.0 * size.sum()
    at, where = _border_distance(knots, size), _border_distance(border, size)
    return np.stack([np.interp(where, at, way[:, axis], period=around) for axis in (0, 1)], axis=1)


def _border_distance(border: FloatArray, size: IntArray) -> FloatArray:
    """The distance of border points from the first pixel along the border, first to the right; (m,)."""
    (x, y), (width, height) = border.T, size
    return np.select(
        [y == 0, x == width, y == height], [x, width + y, 2 * width + height - x], 2 * (width + height) - y
    )


def make_image_mesh(landmarks: FloatArray, width: int, height: int, along: int) -> tuple[FloatArray, IntArray]:
    """Triangulate a grid of ``along`` cells per longer side, without points near landmarks; landmarks come last."""
    # Minimum number of cells along the shorter side, so that vertices can move between landmarks and the border.
    min_cells = 6
    from scipy.spatial import Delaunay, cKDTree

    spacing = max(width - 1, height - 1) / along
    size = (width - 1, height - 1)
    x, y = (np.linspace(0, side, max(min_cells, round(side / spacing)) + 1) for side in size)
    grid = np.stack(np.meshgrid(x, y), axis=2).reshape(-1, 2)
    sides, landmark_sides = ((p == 0) | (p == size) for p in (grid, landmarks))
    near = np.zeros(len(grid), dtype=bool)
    if len(landmarks):
        near = cKDTree(landmarks).query(grid)[0] < 0.5 * spacing
    # Remove border points only near landmarks on the border, and corners only if a landmark is at the same position.
    if landmark_sides.any():
        distance = cKDTree(landmarks[landmark_sides.any(axis=1)]).query(grid)[0]
        near &= ~sides.any(axis=1) | (distance < np.where(sides.all(axis=1), 1e-300, 0.5 * spacing))
    else:
        near &= ~sides.any(axis=1)
    kept = grid[~near]
    points = np.concatenate([kept, landmarks])
    F = Delaunay(points).simplices.astype(np.int64)
    a, b, c = points[F].transpose(1, 0, 2)
    turned = (b - a)[:, 0] * (c - a)[:, 1] < (b - a)[:, 1] * (c - a)[:, 0]
    F[turned] = F[turned, ::-1]
    return points, F
