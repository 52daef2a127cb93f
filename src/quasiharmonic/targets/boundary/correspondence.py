"""Which boundary vertex goes to which place of an outline."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from quasiharmonic.targets.outlines.contours import checked, corners, signed_area
from quasiharmonic.util.arrays import FloatArray, IntArray

# Vertices of a loop and where along a contour they go.
Held = Sequence[tuple[int, float]]


def arc_length(
    loop: ArrayLike, outline: ArrayLike, *, start: int | None = None, corner_angle: float = 20.0
) -> FloatArray:
    """Lay a boundary loop along an outline, in proportion to its length.

    The corners of the outline stay corners: the vertices that come nearest to them along the way
    are moved onto them, and those between are spread in proportion to the lengths of their edges.
    No two vertices coincide and their order is kept.

    Whether a map with this boundary exists is another matter. Where the mesh has an interior edge
    between two boundary vertices, or a triangle with all its vertices on the boundary, their places
    decide alone whether that edge stays inside the outline and that triangle is not inverted.

    Parameters
    ----------
    loop : (n, 2) or (n, 3) float
        Rest positions of the vertices of one boundary loop in order, triangles to the left (as
        `quasiharmonic.geometry.mesh.topology.boundary_loops` lists them).
    outline : (k, 2) float
        The contour they go to, its inside to the left: an outer contour counterclockwise, a hole
        clockwise.
    start : int, optional
        The position in ``loop`` of the vertex that goes to ``outline[0]``. By default the one for
        which loop and outline resemble each other most without being turned; a curved loop is seen
        against its own plane, from the side where it runs counterclockwise, with the y-axis upwards.
    corner_angle : float
        Degrees by which an outline turns at a corner, at the least. Lesser bends belong to a curve.

    Returns
    -------
    (n, 2) float64
        Places on the outline, in the order of ``loop``.

    Raises
    ------
    ValueError
        When the arrays are no curves of finite points; when the loop has fewer vertices than the
        outline has corners; when two successive vertices of the loop coincide, or all but; when
        there is no vertex ``start``.
    """
    points = checked(loop, "loop", (2, 3))
    contour = checked(outline, "outline")
    n = len(points)
    s = arc(points)
    if start is None:
        start = best_start(s, seen_flat(points, contour), contour)
    elif not 0 <= start < n:
        raise ValueError(f"start = {start}, but the loop has vertices 0 to {n - 1}")
    return at(contour, places_along(s, contour, [(start, 0.0)], corner_angle=corner_angle))


def places_along(
    s: FloatArray,
    contour: FloatArray,
    pins: Held,
    *,
    corner_angle: float,
    names: IntArray | None = None,
) -> FloatArray:
    """Find places along a contour for a loop, some of them given; each corner gets the vertex nearest along the way.

    Parameters
    ----------
    s : (n,) float64
        Where the vertices lie along their loop, as `arc` tells.
    contour : (k, 2) float64
    pins : sequence of (int, float)
        Vertices of the loop and where along the contour they go, both in order around; at least one.
    corner_angle : float
        Degrees.
    names : (n,) int64, optional
        What the vertices are called in messages; by default their positions in the loop.

    Returns
    -------
    (n,) float64
        Where along the contour the vertices go, from 0 to 1, as `arc` tells; for `at`.

    Raises
    ------
    ValueError
        When there are fewer vertices than corners between two pins, or two vertices coincide.
    """
    names = np.arange(len(s)) if names is None else names
    t = arc(contour)
    sharp = corners(contour, corner_angle)
    place = np.empty(len(s))
    for stretch in stretches(s, pins):
        here, wanted = stretch.within(t, sharp)
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
        place[run[:-1]] = (stretch.begin + stretch.gap * way[:-1]) % 1.0
        # Without rounding, so that corners are met exactly.
        place[run[chosen]] = t[here]
        place[run[0]] = stretch.begin
    return place


@dataclass(frozen=True)
class Stretch:
    """Everything from one pin to the next, both included.

    Attributes
    ----------
    run : (c + 1,) int64
        Vertices of the loop.
    along : (c + 1,) float64
        Where they lie, from 0 to 1.
    begin : float
        Where along the contour the first one goes.
    gap : float
        How far from there the last one goes.
    """

    run: IntArray
    along: FloatArray
    begin: float
    gap: float

    def within(self, t: FloatArray, some: IntArray) -> tuple[IntArray, FloatArray]:
        """Those of some points of the contour that lie strictly in this stretch, in order, and where from 0 to 1."""
        local = (t[some] - self.begin) % 1.0 / self.gap
        order = np.argsort(local)
        order = order[(local[order] > 0) & (local[order] < 1)]
        return some[order], local[order]


def stretches(s: FloatArray, pins: Held) -> Iterator[Stretch]:
    """Take a loop apart at its pins."""
    n = len(s)
    for (first, begin), (last, end) in zip(pins, [*pins[1:], pins[0]], strict=True):
        run = (first + np.arange(((last - first) % n or n) + 1)) % n
        along = (s[run] - s[first]) % 1.0
        # All the way around a single pin is not nowhere.
        along[-1] = along[-1] or 1.0
        yield Stretch(run, along / along[-1], begin, (end - begin) % 1.0 or 1.0)


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


def arc(points: FloatArray) -> FloatArray:
    """Where the points lie along their closed curve, the whole of which has length 1; (n,) from 0."""
    steps = np.linalg.norm(np.roll(points, -1, axis=0) - points, axis=1)
    ends = np.cumsum(steps)
    if ends[-1] == 0:
        raise ValueError("all points of a closed curve coincide")
    return np.concatenate([[0.0], ends[:-1] / ends[-1]])


def at(contour: FloatArray, place: FloatArray) -> FloatArray:
    """Points of a contour by where they lie along it, from 0 to 1; (n, 2)."""
    t = np.append(arc(contour), 1.0)
    closed = np.concatenate([contour, contour[:1]])
    return np.stack([np.interp(place, t, closed[:, axis]) for axis in range(2)], axis=1)


def off(contour: FloatArray, along: FloatArray, places: FloatArray) -> float:
    """How far a contour's points are at most from the straight sides that a loop's vertices span in their place.

    Parameters
    ----------
    contour : (k, 2) float64
    along : (n,) float64
        Where along the contour the vertices are, in order around;
    places : (n, 2) float64
        and where that is.
    """
    order = np.argsort(along, kind="stable")
    # Points before the first vertex belong to the side that leads to it from the last one.
    last = order[np.searchsorted(along[order], arc(contour), side="right") - 1]
    begin = places[last]
    side = places[(last + 1) % len(places)] - begin
    length = np.maximum((side**2).sum(axis=1), np.finfo(np.float64).tiny)
    share = np.clip(((contour - begin) * side).sum(axis=1) / length, 0, 1)
    return float(np.linalg.norm(begin + share[:, None] * side - contour, axis=1).max())


def _match(along: FloatArray, wanted: FloatArray) -> IntArray:
    """Give every wanted place a vertex of its own, in order, with the least sum of squared distances.

    Both ascend. Row j of ``cost`` holds, for every vertex, the best that can be done for the places
    up to j when j takes that vertex.
    """
    cost = np.empty((wanted.size, along.size))
    for j, place in enumerate(wanted):
        cost[j] = (along - place) ** 2
        if j:
            cost[j, 1:] += np.minimum.accumulate(cost[j - 1])[:-1]
        # The first j vertices are the least the places before take.
        cost[j, :j] = np.inf
    chosen = np.empty(wanted.size, dtype=np.int64)
    end = along.size
    for j in reversed(range(wanted.size)):
        end = int(np.argmin(cost[j, :end]))
        chosen[j] = end
    return chosen


def best_start(s: FloatArray, flat: FloatArray, contour: FloatArray) -> int:
    """Vertex to begin with so that a loop and a contour are as close as they can be.

    With z and w the curves as complex functions of arc length, ∫ |z(s + δ) − w(s)|² ds is least
    where Re ∫ z(s + δ) w̄(s) ds is greatest: a correlation, for all δ at once by FFT.

    Parameters
    ----------
    s : (n,) float64
        Where the vertices lie along the loop.
    flat : (n, 2) float64
        How the loop looks in the plane.
    contour : (k, 2) float64
    """
    t = arc(contour)
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


def seen_flat(points: FloatArray, contour: FloatArray) -> FloatArray:
    """A loop as it looks from where it runs as the contour does, the y-axis upwards; (n, 2)."""
    if points.shape[1] == 2:
        return points
    centred = points - points.mean(axis=0)
    normal = np.cross(centred, np.roll(centred, -1, axis=0)).sum(axis=0)
    return np.asarray(centred @ upright(normal * np.sign(signed_area(contour)))[:2].T)


def upright(normal: FloatArray) -> FloatArray:
    """Right, up and towards the viewer for one who looks against ``normal``, the y-axis upwards.

    From above and below, where the y-axis has no direction, −z and z are up. Without a normal the
    viewer looks against the z-axis.

    Returns
    -------
    (3, 3) float64
        Orthonormal rows.
    """
    size = np.linalg.norm(normal)
    towards = normal / size if size > 0 else np.array([0.0, 0.0, 1.0])
    upwards = np.array([0.0, 1.0, 0.0]) if abs(towards[1]) < 0.99 else np.array([0.0, 0.0, -towards[1]])
    right = np.cross(upwards, towards)
    right /= np.linalg.norm(right)
    return np.stack([right, np.cross(towards, right), towards])
