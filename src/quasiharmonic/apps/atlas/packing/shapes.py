"""Shapes of charts: their outlines, and the directions in which their boxes are small."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from quasiharmonic.geometry.exact.triangles import triangle_signs
from quasiharmonic.geometry.mesh.topology import find_sides
from quasiharmonic.util.arrays import ComplexArray, FloatArray, IntArray, repeat_each, to_complex
from quasiharmonic.util.kernels import compiled

# A shape is straight if this share of its outline lies along two perpendicular directions, up to this angle.
_STRAIGHT, _SKEW = 0.4, np.pi / 180
# Corners of hulls are found on a grid of 2 to this power of cells along a side.
_HULL_BITS = 46
# Corners are at least this far from the side between their neighbours, in cells.
_LEAST_HEIGHT = 2.0


@dataclass(frozen=True, eq=False)
class Shape:
    """The part of the plane that a chart covers.

    The shape is the closure of the points around which the edges wind, and of the edges themselves. For an injective
    chart the edges are its boundary. Where triangles are inverted or degenerate, edges inside the shape are added, so
    that the shape covers every triangle.

    Attributes
    ----------
    tails, heads : (e,) complex128
        Ends of the directed edges. Each point is as often a tail as it is a head.
    hull : (h,) complex128
        Corners of the convex hull, or its two ends if all points are on a line.
    area : float
        Area of the triangles.
    direction : complex
        Unit vector along a side of the shape's box: along most of the outline if the shape is straight, otherwise that
        of the smallest box. It is rotated by at most 45° from the x-axis.
    straight : bool
        Whether much of the outline lies along two perpendicular directions. Such a shape is turned by right angles.
    """

    tails: ComplexArray
    heads: ComplexArray
    hull: ComplexArray
    area: float
    direction: complex
    straight: bool

    @cached_property
    def outline_lengths(self) -> tuple[float, float]:
        """Length of the outline along the sides of the box with the shape's direction, and in all."""
        along = (self.heads - self.tails) / self.direction
        length = np.abs(along)
        straight = np.minimum(np.abs(along.real), np.abs(along.imag)) <= np.sin(_SKEW) * length
        return float(length[straight].sum()), float(length.sum())

    @cached_property
    def sides(self) -> tuple[float, float]:
        """Width and height of the shape's box with the shape's direction."""
        return self.extent(self.direction)

    @property
    def lying(self) -> complex:
        """Unit vector along the longer side of this box."""
        return self.direction if self.sides[0] >= self.sides[1] else self.direction * 1j

    def extent(self, direction: complex) -> tuple[float, float]:
        """Width and height of the shape's box with a side along a unit vector."""
        seen = self.hull * direction.conjugate()
        return float(np.ptp(seen.real)), float(np.ptp(seen.imag))

    def move(self, shift: complex, scale: float) -> Shape:
        """Return the shape after a shift and then a scaling."""
        tails, heads, hull = ((points + shift) * scale for points in (self.tails, self.heads, self.hull))
        return Shape(tails, heads, hull, self.area * scale**2, self.direction, self.straight)

    def box_centre(self, direction: complex) -> complex:
        """Centre of the box with a side along a unit vector, relative to this direction."""
        seen = self.hull * direction.conjugate()
        return complex(seen.real.min() + seen.real.max(), seen.imag.min() + seen.imag.max()) / 2


def make_shape(uv: FloatArray, F: IntArray) -> Shape:
    """Return the shape of a chart with vertices (m, 2) and triangles (k, 3), at least one."""
    z = to_complex(uv)
    sign, _ = triangle_signs(F, uv)
    rows = np.where((sign < 0)[:, None], F[:, ::-1], F)
    tail, head = rows.ravel(), np.roll(rows, -1, axis=1).ravel()
    # Opposite directed edges cancel.
    ends, side = find_sides(rows, len(z))
    count = np.bincount(side.ravel(), np.where(tail < head, 1, -1), len(ends)).astype(np.int64)
    lower, upper = ends.T
    first, second = np.where(count > 0, lower, upper), np.where(count > 0, upper, lower)
    first, second = repeat_each(first, np.abs(count)), repeat_each(second, np.abs(count))
    thin = F[sign == 0]
    if thin.size:
        tail, head = thin.ravel(), np.roll(thin, -1, axis=1).ravel()
        first, second = np.concatenate([first, tail, head]), np.concatenate([second, head, tail])
    corners = z[F]
    across = ((corners[:, 1] - corners[:, 0]).conj() * (corners[:, 2] - corners[:, 0])).imag
    tails, heads, hull = z[first], z[second], convex_hull(z[np.unique(first)])
    along = _find_straight_direction(heads - tails)
    direction = find_smallest_box(hull) if along is None else along
    return Shape(tails, heads, hull, float(np.abs(across).sum() / 2), direction, along is not None)


