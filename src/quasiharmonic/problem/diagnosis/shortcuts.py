"""Find paths in the mesh with fewer edges than the target permits.

A map takes a path between two boundary vertices to a path of as many segments inside the target. So the number of edges
between two vertices cannot be smaller than their link distance.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from scipy.sparse import csr_array

from quasiharmonic.problem import Problem
from quasiharmonic.problem.diagnosis.clearance import clear
from quasiharmonic.problem.diagnosis.curves import Corners
from quasiharmonic.problem.diagnosis.fixture import Fixture
from quasiharmonic.problem.diagnosis.links import Polygon
from quasiharmonic.problem.diagnosis.obstruction import Forbids, Kind, Obstruction, vertex_names
from quasiharmonic.util.arrays import BoolArray, FloatArray, IntArray, invert_indices

# Largest number of edges between the vertices of a pair to check.
LONGEST = 8
# Limit on the steps in the triangulated target, of some microseconds each: a constant,
_WORK = 50_000
# and a number per boundary vertex.
_WORK_PER_VERTEX = 10
# Limit on the pairs to collect.
_MAX_PAIRS = 10_000_000
# Offsets of trial points from the midpoint of two corners, as multiples of half their distance.
_BESIDE = 0.05, 0.3, 1.0, -0.05, -0.3
# Limit on the pairs of a segment and a nearby edge to check, for each call of `clear`.
_MAX_NEAR_PAIRS = 1_000_000


class Shortcuts:
    """Finds boundary vertices that are closer in the mesh than inside the target.

    The problem has a single boundary loop, simple and counterclockwise in the target. After `find`, not all pairs that
    are ``unchecked`` or more edges apart were checked.
    """

    def __init__(self, problem: Problem, fixture: Fixture, corners: Corners) -> None:
        self._loop = problem.domain.loops[0]
        free, place = fixture.joined[:, 0], invert_indices(problem.n, self._loop)[fixture.joined[:, 1]]
        free, place = free[place >= 0], place[place >= 0]
        both = np.concatenate([fixture.inner, fixture.inner[:, ::-1]])
        self._inner = csr_array((np.ones(len(both)), both.T), shape=(problem.n, problem.n))
        self._ends = csr_array((np.ones(len(free)), (place, free)), shape=(len(self._loop), problem.n))
        self._fixture = fixture
        self._corners = corners
        self._sides = np.stack([self._loop, np.roll(self._loop, -1)], axis=1)
        self._polygon = Polygon(fixture.points(self._loop))
        self.unchecked = LONGEST + 1

    def find(self) -> Iterator[Obstruction]:
        """Yield obstructions of vertex pairs with fewer edges than segments between them, nearest pairs first."""
        n = len(self._loop)
        budget = _WORK + _WORK_PER_VERTEX * n
        reached, known = self._ends, np.empty(0, dtype=np.int64)
        at_ends = np.bincount(self._ends.indices, minlength=self._ends.shape[1])
        for k in range(2, LONGEST + 1):
            if at_ends @ np.bincount(reached.indices, minlength=reached.shape[1]) > _MAX_PAIRS:
                self.unchecked = k
                return
            pairs = (reached @ self._ends.T).tocoo()
            i, j = pairs.row.astype(np.int64), pairs.col.astype(np.int64)
            keys = np.setdiff1d((i * n + j)[i < j], known, assume_unique=True)
            known = np.concatenate([known, keys])
            reached = reached @ self._inner + reached
            reached.data[:] = 1
            i, j = np.divmod(keys, n)
            # A path along the boundary needs no more segments than edges, or two for a single edge. `Sight` checks
            # neighbours of a common vertex.
            far = (np.minimum((i - j) % n, (j - i) % n) > k) & (k > 2)
            i, j = i[far], j[far]
            if not i.size:
                continue
            hidden = ~self.are_close(i, j, k)
            for a, b in zip(i[hidden].tolist(), j[hidden].tolist(), strict=True):
                if self._polygon.work > budget:
                    self.unchecked = k
                    return
                if self._polygon.link_distance(a, b, k) > k:
                    yield self._obstruction(a, b, k)

    def are_close(self, i: IntArray, j: IntArray, k: int) -> BoolArray:
        """Return whether corners are provably at most k > 2 segments apart.

        True if one corner sees the other, if one sees a third corner less than k sides from the other, or if both see
        one of a few points between them.
        """
        n, tails, heads = len(self._loop), self._loop[i], self._loop[j]
        where = self._fixture.positions
        p, q = where[tails], where[heads]
        result = self._clear(tails, heads, p, q)
        seen = np.sort(np.concatenate([(i * n + j)[result], (j * n + i)[result]]))
        for here, there in ((i, j), (j, i)) if seen.size else ():
            at = np.searchsorted(seen, here * n + there)
            for nearest in (seen[np.minimum(at, seen.size - 1)], seen[np.maximum(at - 1, 0)]):
                result |= (nearest // n == here) & (np.abs(nearest % n - there) < k)
        # At a bend, try points beside the midpoint, first towards the inside of the bend.
        inward = np.where((j - i) % n < (i - j) % n, 1.0, -1.0)
        dx, dy = (q / 2 - p / 2).T
        left = np.stack([-dy * inward, dx * inward], axis=1)
        for height in _BESIDE:
            left_over = np.flatnonzero(~result)
            if not left_over.size:
                break
            with np.errstate(over="ignore"):
                index = p[left_over] / 2 + q[left_over] / 2 + height * left[left_over]
            once = self._clear(tails[left_over], None, p[left_over], index)
            left_over, index = left_over[once], index[once]
            result[left_over] = self._clear(heads[left_over], None, q[left_over], index)
        return result

    def _clear(self, tails: IntArray, heads: IntArray | None, p: FloatArray, q: FloatArray) -> BoolArray:
        """Return whether segments from corners to other corners, or to points inside, provably lie inside."""
        where = self._fixture.positions
        inside: BoolArray = np.all(np.isfinite(q), axis=1)
        inside[inside] = self._corners.opens_to(tails[inside], q[inside], where)
        if heads is not None:
            inside[inside] = self._corners.opens_to(heads[inside], p[inside], where)
        ends = np.stack([tails, np.full(len(tails), -1) if heads is None else heads], axis=1)
        inside[inside] = clear(p[inside], q[inside], ends[inside], self._sides, where, _MAX_NEAR_PAIRS)
        return inside

    def _obstruction(self, a: int, b: int, k: int) -> Obstruction:
        ends = self._loop[[a, b]]
        message = (
            f"A path of {k} edges inside the mesh joins the boundary {vertex_names(ends)}, and inside the target "
            f"every path from one to the other needs more than {k} segments."
        )
        path = self._shortest_path_edges(a, b, k)
        return Obstruction(Kind.LINK_DISTANCE, Forbids.INJECTIVE, message, vertices=ends, edges=path, split=path)

    def _shortest_path_edges(self, a: int, b: int, k: int) -> IntArray:
        """Return all edges on shortest paths between two boundary vertices, (e, 2) int64."""
        forth, back = self._find_rings(a, k), self._find_rings(b, k)
        start, end = self._loop[[a, b]]
        edges = [np.array([(start, v) for v in np.intersect1d(forth[0], back[k - 2])])]
        for step in range(1, k - 1):
            for v in np.intersect1d(forth[step - 1], back[k - 1 - step]).tolist():
                onward = np.intersect1d(_row_columns(self._inner, v), back[k - 2 - step])
                edges.append(np.array([(v, w) for w in onward.tolist()]))
        edges.append(np.array([(v, end) for v in np.intersect1d(forth[k - 2], back[0])]))
        return np.concatenate(edges)

    def _find_rings(self, corner: int, k: int) -> list[IntArray]:
        """Return free vertices that are exactly 1, 2, … k - 1 edges away from a boundary vertex."""
        rings = [_row_columns(self._ends, corner)]
        inside = rings[0]
        for _ in range(k - 2):
            following = np.unique(np.concatenate([_row_columns(self._inner, v) for v in rings[-1].tolist()]))
            rings.append(np.setdiff1d(following, inside))
            inside = np.union1d(inside, rings[-1])
        return rings


def _row_columns(matrix: csr_array, k: int) -> IntArray:
    """Return column indices of the entries in a row."""
    columns: IntArray = matrix.indices[matrix.indptr[k] : matrix.indptr[k + 1]].astype(np.int64)
    return columns
