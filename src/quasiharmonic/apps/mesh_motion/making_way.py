"""Boundary nodes make way for moved ones that arrive along the same wall, as the walls of a cylinder for its piston.

Between two nodes of a wall that do not slide, the sliding nodes keep their order and the ratios of their distances.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from quasiharmonic.geometry.curves.boundary_curves import BoundaryCurves, Chain
from quasiharmonic.util.arrays import BoolArray, FloatArray, IntArray


def make_way(
    slide: bool | BoundaryCurves, loops: Sequence[IntArray], points: FloatArray, there: FloatArray, moved: IntArray
) -> FloatArray:
    """Shift boundary nodes along their walls where a moved node would pass them.

    Parameters
    ----------
    slide : bool or BoundaryCurves
        The walls: True for the boundary before the move.
    loops : list of (l,) int64
        Boundary loops.
    points, there : (n, 2) float64
        Positions before the move, and those after it, where nodes that are not moved have their old positions.
    moved : (k,) int64

    Returns
    -------
    (n, 2) float64
        ``there`` with shifted nodes. Moved nodes are where they were.
    """
    if isinstance(slide, BoundaryCurves):
        walls = slide.with_fixed_unless_on(moved)
    else:
        walls = BoundaryCurves.around(loops, points, fixed=moved)
    try:
        chains = walls.lay(loops, points).chains
    except ValueError:
        # The boundary is not on the curves before the move: no node arrives along them.
        return there
    found = there.copy()
    for chain in chains:
        near = walls.tolerance * chain.curve.size
        is_moved = np.isin(chain.vertices, moved)
        vertices, s = _shift_along(chain, ~chain.sliding | is_moved, _find_shifts(chain, there, is_moved, near))
        found[vertices] = chain.curve.position(s)
    return found


def _find_shifts(chain: Chain, there: FloatArray, is_moved: BoolArray, near: float) -> FloatArray:
    """Lengths (k,) by which the nodes of a chain move along their curve; zero for those that leave it."""
    curve = chain.curve
    where, distance = curve.nearest(there[chain.vertices])
    shift = where - chain.s
    if curve.closed:
        shift -= curve.length * np.round(shift / curve.length)
    return np.where(is_moved & (distance <= near), shift, 0.0)


def _shift_along(chain: Chain, held: BoolArray, shift: FloatArray) -> tuple[IntArray, FloatArray]:
    """Return the nodes between ``held`` ones (k,) that make way, and their new lengths along the curve."""
    count, length = len(chain.s), chain.curve.length
    stops = np.flatnonzero(held)
    following = np.append(stops[1:], stops[:1] + count) if chain.curve.closed else stops[1:]
    vertices, found = [chain.vertices[:0]], [chain.s[:0]]
    for begin, end in zip(stops.tolist(), following.tolist(), strict=False):
        row = np.arange(begin, end + 1)
        s = chain.s[row % count] + length * (row // count)
        low = s[0] + max(shift[begin], 0.0)
        high = s[-1] + min(shift[end % count], 0.0)
        if len(row) > 2 and low < high and (low >= s[1] or high <= s[-2]):
            moving = low + (s[1:-1] - s[0]) * ((high - low) / (s[-1] - s[0]))
            vertices.append(chain.vertices[row[1:-1] % count])
            found.append(moving % length if chain.curve.closed else moving)
    return np.concatenate(vertices), np.concatenate(found)