def convex_hull(points: ComplexArray) -> ComplexArray:
    """Corners of the convex hull, counterclockwise from the leftmost one; the two ends if all points are on a line.

    Points are not corners if they are so close to the side between two corners that only rounding tells them apart.
    """
    # Rounded to a fine grid, points on an upright side have the same x.
    unit = 2.0 ** (np.frexp(max(np.ptp(points.real), np.ptp(points.imag)))[1] - _HULL_BITS)
    rounded = np.rint((points - complex(points.real.min(), points.imag.min())) / unit)
    order = np.lexsort((rounded.imag, rounded.real))
    corners = np.empty(len(points) + 1, dtype=np.int64)
    return points[order[corners[: find_hull(rounded[order], corners)]]]


@compiled
def find_hull(points: ComplexArray, corners: IntArray) -> int:
    """Fill in the indices of `convex_hull`, and return their number (Andrew's monotone chain [1]_).

    Parameters
    ----------
    points : (m,) complex128
        Of whole numbers, in ascending order of x, and then of y.
    corners : (m + 1,) int64
        Output.

    References
    ----------
    .. [1] A. Andrew, Another efficient algorithm for convex hulls in two dimensions. Information Processing Letters 9
       (1979).
    """
    x, y = points.real.tolist(), points.imag.tolist()
    count, kept = 0, 1
    # The lower side from left to right, and then the upper one back.
    for way in (range(len(x)), range(len(x) - 2, -1, -1)):
        for i in way:
            while count > kept:
                a, b = corners[count - 2], corners[count - 1]
                along, up, across, high = x[i] - x[a], y[i] - y[a], x[b] - x[a], y[b] - y[a]
                turn, least = up * across - along * high, _LEAST_HEIGHT * (abs(along) + abs(up))
                beyond = along * across + up * high > along * along + up * up
                if turn > (0 if beyond else least):
                    break
                count -= 1
            corners[count] = i
            count += 1
        kept = count
    return max(count - 1, 1)


def _find_straight_direction(sides: ComplexArray) -> complex | None:
    """Unit vector along which, or across which, most of some sides lie; None if there is no such direction."""
    length = np.abs(sides)
    total = length.sum()
    # The fourth power is equal for directions that differ by right angles.
    angle = np.angle(sides[length > 0] ** 4) / 4
    length = length[length > 0]
    order = np.argsort(angle, kind="stable")
    angle = np.concatenate([angle[order], angle[order] + np.pi / 2])
    length = np.concatenate([length[order], length[order]])
    below = np.concatenate([[0.0], np.cumsum(length)])
    last = np.searchsorted(angle, angle[: len(order)] + _SKEW, side="right")
    share = below[last] - below[: len(order)]
    if not order.size or share.max() < _STRAIGHT * total:
        return None
    best = int(np.argmax(share))
    # Long sides count most, because short ones are less accurate.
    some = slice(best, last[best])
    mean = float(np.average(angle[some], weights=length[some] ** 2))
    return _turn_to_axis(np.exp(1j * np.array([mean])))[0]


def find_smallest_box(hull: ComplexArray) -> complex:
    """Unit vector along a side of the box of smallest area around a convex hull (h,), at most 45° from the x-axis."""
    # Positions of hull points computed per block.
    block = 1 << 20
    sides = np.roll(hull, -1) - hull
    along = _turn_to_axis(np.concatenate([[1 + 0j], sides[sides != 0] / np.abs(sides[sides != 0])]))
    boxes = [
        np.ptp(seen.real, axis=1) * np.ptp(seen.imag, axis=1)
        for some in np.array_split(along, 1 + along.size * hull.size // block)
        for seen in (hull[None, :] * some.conj()[:, None],)
    ]
    size = np.concatenate(boxes)
    # Boxes whose areas differ by at most this fraction count as equal; the one with the smallest rotation is taken.
    as_small = 1e-9
    small = np.flatnonzero(size <= (1 + as_small) * size.min())
    return complex(along[small[np.argmin(np.abs(along[small].imag))]])


def _turn_to_axis(along: ComplexArray) -> ComplexArray:
    """Rotate unit vectors by multiples of 90° to at most 45° from the x-axis."""
    turn = np.array([1, -1j, -1, 1j])[np.rint(np.angle(along) / (np.pi / 2)).astype(np.int64) % 4]
    return np.asarray(along * turn)
