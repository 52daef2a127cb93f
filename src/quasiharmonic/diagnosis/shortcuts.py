"""Paths through the mesh with fewer edges than the target leaves room for.

A path from one boundary vertex to another becomes a path of as many segments inside the target, so
two vertices cannot be fewer edges apart than their link distance.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csr_array

from quasiharmonic.diagnosis.fixture import Fixture
from quasiharmonic.diagnosis.links import Polygon
from quasiharmonic.diagnosis.obstruction import Forbids, Kind, Obstruction, named_vertices
from quasiharmonic.problem import Problem

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]
BoolArray = NDArray[np.bool_]

# Pairs this many edges apart and more are not looked at.
LONGEST = 8
# Steps in the triangulated target, some microseconds each, after which the search ends: so many at
# least, and more by so many for each boundary vertex.
_WORK, _WORK_PER_VERTEX = 50_000, 20
# More pairs than this are not collected.
_MOST_PAIRS = 10_000_000
# Places from which the target is overlooked, to spare most pairs an exact path.
_HUBS = 8
# Beyond this size, hubs cost more than they spare.
_MOST_FOR_HUBS = 2000


class Shortcuts:
    """Looks for boundary vertices that are closer in the mesh than inside the target.

    Parameters
    ----------
    problem : Problem
        With a single boundary loop, simple and counterclockwise in the target.
    fixture : Fixture

    Attributes
    ----------
    unchecked : int
        Pairs so many edges apart or more were not, or not all, looked at. Known after `find`.
    """

    def __init__(self, problem: Problem, fixture: Fixture) -> None:
        self._loop = problem.loops[0]
        free = ~fixture.fixed
        interior = problem.edges.interior
        inner = interior[free[interior].all(axis=1)]
        mixed = interior[free[interior[:, 0]] != free[interior[:, 1]]]
        mixed = np.where(free[mixed[:, :1]], mixed[:, ::-1], mixed)  # fixed, free
        place = np.full(problem.n, -1)
        place[self._loop] = np.arange(len(self._loop))
        mixed = mixed[place[mixed[:, 0]] >= 0]
        both = np.concatenate([inner, inner[:, ::-1]])
        self._inner = csr_array((np.ones(len(both)), both.T), shape=(problem.n, problem.n))
        self._ends = csr_array(
            (np.ones(len(mixed)), (place[mixed[:, 0]], mixed[:, 1])), shape=(len(self._loop), problem.n)
        )
        rows = fixture.row[self._loop]
        self._near = fixture.lattice.near[rows]
        self._polygon = Polygon([fixture.lattice.points[k] for k in rows.tolist()], self._near)
        self.unchecked = LONGEST + 1

    def find(self) -> Iterator[Obstruction]:
        """Pairs of vertices that are fewer edges apart than segments, nearest ones first."""
        n = len(self._loop)
        budget = _WORK + _WORK_PER_VERTEX * n
        from_hubs = _hub_distances(self._near, np.array(self._polygon.triangles))
        reached, known = self._ends, np.empty(0, dtype=np.int64)
        at_ends = np.bincount(self._ends.indices, minlength=self._ends.shape[1])
        for k in range(2, LONGEST + 1):
            if at_ends @ np.bincount(reached.indices, minlength=reached.shape[1]) > _MOST_PAIRS:
                self.unchecked = k
                return
            pairs = (reached @ self._ends.T).tocoo()
            i, j = pairs.row.astype(np.int64), pairs.col.astype(np.int64)
            keys = np.setdiff1d((i * n + j)[i < j], known, assume_unique=True)
            known = np.concatenate([known, keys])
            reached = reached @ self._inner + reached
            reached.data[:] = 1
            i, j = np.divmod(keys, n)
            # Along the boundary it takes no more segments than edges, two where there is but one, and
            # what a vertex sees of its neighbours has been looked at without this.
            around = np.minimum((i - j) % n, (j - i) % n)
            open_ = (around > k) & (_over_hubs(from_hubs, i, j) > k) & (k > 2)
            for a, b in zip(i[open_].tolist(), j[open_].tolist(), strict=True):
                if self._polygon.work > budget:
                    self.unchecked = k
                    return
                if self._polygon.link_distance(a, b, k) > k:
                    yield self._obstruction(a, b, k)

    def _obstruction(self, a: int, b: int, k: int) -> Obstruction:
        ends = self._loop[[a, b]]
        message = (
            f"The boundary {named_vertices(ends)} are {k} edges apart, and inside the target it takes "
            f"more than {k} segments from one to the other."
        )
        path = self._paths(a, b, k)
        return Obstruction(Kind.LINK_DISTANCE, Forbids.INJECTIVE, message, vertices=ends, edges=path, split=path)

    def _paths(self, a: int, b: int, k: int) -> IntArray:
        """All edges on shortest paths between two boundary vertices, (e, 2) int64."""
        forth, back = self._rings(a, k), self._rings(b, k)
        start, end = self._loop[[a, b]]
        edges = [np.array([(start, v) for v in np.intersect1d(forth[0], back[k - 2])])]
        for step in range(1, k - 1):
            for v in np.intersect1d(forth[step - 1], back[k - 1 - step]).tolist():
                onward = np.intersect1d(_row(self._inner, v), back[k - 2 - step])
                edges.append(np.array([(v, w) for w in onward.tolist()]))
        edges.append(np.array([(v, end) for v in np.intersect1d(forth[k - 2], back[0])]))
        return np.concatenate(edges)

    def _rings(self, corner: int, k: int) -> list[IntArray]:
        """Free vertices that are exactly 1, 2, … k - 1 edges away from a boundary vertex."""
        rings = [_row(self._ends, corner)]
        inside = rings[0]
        for _ in range(k - 2):
            following = np.unique(np.concatenate([_row(self._inner, v) for v in rings[-1].tolist()]))
            rings.append(np.setdiff1d(following, inside))
            inside = np.union1d(inside, rings[-1])
        return rings


def _row(matrix: csr_array, k: int) -> IntArray:
    """Column indices of the entries in a row."""
    columns: IntArray = matrix.indices[matrix.indptr[k] : matrix.indptr[k + 1]].astype(np.int64)
    return columns


def _hub_distances(corners: FloatArray, triangles: IntArray) -> FloatArray:
    """How few segments are known to lead from some places inside a polygon to its corners.

    Rounding matters little here: a number that is too small hides an obstruction and invents none.

    Parameters
    ----------
    corners : (n, 2) float64
        Of the polygon, counterclockwise.
    triangles : (n - 2, 3) int64
        A triangulation.

    Returns
    -------
    (h, n) float64
        Whole numbers, infinite where no way is known.
    """
    n = len(corners)
    if n > _MOST_FOR_HUBS:
        return np.empty((0, n))
    a, b, c = corners[triangles].transpose(1, 0, 2)
    by_area = np.argsort(-_cross(b - a, c - a), kind="stable")
    hubs, seen = np.empty((0, 2)), np.empty((0, n), dtype=bool)
    for t in by_area.tolist():
        if len(hubs) == _HUBS:
            break
        overlooked: BoolArray = np.any(seen[:, triangles[t]], axis=0)
        if not overlooked.all():
            hub = corners[triangles[t]].mean(axis=0)
            hubs = np.concatenate([hubs, hub[None]])
            seen = np.concatenate([seen, _sees(hub, corners, corners)[None]])
    between = np.array([np.where(_sees(hub, hubs, corners), 1.0, np.inf) for hub in hubs])
    np.fill_diagonal(between, 0)
    for middle in range(len(hubs)):
        between = np.minimum(between, between[:, middle, None] + between[middle])
    return np.min(between[:, :, None] + np.where(seen, 1.0, np.inf), axis=1)


def _over_hubs(from_hubs: FloatArray, i: IntArray, j: IntArray) -> FloatArray:
    """Fewest segments known to lead between corners; (k,) float64."""
    shortest: FloatArray = np.min(from_hubs[:, i] + from_hubs[:, j], axis=0, initial=np.inf)
    return shortest


def _sees(place: FloatArray, points: FloatArray, corners: FloatArray) -> BoolArray:
    """Which points (m, 2) are seen from a place inside a polygon; (m,) bool."""
    p, q = corners, np.roll(corners, -1, axis=0)
    way = points - place
    p_side, q_side = (_cross(way[:, None], end - place) for end in (p, q))
    here = _cross(q - p, place - p)
    there = _cross(q - p, points[:, None] - p)
    crossed = (p_side * q_side < 0) & (here * there < 0)
    # A way through a corner is none, unless it ends there.
    along = np.einsum("mk,nk->mn", way, p - place)
    through = (p_side == 0) & (along > 0) & (along < np.einsum("mk,mk->m", way, way)[:, None])
    seen: BoolArray = ~(crossed | through).any(axis=1)
    return seen


def _cross(u: FloatArray, v: FloatArray) -> FloatArray:
    """Cross products along the last axis."""
    product: FloatArray = u[..., 0] * v[..., 1] - u[..., 1] * v[..., 0]
    return product
