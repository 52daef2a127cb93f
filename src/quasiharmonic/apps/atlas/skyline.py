"""Boxes laid into the unit square one after another, each where its upper side comes lowest.

What is filled is told by its upper rim alone, the skyline: steps from left to right. A box lies on the highest of the
steps under it; what is lower remains empty (the bottom-left skyline of Jylänki 2010, A thousand ways to pack the bin).
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple


class Laid(NamedTuple):
    """Where a box lies.

    Attributes
    ----------
    x, y : float
        Its lower left corner.
    turned : bool
        Whether its width and height are exchanged.
    """

    x: float
    y: float
    turned: bool


def laid(boxes: Sequence[tuple[float, float]]) -> list[Laid] | None:
    """Lay boxes into the unit square in the order they are given in, turned by a quarter where that is lower.

    Parameters
    ----------
    boxes : sequence of (width, height)
        Large ones had better come first.

    Returns
    -------
    list of Laid or None
        None if one of them has no room left.
    """
    left, top = [0.0], [0.0]
    places = []
    for width, height in boxes:
        best: tuple[float, float, bool, int, int, float] | None = None
        for turned, w, h in ((False, width, height), (True, height, width)):
            for i, x in enumerate(left):
                if x + w > 1:
                    break
                y, j = top[i], i + 1
                while j < len(left) and left[j] < x + w:
                    y = max(y, top[j])
                    j += 1
                if y + h <= 1 and (best is None or (y + h, x) < best[:2]):
                    best = y + h, x, turned, i, j, w
        if best is None:
            return None
        upper, x, turned, i, j, w = best
        places.append(Laid(x, upper - (width if turned else height), turned))
        end = left[j] if j < len(left) else 1.0
        behind = [(x + w, top[j - 1])] if x + w < end else []
        left[i:j] = [x, *(a for a, _ in behind)]
        top[i:j] = [upper, *(b for _, b in behind)]
    return places
