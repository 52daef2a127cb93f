"""Straight sides of convex pieces, along which no interior edge may lie."""

from __future__ import annotations

from collections.abc import Sequence

from quasiharmonic.solver.construction.halfedges import Edge
from quasiharmonic.solver.construction.regions import Regions
from quasiharmonic.solver.construction.sheet import Sheet


def edges_along_sides(sheet: Sheet, regions: Regions, point: Sequence[int]) -> list[Edge]:
    """Return interior edges with both ends on one side of their piece, behind which triangles would be degenerate.

    ``sheet`` has all cuts. ``point`` is the target's point of every vertex of the mesh, -1 for none. The edges are
    pairs of copies. Sides that are straight only up to rounding are included.
    """
    side: dict[int, set[int]] = {}
    count = 0
    for loop in sheet.loops():
        vertices = [sheet.vertex[copy] for copy in loop]
        marks = [(k, point[v]) for k, v in enumerate(vertices) if v < len(point) and point[v] >= 0]
        first, *others = _corners(marks, regions)
        bends = set(others)
        for k, copy in enumerate(loop[first:] + loop[:first], first):
            side[copy] = {count}
            if k % len(loop) in bends:
                count += 1
                side[copy].add(count)
        # The last side ends at the first corner.
        side[loop[first]].add(count)
        count += 1
    return [(a, b) for a, b in sheet.inner_edges() if not side.get(a, set()).isdisjoint(side.get(b, ()))]


def _corners(marks: list[tuple[int, int]], regions: Regions) -> list[int]:
    """Return the positions in a loop at which it bends; exactly determined if rounding leaves fewer than three."""
    bends: list[int] = []
    for turn in (regions.turn, regions.exact_turn):
        around = zip([marks[-1], *marks[:-1]], marks, [*marks[1:], marks[0]], strict=True)
        bends = [k for (_, before), (k, here), (_, after) in around if turn(before, here, after) != 0]
        if len(bends) >= 3:
            break
    return bends
