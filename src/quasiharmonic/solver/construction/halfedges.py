"""A half-edge table of triangles that supports local changes."""

from __future__ import annotations

from collections.abc import Iterable, Iterator

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
