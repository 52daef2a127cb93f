"""Triangles as a table of half-edges, which is changed triangle by triangle."""

from __future__ import annotations

from collections.abc import Iterable, Iterator

from quasiharmonic.util.arrays import IntArray

Edge = tuple[int, int]
Triangle = tuple[int, int, int]


class HalfEdges:
    """An oriented surface with boundary.

    Parameters
    ----------
    F : (f, 3) int64
        Its triangles.

    Attributes
    ----------
    apex : dict
        The third corner of the triangle to the left of a half-edge.
    following : dict
        The next vertex along the boundary, the surface to the left.
    """

    def __init__(self, F: IntArray) -> None:
        self.apex: dict[Edge, int] = {}
        # The head of some half-edge from each vertex.
        self._some: dict[int, int] = {}
        self.add(F.tolist())
        self.following = {a: b for a, b in self.apex if (b, a) not in self.apex}

    def add(self, triangles: Iterable[Iterable[int]]) -> None:
        """Add triangles, given counterclockwise."""
        apex, some = self.apex, self._some
        for a, b, c in triangles:
            apex[a, b], apex[b, c], apex[c, a] = c, a, b
            some[a], some[b], some[c] = b, c, a

    def remove(self, triangles: Iterable[Triangle]) -> None:
        """Remove triangles; in their place others have to come."""
        for a, b, c in triangles:
            del self.apex[a, b], self.apex[b, c], self.apex[c, a]

    def is_inner(self, a: int, b: int) -> bool:
        """Whether there is an edge between two vertices that has a triangle on either side."""
        return (a, b) in self.apex and (b, a) in self.apex

    def link(self, vertex: int) -> Iterator[Edge]:
        """The sides opposite to a vertex in the triangles around it, counterclockwise."""
        first = tail = self.following.get(vertex, self._some[vertex])
        while (head := self.apex.get((vertex, tail))) is not None:
            yield tail, head
            tail = head
            if tail == first:
                return

    def triangles(self) -> list[Triangle]:
        """All triangles, each from its smallest corner, in the order of these."""
        return sorted((a, b, c) for (a, b), c in self.apex.items() if a < b and a < c)

    def inner_edges(self) -> list[Edge]:
        """All edges with a triangle on either side, the smaller end first, in order."""
        return sorted((a, b) for a, b in self.apex if a < b and (b, a) in self.apex)
