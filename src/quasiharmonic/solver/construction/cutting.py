"""Cut a mesh and its target in the same way, until every piece of the target is convex."""

from __future__ import annotations

import numpy as np

from quasiharmonic.linsolve.laplacian import embed_tutte
from quasiharmonic.problem import Problem
from quasiharmonic.solver.construction.halfedges import Edge
from quasiharmonic.solver.construction.regions import Regions
from quasiharmonic.solver.construction.sheet import Sheet
from quasiharmonic.solver.construction.sides import edges_along_sides
from quasiharmonic.solver.construction.walks import walk
from quasiharmonic.util.arrays import ComplexArray, invert_indices, to_complex
from quasiharmonic.util.progress import heartbeat


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
        self._guide += [self._guide[copy] for copy in path[: len(self.sheet.vertex) - len(self._guide)]]
        # To the right of the cut, corners use the right copies: iterate clockwise around a and counterclockwise around
        # b.
        apex = self.regions.apex
        head = apex[b, a]
        self._copy_at[a, head] = right[0]
        while (a, head) not in self._closed and (head, a) in apex:
            head = apex[head, a]
            self._copy_at[a, head] = right[0]
        if right[-1] != end:
            head = a
            self._copy_at[b, head] = right[-1]
            while (b, (head := apex[b, head])) in apex and (b, head) not in self._closed:
                self._copy_at[b, head] = right[-1]

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
