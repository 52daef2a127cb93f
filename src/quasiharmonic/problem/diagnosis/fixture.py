"""The fixed elements of a problem, and the curves of its boundary in the target.

The fixed elements are positions, edges between them, and those around each free vertex. The curves have intersections,
turning numbers and winding numbers.

All results are exact. The conditions rest on three facts:

1. A map without inverted triangles covers every point off its boundary curves as often as they wind around it. So
   winding numbers are never negative.
2. The exterior angles of its boundary add up to at least 2π times the Euler characteristic of the surface. The sum
   equals this bound unless the map winds more than once around a vertex (count the angles of all triangles in two
   ways).
3. If the curves wind at most once around every point, the map is injective.
"""

from __future__ import annotations

from dataclasses import dataclass
from fractions import Fraction
from functools import cached_property

import numpy as np

from quasiharmonic.geometry.exact.loops import Contacts, LoopEdges, contacts, winding
from quasiharmonic.geometry.exact.predicates import SegmentRelation, orientation
from quasiharmonic.problem import Problem
from quasiharmonic.problem.diagnosis.clipping import Convex, Lattice, line
from quasiharmonic.util.arrays import BoolArray, FloatArray, IntArray, invert_indices
from quasiharmonic.util.progress import heartbeat

# Limit on the pairs of meeting edges to collect; a longer list would not help the user.
MAX_CONTACTS = 10_000


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


def turning_number(loop: FloatArray) -> int:
    """Return how often the direction of a closed polygon (l, 2) turns around, counterclockwise.

    No two consecutive corners are equal. A fold, where an edge reverses the direction of the previous one, counts as a
    turn by -π: the interior angle that triangles can fill there is 2π.
    """
    after = np.roll(loop, -1, axis=0)
    # Compare coordinates, which is exact, instead of subtracting them.
    # Directions of angle 0 ≤ θ < π are up, the others down; each full turn passes from down to up.
    up = (after[:, 1] > loop[:, 1]) | ((after[:, 1] == loop[:, 1]) & (after[:, 0] > loop[:, 0]))
    turn = orientation(loop, after, np.roll(after, -1, axis=0))
    up_after = np.roll(up, -1)
    # A turn of zero between up and down is a fold, and counts as a right turn.
    passes = np.where(turn > 0, ~up & up_after, False).astype(np.int64)
    passes -= np.where(turn <= 0, up & ~up_after, False)
    return int(passes.sum())


