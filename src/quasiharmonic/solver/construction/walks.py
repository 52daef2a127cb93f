"""Shortest walks through the inner vertices of a sheet, from one boundary vertex to another.

A walk may also pass through the middle of an inner edge, which is then split. With the middles of edges between two
boundary vertices alone every two of these have a walk between them, unless they are neighbours: that is a part of the
proof in `quasiharmonic.solver.construction`. The others let it stay near where it should be.
"""

from __future__ import annotations

from collections.abc import Iterator
from heapq import heappop, heappush
from itertools import pairwise

from quasiharmonic.solver.construction.halfedges import Edge
from quasiharmonic.solver.construction.sheet import Sheet

# A node of a walk is a copy, or an inner edge that is yet to be split.
Node = int | Edge

# How much longer a walk seems as far off the segment as that is long; and in the segment's lengths what a step costs, a
# split of an edge that will have to be split some time, and one of another.
_STRAY, _STEP, _SPLIT, _SPLIT_MORE = 8.0, 1e-3, 0.5, 1.0
# A shorter segment is taken for one of this length, so that no cost overflows.
_SHORTEST = 1e-60


def walk(sheet: Sheet, place: list[complex], start: int, end: int) -> list[int]:
    """Find a walk near the segment between two vertices, and split what it has to pass through.

    Parameters
    ----------
    sheet : Sheet
    place : list of complex
        Where each copy is in a plane in which walks are to be short and straight. Those of added copies are appended.
    start : int
        A copy on the boundary.
    end : int
        Another, or an inner one that is the end of no other walk.

    Returns
    -------
    list of int
        The walk's copies, all but the ends inside.
    """
    copies: list[int] = []
    # Of three middles in one triangle two are not joined when all are there, and another walk has to be found. Where
    # all ways are measured alike, the middle one of the three is a detour.
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
    """The cheapest nodes from a copy to another (Dijkstra)."""
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
    """What a walk may go on to: inner copies, middles of inner edges, and the end."""
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
    """Those of some edges that are inside, the smaller end first."""
    for a, b in sides:
        if sheet.is_inner(a, b):
            yield (a, b) if a < b else (b, a)
