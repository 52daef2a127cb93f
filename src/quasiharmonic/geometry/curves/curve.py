"""Curves along which vertices slide: connected lines, Bézier curves and elliptic arcs, parametrised by arc length.

A position on a curve is given by ``s``, its arc length from the start. Points are evaluated in twice the precision and
rounded once, so they are on the curve up to rounding. At a *joint*, where two pieces meet, the curve may turn. A large
turn is a corner and a smaller one a kink. At both the curve has two directions.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from quasiharmonic.geometry.curves.arcs import (
    ZERO_DERIVATIVE,
    Arc,
    angle_at,
    count_chords,
    gauss_rule,
    make_lines,
    nearest_segment,
    on_bezier,
    on_ellipse,
    split_piece,
    subcurve,
)
from quasiharmonic.util.arrays import (
    BoolArray,
    ComplexArray,
    FloatArray,
    IntArray,
    enumerate_each,
    to_complex,
    to_points,
)


class CurveTolerances(NamedTuple):
    """Tolerances of curves, and sizes of the searches for a parameter."""

    # Squares, and products of four numbers, of coordinates below this do not overflow.
    max_size: float = 1e75
    # Above this they do not underflow.
    min_size: float = 1e-75
    # Ends closer than this fraction of the curve's size are connected.
    gap: float = 1e-9
    # Smaller turns, in radians, are ignored: their effect on an optimisation is below its tolerance.
    kink: float = 1e-3
    # Step in the parameter of the chord that gives the direction of a piece where its derivative is zero.
    chord: float = 1e-5
    # Lengths below this fraction of the curve's size count as rounding.
    rounding: float = 1e-13
    # Number of parameters of each piece in the table of lengths.
    table_size: int = 32
    # Distance in the parameter from an end of a piece at which the search near that end starts.
    inner_start: float = 1e-2
    # A search for a parameter has converged if the parameter changes by at most this.
    converged: float = 1e-15
    # Maximum number of steps of the search for a parameter by length.
    length_steps: int = 60
    # Maximum number of steps of the search for a parameter by distance.
    distance_steps: int = 40


_TOLERANCES = CurveTolerances()


class Curve:
    """A plane curve made of pieces, each starting at the end of the previous one.

    Parameters
    ----------
    pieces : sequence of (degree + 1, 2) float or Arc
        Lines and Bézier curves of degree 1 to 3 by their control points, and elliptic arcs. Pieces of zero length
        are dropped. The curve is closed if it ends at its start.

    Raises
    ------
    ValueError
        If a piece has another type, is not finite, or does not start at the end of the previous one. Also if the curve
        has zero length, or coordinates are so large or small that products overflow or underflow.

    Attributes
    ----------
    closed : bool
    length : float
    size : float
        Larger side of the bounding box.

    See Also
    --------
    BoundaryCurves : Curves along which boundary vertices slide.
    geometry.curves.Arc : A piece of a curve.

    Examples
    --------
    >>> import numpy as np
    >>> square = Curve.polygon([(0, 0), (2, 0), (2, 2), (0, 2)])
    >>> square.closed, square.length, square.corners(20.0).tolist()
    (True, 8.0, [0.0, 2.0, 4.0, 6.0])
    >>> square.position(np.array([0.5, 3.0])).tolist()
    [[0.5, 0.0], [2.0, 1.0]]
    """

    def __init__(self, pieces: Sequence[ArrayLike | Arc]) -> None:
        found = [part for i, piece in enumerate(pieces) for part in split_piece(i, piece)]
        if not found:
            raise ValueError("a curve must have at least one piece")
        self._degree = np.array([part.degree for part in found])
        self._control = np.stack([part.control for part in found])
        self._angles = np.array([part.angles for part in found])
        # Long arcs are split to integrate their length. These splits are not joints.
        self._continues = np.array([part.continues for part in found])
        self._measure()
        self._join()

    @classmethod
    def contour(cls, pieces: Sequence[ArrayLike | Arc]) -> Curve:
        """Create a closed curve from pieces, with a straight line from the end to the start if needed."""
        curve = cls(pieces)
        if curve.closed:
            return curve
        ends = curve.position(np.array([curve.length, 0.0]))
        return cls([*pieces, ends])

    @classmethod
    def polygon(cls, points: ArrayLike) -> Curve:
        """Create the closed polygon through points (k, 2)."""
        return cls(make_lines(points, closed=True))

    @classmethod
    def polyline(cls, points: ArrayLike) -> Curve:
        """Create the open polyline through points (k, 2)."""
        return cls(make_lines(points, closed=False))

    @classmethod
    def circle(cls, radius: float = 1.0, centre: ArrayLike = (0.0, 0.0)) -> Curve:
        """Create a circle, counterclockwise from its rightmost point."""
        return cls([Arc(centre, (radius, 0.0), (0.0, radius), 0.0, 2 * np.pi)])

    def transform(self, matrix: ArrayLike, shift: ArrayLike = (0.0, 0.0)) -> Curve:
        """Transform the curve by ``x → matrix @ x + shift``; ``matrix`` (2, 2) or a number, ``shift`` (2,)."""
        matrix = np.asarray(matrix, dtype=np.float64) * (np.eye(2) if np.ndim(matrix) == 0 else 1.0)
        offset = np.asarray(shift, dtype=np.float64)
        return Curve(
            [
                piece.transform(matrix, offset) if isinstance(piece, Arc) else piece @ matrix.T + offset
                for piece in self.section(0.0, self.length)
            ]
        )

    def section(self, start: float, end: float) -> list[FloatArray | Arc]:
        """Pieces between two lengths along the curve; continues past the start if ``end`` is not larger."""
        m = self._degree.size
        (first, last), (begin, stop) = self.locate(np.array([start, end]))
        last += m if end <= start else 0
        found: list[FloatArray | Arc] = []
        for k in range(first, last + 1):
            t, u = begin if k == first else 0.0, stop if k == last else 1.0
            if t == u:
                continue
            points = to_points(self._control[k % m])
            if self._degree[k % m]:
                found.append(subcurve(points[: self._degree[k % m] + 1], t, u))
                continue
            angles = angle_at(self._angles[[k % m, k % m]], np.array([t, u])).tolist()
            before = found[-1] if found and self._continues[k % m] else None
            if isinstance(before, Arc):
                found[-1] = replace(before, last=angles[1])
            else:
                found.append(Arc(points[0], points[1], points[2], *angles))
        return found

    def sides(self, angle: float) -> list[Curve]:
        """Split the curve at its corners, starting at the first corner; without corners, return the curve itself.

        ``angle`` is as for `corners`.
        """
        marks = self.corners(angle)
        ends = np.roll(marks, -1) if self.closed else marks[1:]
        return [Curve(self.section(*pair)) for pair in zip(marks, ends, strict=False)] or [self]

    def position(self, s: FloatArray) -> FloatArray:
        """Points at lengths (k,) along the curve, evaluated in twice the precision and rounded once; (k, 2) float64."""
        piece, t = self.locate(np.asarray(s, dtype=np.float64))
        found = np.empty((t.size, 2))
        for degree in np.unique(self._degree[piece]):
            which = self._degree[piece] == degree
            control = self._control[piece[which]].view(np.float64).reshape(-1, 4, 2)
            if degree:
                found[which] = on_bezier(control[:, : degree + 1], t[which])
            else:
                found[which] = on_ellipse(control, angle_at(self._angles[piece[which]], t[which]))
        return found

    def sample(self, s: FloatArray, *, exactly: bool = False) -> tuple[ComplexArray, ComplexArray]:
        """Points and unit tangents at lengths of any shape.

        By default the lengths are interpolated in a table, which is fast and accurate enough for measures of shape.
        With ``exactly`` they are exact, so that the tangents are the derivatives of the points up to rounding.
        """
        if self.closed:
            s = np.mod(s, self.length)
        if exactly:
            piece, t = self.locate(s.ravel())
        else:
            at = np.interp(s.ravel(), *self._table)
            piece = np.clip(at.astype(np.int64), 0, self._degree.size - 1)
            t = at - piece
        return self._point(piece, t).reshape(s.shape), self._direction(piece, t)[0].reshape(s.shape)

    def frame(self, s: FloatArray, forward: BoolArray) -> tuple[ComplexArray, FloatArray]:
        """Unit tangents (k,) complex128 and curvatures (k,), positive where the curve turns to the left.

        ``forward`` (k,) bool tells whether to use the piece that begins at a joint instead of the piece that ends
        there.
        """
        piece, t = self.locate(s)
        back = ~forward & (s == self._starts[piece])
        if not self.closed:
            back &= piece > 0
        piece = np.where(back, (piece - 1) % self._degree.size, piece)
        return self._direction(piece, np.where(back, 1.0, t))

    def advance(self, s: FloatArray, step: FloatArray, *, stop: bool = False) -> FloatArray:
        """Step along the curve, around a closed one, at most to the ends of an open one.

        Parameters
        ----------
        s, step : (k,) float64
            Start and signed length of each step.
        stop : bool
            Stop at the next kink.
        """
        found = s + step
        if stop and self.stops.size:
            ahead = self.stops[np.searchsorted(self.stops, s, side="right") % self.stops.size]
            behind = self.stops[np.searchsorted(self.stops, s, side="left") - 1]
            room = np.where(step > 0, ahead - s, s - behind)
            room = np.where(room > 0, room, room + self.length)
            found = np.where((step != 0) & (np.abs(step) >= room), np.where(step > 0, ahead, behind), found)
        if not self.closed:
            return np.clip(found, 0.0, self.length)
        around = np.mod(found, self.length)
        return np.where(around < self.length, around, 0.0)

    def has_ended(self, s: FloatArray, forward: BoolArray) -> BoolArray:
        """Whether an open curve has ended in the given direction."""
        return np.where(forward, s >= self.length, s <= 0) & (not self.closed)

    def corners(self, angle: float) -> FloatArray:
        """Ascending lengths at which the curve turns by at least ``angle`` degrees, with the ends of an open curve."""
        marks = self._starts[:-1][(np.abs(self._turn) >= np.radians(angle)) & ~self._continues]
        return marks if self.closed else np.unique(np.append(marks, (0.0, self.length)))

    def nearest(self, points: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Lengths along the curve of the points nearest to (k, 2) points, and the distances; (k,) float64 each.

        Exact up to rounding for points on a curve that does not meet itself. For other points the chords select the
        candidate.
        """
        z = to_complex(points)
        chord, share = nearest_segment(points, to_points(self._chord_tail), to_points(self._chord_head))
        here, at = self._chord_piece[chord], self._chord_first[chord] + share * self._chord_width[chord]
        best = np.full(z.size, np.inf)
        piece, t = here, at
        # Chords deviate from the curve, so near a joint the next piece may be nearer. Start a little inside that piece,
        # because its derivative may be zero at its end.
        for other in (0, -1, 1):
            candidate = here + other
            candidate = candidate % self._degree.size if self.closed else np.clip(candidate, 0, self._degree.size - 1)
            begin = np.where(
                candidate == here, at, _TOLERANCES.inner_start if other > 0 else 1 - _TOLERANCES.inner_start
            )
            found, offset = self._refine(candidate, begin, z)
            better = offset < best
            piece, t = np.where(better, candidate, piece), np.where(better, found, t)
            best = np.minimum(best, offset)
        s = self._starts[piece] + self._length_to(piece, t)
        # Return the exact length of a joint for points at a joint.
        joint = np.concatenate([piece, (piece + 1) % self._degree.size if self.closed else piece + 1])
        for s_joint in joint.reshape(2, -1):
            goal = self._starts[s_joint]
            off = np.abs(s - goal)
            off = np.minimum(off, self.length - off) if self.closed else off
            s = np.where(off <= _TOLERANCES.rounding * self.size, goal, s)
        return np.where(s < self.length, s, 0.0) if self.closed else s, best

    def _measure(self) -> None:
        """Compute polynomial coefficients of the pieces, chords for the nearest-point search, and start lengths."""
        a, b, c, d = self._control.T
        by_degree = [(a, 0 * a, 0 * a, 0 * a), (a, b - a, 0 * a, 0 * a), (a, 2 * (b - a), a - 2 * b + c, 0 * a)]
        by_degree.append((a, 3 * (b - a), 3 * (a - 2 * b + c), d - a + 3 * (b - c)))
        degree = self._degree.astype(np.intp)  # 32-bit systems reject others
        self._powers = np.stack([np.choose(degree, rows) for rows in zip(*by_degree, strict=True)], axis=1)
        count = np.array([count_chords(*part) for part in zip(self._degree, self._control, self._angles, strict=True)])
        self._chord_piece, nth = enumerate_each(count)
        self._chord_width = 1.0 / count[self._chord_piece]
        self._chord_first = nth * self._chord_width
        self._chord_tail = self._point(self._chord_piece, self._chord_first)
        self._chord_head = self._point(self._chord_piece, (nth + 1) * self._chord_width)
        every = np.concatenate([self._chord_tail, self._chord_head])
        self.size = float(max(np.ptp(every.real), np.ptp(every.imag)))
        if not (self.size > _TOLERANCES.min_size and np.abs(every).max() < _TOLERANCES.max_size):
            raise ValueError(
                f"a curve of size {self.size:.3g} around {every[0]:.3g} is outside the supported range "
                f"({_TOLERANCES.min_size:.0e} to {_TOLERANCES.max_size:.0e}): scale the drawing"
            )
        lengths = self._length_to(np.arange(count.size), np.ones(count.size))
        kept = lengths > _TOLERANCES.rounding * self.size
        if not kept.all():
            self._degree, self._control = self._degree[kept], self._control[kept]
            self._angles, self._continues = self._angles[kept], self._continues[kept]
            self._measure()
            return
        self._starts = np.concatenate([[0.0], np.cumsum(lengths)])
        self.length = float(self._starts[-1])
        # Table of lengths with piece and parameter in one number: piece 3, t = 0.25 is 3.25.
        piece, nth = np.divmod(np.arange(_TOLERANCES.table_size * lengths.size), _TOLERANCES.table_size)
        length = self._starts[piece] + self._length_to(piece, nth / _TOLERANCES.table_size)
        self._table = (
            np.append(length, self.length),
            np.append(piece + nth / _TOLERANCES.table_size, float(lengths.size)),
        )

    def _join(self) -> None:
        """Check that pieces meet; determine whether the curve is closed and its turns at joints."""
        m = self._degree.size
        every = np.arange(m)
        heads, tails = self._point(every, np.ones(m)), self._point(every, np.zeros(m))
        is_apart = np.abs(heads - np.roll(tails, -1)) > _TOLERANCES.gap * self.size
        if is_apart[:-1].any():
            k = int(np.argmax(is_apart[:-1]))
            raise ValueError(
                f"pieces {k} and {k + 1} of the curve (without pieces of zero length) do not meet: "
                f"{heads[k]:.6g} and {tails[k + 1]:.6g}"
            )
        self.closed = not is_apart[-1]
        ahead, _ = self._direction(every, np.zeros(m))
        before = np.roll(self._direction(every, np.ones(m))[0], 1)
        self._turn = np.angle(ahead / before)
        if not self.closed:
            self._turn[0] = 0.0
        self.stops = self.corners(np.degrees(_TOLERANCES.kink))

    def locate(self, s: FloatArray) -> tuple[IntArray, FloatArray]:
        """Piece indices and parameters in [0, 1] at lengths along the curve."""
        piece = np.clip(np.searchsorted(self._starts, s, side="right") - 1, 0, self._degree.size - 1)
        whole = self._starts[piece + 1] - self._starts[piece]
        length = np.clip(s - self._starts[piece], 0.0, whole)
        # The table gives a good start, but rounding may put it outside the piece.
        guess = np.clip(np.interp(s, *self._table) - piece, 1e-3, 1 - 1e-3)
        t = np.where((self._degree[piece] == 1) | (length <= 0) | (length >= whole), length / whole, guess)
        active = np.flatnonzero((self._degree[piece] != 1) & (t > 0) & (t < 1))
        low, high = np.zeros(active.size), np.ones(active.size)
        # Newton's method, with bisection if a step leaves the bracket.
        for _ in range(_TOLERANCES.length_steps):
            if not active.size:
                break
            here = t[active]
            excess = self._length_to(piece[active], here) - length[active]
            low, high = np.where(excess < 0, here, low), np.where(excess < 0, high, here)
            speed = np.abs(self._derivatives(piece[active], here)[0])
            with np.errstate(all="ignore"):
                there = here - excess / speed
            there = np.where((there > low) & (there < high), there, 0.5 * (low + high))
            t[active] = np.where(excess == 0, here, there)
            moving = np.abs(t[active] - here) > 4e-16
            active, low, high = active[moving], low[moving], high[moving]
        return piece, t

    def _length_to(self, piece: IntArray, t: FloatArray) -> FloatArray:
        """Length of pieces from their start to a parameter, by Gauss' formula for curved pieces."""
        found = np.abs(self._control[piece, 1] - self._control[piece, 0]) * t
        curved = np.flatnonzero(self._degree[piece] != 1)
        if curved.size:
            nodes, weights = gauss_rule()
            which, until = np.repeat(piece[curved], nodes.size), t[curved]
            speed = np.abs(self._derivatives(which, (until[:, None] * nodes).ravel())[0])
            found[curved] = until * (speed.reshape(-1, nodes.size) @ weights)
        return found

    def _point(self, piece: IntArray, t: FloatArray) -> ComplexArray:
        """Points in double precision."""
        a, b, c, d = self._powers[piece].T
        found: ComplexArray = a + t * (b + t * (c + t * d))
        for arc, cos, sin in self._on_arcs(piece, t):
            centre, along, across, _ = self._control[piece[arc]].T
            found[arc] = centre + along * cos + across * sin
        return found

    def _derivatives(self, piece: IntArray, t: FloatArray) -> tuple[ComplexArray, ComplexArray]:
        """First and second derivatives by the parameter."""
        _, b, c, d = self._powers[piece].T
        first: ComplexArray = b + t * (2 * c + 3 * t * d)
        second: ComplexArray = 2 * c + 6 * t * d
        for arc, cos, sin in self._on_arcs(piece, t):
            _, along, across, _ = self._control[piece[arc]].T
            span = self._angles[piece[arc], 1] - self._angles[piece[arc], 0]
            first[arc] = span * (across * cos - along * sin)
            second[arc] = -(span**2) * (along * cos + across * sin)
        return first, second

    def _on_arcs(self, piece: IntArray, t: FloatArray) -> Iterator[tuple[IntArray, FloatArray, FloatArray]]:
        """Yield the indices of points on arcs, if there are any, with the cosines and sines there."""
        arc = np.flatnonzero(self._degree[piece] == 0)
        if arc.size:
            angle = angle_at(self._angles[piece[arc]], t[arc])
            yield arc, np.cos(angle), np.sin(angle)

    def _direction(self, piece: IntArray, t: FloatArray) -> tuple[ComplexArray, FloatArray]:
        """Unit tangents and curvatures."""
        first, second = self._derivatives(piece, t)
        speed = np.abs(first)
        # If control points coincide with an end, the derivative is 0 there, and a short chord gives the direction.
        slow = speed <= ZERO_DERIVATIVE * np.abs(self._control[piece]).max(axis=1).clip(self.size)
        if slow.any():
            step = np.where(t < 0.5, _TOLERANCES.chord, -_TOLERANCES.chord)
            chord = (self._point(piece, t + step) - self._point(piece, t)) / step
            first = np.where(slow, chord, first)
        with np.errstate(divide="ignore", invalid="ignore"):
            curvature = (first.conj() * second).imag / np.abs(first) ** 3
        return first / np.abs(first), np.where(slow, 0.0, curvature)

    def _refine(self, piece: IntArray, t: FloatArray, z: ComplexArray) -> tuple[FloatArray, FloatArray]:
        """Parameter of the nearest point of a piece to each given point, by Newton's method, and the distance."""
        t, smallest = t.copy(), np.abs(self._point(piece, t) - z)
        best, active = t.copy(), np.arange(z.size)
        for _ in range(_TOLERANCES.distance_steps):
            at, here = piece[active], t[active]
            offset = self._point(at, here) - z[active]
            first, second = self._derivatives(at, here)
            slope = (offset.conj() * first).real
            square = np.abs(first) ** 2
            bend = square + (offset.conj() * second).real
            with np.errstate(divide="ignore", invalid="ignore"):
                step = slope / np.where(bend > 0.5 * square, bend, square)
            there = np.clip(here - np.nan_to_num(step), 0.0, 1.0)
            found = np.abs(self._point(at, there) - z[active])
            better = found < smallest[active]
            best[active[better]], smallest[active[better]] = there[better], found[better]
            t[active] = there
            # Most points converge in four steps; near a zero of the derivative it takes ten times as many.
            active = active[np.abs(there - here) > _TOLERANCES.converged]
            if not active.size:
                break
        return best, smallest
