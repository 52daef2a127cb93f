"""Exact geometric predicates on arrays of points.

Predicates are exact for the coordinates as stored, whatever their magnitude. Doubles are rational numbers, so no sign
depends on rounding. `segment_relation` uses `orientation`, which has three stages. Each stage processes the cases that
the previous one could not decide:

1. the determinant in floating point, with an error bound (one pass over the array);
2. the determinant after scaling each triple by a power of two to magnitude one, then as an exact sum of
   sixteen doubles [1]_, which is distilled until its sign is certain [2]_ [3]_;
3. integers of any size, for triples whose coordinates span more than 130 orders of magnitude.

`sure_orientation` has only the first stage: it returns the exact sign, or 0 where this stage cannot decide.
`twice_area` returns the determinant instead of its sign. It computes the sum of stage 2 with a relative error of at
most 2⁻⁴⁸.

The code requires IEEE 754 doubles with gradual underflow. NumPy has these unless another library in the
process makes its thread flush subnormal numbers to zero. If NumPy computes in x87 registers, as on 32-bit x86 without
SSE2, sums are rounded twice; then stage 3 replaces stage 2.

References
----------
.. [1] J. R. Shewchuk, Adaptive precision floating-point arithmetic and fast robust geometric
   predicates. Discrete & Computational Geometry 18 (1997).
.. [2] S. M. Rump, T. Ogita, S. Oishi, Accurate floating-point summation part I: faithful rounding.
   SIAM Journal on Scientific Computing 31 (2008).
.. [3] G. Bohlender, Floating-point computation of functions with maximum accuracy.
   IEEE Transactions on Computers C-26 (1977).
"""

from __future__ import annotations

from enum import IntEnum
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from quasiharmonic.util.arrays import (
    BoolArray,
    FloatArray,
    IntArray,
    SignArray,
    to_integers,
)


class OrientationBounds(NamedTuple):
    """Bounds of rounding errors of an orientation. The C kernel has the same values of the first two."""

    # |computed − exact| ≤ (3u + O(u²)) (|l| + |r|) for the determinant l − r, u = 2⁻⁵³ [1]_, and 4u covers the second
    # order and the rounding of the bound itself.
    relative_bound: float = 2.0**-51
    # Each of the two products, and the bound, may lose up to 2⁻¹⁰⁷⁵ to underflow; sums lose nothing.
    underflow_bound: float = 2.0**-1060
    # After scaling, a coordinate of stage 2 is 0 or at least this; stage 3 takes the other triples. So all intermediate
    # values are multiples of 2⁻⁹⁸⁴, and no product underflows.
    min_scaled: float = 2.0**-440
    # Triples per block in stage 2, so that the sixteen components stay in the cache.
    exact_chunk: int = 8192


_BOUNDS = OrientationBounds()

# Whether NumPy rounds a sum once. x87 registers round this one to 1 + 2⁻⁵³ first, and then to 1.
ROUNDS_ONCE = bool(np.add(np.ones(1), 2.0**-53 + 2.0**-78)[0] > 1.0)


def orientation(a: ArrayLike, b: ArrayLike, c: ArrayLike) -> SignArray:
    """Exact sign of the signed area of triangles.

    Parameters
    ----------
    a, b, c : (k, 2) float64
        Corners, or arrays that broadcast to a common shape (..., 2).

    Returns
    -------
    (k,) int8
        1 if ``a, b, c`` is counterclockwise, -1 if it is clockwise, 0 if the three points
        lie exactly on a line.

    Raises
    ------
    ValueError
        If a coordinate is NaN or infinite.

    Examples
    --------
    >>> orientation([[0.0, 0.0]], [[1.0, 0.0]], [[0.5, 1e-300]])
    array([1], dtype=int8)
    """
    sign, nonfinite = orientation_or_nonfinite(a, b, c)
    if nonfinite.size:
        raise ValueError(f"NaN or infinite coordinates in triple {nonfinite[0]} ({nonfinite.size} in all)")
    return sign


def orientation_or_nonfinite(a: ArrayLike, b: ArrayLike, c: ArrayLike) -> tuple[SignArray, IntArray]:
    """Compute `orientation`, but report triples with NaN or infinite coordinates instead of raising.

    Returns the signs (k,) int8, 0 for these triples, and the ascending flat indices of these triples.
    """
    a, b, c = (np.asarray(p, dtype=np.float64) for p in (a, b, c))
    corners = (a[..., 0], a[..., 1], b[..., 0], b[..., 1], c[..., 0], c[..., 1])
    # An overflow or an invalid operation makes the bound infinite or the determinant NaN, so the triple stays
    # undecided.
    with np.errstate(over="ignore", under="ignore", invalid="ignore"):
        sign = _sign_if_certain(*corners)
        if np.all(sign):
            return sign, np.empty(0, dtype=np.int64)
        undecided = sign == 0
        x = np.stack([(p if p.shape == sign.shape else np.broadcast_to(p, sign.shape))[undecided] for p in corners])
        finite = np.isfinite(x).all(axis=0)
        decided = np.zeros(finite.size, dtype=np.int8)
        decided[finite] = _decide_exactly(x[:, finite])
        sign[undecided] = decided
    return sign, np.flatnonzero(undecided)[~finite]


