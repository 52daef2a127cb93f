"""Polygonal faces and their triangulation.

The triangulation adds no vertices and depends on the shape of the polygons. A polygon is a ring of corners of
triangles. So data at the corners of triangles, such as vertex and texture position, also describe the polygon's
corners.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from quasiharmonic.util.arrays import (
    BoolArray,
    ComplexArray,
    FloatArray,
    IntArray,
    names_of,
    repeat_each,
    scale_to_unit,
)

# Ears whose scores differ by less count as equal, and the first one is cut, so that rounding does not decide.
_SCORE_TOLERANCE = 1e-9


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
    small = np.flatnonzero(sizes < 3)
    if small.size:
        raise ValueError(f"{names_of('face', 'faces', small)} of fewer than three corners")
    face = repeat_each(np.arange(len(sizes)), np.where(sizes > 3, sizes, 0))
    vertices = vertices[repeat_each(sizes > 3, sizes)]
    order = np.lexsort((vertices, face))
    same = (np.diff(face[order]) == 0) & (np.diff(vertices[order]) == 0)
    if same.any():
        raise ValueError(
            f"{names_of('face', 'faces', np.unique(face[order][1:][same]))} with a vertex twice: remove the repetition"
        )


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
    before, after = np.roll(flat, 1, axis=1), np.roll(flat, -1, axis=1)
    score = _shape(before, flat, after)
    if flat.shape[1] == 4:
        # Score the remaining triangle, too.
        score = np.minimum(score, _shape(after, np.roll(flat, -2, axis=1), before))
    rows = np.arange(len(flat))
    best = np.argmax(score >= score.max(axis=1, keepdims=True) - _SCORE_TOLERANCE, axis=1)
    chosen, is_open, untried = best.copy(), np.ones(len(flat), dtype=np.bool_), score.copy()
    while is_open.any():
        row, ear = rows[is_open], chosen[is_open]
        blocked = _contains_another(flat[row], ear) & (untried[row, ear] > 0)
        untried[row[blocked], ear[blocked]] = -np.inf
        is_open[row[~blocked]] = False
        blocked_rows = row[blocked]
        best_left = untried[blocked_rows].max(axis=1, keepdims=True)
        chosen[blocked_rows] = np.argmax(untried[blocked_rows] >= best_left - _SCORE_TOLERANCE, axis=1)
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
