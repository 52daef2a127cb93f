"""Cut a mesh and its target in the same way, until every piece of the target is convex.

The cuts follow shortest walks through the interior vertices of a sheet, from one boundary vertex to another. A walk may
also pass through the midpoint of an interior edge, which is then split. With only the midpoints of edges
between two boundary vertices, any two boundary vertices that are not neighbours are joined by a walk. This is a part of
the proof in `quasiharmonic.solver.construction`. The other midpoints let the walk stay closer to its segment.

No interior edge may lie along a straight side of a convex piece.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from heapq import heappop, heappush
from itertools import pairwise
from typing import NamedTuple

import numpy as np

from quasiharmonic.linsolve.laplacian import embed_tutte
from quasiharmonic.problem import Problem
from quasiharmonic.solver.construction.half_edges import Edge, Regions, Sheet
from quasiharmonic.util.arrays import ComplexArray, invert_indices, to_complex
from quasiharmonic.util.progress import heartbeat


class CuttingCosts(NamedTuple):
    """Costs of a way along edges, in lengths of the segment that it replaces."""

    # Factor on length per distance from the segment, relative to its length.
    deviation: float = 8.0
    # A step along an edge.
    step: float = 1e-3
    # A split of an edge that must be split at some point.
    needed_split: float = 0.5
    # Another split.
    other_split: float = 1.0
    # Minimum length of a segment in costs, to avoid overflow.
    shortest: float = 1e-60


_COSTS = CuttingCosts()


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


# A node of a walk: a copy, or an interior edge to be split.
Node = int | Edge


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
    for weight in (_COSTS.deviation, _COSTS.deviation, 0.0):
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
    size = max(abs(chord), _COSTS.shortest)

    def locate(node: Node) -> complex:
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
        here = locate(node)
        for other in _neighbours(sheet, node, start, end):
            if other in done:
                continue
            there = locate(other)
            further = abs(there - here) * (1 + weight * (deviation(here) + deviation(there))) + _COSTS.step
            if not isinstance(other, int):
                further += (
                    _COSTS.needed_split if sheet.is_fixed(other[0]) and sheet.is_fixed(other[1]) else _COSTS.other_split
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


class TooManyError(Exception):
    """More vertices are needed than allowed."""


class Cutting:
    """A mesh and its target, cut in the same way.

    Parameters
    ----------
    problem : Problem
        Its target has magnitude about one; its loops are simple, disjoint, nested and wound as the mesh's. The surface
        has no handles.
    guide : (n,) complex128, optional
        A map that determines the path of cuts. Without it, the mesh is mapped into a circle as soon as it is a disk.
    max_added : int, optional
        Maximum number of added vertices.

    Raises
    ------
    TooManyError
        If more vertices are needed.

    Attributes
    ----------
    sheet : Sheet
        The mesh, cut, and split if needed.
    regions : Regions
        The target.
    positions : dict
        The position of every vertex on a cut.
    """

    def __init__(self, problem: Problem, guide: ComplexArray | None = None, max_added: int | None = None) -> None:
        self._max_added = max_added
        domain = problem.domain
        point = invert_indices(problem.n, problem.fixed)
        self.regions = Regions(problem.target, [point[loop] for loop in domain.loops], point[domain.pins])
        self.sheet = Sheet(problem.F, problem.n, domain.pins.tolist())
        self.positions: dict[int, complex] = {}
        self._target = to_complex(problem.target).tolist()
        # The copy at each corner of the target's triangles, keyed by the half-edge that begins there.
        fixed = problem.fixed.tolist()
        self._copy_at = {(a, b): fixed[a] for a, b in self.regions.apex}
        self._closed = set[Edge]()
        bridges = self.regions.bridges()
        if guide is not None or bridges:
            if guide is None:
                # Tutte's embedding may have inverted triangles.
                guide = embed_tutte(problem.F, to_complex(problem.place_fixed()), problem.fixed)
            self._guide = guide.tolist()
        for a, b in bridges:
            self._cut(a, b)
        if guide is None:
            self._guide = _circle_embedding(self.sheet)
        for a, b in self.regions.diagonals(bridges):
            self._cut(a, b)
        for a, b in edges_along_sides(self.sheet, self.regions, point.tolist()):
            self.sheet.split(a, b)

    def _cut(self, a: int, b: int) -> None:
        """Cut the target and the sheet between two points of the target."""
        heartbeat()
        if self._max_added is not None and len(self.sheet.parents) > self._max_added:
            raise TooManyError
        self._closed |= {(a, b), (b, a)}
        start, end = self._copy_at[a, b], self._copy_at[b, a]
        path = walk(self.sheet, self._guide, start, end)
        self._place_along(path, self._target[a], self._target[b])
        right = self.sheet.cut(path)
        # The sheet has numbered new copies, on the right of the cut, in the order of the walk; the last one only if the
        # end was doubled, too. They have the same positions in the guide.
        self._guide += [self._guide[copy] for copy in path[: len(self.sheet.vertex) - len(self._guide)]]
        self._use_copies(a, b, right[0], right[-1] if right[-1] != end else None)

    def _use_copies(self, a: int, b: int, at_a: int, at_b: int | None) -> None:
        """Note the copies at the corners to the right of a cut from a to b; ``at_b`` is None if b was not doubled.

        The corners at ``a`` follow clockwise, those at ``b`` counterclockwise, up to the next cut.
        """
        apex = self.regions.apex
        head = apex[b, a]
        self._copy_at[a, head] = at_a
        while (a, head) not in self._closed and (head, a) in apex:
            head = apex[head, a]
            self._copy_at[a, head] = at_a
        if at_b is not None:
            head = a
            self._copy_at[b, head] = at_b
            while (b, (head := apex[b, head])) in apex and (b, head) not in self._closed:
                self._copy_at[b, head] = at_b

    def _place_along(self, path: list[int], start: complex, end: complex) -> None:
        """Assign positions on the segment to the vertices of a walk: half by their current spacing, half evenly."""
        steps = np.abs(np.diff([self._guide[copy] for copy in path]))
        steps = steps / (steps.sum() or 1.0) + 1 / len(steps)
        share = np.cumsum(steps)[:-1] / steps.sum()
        for copy, t in zip(path[1:-1], share.tolist(), strict=True):
            self.positions[self.sheet.vertex[copy]] = (1 - t) * start + t * end


def _circle_embedding(sheet: Sheet) -> list[complex]:
    """Return positions of the copies of a disk whose boundary is spread evenly along a circle."""
    (loop,) = sheet.loops()
    w = np.zeros(len(sheet.vertex), dtype=np.complex128)
    w[loop] = np.exp(2j * np.pi * np.arange(len(loop)) / len(loop))
    positions: list[complex] = embed_tutte(sheet.rows(), w, np.array(loop)).tolist()
    return positions
