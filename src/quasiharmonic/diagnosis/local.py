"""Conditions on single elements that hold for every map without inverted triangles.

None of them asks whether the target overlaps itself: the triangles of a fixed element must be
positive however the rest is laid out.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ..mesh.topology import named
from ..predicates import orientation
from ..problem import Problem
from .clipping import Convex, Lattice, line
from .obstruction import Forbids, Kind, Obstruction, named_edges, named_vertices

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]
BoolArray = NDArray[np.bool_]


@dataclass(frozen=True)
class Fixture:
    """Which elements of a mesh have given positions.

    Attributes
    ----------
    positions : (n, 2) float64
        Target positions, NaN at free vertices.
    fixed : (n,) bool
    chords : (c, 2) int64
        Interior edges with both ends fixed.
    lattice : Lattice
        The fixed positions as integers, in the order of ``Problem.fixed``.
    row : (n,) int64
        Where in ``Problem.fixed`` a vertex is, -1 for free ones.
    """

    positions: FloatArray
    fixed: BoolArray
    chords: IntArray
    lattice: Lattice
    row: IntArray

    @staticmethod
    def of(problem: Problem) -> Fixture:
        """Collect what is fixed in a problem."""
        positions = np.full((problem.n, 2), np.nan)
        positions[problem.fixed] = problem.target
        row = np.full(problem.n, -1)
        row[problem.fixed] = np.arange(len(problem.fixed))
        interior = problem.edges.interior
        chords = interior[(row[interior] >= 0).all(axis=1)]
        return Fixture(positions, row >= 0, chords, Lattice(problem.target), row)

    def points(self, vertices: IntArray) -> list[tuple[int, int]]:
        """Integer positions of fixed vertices."""
        return [self.lattice.points[k] for k in self.row[vertices].tolist()]

    def extent(self) -> Convex:
        """The open box around all fixed vertices, which contains the image of every free one."""
        return Convex.box(self.lattice.low, self.lattice.high)


@dataclass(frozen=True)
class Star:
    """A free vertex and what is fixed around it.

    Attributes
    ----------
    vertex : int
    neighbours : (k,) int64
        Fixed vertices joined to it.
    opposite : (h, 2) int64
        Fixed edges that form a triangle with it, which lies to their left.
    """

    vertex: int
    neighbours: IntArray
    opposite: IntArray


def stars(problem: Problem, fixture: Fixture, folds: IntArray) -> Iterator[Star]:
    """Free vertices whose fixed surroundings could leave them no place.

    Left out are those that always find one: with a single fixed neighbour, or with those of one or
    two consecutive boundary edges, which are all seen from near the middle one.

    Parameters
    ----------
    problem : Problem
    fixture : Fixture
    folds : (k,) int64
        Vertices at which the boundary goes back along itself: nothing is near these.
    """
    fixed = fixture.fixed
    interior = problem.edges.interior
    joined = interior[fixed[interior[:, 0]] != fixed[interior[:, 1]]]
    joined = np.where(fixed[joined[:, :1]], joined[:, ::-1], joined)  # free, fixed
    free = np.argmin(fixed[problem.F], axis=1)
    two = np.flatnonzero(fixed[problem.F].sum(axis=1) == 2)
    corner = problem.F[two[:, None], (free[two, None] + [0, 1, 2]) % 3]  # free, then the fixed edge

    neighbours = np.bincount(joined[:, 0], minlength=problem.n)
    opposite = np.bincount(corner[:, 0], minlength=problem.n)
    outer = np.zeros(problem.n, dtype=np.int64)
    following = np.full(problem.n, -1)
    following[problem.edges.boundary[:, 0]] = problem.edges.boundary[:, 1]
    np.add.at(outer, corner[following[corner[:, 1]] == corner[:, 2], 0], 1)
    placed = (neighbours <= 3) & (outer == neighbours - 1) & (outer == opposite)
    placed[corner[np.isin(corner[:, 1], folds), 0]] = False
    wanted = np.flatnonzero((neighbours >= 2) & ~placed)

    joined = joined[np.argsort(joined[:, 0], kind="stable")]
    corner = corner[np.argsort(corner[:, 0], kind="stable")]
    first_joined, first_corner = np.cumsum(neighbours) - neighbours, np.cumsum(opposite) - opposite
    for v in wanted.tolist():
        a, b = first_joined[v], first_corner[v]
        yield Star(v, joined[a : a + neighbours[v], 1], corner[b : b + opposite[v], 1:])


def collapsed_edges(problem: Problem, fixture: Fixture) -> Iterator[Obstruction]:
    """Edges whose two ends are fixed at the same position."""
    every = np.concatenate([problem.edges.boundary, fixture.chords])
    where = fixture.positions
    for edge in every[(where[every[:, 0]] == where[every[:, 1]]).all(axis=1)]:
        message = f"The target gives both ends of {named_edges(edge[None])} the same position."
        yield Obstruction(Kind.COLLAPSED_EDGE, Forbids.INJECTIVE, message, vertices=edge, edges=edge)


def inverted_triangles(problem: Problem, fixture: Fixture) -> Iterator[Obstruction]:
    """Triangles with three fixed vertices that the target itself inverts or flattens."""
    whole = np.flatnonzero(fixture.fixed[problem.F].all(axis=1))
    corners = problem.F[whole]
    sign = orientation(*(fixture.positions[corners[:, k]] for k in range(3)))
    boundary = _keys(problem.edges.boundary, problem.n)
    for t, abc, s in zip(whole[sign <= 0], corners[sign <= 0], sign[sign <= 0], strict=True):
        sides = np.stack([abc, np.roll(abc, -1)], axis=1)
        message = (
            f"All vertices of {named('triangle', 'triangles', t[None])} are fixed, "
            f"and the target {'inverts' if s < 0 else 'flattens'} it."
        )
        split = sides[~np.isin(_keys(sides, problem.n), boundary)]
        yield Obstruction(
            Kind.INVERTED_TRIANGLE, Forbids.INJECTIVE, message, vertices=abc, triangles=t, split=split
        )


def inverted_patches(problem: Problem, fixture: Fixture) -> Iterator[Obstruction]:
    """Parts of the mesh that fixed edges cut off, and to which the target leaves no positive area.

    The areas of a patch's triangles add up to what its fixed border encloses.
    """
    if not len(fixture.chords):
        return
    from scipy.sparse import csr_array
    from scipy.sparse.csgraph import connected_components

    # Triangles around a free vertex belong together, and so do those of two free vertices joined.
    free = ~fixture.fixed
    interior = problem.edges.interior
    inner = interior[free[interior].all(axis=1)]
    graph = csr_array((np.ones(len(inner), dtype=np.int8), inner.T), shape=(problem.n, problem.n))
    label = connected_components(graph, directed=False)[1]
    open_ = np.flatnonzero(free[problem.F].any(axis=1))
    corners = problem.F[open_]
    patch = label[corners[np.arange(len(corners)), np.argmax(free[corners], axis=1)]]
    sides = np.stack([corners, np.roll(corners, -1, axis=1)], axis=2)
    border = fixture.fixed[sides].all(axis=2)
    of, edge = patch[np.nonzero(border)[0]], sides[border]

    if len(open_) == len(problem.F) and (patch == patch[0]).all():
        return  # fixed edges that cut nothing off

    twice_area: dict[int, int] = {}
    for k, (px, py), (qx, qy) in zip(
        of.tolist(), fixture.points(edge[:, 0]), fixture.points(edge[:, 1]), strict=True
    ):
        twice_area[k] = twice_area.get(k, 0) + px * qy - py * qx
    boundary = _keys(problem.edges.boundary, problem.n)
    for k in sorted(k for k, area in twice_area.items() if area <= 0):
        around = edge[of == k]
        message = f"The fixed {named_edges(around)} around a part of the mesh leave it no positive area."
        split = around[~np.isin(_keys(around, problem.n), boundary)]
        yield Obstruction(
            Kind.INVERTED_PATCH,
            Forbids.INJECTIVE,
            message,
            edges=around,
            triangles=open_[patch == k],
            split=split,
        )


def clip_to(area: Convex | None, edges: IntArray, fixture: Fixture) -> Convex | None:
    """What lies to the left of fixed edges, or None if that has no area.

    Edges of length zero have no left side and are passed over.
    """
    for p, q in zip(fixture.points(edges[:, 0]), fixture.points(edges[:, 1]), strict=True):
        if area is None:
            return None
        if p != q:
            area = area.cut(line(p, q))
    return area


def half_planes(star: Star, fixture: Fixture) -> Obstruction | None:
    """Whether no point lies to the left of all the fixed edges that form triangles with a vertex."""
    area = fixture.extent()
    if clip_to(area, star.opposite, fixture) is not None:
        return None
    needed = star.opposite
    for edge in star.opposite.tolist():
        without = needed[(needed != edge).any(axis=1)]
        if clip_to(area, without, fixture) is None:
            needed = without
    vertex = np.array([star.vertex])
    ends = np.unique(needed)
    message = (
        f"{named_vertices(vertex).capitalize()} must lie to the left of the fixed {named_edges(needed)}, "
        "and no point of the target's bounding box does."
    )
    return Obstruction(
        Kind.HALF_PLANES,
        Forbids.INJECTIVE,
        message,
        vertices=vertex,
        edges=needed,
        split=np.stack([np.full(len(ends), star.vertex), ends], axis=1),
    )


def _keys(edges: IntArray, n: int) -> IntArray:
    """One integer for each undirected edge."""
    keys: IntArray = np.minimum(edges[:, 0], edges[:, 1]) * n + np.maximum(edges[:, 0], edges[:, 1])
    return keys
