"""Maps with loops, sheets and branch points."""

from __future__ import annotations

import numpy as np

SQUARE = np.array([[0, 1, 2], [0, 2, 3]])


CORNERS = np.array([[0.0, 0], [1, 0], [1, 1], [0, 1]])


def strip(columns, rows=1, closed=False):
    """A band of ``columns × rows`` squares along the first axis, numbered by column, optionally closed to a ring."""
    index = np.arange((columns + (not closed)) * (rows + 1)).reshape(-1, rows + 1)
    following = np.roll(index, -1, axis=0) if closed else index[1:]
    index = index if closed else index[:-1]
    a, b, c, d = index[:, :-1], following[:, :-1], following[:, 1:], index[:, 1:]
    return np.stack([a, b, c, a, c, d], axis=-1).reshape(-1, 3)


def polar(radius, turns):
    return np.stack([radius * np.cos(2 * np.pi * turns), radius * np.sin(2 * np.pi * turns)], axis=-1)


def spiral(turns, pitch, columns=60):
    """A band of width one wound around the origin, with its inner side first in every column."""
    t = np.linspace(0, turns, columns + 1)
    # For counterclockwise triangles the outer side must come first.
    outer, inner = polar(2 + pitch * t, t), polar(1 + pitch * t, t)
    return strip(columns), np.stack([outer, inner], axis=1).reshape(-1, 2)


def ring(inner=1.0, outer=2.0, columns=12):
    """An annulus with vertex 2i on the outer loop and 2i + 1 on the inner one."""
    t = np.arange(columns) / columns
    return strip(columns, closed=True), np.stack([polar(outer, t), polar(inner, t)], axis=1).reshape(-1, 2)


def fan(polygon, centre=(0.0, 0.0)):
    """A fan whose boundary is a polygon, with vertex 0 at its centre."""
    k = len(polygon)
    rim = np.arange(k)
    return np.stack([np.zeros(k, dtype=int), 1 + rim, 1 + (rim + 1) % k], axis=1), np.vstack([centre, polygon])


def together(*parts):
    """The disjoint union of several meshes."""
    offsets = np.cumsum([0] + [len(uv) for _, uv in parts])
    return np.vstack([F + o for (F, _), o in zip(parts, offsets, strict=False)]), np.vstack([uv for _, uv in parts])


def square(x, y, size):
    return SQUARE, CORNERS * size + (x, y)


def kinds(certificate):
    return {reason.kind for reason in certificate.reasons}
