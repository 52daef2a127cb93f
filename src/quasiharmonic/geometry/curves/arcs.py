"""Pieces of curves: lines, Bézier curves and elliptic arcs, and their points evaluated in twice the precision."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache
from itertools import pairwise
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from quasiharmonic.geometry.exact.predicates import two_product, two_sum
from quasiharmonic.util.arrays import ComplexArray, FloatArray, IntArray, check_finite, real_array, to_complex

# Longest arc in radians, so that a few nodes integrate its length to rounding.
_MAX_ARC = np.pi / 4


class ArcTuning(NamedTuple):
    """Numbers that tune lengths and distances on curves."""

    # Turn of a curve along one chord, in radians.
    flat: float = 0.1
    # A zero of the derivative is interior if its parameter differs by at least this value from both ends.
    inside: float = 1e-6
    # Nodes of Gauss' formula for a length.
    nodes: int = 16
    # Number of distances between points and segments computed together.
    pairs: int = 1 << 20


_TUNING = ArcTuning()

#: A derivative below this value, relative to the curve's size, counts as zero.
ZERO_DERIVATIVE = 1e-9


@dataclass(frozen=True, eq=False)
class Arc:
    """An elliptic arc ``centre + a cos θ + b sin θ`` from one angle to another.

    Attributes
    ----------
    centre, a, b : (2,) float
        Axes. If they are orthogonal and of equal length, the arc is circular.
    first, last : float
        Angles in radians. The arc runs clockwise if ``last`` is smaller.

    See Also
    --------
    geometry.curves.Curve : Made of arcs and other pieces.

    Examples
    --------
    >>> import math
    >>> from quasiharmonic.geometry.curves import Arc, Curve
    >>> half = Curve([Arc((0, 0), (1, 0), (0, 1), 0, math.pi)])
    >>> half.closed, round(half.length, 6)
    (False, 3.141593)
    """

    centre: ArrayLike
    a: ArrayLike
    b: ArrayLike
    first: float
    last: float

    def transform(self, matrix: FloatArray, shift: FloatArray) -> Arc:
        """The elliptic arc after ``x → matrix @ x + shift``."""
        centre, a, b = (matrix @ np.asarray(x, dtype=np.float64) for x in (self.centre, self.a, self.b))
        return Arc(centre + shift, a, b, self.first, self.last)


class ArcPiece(NamedTuple):
    """Internal form of a piece of a curve.

    Attributes
    ----------
    degree : int
        Degree of a Bézier curve; 0 for an arc.
    control : (4,) complex128
        Control points, or centre and axes, padded with zeros.
    angles : (float, float)
        First and last angle of an arc.
    continues : bool
        Whether it continues an arc that was split.
    """

    degree: int
    control: ComplexArray
    angles: tuple[float, float]
    continues: bool


def split_piece(i: int, piece: ArrayLike | Arc) -> list[ArcPiece]:
    """Check piece ``i`` of a curve. Split long arcs, and split Bézier curves at interior zeros of the derivative."""
    if isinstance(piece, Arc):
        rows = [real_array(f"piece {i} of the curve", x) for x in (piece.centre, piece.a, piece.b)]
        if any(row.shape != (2,) for row in rows):
            raise ValueError(f"piece {i} of the curve: an arc has a centre and two axes of shape (2,)")
        control, ends = np.stack(rows), (float(piece.first), float(piece.last))
    else:
        control, ends = real_array(f"piece {i} of the curve", piece), (0.0, 0.0)
        if control.ndim != 2 or control.shape[1] != 2 or not 2 <= len(control) <= 4:
            raise ValueError(f"piece {i} of the curve must have shape (2, 2), (3, 2) or (4, 2), not {control.shape}")
    if not (np.isfinite(control).all() and np.isfinite(ends).all()):
        raise ValueError(f"piece {i} of the curve is not finite")
    if not isinstance(piece, Arc):
        return [
            ArcPiece(len(control) - 1, _pad(subcurve(control, *span)), ends, False)
            for span in pairwise([0.0, *_cusps(control), 1.0])
        ]
    four = _pad(control)
    steps = max(1, int(np.ceil(abs(ends[1] - ends[0]) / _MAX_ARC)))
    angles = np.linspace(*ends, steps + 1).tolist()
    return [ArcPiece(0, four, pair, k > 0) for k, pair in enumerate(pairwise(angles))]


def _pad(control: FloatArray) -> ComplexArray:
    """Control points, or centre and axes (k, 2), in the format of `ArcPiece`."""
    four = np.zeros(4, dtype=np.complex128)
    four[: len(control)] = to_complex(control)
    return four


def _cusps(control: FloatArray) -> list[float]:
    """Ascending interior parameters of a Bézier curve with zero speed: turning points and cusps.

    There both coordinates of the derivative vanish, so the complex polynomial has a real root.
    """
    points = to_complex(control - control[0])
    if len(points) < 3:
        return []
    if len(points) == 3:
        by_power = [points[1] - points[0], points[0] - 2 * points[1] + points[2]]
    else:
        third = points[3] - points[0] + 3 * (points[1] - points[2])
        by_power = [points[1] - points[0], 2 * (points[0] - 2 * points[1] + points[2]), third]
    roots = np.roots(by_power[::-1]).real
    inner = np.unique(roots[(roots > _TUNING.inside) & (roots < 1 - _TUNING.inside)])
    speed = np.abs(np.polynomial.polynomial.polyval(inner, by_power))
    return [float(t) for t in inner[speed <= ZERO_DERIVATIVE * np.abs(points).max()]]


def make_lines(points: ArrayLike, *, closed: bool) -> list[FloatArray]:
    """Straight lines between consecutive points."""
    array = real_array("points", points)
    least = 3 if closed else 2
    if array.ndim != 2 or array.shape[1] != 2 or len(array) < least:
        raise ValueError(f"points must have shape (k, 2) with k at least {least}, not {array.shape}")
    check_finite("points", "row", "rows", array)
    ends = np.concatenate([array, array[:1]]) if closed else array
    return list(np.stack([ends[:-1], ends[1:]], axis=1))


def count_chords(degree: int, control: ComplexArray, angles: FloatArray) -> int:
    """Number of chords of a piece such that the curve turns little along each."""
    if degree == 1:
        return 1
    if degree == 0:
        return int(max(1, np.ceil(abs(angles[1] - angles[0]) / _TUNING.flat)))
    sides = np.diff(control[: degree + 1])
    sides = sides[sides != 0]
    bends = np.abs(np.angle(sides[1:] / sides[:-1])).sum()
    # Use more chords for Bézier curves, because the turn is not spread evenly over the parameter.
    return int(max(4, 2 * np.ceil(bends / _TUNING.flat)))


def subcurve(control: FloatArray, t: float, u: float) -> FloatArray:
    """Control points (degree + 1, 2) of the part of a Bézier curve between two parameters.

    They are values of its blossom: de Casteljau's construction with a separate parameter in each round. For control
    point k, k of the parameters are ``u`` and the others ``t``.
    """
    if (t, u) == (0.0, 1.0):
        return control
    degree, found = len(control) - 1, []
    for k in range(degree + 1):
        points = control
        for share in [u] * k + [t] * (degree - k):
            points = (1 - share) * points[:-1] + share * points[1:]
        found.append(points[0])
    return np.array(found)


def nearest_on_segments(points: FloatArray, tails: FloatArray, heads: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return where segments are nearest to points, as shares of their lengths in [0, 1], and the distances there.

    All arrays have shape (k, 2), or one that broadcasts to it. A segment may be a point.
    """
    side, offset = heads - tails, points - tails
    square = np.maximum((side**2).sum(axis=-1), np.finfo(np.float64).tiny)
    share = np.clip((offset * side).sum(axis=-1) / square, 0, 1)
    return share, np.linalg.norm(offset - share[..., None] * side, axis=-1)


