"""A surface that is cut along walks, and whose inner edges are split.

A vertex that a cut passes through becomes two *copies*, one on either side. All here is by copies, and each copy knows
the vertex that it is of; vertices beyond the mesh's own were made by splitting an edge in the middle.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from itertools import pairwise

import numpy as np

from quasiharmonic.solver.construction.halfedges import Edge, HalfEdges, Triangle
from quasiharmonic.util.arrays import IntArray


class Sheet(HalfEdges):
    """An oriented surface with boundary, to be cut.

    Parameters
    ----------
    F : (f, 3) int64
        Its triangles, before anything is cut.
    n : int
        Number of vertices.
    pins : iterable of int
        Inner vertices that are as loops of one vertex until a cut ends in them.

    Attributes
    ----------
    vertex : list of int
        The vertex that each copy is of.
    parents : list of (int, int)
        The vertices between which each added one lies, in the order in which they were added.
    preceding : dict
        The last copy along the boundary.
    """

    def __init__(self, F: IntArray, n: int, pins: Iterable[int] = ()) -> None:
        super().__init__(F)
        self._n = n
        self._pins = set(pins)
        self.vertex = list(range(n))
        self.parents: list[Edge] = []
        self.preceding = {b: a for a, b in self.following.items()}

    def is_held(self, copy: int) -> bool:
        """Whether a copy lies on the boundary, or is a pin."""
        return copy in self.following or copy in self._pins

    def loops(self) -> list[list[int]]:
        """The boundary's copies in order, loop by loop, the surface to the left."""
        found: list[list[int]] = []
        seen = set[int]()
        for start in sorted(self.following):
            if start not in seen:
                loop = [start]
                while (ahead := self.following[loop[-1]]) != start:
                    loop.append(ahead)
                seen.update(loop)
                found.append(loop)
        return found

    def split(self, a: int, b: int) -> int:
        """Put a vertex onto the middle of an inner edge; its copy."""
        middle = len(self.vertex)
        self.vertex.append(self._n + len(self.parents))
        self.parents.append((self.vertex[a], self.vertex[b]))
        for tail, head in ((a, b), (b, a)):
            opposite = self.apex.pop((tail, head))
            self.add([(tail, middle, opposite), (middle, head, opposite)])
        return middle

    def cut(self, walk: Sequence[int]) -> list[int]:
        """Cut along inner edges, from a copy on the boundary to another, or to a pin that is none yet.

        Parameters
        ----------
        walk : sequence of int
            Copies, each once; those between the ends are inner ones.

        Returns
        -------
        list of int
            The copies to the right of the walk; to its left stay the old ones. A pin inside is not doubled.
        """
        doubled = walk if walk[-1] in self.following else walk[:-1]
        right = dict(zip(doubled, range(len(self.vertex), len(self.vertex) + len(doubled)), strict=True))
        self.vertex += [self.vertex[copy] for copy in doubled]
        renamed: dict[Triangle, list[int]] = {}
        for before, copy, after in zip([None, *walk[:-1]], walk, [*walk[1:], None], strict=True):
            if copy not in right:
                continue
            tail = self.following[copy] if before is None else before
            end = self.preceding[copy] if after is None else after
            while tail != end:
                head = self.apex[copy, tail]
                corners = (copy, tail, head)
                least = corners.index(min(corners))
                triangle = (corners[least], corners[least - 2], corners[least - 1])
                renamed.setdefault(triangle, list(triangle))[triangle.index(copy)] = right[copy]
                tail = head
        self.remove(renamed)
        self.add(renamed.values())
        back = [right.get(copy, copy) for copy in walk]
        self._mend_boundary(walk, back)
        return back

    def _mend_boundary(self, walk: Sequence[int], right: Sequence[int]) -> None:
        """Let the boundary run along both sides of a cut: from its start on the left, back to it on the right."""
        after, before = self.following[walk[0]], self.preceding.get(walk[-1])
        pairs = [*pairwise(walk), *zip(right[:0:-1], right[-2::-1], strict=True)]
        pairs.append((right[0], after))
        if before is not None:
            pairs.append((before, right[-1]))
        for tail, head in pairs:
            self.following[tail] = head
            self.preceding[head] = tail

    def rows(self) -> IntArray:
        """All triangles by copies, (t, 3) int64."""
        return np.array(self.triangles(), dtype=np.int64).reshape(-1, 3)
