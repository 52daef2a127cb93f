"""A surface that is cut along walks and whose interior edges are split.

A vertex on a cut becomes two *copies*, one on either side. All indices are of copies, and ``vertex`` maps each copy to
its vertex. Vertices beyond the original mesh are midpoints of split edges.

The triangles are kept in a half-edge table, which supports local changes.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from itertools import pairwise

import numpy as np

from quasiharmonic.geometry.mesh.topology import trace_loops
from quasiharmonic.util.arrays import IntArray

Edge = tuple[int, int]
Triangle = tuple[int, int, int]


class HalfEdges:
    """An oriented surface with boundary, made from triangles ``F`` (f, 3).

    Attributes
    ----------
    apex : dict
        The third corner of the triangle to the left of a half-edge.
    following : dict
        The next vertex along the boundary, with the surface to the left.
    """

    def __init__(self, F: IntArray) -> None:
        self.apex: dict[Edge, int] = {}
        # The head of one half-edge from each vertex.
        self._neighbour: dict[int, int] = {}
        self.add(F.tolist())
        self.following = {a: b for a, b in self.apex if (b, a) not in self.apex}

    def add(self, triangles: Iterable[Iterable[int]]) -> None:
        """Add counterclockwise triangles."""
        apex, neighbour = self.apex, self._neighbour
        for a, b, c in triangles:
            apex[a, b], apex[b, c], apex[c, a] = c, a, b
            neighbour[a], neighbour[b], neighbour[c] = b, c, a

    def remove(self, triangles: Iterable[Triangle]) -> None:
        """Remove triangles; others must replace them."""
        for a, b, c in triangles:
            del self.apex[a, b], self.apex[b, c], self.apex[c, a]

    def is_inner(self, a: int, b: int) -> bool:
        """Whether an edge exists between two vertices and has a triangle on either side."""
        return (a, b) in self.apex and (b, a) in self.apex

    def link(self, vertex: int) -> Iterator[Edge]:
        """Yield the sides opposite to a vertex in its triangles, counterclockwise."""
        first = tail = self.following.get(vertex, self._neighbour[vertex])
        while (head := self.apex.get((vertex, tail))) is not None:
            yield tail, head
            tail = head
            if tail == first:
                return

    def triangles(self) -> list[Triangle]:
        """Return all triangles, each from its smallest corner, sorted."""
        return sorted((a, b, c) for (a, b), c in self.apex.items() if a < b and a < c)

    def inner_edges(self) -> list[Edge]:
        """Return all edges with a triangle on either side, the smaller end first, sorted."""
        return sorted((a, b) for a, b in self.apex if a < b and (b, a) in self.apex)


class Sheet(HalfEdges):
    """An oriented surface with boundary that can be cut.

    Parameters
    ----------
    F : (f, 3) int64
        Its triangles before any cut.
    n : int
        Number of vertices.
    pins : iterable of int
        Interior vertices that act as loops of one vertex until a cut ends there.

    Attributes
    ----------
    vertex : list of int
        The vertex of each copy.
    parents : list of (int, int)
        The two vertices whose midpoint each added vertex is, in order of addition.
    preceding : dict
        The previous copy along the boundary.
    """

    def __init__(self, F: IntArray, n: int, pins: Iterable[int] = ()) -> None:
        super().__init__(F)
        self._n = n
        self._pins = set(pins)
        self.vertex = list(range(n))
        self.parents: list[Edge] = []
        self.preceding = {b: a for a, b in self.following.items()}

    def is_fixed(self, copy: int) -> bool:
        """Whether a copy is on the boundary or is a pin."""
        return copy in self.following or copy in self._pins

    def loops(self) -> list[list[int]]:
        """Return the boundary copies in order, loop by loop, with the surface to the left."""
        boundary = np.array(list(self.following.items()), dtype=np.int64).reshape(-1, 2)
        return [loop.tolist() for loop in trace_loops(boundary)]

    def split(self, a: int, b: int) -> int:
        """Add a vertex at the midpoint of an interior edge; return its copy."""
        middle = len(self.vertex)
        self.vertex.append(self._n + len(self.parents))
        self.parents.append((self.vertex[a], self.vertex[b]))
        for tail, head in ((a, b), (b, a)):
            opposite = self.apex.pop((tail, head))
            self.add([(tail, middle, opposite), (middle, head, opposite)])
        return middle

    def cut(self, walk: Sequence[int]) -> list[int]:
        """Cut along interior edges, from a copy on the boundary to another, or to a pin that is still uncut.

        All copies of the walk but its ends are interior; none occurs twice. Return the copies to the right of the walk;
        the old copies stay to its left. A pin at the end is not duplicated.
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
                smallest = corners.index(min(corners))
                triangle = (corners[smallest], corners[smallest - 2], corners[smallest - 1])
                renamed.setdefault(triangle, list(triangle))[triangle.index(copy)] = right[copy]
                tail = head
        self.remove(renamed)
        self.add(renamed.values())
        back = [right.get(copy, copy) for copy in walk]
        self._update_boundary(walk, back)
        return back

    def _update_boundary(self, walk: Sequence[int], right: Sequence[int]) -> None:
        """Update the boundary: from the start of a cut along its left side, and back along its right side."""
        after, before = self.following[walk[0]], self.preceding.get(walk[-1])
        pairs = [*pairwise(walk), *zip(right[:0:-1], right[-2::-1], strict=True)]
        pairs.append((right[0], after))
        if before is not None:
            pairs.append((before, right[-1]))
        for tail, head in pairs:
            self.following[tail] = head
            self.preceding[head] = tail

    def rows(self) -> IntArray:
        """Return all triangles as copies, (t, 3) int64."""
        return np.array(self.triangles(), dtype=np.int64).reshape(-1, 3)
