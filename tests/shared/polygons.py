"""Outlines in the plane: simple, spiral and random ones."""

from __future__ import annotations

import numpy as np

from quasiharmonic.geometry.exact.predicates import SegmentRelation, segment_relation

# A corridor around three sides of a square: its ends are not visible from each other.
U = [[0, 0], [9, 0], [9, 9], [6, 9], [6, 3], [3, 3], [3, 9], [0, 9]]


def circle(n, radius=1.0, turns=1):
    t = 2 * np.pi * turns * np.arange(n) / n
    return radius * np.stack([np.cos(t), np.sin(t)], axis=1)


def spread(polygon, n):
    """``n`` points on a polygon: its corners, and repeated midpoints of its longest sides."""
    points = [np.asarray(p, dtype=float) for p in polygon]
    while len(points) < n:
        k = int(np.argmax([np.linalg.norm(points[k] - points[k - 1]) for k in range(len(points))]))
        points.insert(k, (points[k] + points[k - 1]) / 2)
    return np.array(points)


def spiral(n, turns, width=0.6):
    """A band wound around itself without touching, as a polygon with ``2 n`` corners."""
    t = np.linspace(0, 2 * np.pi * turns, n)
    outward = np.stack([np.cos(t), np.sin(t)], axis=1)
    middle = 1 + t[:, None] / (2 * np.pi)
    return np.concatenate([(middle + width / 2) * outward, ((middle - width / 2) * outward)[::-1]])


def random_polygon(rng, n, size):
    """A simple polygon, counterclockwise, on a grid of ``size`` points a side, often with straight angles."""
    while True:
        p = rng.permutation(np.stack(np.divmod(rng.permutation(size**2)[:n], size), axis=1)).astype(float)
        for _ in range(20 * n):
            q = np.roll(p, -1, axis=0)
            i, j = np.triu_indices(n, 2)
            relation = segment_relation(p[i], q[i], p[j], q[j])
            # The first edge and the last share an endpoint.
            crossed = np.flatnonzero((relation != SegmentRelation.DISJOINT) & ((i > 0) | (j < n - 1)))
            if not crossed.size:
                break
            k = rng.choice(crossed)
            p[i[k] + 1 : j[k] + 1] = p[i[k] + 1 : j[k] + 1][::-1].copy()
        folded = segment_relation(p, q, q, np.roll(q, -1, axis=0)) == SegmentRelation.OVERLAPPING
        area = np.sum(p[:, 0] * q[:, 1] - p[:, 1] * q[:, 0])
        if not crossed.size and not folded.any() and area:
            return p if area > 0 else p[::-1]
