"""Geometry in space in exact numbers, independent of the library's."""

from fractions import Fraction
from itertools import combinations, product

import numpy as np

from shared.exact import integers


def exact(points):
    """The points, times a common power of two, in integers."""
    numbers = iter(integers(*np.asarray(points).ravel()))
    return [list(point) for point in zip(numbers, numbers, numbers, strict=True)]


def minus(a, b):
    return [x - y for x, y in zip(a, b, strict=True)]


def dot(a, b):
    return sum(x * y for x, y in zip(a, b, strict=True))


def cross(a, b):
    return [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]]


def determinant(p):
    return dot(minus(p[1], p[0]), cross(minus(p[2], p[0]), minus(p[3], p[0])))


def overlap(p, q):
    """Whether the interiors of two tetrahedra meet: no axis separates them."""
    axes = []
    for one in (p, q):
        axes += [cross(minus(b, a), minus(c, a)) for a, b, c in combinations(one, 3)]
    for (a, b), (c, d) in product(combinations(p, 2), combinations(q, 2)):
        axes.append(cross(minus(b, a), minus(d, c)))
    for axis in axes:
        if any(axis):
            one, other = ([dot(axis, point) for point in points] for points in (p, q))
            if max(one) <= min(other) or max(other) <= min(one):
                return False
    return True


def clip(polygon, normal, offset):
    """The part of a convex polygon in a closed half-space."""
    result = []
    for k, a in enumerate(polygon):
        b = polygon[(k + 1) % len(polygon)]
        left, right = dot(normal, a) - offset, dot(normal, b) - offset
        if left >= 0:
            result.append(a)
        if left * right < 0:
            t = Fraction(left, left - right)
            result.append([x + t * (y - x) for x, y in zip(a, b, strict=True)])
    return result


def contact(p, q):
    """Corners of the intersection of two triangles in space, by clipping one to the plane and sides of the other."""
    normal = cross(minus(q[1], q[0]), minus(q[2], q[0]))
    polygon = clip(p, normal, dot(normal, q[0]))
    down = [-x for x in normal]
    polygon = clip(polygon, down, dot(down, q[0]))
    for k in range(3):
        side = cross(normal, minus(q[(k + 1) % 3], q[k]))
        polygon = clip(polygon, side, dot(side, q[k]))
    return polygon
