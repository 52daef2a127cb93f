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

# Factor on length per distance from the segment, relative to its length. Then costs in lengths of the segment: a step,
# a split of an edge that must be split at some point, and another split.
_STRAY, _STEP, _SPLIT, _SPLIT_MORE = 8.0, 1e-3, 0.5, 1.0
# Minimum length of a segment in costs, to avoid overflow.
_SHORTEST = 1e-60


def walk(sheet: Sheet, place: list[complex], start: int, end: int) -> list[int]:
    """Find a walk near the segment between two vertices, and split the edges that it passes through.

    Parameters
    ----------
    sheet : Sheet
    place : list of complex
        Position of each copy in a plane in which walks should be short and straight. Positions of added copies are
        appended.
    start : int
        A copy on the boundary.
    end : int
        Another one, or an interior copy at which no other walk ends.

    Returns
    -------
    list of int
        The walk's copies, all interior except the ends.
    """
    copies: list[int] = []
    # If a walk uses three midpoints in one triangle, two are not joined after splitting, and another walk is needed. If
    # all directions cost the same, the second of the three is a detour.
    for stray in (_STRAY, _STRAY, 0.0):
        nodes = _shortest(sheet, place, start, end, stray)
        copies = [node if isinstance(node, int) else _split(sheet, place, node) for node in nodes]
        if all(sheet.is_inner(a, b) for a, b in pairwise(copies)):
            break
    return copies


def _split(sheet: Sheet, place: list[complex], edge: Edge) -> int:
    place.append((place[edge[0]] + place[edge[1]]) / 2)
    return sheet.split(*edge)


def _shortest(sheet: Sheet, place: list[complex], start: int, end: int, weight: float) -> list[Node]:
    """Return the cheapest path of nodes between two copies (Dijkstra)."""
    chord = place[end] - place[start]
    axis = chord / (abs(chord) or 1.0)
    size = max(abs(chord), _SHORTEST)

    def where(node: Node) -> complex:
        at = place[node] if isinstance(node, int) else (place[node[0]] + place[node[1]]) / 2
        return (at - place[start]) * axis.conjugate() / size

    def stray(z: complex) -> float:
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
            further = abs(there - here) * (1 + weight * (stray(here) + stray(there))) + _STEP
            if not isinstance(other, int):
                further += _SPLIT if sheet.is_held(other[0]) and sheet.is_held(other[1]) else _SPLIT_MORE
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
            if c == end or not sheet.is_held(c):
                yield c
            yield from _middles(sheet, (b, c), (c, a))
        if end in node:
            yield end
        return
    for a, b in sheet.link(node):
        for copy in (a, b):
            if not sheet.is_held(copy) or (copy == end and sheet.is_inner(node, copy)):
                yield copy
        yield from _middles(sheet, (a, b))
        if node == start:
            yield from _middles(sheet, (node, a), (node, b))


def _middles(sheet: Sheet, *sides: Edge) -> Iterator[Edge]:
    """Yield the interior ones of some edges, the smaller end first."""
    for a, b in sides:
        if sheet.is_inner(a, b):
            yield (a, b) if a < b else (b, a)
