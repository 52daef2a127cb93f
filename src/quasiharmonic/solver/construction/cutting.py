"""Mesh and target cut alike, until every piece of the target is convex."""

from __future__ import annotations

import numpy as np

from quasiharmonic.problem import Problem
from quasiharmonic.solver.construction.embedding import tutte
from quasiharmonic.solver.construction.halfedges import Edge
from quasiharmonic.solver.construction.regions import Regions
from quasiharmonic.solver.construction.sheet import Sheet
from quasiharmonic.solver.construction.sides import along_sides
from quasiharmonic.solver.construction.walks import walk
from quasiharmonic.util.arrays import ComplexArray
from quasiharmonic.util.progress import heartbeat


class TooManyError(Exception):
    """More vertices would have to be added than were allowed."""


class Cutting:
    """A mesh and its target, cut alike.

    Parameters
    ----------
    problem : Problem
        Its target is of magnitude about one, its loops are simple, disjoint and nested, and wound as the mesh's; the
        surface has no handles.
    guide : (n,) complex128, optional
        A map near which the mesh is to be cut. Without it the mesh, once it is a disk, is laid into a circle.
    most : int, optional
        Vertices to add at most.

    Raises
    ------
    TooManyError
        When that is not enough.

    Attributes
    ----------
    sheet : Sheet
        The mesh, cut, and split where that was needed.
    regions : Regions
        The target.
    places : dict
        The place of every vertex on a cut.
    """

    def __init__(self, problem: Problem, guide: ComplexArray | None = None, most: int | None = None) -> None:
        self._most = most
        domain = problem.domain
        point = np.full(problem.n, -1)
        point[problem.fixed] = np.arange(len(problem.fixed))
        self.regions = Regions(problem.target, [point[loop] for loop in domain.loops], point[domain.pins])
        self.sheet = Sheet(problem.F, problem.n, domain.pins.tolist())
        self.places: dict[int, complex] = {}
        self._target = (problem.target @ np.array([1, 1j])).tolist()
        # The copy at each corner of the target's triangles, by the half-edge that begins there.
        fixed = problem.fixed.tolist()
        self._at = {(a, b): fixed[a] for a, b in self.regions.apex}
        self._closed = set[Edge]()
        bridges = self.regions.bridges()
        if guide is not None or bridges:
            self._place = (_harmonic(problem) if guide is None else guide).tolist()
        for a, b in bridges:
            self._cut(a, b)
        if guide is None:
            self._place = _on_circle(self.sheet)
        for a, b in self.regions.diagonals(bridges):
            self._cut(a, b)
        for a, b in along_sides(self.sheet, self.regions, point.tolist()):
            self.sheet.split(a, b)

    def _cut(self, a: int, b: int) -> None:
        """Cut target and sheet from one point of the target to another."""
        heartbeat()
        if self._most is not None and len(self.sheet.parents) > self._most:
            raise TooManyError
        self._closed |= {(a, b), (b, a)}
        start, end = self._at[a, b], self._at[b, a]
        way = walk(self.sheet, self._place, start, end)
        self._spread(way, self._target[a], self._target[b])
        right = self.sheet.cut(way)
        self._place += [self._place[copy] for copy in way[: len(self.sheet.vertex) - len(self._place)]]
        # To the right of the cut, corners are at the copies on its right: around a clockwise, around b the other way.
        apex = self.regions.apex
        head = apex[b, a]
        self._at[a, head] = right[0]
        while (a, head) not in self._closed and (head, a) in apex:
            head = apex[head, a]
            self._at[a, head] = right[0]
        if right[-1] != end:
            head = a
            self._at[b, head] = right[-1]
            while (b, (head := apex[b, head])) in apex and (b, head) not in self._closed:
                self._at[b, head] = right[-1]

    def _spread(self, way: list[int], start: complex, end: complex) -> None:
        """Give the vertices of a walk places on the segment: half as they lie now, half evenly."""
        steps = np.abs(np.diff([self._place[copy] for copy in way]))
        steps = steps / (steps.sum() or 1.0) + 1 / len(steps)
        share = np.cumsum(steps)[:-1] / steps.sum()
        for copy, t in zip(way[1:-1], share.tolist(), strict=True):
            self.places[self.sheet.vertex[copy]] = (1 - t) * start + t * end


def _harmonic(problem: Problem) -> ComplexArray:
    """Tutte's embedding, wherever that inverts triangles."""
    w = np.zeros(problem.n, dtype=np.complex128)
    w[problem.fixed] = problem.target @ np.array([1, 1j])
    return tutte(problem.F, w, problem.fixed)


def _on_circle(sheet: Sheet) -> list[complex]:
    """The places of copies when a disk's boundary is laid evenly along a circle."""
    (loop,) = sheet.loops()
    w = np.zeros(len(sheet.vertex), dtype=np.complex128)
    w[loop] = np.exp(2j * np.pi * np.arange(len(loop)) / len(loop))
    placed: list[complex] = tutte(sheet.rows(), w, np.array(loop)).tolist()
    return placed
