"""The fixed elements of a problem: positions, edges between them, and the fixed elements around each free vertex."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from quasiharmonic.problem import Problem
from quasiharmonic.problem.diagnosis.clipping import Convex, Lattice, line
from quasiharmonic.util.arrays import BoolArray, FloatArray, IntArray, invert_indices
from quasiharmonic.util.progress import heartbeat


@dataclass(frozen=True)
class Fixture:
    """The elements of a mesh with fixed positions.

    Attributes
    ----------
    positions : (n, 2) float64
        Target positions, NaN at free vertices.
    fixed : (n,) bool
        Whether a vertex is fixed.
    chords : (c, 2) int64
        Interior edges with both ends fixed.
    joined : (j, 2) int64
        Interior edges with one end fixed; columns: free vertex, fixed vertex.
    inner : (i, 2) int64
        Edges with both ends free.
    lattice : Lattice
        The target positions as integers, in the order of ``Problem.fixed``.
    row : (n,) int64
        Index of a vertex in ``Problem.fixed``, -1 for free vertices.
    """

    positions: FloatArray
    fixed: BoolArray
    chords: IntArray
    joined: IntArray
    inner: IntArray
    lattice: Lattice
    row: IntArray

    @staticmethod
    def of(problem: Problem) -> Fixture:
        """Return the fixed elements of a problem."""
        row = invert_indices(problem.n, problem.fixed)
        fixed, interior = row >= 0, problem.domain.edges.interior
        ends = fixed[interior].sum(axis=1)
        mixed = interior[ends == 1]
        joined = np.where(fixed[mixed[:, :1]], mixed[:, ::-1], mixed)
        return Fixture(
            problem.place_fixed(np.nan),
            fixed,
            interior[ends == 2],
            joined,
            interior[ends == 0],
            Lattice(problem.target),
            row,
        )

    def points(self, vertices: IntArray) -> list[tuple[int, int]]:
        """Return integer positions of fixed vertices."""
        return [self.lattice.points[k] for k in self.row[vertices].tolist()]

    def extent(self) -> Convex:
        """Return the open bounding box of all fixed vertices, which contains the image of every free vertex."""
        return Convex.box(self.lattice.low, self.lattice.high)

    def left_of(self, area: Convex | None, edges: IntArray) -> Convex | None:
        """Return the part of an area to the left of fixed edges (k, 2), or None if it is empty.

        Edges of length zero have no left side and are skipped.
        """
        for p, q in zip(self.points(edges[:, 0]), self.points(edges[:, 1]), strict=True):
            heartbeat()
            if area is None:
                return None
            if p != q:
                area = area.cut(line(p, q))
        return area


@dataclass(frozen=True)
class Star:
    """A free vertex and the fixed elements around it.

    Attributes
    ----------
    vertex : int
    neighbours : (k,) int64
        Fixed vertices joined to it.
    opposite : (h, 2) int64
        Fixed edges that form a triangle with it; the vertex must be to their left.
    """

    vertex: int
    neighbours: IntArray
    opposite: IntArray

    def edges_to(self, ends: IntArray) -> IntArray:
        """Return the edges (k, 2) from the vertex to some of its neighbours, given repeatedly and in any shape."""
        ends = np.unique(ends)
        return np.stack([np.full(len(ends), self.vertex), ends], axis=1)


@dataclass(frozen=True)
class Stars:
    """The stars of several free vertices.

    Attributes
    ----------
    vertices : (s,) int64
        Ascending.
    of_neighbour, neighbours : (k,) int64
        Index of the star of each neighbour, ascending; the neighbour.
    of_opposite, opposite : (h,), (h, 2) int64
        Index of the star of each edge, ascending; the edge.
    """

    vertices: IntArray
    of_neighbour: IntArray
    neighbours: IntArray
    of_opposite: IntArray
    opposite: IntArray

    def __len__(self) -> int:
        return len(self.vertices)

    def __getitem__(self, k: int) -> Star:
        near = slice(*np.searchsorted(self.of_neighbour, (k, k + 1)))
        beyond = slice(*np.searchsorted(self.of_opposite, (k, k + 1)))
        return Star(int(self.vertices[k]), self.neighbours[near], self.opposite[beyond])

    def take(self, chosen: IntArray) -> Stars:
        """Return some of the stars, given their indices in ascending order."""
        at = invert_indices(len(self), chosen)
        near, beyond = at[self.of_neighbour], at[self.of_opposite]
        a, b = near >= 0, beyond >= 0
        return Stars(self.vertices[chosen], near[a], self.neighbours[a], beyond[b], self.opposite[b])


def stars(problem: Problem, fixture: Fixture, folds: IntArray) -> Stars:
    """Return the stars of free vertices that may have no valid position.

    Two kinds of free vertices always have one and are left out: those with a single fixed neighbour, and those whose
    fixed neighbours are the vertices of one or two consecutive boundary edges. The latter see all of these from a point
    near the middle one. At ``folds`` (k,), the vertices where the boundary reverses its direction, there is no such
    point.
    """
    fixed, joined = fixture.fixed, fixture.joined
    two = np.flatnonzero(fixed[problem.F].sum(axis=1) == 2)
    free = np.argmin(fixed[problem.F[two]], axis=1)
    corner = problem.F[two[:, None], (free[:, None] + [0, 1, 2]) % 3]  # columns: free, fixed edge

    neighbours = np.bincount(joined[:, 0], minlength=problem.n)
    opposite = np.bincount(corner[:, 0], minlength=problem.n)
    following = np.full(problem.n, -1)
    following[problem.domain.edges.boundary[:, 0]] = problem.domain.edges.boundary[:, 1]
    outer = np.bincount(corner[following[corner[:, 1]] == corner[:, 2], 0], minlength=problem.n)
    placed = (neighbours <= 3) & (outer == neighbours - 1) & (outer == opposite)
    placed[corner[np.isin(corner[:, 1], folds), 0]] = False

    every = np.arange(problem.n)
    joined = joined[np.argsort(joined[:, 0], kind="stable")]
    corner = corner[np.argsort(corner[:, 0], kind="stable")]
    around = Stars(every, joined[:, 0], joined[:, 1], corner[:, 0], corner[:, 1:])
    return around.take(np.flatnonzero((neighbours >= 2) & ~placed))
