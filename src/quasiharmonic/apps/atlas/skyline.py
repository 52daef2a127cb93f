"""Pack boxes into the unit square one after another, each at the position with the lowest top side.

The filled region is represented by its upper boundary only, the skyline: steps from left to right. A box lies on the
highest of the steps below it, and the space under it stays empty. This is the bottom-left skyline algorithm (Jylänki
2010, A thousand ways to pack the bin).
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple


class Laid(NamedTuple):
    """The position of a box.

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
    """Pack boxes into the unit square in the given order, rotated by 90° if this is lower.

    Parameters
    ----------
    boxes : sequence of (width, height)
        Box sizes; large boxes should come first.

    Returns
    -------
    list of Laid or None
        None if a box does not fit.
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
