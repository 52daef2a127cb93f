"""Shortest walks through the interior vertices of a sheet, from one boundary vertex to another.

A walk may also pass through the midpoint of an interior edge, which is then split. With only the midpoints of edges
between two boundary vertices, any two boundary vertices that are not neighbours are joined by a walk. This is a part of
the proof in `quasiharmonic.solver.construction`. The other midpoints let the walk stay closer to its segment.
"""

from __future__ import annotations

from collections.abc import Iterator
from heapq import heappop, heappush
from itertools import pairwise

from quasiharmonic.solver.construction.halfedges import Edge
from quasiharmonic.solver.construction.sheet import Sheet

# A node of a walk: a copy, or an interior edge to be split.
Node = int | Edge

# Factor on length per distance from the segment, relative to its length.
_DEVIATION_COST = 8.0
# Costs in lengths of the segment: a step,
_STEP_COST = 1e-3
# a split of an edge that must be split at some point,
_NEEDED_SPLIT_COST = 0.5
# and another split.
_OTHER_SPLIT_COST = 1.0
# Minimum length of a segment in costs, to avoid overflow.
_SHORTEST = 1e-60


def walk(sheet: Sheet, positions: list[complex], start: int, end: int) -> list[int]:
    """Find a walk near the segment between two vertices, and split the edges that it passes through.

    Parameters
    ----------
    sheet : Sheet
    positions : list of complex
        Position of each copy in a plane in which walks should be short and straight. Positions of added copies are
        appended.
    start, end : int
        A copy on the boundary; another one, or an interior copy at which no other walk ends.

    Returns
    -------
    list of int
        The walk's copies, all interior except the ends.
    """
    copies: list[int] = []
    # If a walk uses three midpoints in one triangle, two are not joined after splitting, and another walk is needed. If
    # all directions cost the same, the second of the three is a detour.
    for weight in (_DEVIATION_COST, _DEVIATION_COST, 0.0):
        nodes = _find_path(sheet, positions, start, end, weight)
        copies = [node if isinstance(node, int) else _split(sheet, positions, node) for node in nodes]
        if all(sheet.is_inner(a, b) for a, b in pairwise(copies)):
            break
    return copies


def _split(sheet: Sheet, positions: list[complex], edge: Edge) -> int:
    positions.append((positions[edge[0]] + positions[edge[1]]) / 2)
    return sheet.split(*edge)


def _find_path(sheet: Sheet, positions: list[complex], start: int, end: int, weight: float) -> list[Node]:
    """Return the path of lowest cost between two copies of vertices (see `Sheet`), found by Dijkstra's algorithm."""
    chord = positions[end] - positions[start]
    axis = chord / (abs(chord) or 1.0)
    size = max(abs(chord), _SHORTEST)

    def where(node: Node) -> complex:
        at = positions[node] if isinstance(node, int) else (positions[node[0]] + positions[node[1]]) / 2
        return (at - positions[start]) * axis.conjugate() / size

    def deviation(z: complex) -> float:
        beyond = max(0.0, -z.real, z.real - 1.0)
        return (z.imag * z.imag + beyond * beyond) ** 0.5

    cost: dict[Node, float] = {start: 0.0}
    last: dict[Node, Node] = {}
    waiting: list[tuple[float, int, Node]] = [(0.0, 0, start)]
    done, count = set[Node](), 0
    while waiting:
        so_far, _, node = heappop(waiting)
        if node in done:
            continue
        if node == end:
            break
        done.add(node)
        here = where(node)
        for other in _neighbours(sheet, node, start, end):
            if other in done:
                continue
            there = where(other)
            further = abs(there - here) * (1 + weight * (deviation(here) + deviation(there))) + _STEP_COST
            if not isinstance(other, int):
                further += (
                    _NEEDED_SPLIT_COST if sheet.is_fixed(other[0]) and sheet.is_fixed(other[1]) else _OTHER_SPLIT_COST
                )
            if so_far + further < cost.get(other, float("inf")):
                cost[other], last[other] = so_far + further, node
                count += 1
                heappush(waiting, (so_far + further, count, other))
    found: list[Node] = [end]
    while found[-1] != start:
        found.append(last[found[-1]])
    return found[::-1]


def _neighbours(sheet: Sheet, node: Node, start: int, end: int) -> Iterator[Node]:
    """Yield the nodes that a walk may visit next: interior copies, midpoints of interior edges, and the end."""
    if isinstance(node, tuple):
        for a, b in (node, node[::-1]):
            c = sheet.apex[a, b]
            if c == end or not sheet.is_fixed(c):
                yield c
            yield from _inner_edges(sheet, (b, c), (c, a))
        if end in node:
            yield end
        return
    for a, b in sheet.link(node):
        for copy in (a, b):
            if not sheet.is_fixed(copy) or (copy == end and sheet.is_inner(node, copy)):
                yield copy
        yield from _inner_edges(sheet, (a, b))
        if node == start:
            yield from _inner_edges(sheet, (node, a), (node, b))


def _inner_edges(sheet: Sheet, *sides: Edge) -> Iterator[Edge]:
    """Yield the interior ones of some edges, the smaller end first."""
    for a, b in sides:
        if sheet.is_inner(a, b):
            yield (a, b) if a < b else (b, a)
