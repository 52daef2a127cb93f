"""Orientation and intersection in exact arithmetic, by formulas different from the library's."""

from __future__ import annotations

from quasiharmonic.geometry.exact.predicates import SegmentRelation


def integers(*numbers):
    """The numbers, times a common power of two that makes all of them whole."""
    ratios = [float(x).as_integer_ratio() for x in numbers]
    whole = max(below for _, below in ratios)
    return [above * (whole // below) for above, below in ratios]


def exact_orientation(a, b, c):
    """Sign of the signed area in integers."""
    ax, ay, bx, by, cx, cy = integers(*a, *b, *c)
    det = (ax - cx) * (by - cy) - (ay - cy) * (bx - cx)
    return (det > 0) - (det < 0)


def exact_relation(p, q, r, s):
    """The relation of two segments, found by solving for their common point in integers."""
    px, py, qx, qy, rx, ry, sx, sy = integers(*p, *q, *r, *s)
    p, q, r, s = (px, py), (qx, qy), (rx, ry), (sx, sy)
    if p == q or r == s:
        point, (a, b) = (p, (r, s)) if p == q else (r, (p, q))
        on_line = (b[0] - a[0]) * (point[1] - a[1]) == (b[1] - a[1]) * (point[0] - a[0])
        return SegmentRelation(2 * (on_line and min(a, b) <= point <= max(a, b)))
    d, e, f = ((y[0] - x[0], y[1] - x[1]) for x, y in ((p, q), (r, s), (p, r)))
    det = d[0] * e[1] - d[1] * e[0]
    if det == 0:
        if d[0] * f[1] != d[1] * f[0]:
            return SegmentRelation.DISJOINT
        # Parameters along pq, from 0 at p to |d|² at q.
        along = sorted((x[0] - p[0]) * d[0] + (x[1] - p[1]) * d[1] for x in (r, s))
        lo, hi = max(along[0], 0), min(along[1], d[0] ** 2 + d[1] ** 2)
        return SegmentRelation.OVERLAPPING if lo < hi else SegmentRelation(2 * (lo == hi))
    # The parameters of the common point along both segments, times |det|.
    sign = 1 if det > 0 else -1
    t = (f[0] * e[1] - f[1] * e[0]) * sign
    u = (f[0] * d[1] - f[1] * d[0]) * sign
    if 0 < t < det * sign and 0 < u < det * sign:
        return SegmentRelation.CROSSING
    return SegmentRelation(2 * (0 <= t <= det * sign and 0 <= u <= det * sign))


def inverted(F, uv):
    """Count inverted triangles in integers, independently of the library."""
    return sum(exact_orientation(*uv[corners]) <= 0 for corners in F)
