"""Meshes of simulations: quadrilaterals, second-order triangles, channels around a body."""

from __future__ import annotations

from fractions import Fraction
from itertools import combinations
from operator import mul

import numpy as np

from shared.exact import integers


def quadrilaterals(n, m):
    """The unit square cut into n × m quadrilaterals, counterclockwise."""
    x, y = np.meshgrid(np.linspace(0, 1, n + 1), np.linspace(0, 1, m + 1))
    number = np.arange(x.size).reshape(m + 1, n + 1)
    corners = [number[:-1, :-1], number[:-1, 1:], number[1:, 1:], number[1:, :-1]]
    return np.stack([x.ravel(), y.ravel()], axis=1), np.stack(corners, axis=-1).reshape(-1, 4)


def channel(n):
    """Quadrilaterals of the square from -1 to 1 around a flat body, and the body's nodes; n is a multiple of 8."""
    points, F = quadrilaterals(n, n)
    points = 2 * points - 1
    middle = np.abs(points[F].mean(axis=1))
    F = F[(middle[:, 0] > 0.5) | (middle[:, 1] > 0.25)]
    used = np.unique(F)
    points, F = points[used], np.searchsorted(used, F)
    body = (np.abs(points[:, 0]) <= 0.5 + 1e-9) & (np.abs(points[:, 1]) <= 0.25 + 1e-9)
    return points, F, np.flatnonzero(body)


def second_order(points, F):
    """The same triangles with a node in the middle of every side, numbered after the others."""
    pairs, number = np.unique(np.sort(F[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2), axis=1), axis=0, return_inverse=True)
    middles = points[pairs].mean(axis=1)
    return np.concatenate([points, middles]), np.concatenate([F, len(points) + number.reshape(-1, 3)], axis=1)


def turned(points, degrees):
    """Points turned about the origin."""
    angle = np.radians(degrees)
    return points @ np.array([(np.cos(angle), np.sin(angle)), (-np.sin(angle), np.cos(angle))])


def min_jacobian(nodes):
    """The minimum Jacobian determinant of a six-node triangle (6, 2), as a fraction, from its shape functions.

    The determinant is a quadratic polynomial of (s, t), determined by its values at six points. Its minimum is at a
    corner or at a stationary point on a side or inside.
    """
    *numbers, unit = integers(*np.ravel(nodes), 1.0)
    x, y = numbers[::2], numbers[1::2]

    def determinant(s, t):
        """At s / 2 and t / 2, in squares of the unit."""
        r = 2 - s - t
        by_s = [1 - 2 * r, 2 * s - 1, 0, 2 * (r - s), 2 * t, -2 * t]
        by_t = [1 - 2 * r, 0, 2 * t - 1, -2 * s, 2 * s, 2 * (r - t)]
        a, b, c, d = (sum(map(mul, by, at)) for by in (by_s, by_t) for at in (x, y))
        return a * d - b * c

    corners = [(0, 0), (2, 0), (0, 2)]
    candidates = [determinant(*corner) for corner in corners]
    for (s0, t0), (s1, t1) in combinations(corners, 2):
        a, b, c = determinant(s0, t0), determinant((s0 + s1) // 2, (t0 + t1) // 2), determinant(s1, t1)
        bend, slope = 2 * (a + c - 2 * b), 4 * b - 3 * a - c
        if 0 < -slope < 2 * bend:
            candidates.append(a - Fraction(slope * slope, 4 * bend))
    # f = c + p s + q t + u s² + v s t + w t²
    c, at_s, at_t = candidates[:3]
    u = 2 * (c + at_s - 2 * determinant(1, 0))
    w = 2 * (c + at_t - 2 * determinant(0, 1))
    p, q = at_s - c - u, at_t - c - w
    v = 4 * (determinant(1, 1) - c) - 2 * (p + q) - u - w
    det = 4 * u * w - v * v
    if det != 0:
        s, t = Fraction(v * q - 2 * w * p, det), Fraction(v * p - 2 * u * q, det)
        if s > 0 and t > 0 and s + t < 1:
            candidates.append(determinant(2 * s, 2 * t))
    return min(candidates) / Fraction(unit) ** 2
