"""Polygonal faces and their triangulation, and the exact triangulation of one simple polygon.

The triangulation of faces adds no vertices and depends on the shape of the polygons. A polygon is a ring of corners of
triangles. So data at the corners of triangles, such as vertex and texture position, also describe the polygon's
corners.

References
----------
.. [1] S. Hertel, K. Mehlhorn, Fast triangulation of simple polygons. Foundations of Computation
   Theory, Lecture Notes in Computer Science 158 (1983).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from quasiharmonic.util.arrays import (
    BoolArray,
    ComplexArray,
    FloatArray,
    IntArray,
    reject,
    repeat_each,
    scale_to_unit,
)

Point = tuple[int, int]
Triangle = tuple[int, int, int]


@dataclass(frozen=True, eq=False)
class Polygons:
    """Faces as rings of corners of triangles.

    The triangles are numbered polygon by polygon; a polygon of k corners has k - 2 triangles.

    Attributes
    ----------
    corners : (c,) int64
        The rings, one after another: indices into the flattened triangles. A corner that belongs to several of
        the polygon's triangles is listed as a corner of one of them.
    starts : (p + 1,) int64
        Start of each ring, and the end of the last one.
    """

    corners: IntArray
    starts: IntArray

    def __len__(self) -> int:
        return len(self.starts) - 1

    @property
    def sizes(self) -> IntArray:
        """Number of corners of each polygon; (p,) int64."""
        return np.diff(self.starts)

    @property
    def first_triangle(self) -> IntArray:
        """Index of the first triangle of each polygon, and the number of triangles; (p + 1,) int64."""
        return self.starts - 2 * np.arange(len(self.starts))

    @property
    def of_triangle(self) -> IntArray:
        """Index of the polygon of each triangle; (f,) int64."""
        return repeat_each(np.arange(len(self)), self.sizes - 2)

    def turn_over(self) -> Polygons:
        """Reversed polygons, of triangles whose last two corners are exchanged."""
        ring = repeat_each(np.arange(len(self)), self.sizes)
        backwards = (self.starts[:-1] + self.starts[1:] - 1)[ring] - np.arange(len(self.corners))
        triangle, corner = np.divmod(self.corners[backwards], 3)
        return Polygons(3 * triangle + -corner % 3, self.starts)

    def divide(self, divided: BoolArray) -> Polygons:
        """Polygons of which those in a mask (p,) are replaced by their triangles."""
        rings = np.split(self.corners, self.starts[1:-1])
        first = self.first_triangle
        new: list[IntArray] = []
        for k, ring in enumerate(rings):
            new += [3 * t + np.arange(3) for t in range(first[k], first[k + 1])] if divided[k] else [ring]
        return Polygons(np.concatenate(new), np.cumsum([0, *map(len, new)]))

    def diagonals(self, F: IntArray) -> IntArray:
        """Edges (d, 2) of the triangles ``F`` inside polygons, by vertices; a mesh cannot be cut there."""
        inside = repeat_each(self.sizes > 3, self.sizes - 2)
        parent = self.of_triangle[inside]
        tail = F[inside]
        ends = np.stack([tail, tail[:, (1, 2, 0)]], axis=2).reshape(-1, 2)
        rows = np.column_stack([np.repeat(parent, 3), np.sort(ends, axis=1)])
        found, count = np.unique(rows, axis=0, return_counts=True)
        return found[count == 2, 1:]


def triangulate_polygons(V: FloatArray, vertices: IntArray, starts: IntArray) -> tuple[IntArray, Polygons]:
    """Triangulate polygons by their shape.

    Each polygon is projected along its mean normal. Then ears are cut off, best shape first. An ear is a convex corner
    whose triangle has no other corner inside or on it. For the last four corners the better diagonal is used.

    Parameters
    ----------
    V : (n, 3) float64
        Positions.
    vertices : (c,) int64
        Vertices of the polygons, ring after ring.
    starts : (p + 1,) int64
        Start of each ring, and the end of the last one.

    Returns
    -------
    T : (f, 3) int64
        Triangles as indices into ``vertices``, polygon by polygon, with the orientation of the polygons. A polygon of
        three corners is unchanged.
    polygons : Polygons

    Raises
    ------
    ValueError
        If a polygon has fewer than three corners, or a polygon of more than three corners repeats a vertex. The message
        names the first ones.
    """
    sizes = np.diff(starts)
    _check_rings(vertices, sizes)
    V = scale_to_unit(V)
    T = np.empty((len(vertices) - 2 * len(sizes), 3), dtype=np.int64)
    first = starts[:-1] - 2 * np.arange(len(sizes))
    for size in np.unique(sizes).tolist():
        same_size = np.flatnonzero(sizes == size)
        rings = starts[same_size, None] + np.arange(size)
        cut = rings[:, None] if size == 3 else _triangulate_by_ears(V[vertices[rings]], rings)
        T[first[same_size, None] + np.arange(size - 2)] = cut
    # Assign triangle corners to polygon corners in reverse order, so that the first one is kept.
    corner = np.empty(len(vertices), dtype=np.int64)
    corner[T.ravel()[::-1]] = np.arange(T.size)[::-1]
    return T, Polygons(corner, starts)


def _check_rings(vertices: IntArray, sizes: IntArray) -> None:
    reject(sizes < 3, "face", "faces", "{} of fewer than three corners: remove them")
    face = repeat_each(np.arange(len(sizes)), np.where(sizes > 3, sizes, 0))
    vertices = vertices[repeat_each(sizes > 3, sizes)]
    order = np.lexsort((vertices, face))
    same = (np.diff(face[order]) == 0) & (np.diff(vertices[order]) == 0)
    twice = np.unique(face[order][1:][same])
    reject(twice, "face", "faces", "{} with a vertex twice: remove the repetition")


def _triangulate_by_ears(points: FloatArray, rings: IntArray) -> IntArray:
    """Triangulate polygons (p, k, 3) with k corners each, numbered ``rings`` (p, k); (p, k - 2, 3)."""
    # If coordinates or their products are not finite, any triangulation is accepted.
    with np.errstate(all="ignore"):
        return _cut_ears(_project(points), rings)


def _cut_ears(flat: ComplexArray, rings: IntArray) -> IntArray:
    """Cut ears off plane polygons (p, k), best first."""
    triangles = []
    while rings.shape[1] > 3:
        ear = _best_ears(flat)
        left, right = (ear - 1) % rings.shape[1], (ear + 1) % rings.shape[1]
        triangles.append(np.take_along_axis(rings, np.stack([left, ear, right], axis=1), axis=1))
        others = np.ones(rings.shape, dtype=np.bool_)
        np.put_along_axis(others, ear[:, None], False, axis=1)
        rings, flat = rings[others].reshape(len(rings), -1), flat[others].reshape(len(rings), -1)
    return np.stack([*triangles, rings], axis=1)


def _project(points: FloatArray) -> ComplexArray:
    """Project polygons (p, k, 3) along their mean normal (Newell's formula) to complex numbers (p, k)."""
    ahead = np.roll(points, -1, axis=1)
    normal = np.cross(points, ahead).sum(axis=1)
    # Two directions in the plane: the axis least aligned with the normal gives the first, a cross product the second.
    least = np.eye(3)[np.abs(normal).argmin(axis=1)]
    across = np.cross(normal, least)
    along = np.cross(across, normal)
    across, along = (d / np.linalg.norm(d, axis=1, keepdims=True) for d in (across, along))
    # A polygon without area has no normal, so any direction is used.
    plane = np.nan_to_num(along + 1j * across, nan=1.0)
    return np.einsum("pkd,pd->pk", points, plane)


def _best_ears(flat: ComplexArray) -> IntArray:
    """Index of the best corner to cut off each polygon (p, k), k > 3; (p,) int64."""
    # Ears whose scores differ by less count as equal, and the first one is cut, so that rounding does not decide.
    tolerance = 1e-9
    before, after = np.roll(flat, 1, axis=1), np.roll(flat, -1, axis=1)
    score = _shape(before, flat, after)
    if flat.shape[1] == 4:
        # Score the remaining triangle, too.
        score = np.minimum(score, _shape(after, np.roll(flat, -2, axis=1), before))
    rows = np.arange(len(flat))
    best = np.argmax(score >= score.max(axis=1, keepdims=True) - tolerance, axis=1)
    chosen, is_open, untried = best.copy(), np.ones(len(flat), dtype=np.bool_), score.copy()
    while is_open.any():
        row, ear = rows[is_open], chosen[is_open]
        blocked = _contains_another(flat[row], ear) & (untried[row, ear] > 0)
        untried[row[blocked], ear[blocked]] = -np.inf
        is_open[row[~blocked]] = False
        blocked_rows = row[blocked]
        best_left = untried[blocked_rows].max(axis=1, keepdims=True)
        chosen[blocked_rows] = np.argmax(untried[blocked_rows] >= best_left - tolerance, axis=1)
        # A polygon without any ear crosses itself. Any triangulation is equally bad, so cut the best-scored corner.
        without_ear = blocked_rows[best_left[:, 0] <= 0]
        chosen[without_ear], is_open[without_ear] = best[without_ear], False
    return chosen


def _shape(a: ComplexArray, b: ComplexArray, c: ComplexArray) -> FloatArray:
    """Twice the signed area over the sum of the squared sides; 0 if the triangle is a point."""
    twice_area = ((b - a).conj() * (c - a)).imag
    sides = np.abs(b - a) ** 2 + np.abs(c - b) ** 2 + np.abs(a - c) ** 2
    return np.divide(twice_area, sides, out=np.zeros_like(sides), where=sides > 0)


def _contains_another(flat: ComplexArray, ear: IntArray) -> BoolArray:
    """Whether the triangle at corner ``ear`` of each polygon (p, k) has another corner inside or on it; (p,) bool."""
    rows, k = np.arange(len(flat)), flat.shape[1]
    a, b, c = (flat[rows, (ear + step) % k][:, None] for step in (-1, 0, 1))
    inside = np.ones(flat.shape, dtype=np.bool_)
    for tail, head in ((a, b), (b, c), (c, a)):
        inside &= ((head - tail).conj() * (flat - tail)).imag >= 0
    inside &= (flat != a) & (flat != b) & (flat != c)
    return np.asarray(inside.any(axis=1))


def triangulate(corners: list[Point]) -> list[Triangle]:
    """Triangulate a simple polygon in O(n log n) steps.

    The corners are integers, counterclockwise and distinct. Straight angles are allowed. The triangles are
    counterclockwise and of positive area, two fewer than there are corners.

    A line sweeps the polygon from left to right [1]_. Each interval of the line inside the polygon bounds a region on
    its left. This region is triangulated except for a chain of corners, from the side below the interval to the side
    above. The chain is convex towards the right, so that no more triangles can be cut off. Each new corner extends a
    chain at one of its ends, or splits or merges chains. It cuts off triangles until all chains are convex again.
    """
    sweep = _Sweep(corners)
    for v in sorted(range(len(corners)), key=corners.__getitem__):
        sweep.process(v)
    return sweep.triangles


@dataclass(slots=True, eq=False)
class _Link:
    """Element of a chain. When a chain is split, its rightmost corner gets two elements."""

    corner: int
    below: _Link | None = None
    above: _Link | None = None


@dataclass(slots=True, eq=False)
class _Interval:
    """Interval of the sweep line between two sides of the polygon."""

    # The side of the polygon below, from left to right.
    side: tuple[int, int]
    # The ends of the chain, and its rightmost corner, the one that came last.
    bottom: _Link
    last: _Link
    top: _Link


class _Sweep:
    """Sweep state: intervals of the sweep line from bottom to top, and the triangles to its left."""

    def __init__(self, corners: list[Point]) -> None:
        self._corners = corners
        self._intervals: list[_Interval] = []
        self.triangles: list[Triangle] = []

    def process(self, v: int) -> None:
        """Process the next corner."""
        before, after = v - 1, (v + 1) % len(self._corners)
        here = self._corners[v]
        from_left, to_right = self._corners[before] < here, here < self._corners[after]
        at = self._find_below(here)
        interval = self._intervals[at] if at >= 0 else None
        if from_left and to_right:  # on the lower side of an interval
            assert interval is not None
            self._add_below(interval, _Link(v))
            interval.side = v, after
        elif not from_left and not to_right:  # on the upper side of an interval
            assert interval is not None
            self._add_above(interval, _Link(v))
        elif to_right:
            self._open(at, v, after)
        else:
            self._close(at, v)

    def _open(self, at: int, v: int, after: int) -> None:
        """Process a corner with both sides to its right: an interval begins or is split."""
        link = _Link(v)
        if self._turn(v - 1, v, after) > 0:
            self._intervals.insert(at + 1, _Interval((v, after), link, link, link))
            return
        lower = self._intervals[at]
        # The rightmost corner of a chain that is convex towards the right is visible from every point to its right.
        last, top = lower.last, lower.top
        copy = _Link(last.corner)
        copy.above, last.above = last.above, None
        if copy.above is not None:
            copy.above.below = copy
        upper = _Interval((v, after), copy, copy, copy if top is last else top)
        lower.top = last
        self._add_above(lower, _Link(v))
        self._add_below(upper, link)
        self._intervals.insert(at + 1, upper)

    def _close(self, at: int, v: int) -> None:
        """Process a corner with both sides to its left: an interval ends, or two intervals merge."""
        upper = self._intervals.pop(at)
        if self._turn(v - 1, v, (v + 1) % len(self._corners)) > 0:
            link = upper.bottom
            while link.above is not None:
                self.triangles.append((v, link.above.corner, link.corner))
                link = link.above
            return
        lower = self._intervals[at - 1]
        link = _Link(v)
        self._add_below(upper, link)
        self._add_above(lower, _Link(v))
        # Merge the two elements of the corner into one.
        if lower.top.below is not None:
            lower.top.below.above = link
            link.below = lower.top.below
        else:
            lower.bottom = link
        lower.last, lower.top = link, upper.top

    def _add_below(self, interval: _Interval, link: _Link) -> None:
        """Add a corner at the lower end of a chain and cut off triangles until the chain is convex."""
        next_ = interval.bottom
        while next_.above is not None and self._turn(link.corner, next_.corner, next_.above.corner) < 0:
            self.triangles.append((link.corner, next_.above.corner, next_.corner))
            next_ = next_.above
        link.above, next_.below = next_, link
        interval.bottom = interval.last = link

    def _add_above(self, interval: _Interval, link: _Link) -> None:
        """Add a corner at the upper end of a chain and cut off triangles until the chain is convex."""
        next_ = interval.top
        while next_.below is not None and self._turn(link.corner, next_.corner, next_.below.corner) > 0:
            self.triangles.append((link.corner, next_.corner, next_.below.corner))
            next_ = next_.below
        link.below, next_.above = next_, link
        interval.top = interval.last = link

    def _find_below(self, point: Point) -> int:
        """Index of the highest interval whose lower side is below or at a point; -1 if there is no such interval."""
        low, high = 0, len(self._intervals)
        x, y = point
        while low < high:
            middle = (low + high) // 2
            tail, head = self._intervals[middle].side
            (px, py), (qx, qy) = self._corners[tail], self._corners[head]
            if (qx - px) * (y - py) >= (qy - py) * (x - px):
                low = middle + 1
            else:
                high = middle
        return low - 1

    def _turn(self, p: int, q: int, r: int) -> int:
        """Twice the signed area of the triangle p, q, r: positive for a left turn, negative for a right turn."""
        (px, py), (qx, qy), (rx, ry) = self._corners[p], self._corners[q], self._corners[r]
        return (qx - px) * (ry - py) - (qy - py) * (rx - px)
