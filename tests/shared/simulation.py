"""Meshes of simulations: quadrilaterals, second-order triangles, channels around a body."""

from __future__ import annotations

from fractions import Fraction
from itertools import combinations

import numpy as np


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
    X = [[Fraction(x) for x in row] for row in np.asarray(nodes).tolist()]

    def determinant(s, t):
        r = 1 - s - t
        by_s = [1 - 4 * r, 4 * s - 1, 0, 4 * (r - s), 4 * t, -4 * t]
        by_t = [1 - 4 * r, 0, 4 * t - 1, -4 * s, 4 * s, 4 * (r - t)]
        (a, b), (c, d) = (
            [sum(slope * x[i] for slope, x in zip(by, X, strict=True)) for i in (0, 1)] for by in (by_s, by_t)
        )
        return a * d - b * c

    half = Fraction(1, 2)
    corners = [(Fraction(0), Fraction(0)), (Fraction(1), Fraction(0)), (Fraction(0), Fraction(1))]
    candidates = [determinant(*corner) for corner in corners]
    for (s0, t0), (s1, t1) in combinations(corners, 2):
        a, b, c = determinant(s0, t0), determinant((s0 + s1) * half, (t0 + t1) * half), determinant(s1, t1)
        bend, slope = 2 * (a + c - 2 * b), 4 * b - 3 * a - c
        if bend > 0 and 0 < -slope / (2 * bend) < 1:
            candidates.append(a - slope * slope / (4 * bend))
    # f = c + p s + q t + u s² + v s t + w t²
    c, at_s, at_t = candidates[:3]
    u = 2 * (c + at_s - 2 * determinant(half, 0))
    w = 2 * (c + at_t - 2 * determinant(0, half))
    p, q = at_s - c - u, at_t - c - w
    v = 4 * (determinant(half, half) - c - (p + q) * half - (u + w) * half * half)
    det = 4 * u * w - v * v
    if det != 0:
        s, t = (v * q - 2 * w * p) / det, (v * p - 2 * u * q) / det
        if s > 0 and t > 0 and s + t < 1:
            candidates.append(determinant(s, t))
    return min(candidates)
