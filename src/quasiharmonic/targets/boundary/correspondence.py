"""Correspondence between the vertices of a boundary loop and the points of an outline.

Both curves have a parameter, the arc length from their start divided by their total length. `arc_length` gives every
vertex the point with the same parameter, except that the corners of the outline are met by vertices. `find_start`
chooses the vertex that goes to the start of the outline.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from numbers import Integral

import numpy as np
from numpy.typing import ArrayLike

from quasiharmonic.geometry.curves.arcs import nearest_on_segments
from quasiharmonic.geometry.curves.boundary_curves import check_corner_angle
from quasiharmonic.targets.outlines.contours import check_contour, corners, signed_area
from quasiharmonic.util.arrays import FloatArray, IntArray, describe

#: Pins of a loop: vertices with given parameters along a contour, in order around.
LoopPins = Sequence[tuple[int, float]]


def arc_length(
    loop: ArrayLike, outline: ArrayLike, *, start: int | None = None, corner_angle: float = 20.0
) -> FloatArray:
    """Place a boundary loop along an outline, in proportion to arc length.

    Corners of the outline are kept. At each corner, the vertex nearest along the loop is moved onto it, and the
    vertices between are spread in proportion to the lengths of their edges. No two vertices coincide, and their order
    is kept.

    A map with this boundary need not exist. An interior edge between two boundary vertices may leave the outline. A
    triangle with all its vertices on the boundary may be inverted. The target positions alone determine both.

    Parameters
    ----------
    loop : (n, 2) or (n, 3) float
        Rest positions of the vertices of one boundary loop in order, triangles to the left (as returned by
        `quasiharmonic.geometry.mesh.topology.boundary_loops`).
    outline : (k, 2) float
        The target contour, with its inside to the left: an outer contour counterclockwise, a hole clockwise.
    start : int, optional
        The position in ``loop`` of the vertex that goes to ``outline[0]``. By default, the start with the best match of
        loop and outline without rotation. A loop in space is projected along its normal, from the side where it is
        counterclockwise, with the y-axis upwards.
    corner_angle : float
        Minimum angle in degrees by which an outline turns at a corner. Smaller bends belong to a curve.

    Returns
    -------
    (n, 2) float64
        Target positions, in the order of ``loop``.

    Raises
    ------
    ValueError
        When an array is not a curve of finite points, the loop has fewer vertices than the outline has corners, two
        successive vertices of the loop (almost) coincide, or ``start`` is out of range.
    """
    points = check_contour(loop, "loop", (2, 3))
    contour = check_contour(outline, "outline")
    n = len(points)
    check_corner_angle(corner_angle)
    s = arc_parameters(points)
    if start is None:
        start = find_start(s, project_loop(points, contour), contour)
    elif not isinstance(start, Integral) or not 0 <= start < n:
        raise ValueError(f"start = {describe(start)}, but the loop has vertices 0 to {n - 1}")
    return points_at(contour, find_parameters(s, contour, [(start, 0.0)], corner_angle=corner_angle))


def find_parameters(
    s: FloatArray, contour: FloatArray, pins: LoopPins, *, corner_angle: float, names: IntArray | None = None
) -> FloatArray:
    """Find parameters along a contour for a loop with given pins; each corner gets the vertex nearest along the loop.

    ``s`` (n,) are the vertices' parameters along their loop, as from `arc_parameters`. The ``pins``, at least one, are
    vertices of the loop and their parameters along the contour, in order around. The result (n,) is an input of
    `points_at`. Messages use the vertex numbers ``names`` (n,). ValueError when there are fewer vertices than corners
    between two pins, or two vertices coincide.
    """
    names = np.arange(len(s)) if names is None else names
    t = arc_parameters(contour)
    sharp = corners(contour, corner_angle)
    parameters = np.empty(len(s))
    for stretch in stretches(s, pins):
        here, wanted = stretch.find_inside(t, sharp)
        run, along, count = stretch.run, stretch.along, len(stretch.run) - 1
        if count - 1 < len(here):
            raise _too_few(names[run[0]], names[run[-1]], count - 1, len(here))
        chosen = 1 + _match(along[1:-1], wanted)
        way = np.interp(along, along[[0, *chosen, count]], np.concatenate([[0.0], wanted, [1.0]]))
        stuck = np.flatnonzero(np.diff(way) <= 0)
        if stuck.size:
            pair = f"vertices {names[run[stuck[0]]]} and {names[run[stuck[0] + 1]]} of the loop"
            if along[stuck[0]] == along[stuck[0] + 1]:
                raise ValueError(f"{pair} coincide")
            raise ValueError(
                f"{pair} get the same position: some sides of the outline are too short compared with the others"
            )
        parameters[run[:-1]] = (stretch.begin + stretch.gap * way[:-1]) % 1.0
        # Assign corners without rounding, so that they are met exactly.
        parameters[run[chosen]] = t[here]
        parameters[run[0]] = stretch.begin
    return parameters


@dataclass(frozen=True)
class BoundaryStretch:
    """The part of a loop from one pin to the next, both included."""

    run: IntArray  # (c + 1,): vertices of the loop
    along: FloatArray  # (c + 1,): their parameters along the stretch, from 0 to 1
    begin: float  # Parameter of the first pin along the contour
    gap: float  # Distance along the contour from the first pin to the last

    def find_inside(self, t: FloatArray, some: IntArray) -> tuple[IntArray, FloatArray]:
        """Return the given contour points strictly inside this stretch, in order, with local parameters from 0 to 1."""
        local = (t[some] - self.begin) % 1.0 / self.gap
        order = np.argsort(local)
        order = order[(local[order] > 0) & (local[order] < 1)]
        return some[order], local[order]


def stretches(s: FloatArray, pins: LoopPins) -> Iterator[BoundaryStretch]:
    """Split a loop at its pins."""
    n = len(s)
    for (first, begin), (last, end) in zip(pins, [*pins[1:], pins[0]], strict=True):
        run = (first + np.arange(((last - first) % n or n) + 1)) % n
        along = (s[run] - s[first]) % 1.0
        # With a single pin, the stretch is the whole loop, not empty.
        along[-1] = along[-1] or 1.0
        yield BoundaryStretch(run, along / along[-1], begin, (end - begin) % 1.0 or 1.0)


def _too_few(first: int, last: int, free: int, wanted: int) -> ValueError:
    if first == last:
        what = f"the loop has {free + 1} vertices, too few to keep the {wanted + 1} corners of the outline"
    else:
        what = (
            f"there are {free} boundary vertices between {first} and {last}, "
            f"too few to keep the {wanted} corners of the outline there"
        )
    return ValueError(
        f"{what}: refine the boundary, or let fewer bends count as corners (corner_angle; qhm map --corner-angle)"
    )


def arc_parameters(points: FloatArray) -> FloatArray:
    """Parameters of points along their closed curve of total length 1; (n,) from 0."""
    steps = np.linalg.norm(np.roll(points, -1, axis=0) - points, axis=1)
    ends = np.cumsum(steps)
    if ends[-1] == 0:
        raise ValueError("all points of a closed curve coincide")
    return np.concatenate([[0.0], ends[:-1] / ends[-1]])


def points_at(contour: FloatArray, parameters: FloatArray) -> FloatArray:
    """Points of a contour at parameters from 0 to 1; (n, 2)."""
    t = np.append(arc_parameters(contour), 1.0)
    closed = np.concatenate([contour, contour[:1]])
    return np.stack([np.interp(parameters, t, closed[:, axis]) for axis in range(2)], axis=1)


def max_deviation(contour: FloatArray, along: FloatArray, positions: FloatArray) -> float:
    """Maximum distance of a contour's points from the sides of the polygon of a loop's target positions (n, 2).

    ``along`` (n,) are the parameters of the vertices along the contour, in order around.
    """
    order = np.argsort(along, kind="stable")
    # Points before the first vertex belong to the side from the last vertex to it.
    last = order[np.searchsorted(along[order], arc_parameters(contour), side="right") - 1]
    return float(nearest_on_segments(contour, positions[last], positions[(last + 1) % len(positions)])[1].max())


def _match(along: FloatArray, wanted: FloatArray) -> IntArray:
    """Assign a separate vertex to every wanted parameter, in order, minimising the sum of squared distances.

    Both sequences ascend. Row j of ``costs`` has, for every vertex in reach, the lowest cost of the first j + 1
    parameters if parameter j takes that vertex.
    """
    # A parameter takes its nearest vertex, or the one beside the vertex that the parameter before or after takes. Reach
    # one vertex further, because the nearest vertex is rounded.
    rank = np.arange(wanted.size)
    nearest = np.searchsorted((along[1:] + along[:-1]) / 2, wanted) - rank
    begin = np.maximum(np.minimum.accumulate(nearest[::-1])[::-1] - 1, 0) + rank
    end = np.minimum(np.maximum.accumulate(nearest) + 1, along.size - wanted.size) + rank + 1
    costs: list[FloatArray] = []
    for j, parameter in enumerate(wanted):
        costs.append((along[begin[j] : end[j]] - parameter) ** 2)
        if j:
            before = np.minimum.accumulate(costs[j - 1])
            costs[j] += before[np.minimum(np.arange(begin[j], end[j]) - begin[j - 1], before.size) - 1]
    chosen = np.empty_like(rank)
    last = along.size
    for j in reversed(range(wanted.size)):
        chosen[j] = last = begin[j] + np.argmin(costs[j][: last - begin[j]])
    return chosen


def find_start(s: FloatArray, flat: FloatArray, contour: FloatArray) -> int:
    """Return the start vertex for which a loop and a contour are closest.

    ``s`` (n,) are parameters along the loop, ``flat`` (n, 2) the projected loop. With the curves z and w as complex
    functions of arc length, ∫ |z(s + δ) − w(s)|² ds is minimal where Re ∫ z(s + δ) w̄(s) ds is maximal. This
    correlation is computed for all δ at once by FFT.
    """
    t = arc_parameters(contour)
    m = max(1024, 4 * len(s))
    z, w = (
        np.interp(np.arange(m) / m, np.append(where, 1.0), np.append(curve, curve[0]))
        for where, curve in ((s, flat[:, 0] + 1j * flat[:, 1]), (t, contour[:, 0] + 1j * contour[:, 1]))
    )
    z, w = z - z.mean(), w - w.mean()
    match = np.fft.ifft(np.fft.fft(z) * np.conj(np.fft.fft(w))).real
    best = np.argmax(match) / m
    away = np.abs(s - best)
    return int(np.argmin(np.minimum(away, 1 - away)))


def project_loop(points: FloatArray, contour: FloatArray) -> FloatArray:
    """Project a loop to the plane from the side where it has the contour's orientation, y-axis upwards; (n, 2)."""
    if points.shape[1] == 2:
        return points
    centred = points - points.mean(axis=0)
    normal = np.cross(centred, np.roll(centred, -1, axis=0)).sum(axis=0)
    return np.asarray(centred @ viewer_axes(normal * np.sign(signed_area(contour)))[:2].T)


def viewer_axes(normal: FloatArray) -> FloatArray:
    """Right, up and towards-the-viewer axes of a viewer who looks against ``normal``, as orthonormal rows.

    Up is the y-axis as far as possible; for a viewer along the y-axis it is −z from above and z from below. For a zero
    normal the viewer looks against the z-axis.
    """
    size = np.linalg.norm(normal)
    towards = normal / size if size > 0 else np.array([0.0, 0.0, 1.0])
    upwards = np.array([0.0, 1.0, 0.0]) if abs(towards[1]) < 0.99 else np.array([0.0, 0.0, -towards[1]])
    right = np.cross(upwards, towards)
    right /= np.linalg.norm(right)
    return np.stack([right, np.cross(towards, right), towards])