def sure_orientation(a: FloatArray, b: FloatArray, c: FloatArray) -> SignArray:
    """The `orientation` where floating point is certain of it; 0 elsewhere."""
    with np.errstate(over="ignore", under="ignore", invalid="ignore"):
        return _sign_if_certain(a[..., 0], a[..., 1], b[..., 0], b[..., 1], c[..., 0], c[..., 1])


def _sign_if_certain(
    ax: FloatArray, ay: FloatArray, bx: FloatArray, by: FloatArray, cx: FloatArray, cy: FloatArray
) -> SignArray:
    """Sign of the orientation where rounding cannot change it; 0 elsewhere."""
    left = (ax - cx) * (by - cy)
    right = (ay - cy) * (bx - cx)
    det = left - right
    bound = np.abs(left)
    bound += np.abs(right)
    bound *= _BOUNDS.relative_bound
    bound += _BOUNDS.underflow_bound
    sign = np.asarray(det > bound).view(np.int8)
    sign -= np.asarray(det < -bound).view(np.int8)
    return sign


def _decide_exactly(x: FloatArray) -> SignArray:
    """Orientation of the triples ``x``, (6, k) finite, as rows ax, ay, bx, by, cx, cy."""
    # Rounded differences have the right sign. If the two products have different signs, the sign of their difference is
    # therefore exact. This covers coincident corners and lines along an axis at little cost.
    left = np.sign(x[0] - x[4]) * np.sign(x[3] - x[5])
    right = np.sign(x[1] - x[5]) * np.sign(x[2] - x[4])
    sign: SignArray = np.sign(left - right).astype(np.int8)
    undecided = np.flatnonzero((left == right) & (left != 0) & ((x[0] != x[2]) | (x[1] != x[3])))
    for start in range(0, undecided.size, _BOUNDS.exact_chunk):
        chunk = undecided[start : start + _BOUNDS.exact_chunk]
        sign[chunk] = _decide_scaled(x[:, chunk])
    return sign


def _decide_scaled(x: FloatArray) -> SignArray:
    """Compute `_decide_exactly` after scaling every triple to magnitude one."""
    exponent = np.frexp(np.abs(x).max(axis=0))[1]
    scaled = np.ldexp(x, -exponent)
    # Scaling may have rounded the coordinates of these triples; the following code is valid for the others.
    wide = ((np.abs(scaled) < _BOUNDS.min_scaled) & (x != 0)).any(axis=0) | (not ROUNDS_ONCE)
    sign = _sign_if_certain(*scaled)
    undecided = (sign == 0) & ~wide
    if np.any(undecided):
        sign[undecided] = _decide_by_expansion(scaled[:, undecided])
    for k in np.flatnonzero(wide):
        sign[k] = _decide_in_integers(x[:, k])
    return sign


def _decide_by_expansion(x: FloatArray) -> SignArray:
    """Orientation by expansion, for coordinates of magnitude up to one that are 0 or ≥ 2⁻⁴⁴⁰."""
    return np.sign(exact_sum(_components(x))).astype(np.int8)


def _components(x: FloatArray) -> FloatArray:
    """Sixteen doubles, usually smaller ones first, whose exact sum is the determinant; (16, k)."""
    (ax, bx), (ax_tail, bx_tail) = two_sum(x[0:4:2], -x[4])
    (ay, by), (ay_tail, by_tail) = two_sum(x[1:4:2], -x[5])
    # Expand (ax + ax_tail)(by + by_tail) − (ay + ay_tail)(bx + bx_tail) into products, small ones first.
    product, error = two_product(
        np.stack([ax_tail, -ay_tail, ax_tail, ax, -ay_tail, -ay, ax, -ay]),
        np.stack([by_tail, bx_tail, by, by_tail, bx, bx_tail, by, bx]),
    )
    return np.concatenate([error[:2], product[:2], error[2:6], error[6:], product[2:6], product[6:]])


def exact_sum(terms: FloatArray) -> FloatArray:
    """Sum over axis 0 of (t, k) terms whose sums neither overflow nor underflow; relative error at most 2⁻⁴⁸.

    The terms are overwritten.

    Each sweep replaces the terms by others with the same exact sum. The last one is the rounded sum, and the
    others are rounding errors [2]_. A sum is decided when the last term exceeds the rest in magnitude. This takes
    at most t - 1 sweeps [3]_ and usually two or three.
    """
    total = np.zeros(terms.shape[1])
    left = np.arange(terms.shape[1])
    while left.size:
        for i in range(1, len(terms)):
            terms[i], terms[i - 1] = two_sum(terms[i], terms[i - 1])
        # Doubling makes the computed magnitude of the rest an upper bound.
        rest = 2.0 * np.abs(terms[:-1]).sum(axis=0)
        decided = (np.abs(terms[-1]) > rest) | (rest == 0.0)
        total[left[decided]] = terms[-1, decided] + terms[:-1, decided].sum(axis=0)
        left, terms = left[~decided], terms[:, ~decided]
    return total


