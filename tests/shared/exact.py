"""Orientation and intersection in rational arithmetic, by formulas different from the library's."""

from __future__ import annotations

from fractions import Fraction

from quasiharmonic.geometry.exact.predicates import SegmentRelation


def exact_orientation(a, b, c):
    """Sign of the signed area in rational arithmetic."""
    ax, ay, bx, by, cx, cy = (Fraction(float(x)) for x in (*a, *b, *c))
    det = (ax - cx) * (by - cy) - (ay - cy) * (bx - cx)
    return (det > 0) - (det < 0)


def exact_relation(p, q, r, s):
    """The relation of two segments, found by solving for their common point in rational arithmetic."""
    p, q, r, s = (tuple(Fraction(float(x)) for x in point) for point in (p, q, r, s))
    if p == q or r == s:
        point, (a, b) = (p, (r, s)) if p == q else (r, (p, q))
        on_line = (b[0] - a[0]) * (point[1] - a[1]) == (b[1] - a[1]) * (point[0] - a[0])
        return SegmentRelation(2 * (on_line and min(a, b) <= point <= max(a, b)))
    d, e, f = ((y[0] - x[0], y[1] - x[1]) for x, y in ((p, q), (r, s), (p, r)))
    det = d[0] * e[1] - d[1] * e[0]
    if det == 0:
        if d[0] * f[1] != d[1] * f[0]:
            return SegmentRelation.DISJOINT
        # Parameters along pq, from 0 at p to 1 at q.
        along = sorted(((x[0] - p[0]) * d[0] + (x[1] - p[1]) * d[1]) / (d[0] ** 2 + d[1] ** 2) for x in (r, s))
        lo, hi = max(along[0], 0), min(along[1], 1)
        return SegmentRelation.OVERLAPPING if lo < hi else SegmentRelation(2 * (lo == hi))
    t = (f[0] * e[1] - f[1] * e[0]) / det
    u = (f[0] * d[1] - f[1] * d[0]) / det
    if 0 < t < 1 and 0 < u < 1:
        return SegmentRelation.CROSSING
    return SegmentRelation(2 * (0 <= t <= 1 and 0 <= u <= 1))


def inverted(F, uv):
    """Count inverted triangles in rational arithmetic, independently of the library."""
    count = 0
    for i, j, k in F:
        (ax, ay), (bx, by), (cx, cy) = ((Fraction(x), Fraction(y)) for x, y in uv[[i, j, k]])
        count += (bx - ax) * (cy - ay) - (by - ay) * (cx - ax) <= 0
    return count