class TargetCurves:
    """The boundary loops of a surface at their target positions.

    Attributes
    ----------
    positions : (n, 2) float64
        Positions of vertices, finite on the boundary.
    loops : list of (l,) int64
        Boundary loops, with the surface to their left, each from its lowest corner (the leftmost of several).
    ends : (m, 2) int64
        Boundary edges, loop by loop, in order.
    tails, heads : (m, 2) float64
        Positions of their ends.
    loop_of : (m,) int64
        Index of the loop of each edge.
    """

    def __init__(self, positions: FloatArray, loops: list[IntArray]) -> None:
        self.positions = positions
        self.loops = [np.roll(loop, -int(np.lexsort(positions[loop].T)[0])) for loop in loops]
        edges = LoopEdges.of(self.loops, positions)
        self.ends, self.loop_of, self.tails, self.heads = edges.ends, edges.owner, edges.p, edges.q

    @cached_property
    def degenerate(self) -> IntArray:
        """Indices of edges of length zero."""
        return np.flatnonzero((self.tails == self.heads).all(axis=1))

    @cached_property
    def folds(self) -> IntArray:
        """Vertices at which the curve reverses its direction."""
        folded = []
        for loop in self.loops:
            here, before, after = (self.positions[np.roll(loop, k)] for k in (0, 1, -1))
            flat = orientation(before, here, after) == 0
            # Three collinear vertices form a fold unless the middle one lies between the others.
            low, high = np.minimum(before, after), np.maximum(before, after)
            distinct = (here != before).any(axis=1) & (here != after).any(axis=1)
            outside = ((here < low) | (here > high)).any(axis=1)
            folded.append(loop[flat & distinct & outside])
        return np.concatenate(folded)

    @cached_property
    def contacts(self) -> Contacts:
        """Pairs of edges at which the curves meet themselves or each other."""
        return contacts(self.positions, self.ends, MAX_CONTACTS)

    @property
    def simple(self) -> bool:
        """Whether every loop is simple and no two loops meet."""
        return not self.degenerate.size and not len(self.contacts.pairs)

    @cached_property
    def turning(self) -> list[int] | None:
        """Turning number of each loop; None if there are edges of length zero, which have no direction."""
        if self.degenerate.size:
            return None
        return [turning_number(self.positions[loop]) for loop in self.loops]

    @cached_property
    def winding_range(self) -> IntArray | None:
        """Smallest winding number right of each loop, largest one left of it; (loops, 2) int64.

        The numbers are those of all curves together, and every region of the plane except the outermost is next to a
        loop. None if curves touch or overlap instead of crossing, or if the list of contacts is incomplete.
        """
        meet = self.contacts
        if self.degenerate.size or not meet.complete or (meet.relation != SegmentRelation.CROSSING).any():
            return None
        edge, other = np.concatenate([meet.pairs, meet.pairs[:, ::-1]]).T
        # Crossing a curve from its right to its left increases the winding number by one.
        step = orientation(self.tails[other], self.heads[other], self.heads[edge])
        several = np.bincount(edge, minlength=len(self.ends))[edge] > 1
        position = [
            self._crossing_position(e, o) if s else Fraction(0) for e, o, s in zip(edge, other, several, strict=True)
        ]
        steps: list[dict[tuple[int, Fraction], int]] = [{} for _ in self.loops]
        for k in sorted(range(len(edge)), key=lambda k: (edge[k], position[k])):
            heartbeat()
            # Add up all crossings at the same point.
            along = steps[self.loop_of[edge[k]]]
            at = (int(edge[k]), position[k])
            along[at] = along.get(at, 0) + int(step[k])
        ranges = []
        for index, along in enumerate(steps):
            left = self._left_at_start(index) + np.cumsum([0, *along.values()])
            ranges.append((left.min() - 1, left.max()))
        return np.array(ranges, dtype=np.int64)

    @property
    def proper(self) -> bool:
        """Whether the loops are simple, disjoint, and nested as holes in one outer loop."""
        if not self.simple or self.turning is None or self.winding_range is None:
            return False
        low, high = self.winding_range.T
        return self.turning.count(1) == 1 and bool((low >= 0).all() and (high <= 1).all())

    def _crossing_position(self, edge: int, other: int) -> Fraction:
        """Return the position along an edge where another crosses it, from 0 at its tail to 1 at its head."""
        heartbeat()
        (px, py), (qx, qy), (rx, ry), (sx, sy) = (
            tuple(map(Fraction, self.positions[vertex].tolist())) for vertex in (*self.ends[edge], *self.ends[other])
        )
        tail = (sx - rx) * (py - ry) - (sy - ry) * (px - rx)
        head = (sx - rx) * (qy - ry) - (sy - ry) * (qx - rx)
        return tail / (tail - head)

    def _left_at_start(self, index: int) -> int:
        """Return the winding number just left of the lowest corner of a loop."""
        own = self.loop_of == index
        before, here, after = (self.positions[self.loops[index][k]] for k in (-1, 0, 1))
        others, _ = winding(here[None], self.tails[~own], self.heads[~own])
        # A loop has winding number zero below its lowest corner. At a left turn, the inner side is the left one.
        return int(others[0]) + int(orientation(before, here, after) > 0)


class Corners:
    """The angles of the target at its boundary vertices.

    Attributes
    ----------
    known : (n,) bool
        Whether a vertex is on the boundary.
    before, after : (n,) int64
        The previous and the next boundary vertex, -1 at other vertices.
    """

    def __init__(self, curves: TargetCurves) -> None:
        n = len(curves.positions)
        self.known = np.zeros(n, dtype=bool)
        self.before, self.after = np.full((2, n), -1)
        tails, heads = curves.ends.T
        self.known[tails] = True
        self.before[heads], self.after[tails] = tails, heads

    def reflex(self, vertices: IntArray, where: FloatArray) -> BoolArray:
        """Return whether the interior angle is larger than π; (k,) bool."""
        return orientation(where[self.before[vertices]], where[vertices], where[self.after[vertices]]) < 0

    def opens_to(self, vertices: IntArray, points: FloatArray, where: FloatArray) -> BoolArray:
        """Return whether the segment to a point starts strictly inside the interior angle; (k,) bool, False at pins."""
        result = np.zeros(len(vertices), dtype=bool)
        known = np.flatnonzero(self.known[vertices])
        v, x = vertices[known], points[known]
        left_of_last = orientation(where[self.before[v]], where[v], x) > 0
        left_of_next = orientation(where[v], where[self.after[v]], x) > 0
        reflex = self.reflex(v, where)
        result[known] = np.where(reflex, left_of_last | left_of_next, left_of_last & left_of_next)
        return result