def two_sum(a: FloatArray, b: FloatArray) -> tuple[FloatArray, FloatArray]:
    """The rounded sum and its rounding error, which together equal ``a + b`` exactly (Knuth)."""
    total = a + b
    b_part = total - a
    return total, (a - (total - b_part)) + (b - b_part)


def two_product(a: FloatArray, b: FloatArray) -> tuple[FloatArray, FloatArray]:
    """The rounded product and its rounding error, which together equal ``a * b`` exactly (Dekker, Veltkamp)."""
    product = a * b
    a_high, a_low = _split(a)
    b_high, b_low = _split(b)
    error = a_low * b_low - (((product - a_high * b_high) - a_low * b_high) - a_high * b_low)
    return product, error


def _split(a: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Two parts of at most 26 bits each with exact sum ``a``."""
    scaled = 134217729.0 * a  # 2²⁷ + 1
    high = scaled - (scaled - a)
    return high, a - high


def _decide_in_integers(x: FloatArray) -> int:
    """Orientation of one triple (6,) in integer arithmetic."""
    ax, ay, bx, by, cx, cy = to_integers(x)
    det: int = (ax - cx) * (by - cy) - (ay - cy) * (bx - cx)
    return (det > 0) - (det < 0)


def twice_area(a: FloatArray, b: FloatArray, c: FloatArray) -> FloatArray:
    """Twice the signed area of triangles, accurate for thin triangles.

    Parameters
    ----------
    a, b, c : (k, 2) float64
        Corners, finite, with differences of magnitude about one.

    Returns
    -------
    (k,) float64
        Relative error at most 2⁻⁴⁸, so zero exactly for corners on a line. This holds if no product of
        differences, or of their rounding errors, underflows.
    """
    x = np.concatenate([a.T, b.T, c.T])
    area = np.empty(x.shape[1])
    for start in range(0, area.size, _BOUNDS.exact_chunk):
        chunk = slice(start, start + _BOUNDS.exact_chunk)
        area[chunk] = exact_sum(_components(x[:, chunk]))
    return area


class SegmentRelation(IntEnum):
    """Kinds of intersections of two closed segments."""

    DISJOINT = 0  # No point
    CROSSING = 1  # One point, interior to both
    TOUCHING = 2  # One point, an end of at least one of them
    OVERLAPPING = 3  # A segment of positive length


def segment_relation(p: FloatArray, q: FloatArray, r: FloatArray, s: FloatArray) -> SignArray:
    """Classify the intersection of the closed segments ``pq`` and ``rs`` exactly, as a `SegmentRelation`.

    The ends (k, 2) are finite; a segment may be a single point.
    """
    relation = np.zeros(len(p), dtype=np.int8)
    r_side, s_side = orientation(p, q, r), orientation(p, q, s)
    # Most candidates have rs strictly on one side of pq and need no further test.
    near = np.flatnonzero(r_side * s_side <= 0)
    p, q, r, s = (array.take(near, axis=0) for array in (p, q, r, s))
    r_side, s_side = r_side[near], s_side[near]
    p_side, q_side = orientation(r, s, p), orientation(r, s, q)
    crossing = (r_side * s_side < 0) & (p_side * q_side < 0)
    touching = (
        ((r_side == 0) & _in_box(r, p, q))
        | ((s_side == 0) & _in_box(s, p, q))
        | ((p_side == 0) & _in_box(p, r, s))
        | ((q_side == 0) & _in_box(q, r, s))
    )
    # On a common line, lexicographic order is the order along the line, so the overlap is that of two intervals.
    collinear = (r_side == 0) & (s_side == 0) & (p_side == 0) & (q_side == 0)
    p_first, r_first = _compare_lexically(p, q), _compare_lexically(r, s)
    p, q = np.where(p_first[:, None], p, q), np.where(p_first[:, None], q, p)
    r, s = np.where(r_first[:, None], r, s), np.where(r_first[:, None], s, r)
    start = np.where(_compare_lexically(p, r)[:, None], r, p)
    end = np.where(_compare_lexically(q, s)[:, None], q, s)
    relation[near[touching]] = SegmentRelation.TOUCHING
    relation[near[crossing]] = SegmentRelation.CROSSING
    relation[near[collinear & _compare_lexically(start, end)]] = SegmentRelation.OVERLAPPING
    return relation


def _compare_lexically(a: FloatArray, b: FloatArray) -> BoolArray:
    """Lexicographic order of points: by x, then by y."""
    return (a[:, 0] < b[:, 0]) | ((a[:, 0] == b[:, 0]) & (a[:, 1] < b[:, 1]))


def _in_box(x: FloatArray, p: FloatArray, q: FloatArray) -> BoolArray:
    """Whether ``x`` lies in the closed box spanned by ``p`` and ``q``."""
    inside: BoolArray = (np.minimum(p, q) <= x) & (x <= np.maximum(p, q))
    return inside[:, 0] & inside[:, 1]
