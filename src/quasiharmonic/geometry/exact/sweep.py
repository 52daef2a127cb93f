"""Exact triangulation of a simple polygon.

A line sweeps the polygon from left to right [1]_. Each interval of the line inside the polygon bounds a region on its
left. This region is triangulated except for a chain of corners, from the side below the interval to the side above. The
chain is convex towards the right, so that no more triangles can be cut off. Each new corner extends a chain at one of
its ends, or splits or merges chains. It cuts off triangles until all chains are convex again.

References
----------
.. [1] S. Hertel, K. Mehlhorn, Fast triangulation of simple polygons. Foundations of Computation
   Theory, Lecture Notes in Computer Science 158 (1983).
"""

from __future__ import annotations

Point = tuple[int, int]
Triangle = tuple[int, int, int]


def triangulate(corners: list[Point]) -> list[Triangle]:
    """Triangulate a simple polygon in O(n log n) steps.

    The corners are integers, counterclockwise and distinct. Straight angles are allowed. The triangles are
    counterclockwise and of positive area, two fewer than there are corners.
    """
    sweep = _Sweep(corners)
    for v in sorted(range(len(corners)), key=corners.__getitem__):
        sweep.process(v)
    return sweep.triangles


class _Link:
    """Element of a chain. When a chain is split, its rightmost corner gets two elements."""

    __slots__ = ("above", "below", "corner")

    def __init__(self, corner: int) -> None:
        self.corner = corner
        self.below: _Link | None = None
        self.above: _Link | None = None


class _Interval:
    """Interval of the sweep line between two sides of the polygon."""

    __slots__ = ("bottom", "last", "side", "top")

    def __init__(self, side: tuple[int, int], bottom: _Link, last: _Link, top: _Link) -> None:
        self.side = side
        """The side of the polygon below, from left to right."""
        self.bottom = bottom
        self.last = last
        """The rightmost corner of the chain: the one that came last."""
        self.top = top


class _Sweep:
    """Sweep state: intervals of the sweep line from bottom to top, and the triangles to its left."""

    def __init__(self, corners: list[Point]) -> None:
        self._corners = corners
        self._intervals: list[_Interval] = []
        self.triangles: list[Triangle] = []

    def process(self, v: int) -> None:
        """Process the next corner."""
        before, after = v - 1, (v + 1) % len(self._corners)
        here = self._corners[v]
        from_left, to_right = self._corners[before] < here, here < self._corners[after]
        at = self._below(here)
        interval = self._intervals[at] if at >= 0 else None
        if from_left and to_right:  # on the lower side of an interval
            assert interval is not None
            self._add_below(interval, _Link(v))
            interval.side = v, after
        elif not from_left and not to_right:  # on the upper side of an interval
            assert interval is not None
            self._add_above(interval, _Link(v))
        elif to_right:
            self._open(at, v, after)
        else:
            self._close(at, v)

    def _open(self, at: int, v: int, after: int) -> None:
        """Process a corner with both sides to its right: an interval begins or is split."""
        link = _Link(v)
        if self._turn(v - 1, v, after) > 0:
            self._intervals.insert(at + 1, _Interval((v, after), link, link, link))
            return
        lower = self._intervals[at]
        # The rightmost corner of a chain that is convex towards the right is visible from every point to its right.
        last, top = lower.last, lower.top
        copy = _Link(last.corner)
        copy.above, last.above = last.above, None
        if copy.above is not None:
            copy.above.below = copy
        upper = _Interval((v, after), copy, copy, copy if top is last else top)
        lower.top = last
        self._add_above(lower, _Link(v))
        self._add_below(upper, link)
        self._intervals.insert(at + 1, upper)

    def _close(self, at: int, v: int) -> None:
        """Process a corner with both sides to its left: an interval ends, or two intervals merge."""
        upper = self._intervals.pop(at)
        if self._turn(v - 1, v, (v + 1) % len(self._corners)) > 0:
            link = upper.bottom
            while link.above is not None:
                self.triangles.append((v, link.above.corner, link.corner))
                link = link.above
            return
        lower = self._intervals[at - 1]
        link = _Link(v)
        self._add_below(upper, link)
        self._add_above(lower, _Link(v))
        # Merge the two elements of the corner into one.
        if lower.top.below is not None:
            lower.top.below.above = link
            link.below = lower.top.below
        else:
            lower.bottom = link
        lower.last, lower.top = link, upper.top

    def _add_below(self, interval: _Interval, link: _Link) -> None:
        """Add a corner at the lower end of a chain and cut off triangles until the chain is convex."""
        next_ = interval.bottom
        while next_.above is not None and self._turn(link.corner, next_.corner, next_.above.corner) < 0:
            self.triangles.append((link.corner, next_.above.corner, next_.corner))
            next_ = next_.above
        link.above, next_.below = next_, link
        interval.bottom = interval.last = link

    def _add_above(self, interval: _Interval, link: _Link) -> None:
        """Add a corner at the upper end of a chain and cut off triangles until the chain is convex."""
        next_ = interval.top
        while next_.below is not None and self._turn(link.corner, next_.corner, next_.below.corner) > 0:
            self.triangles.append((link.corner, next_.corner, next_.below.corner))
            next_ = next_.below
        link.below, next_.above = next_, link
        interval.top = interval.last = link

    def _below(self, point: Point) -> int:
        """Index of the highest interval whose lower side is below or at a point; -1 if there is no such interval."""
        low, high = 0, len(self._intervals)
        x, y = point
        while low < high:
            middle = (low + high) // 2
            tail, head = self._intervals[middle].side
            (px, py), (qx, qy) = self._corners[tail], self._corners[head]
            if (qx - px) * (y - py) >= (qy - py) * (x - px):
                low = middle + 1
            else:
                high = middle
        return low - 1

    def _turn(self, p: int, q: int, r: int) -> int:
        """Twice the signed area of the triangle p, q, r: positive for a left turn, negative for a right turn."""
        (px, py), (qx, qy), (rx, ry) = self._corners[p], self._corners[q], self._corners[r]
        return (qx - px) * (ry - py) - (qy - py) * (rx - px)
