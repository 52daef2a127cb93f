"""Which boundary vertex goes to which place of an outline."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]


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
        `quasiharmonic.mesh.topology.boundary_loops` lists them).
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
    points = _checked(loop, "loop", (2, 3))
    contour = _checked(outline, "outline", (2,))
    n = len(points)
    s, length = _arc(points)
    t, _ = _arc(contour)
    corners = _corners(contour, corner_angle)
    if n < len(corners):
        raise ValueError(
            f"the loop has {n} vertices, too few to keep the {len(corners)} corners of the outline: "
            "refine the boundary, or let fewer bends count as corners (corner_angle)"
        )
    if start is None:
        start = _best_start(points, contour)
    elif not 0 <= start < n:
        raise ValueError(f"start = {start}, but the loop has vertices 0 to {n - 1}")

    turned = np.roll(np.arange(n), -start)
    along = (s[turned] - s[start]) % 1.0
    # The first corner is where the start goes; the circle ends where it began.
    fixed = np.concatenate([[0], 1 + _match(along[1:], t[corners[1:]])])
    place = np.interp(along, np.append(along[fixed], 1.0), np.append(t[corners], 1.0))
    stuck = np.flatnonzero(np.diff(place, append=1.0) <= 0)
    if stuck.size:
        first, second = turned[stuck[0]], turned[(stuck[0] + 1) % n]
        raise ValueError(f"vertices {first} and {second} of the loop coincide (its length is {length:.3g})")
    result = np.empty((n, 2))
    for axis in range(2):
        column = np.append(contour[:, axis], contour[0, axis])
        result[turned, axis] = np.interp(place, np.append(t, 1.0), column)
    return result


def _checked(curve: ArrayLike, name: str, widths: tuple[int, ...]) -> FloatArray:
    points = np.asarray(curve, dtype=np.float64)
    if points.ndim != 2 or points.shape[1] not in widths or len(points) < 3:
        wanted = " or ".join(f"(k, {w})" for w in widths)
        raise ValueError(f"{name} must be {wanted} with k at least 3, not {points.shape}")
    if not np.isfinite(points).all():
        raise ValueError(f"point {int(np.argmin(np.isfinite(points).all(axis=1)))} of {name} is not finite")
    return points


def _arc(points: FloatArray) -> tuple[FloatArray, float]:
    """Where the points lie along their closed curve of length 1, and the length it has."""
    steps = np.linalg.norm(np.roll(points, -1, axis=0) - points, axis=1)
    ends = np.cumsum(steps)
    if ends[-1] == 0:
        raise ValueError("all points of a closed curve coincide")
    return np.concatenate([[0.0], ends[:-1] / ends[-1]]), float(ends[-1])


def _corners(contour: FloatArray, corner_angle: float) -> IntArray:
    """Indices of the first point and of every corner, ascending."""
    ahead = np.roll(contour, -1, axis=0) - contour
    before = np.roll(ahead, 1, axis=0)
    cross = before[:, 0] * ahead[:, 1] - before[:, 1] * ahead[:, 0]
    bend = np.abs(np.arctan2(cross, (before * ahead).sum(axis=1))) >= np.radians(corner_angle)
    bend[0] = True
    return np.flatnonzero(bend)


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


def _best_start(points: FloatArray, contour: FloatArray) -> int:
    """Vertex to begin with so that the two curves are as close as they can be.

    With z and w the curves as complex functions of arc length, ∫ |z(s + δ) − w(s)|² ds is least
    where Re ∫ z(s + δ) w̄(s) ds is greatest: a correlation, for all δ at once by FFT.
    """
    flat = _seen_flat(points)
    s, _ = _arc(points)
    t, _ = _arc(contour)
    m = max(1024, 4 * len(points))
    z, w = (
        np.interp(np.arange(m) / m, np.append(at, 1.0), np.append(curve, curve[0]))
        for at, curve in ((s, flat[:, 0] + 1j * flat[:, 1]), (t, contour[:, 0] + 1j * contour[:, 1]))
    )
    z, w = z - z.mean(), w - w.mean()
    match = np.fft.ifft(np.fft.fft(z) * np.conj(np.fft.fft(w))).real
    best = np.argmax(match) / m
    away = np.abs(s - best)
    return int(np.argmin(np.minimum(away, 1 - away)))


def _seen_flat(points: FloatArray) -> FloatArray:
    """A loop as it looks from where it runs counterclockwise, the y-axis upwards; (n, 2)."""
    if points.shape[1] == 2:
        return points
    centred = points - points.mean(axis=0)
    normal = np.cross(centred, np.roll(centred, -1, axis=0)).sum(axis=0)
    return np.asarray(centred @ upright(normal)[:2].T)


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