def nearest_segment(points: FloatArray, tails: FloatArray, heads: FloatArray) -> tuple[IntArray, FloatArray]:
    """Return the segment (k, 2) nearest to each point (m, 2), and where on it, as a share of its length; (m,) each."""
    nearest, share = np.empty(len(points), dtype=np.int64), np.empty(len(points))
    portion = max(1, _TUNING.pairs // len(tails))
    for start in range(0, len(points), portion):
        part = slice(start, start + portion)
        shares, distance = nearest_on_segments(points[part, None], tails, heads)
        nearest[part] = distance.argmin(axis=1)
        share[part] = np.take_along_axis(shares, nearest[part, None], axis=1)[:, 0]
    return nearest, share


def angle_at(angles: FloatArray, t: FloatArray) -> FloatArray:
    """Angles on arcs with angles (k, 2) at parameters in [0, 1]."""
    return angles[:, 0] + t * (angles[:, 1] - angles[:, 0])


def on_bezier(control: FloatArray, t: FloatArray) -> FloatArray:
    """De Casteljau's construction in twice the precision, rounded once; control (k, degree + 1, 2), t (k,)."""
    t = t[:, None]
    high, low = np.moveaxis(control, 1, 0), np.zeros((control.shape[1], len(t), 2))
    u, u_low = two_sum(np.ones_like(t), -t)
    while len(high) > 1:
        left, left_low = two_product(u, high[:-1])
        right, right_low = two_product(t, high[1:])
        total, lost = two_sum(left, right)
        low = lost + left_low + right_low + (u_low * high[:-1] + u * low[:-1] + t * low[1:])
        high, low = two_sum(total, low)
    return np.asarray(high[0])


def on_ellipse(control: FloatArray, angle: FloatArray) -> FloatArray:
    """``centre + a cos θ + b sin θ`` in twice the precision, rounded once; control (k, 4, 2), angle (k,)."""
    cos, sin = np.cos(angle)[:, None], np.sin(angle)[:, None]
    # Rounded cosines and sines lie off the unit circle. The correction moves them back onto it. The result then belongs
    # to a slightly different angle, which is harmless.
    (cc, cc_low), (ss, ss_low) = two_product(cos, cos), two_product(sin, sin)
    square, square_low = two_sum(cc, ss)
    off = ((square - 1) + (square_low + cc_low + ss_low)) / 2
    centre, a, b = control[:, 0], control[:, 1], control[:, 2]
    (along_a, a_low), (along_b, b_low) = two_product(cos, a), two_product(sin, b)
    one, one_low = two_sum(along_a, along_b)
    two, two_low = two_sum(one, centre)
    return np.asarray(two + (two_low + one_low + a_low + b_low - off * one))


@cache
def gauss_rule() -> tuple[FloatArray, FloatArray]:
    """Nodes and weights of Gauss' formula on [0, 1]."""
    nodes, weights = np.polynomial.legendre.leggauss(_TUNING.nodes)
    return (nodes + 1) / 2, weights / 2
