"""A barrier between boundary vertices and near boundary edges, which keeps a free boundary from intersecting itself.

A boundary vertex ``v`` and a boundary edge ``a → b`` that face each other across the outside of the surface are in
*contact* if their distance ``d`` is below a reach ``d̂``. They then repel each other by ``(d̂/d − 1)²``, which starts
smoothly and is unbounded [1]_. The reach is proportional to the local edge length of the boundary, so parts that have
shrunk to a millionth have gaps of a millionth. Second derivatives neglect rotation of the contact direction
(Gauss–Newton): let ``n`` be the unit vector from the edge's nearest point ``(1 − s) a + s b`` to ``v``. The gap changes
by ``Re n̄ (dv − (1 − s) da − s db)``, and the second derivative is a factor times the square of this.

For Newton's system a contact is one more triangle ``v, a, b``. Any displacement of its corners is affine, so the gap
changes by ``Re(α dp + β dq)`` in the derivatives on a fixed right triangle at rest. Its square is a quadratic form.

The barrier only guides Newton's method. An exact test on every map decides whether the boundary is simple.

References
----------
.. [1] J. Smith, S. Schaefer, Bijective parameterization with free boundaries. ACM Transactions on Graphics 34 (2015).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from quasiharmonic.energies.energies import QuadraticForm
from quasiharmonic.geometry.exact.box_pairs import box_pairs_between
from quasiharmonic.geometry.exact.certificate import is_injective
from quasiharmonic.geometry.exact.loops import check_loops, contacts
from quasiharmonic.util.arrays import BoolArray, ComplexArray, FloatArray, IntArray, sum_at, to_complex, to_points


class ContactTuning(NamedTuple):
    """Numbers that tune the barrier, and the pulling apart of small overlaps."""

    # Reach of the barrier, relative to the local edge length of the boundary.
    reach: float = 1.0
    # Pairs up to this many times the reach are also tracked during a step, which may bring them closer.
    lookout: float = 2.0
    # Maximum number of pairs of edges that are tracked.
    max_tracked: int = 1000
    # Small overlaps have less than this number of pairs of edges.
    max_pulled: int = 10_000


_TUNING = ContactTuning()
# Vertices of small overlaps move by these fractions of the smallest height of their triangles, tried in turn.
_SHARES = 0.0, *(1e-6 * 2.0**k for k in range(20))
#: Half the gradients of the hat functions of a triangle v, a, b with a right angle at a and legs of length 1.
HATS = np.array([0.5, -0.5 - 0.5j, 0.5j])


@dataclass(frozen=True, eq=False)
class RimContacts:
    """Pairs of a boundary vertex and a boundary edge that may touch."""

    corners: IntArray  # (3, c): vertex, and start and end of the edge
    reach: FloatArray  # (c,): distance below which they repel each other, in the map's units; 0 for pairs that do not

    @classmethod
    def none(cls) -> RimContacts:
        """Return an empty set of contacts."""
        return cls(np.zeros((3, 0), dtype=np.int64), np.zeros(0))

    def smallest_gap(self, w: ComplexArray) -> float:
        """The smallest ratio of distance to reach; ``inf`` without contacts."""
        d, _, _ = nearest_on_edges(*w[self.corners])
        return float(np.min(d[self.reach > 0] / self.reach[self.reach > 0], initial=np.inf))

    def value(self, w: ComplexArray) -> float:
        """The sum of the barriers for a map (n,) complex128."""
        d, _, _ = nearest_on_edges(*w[self.corners])
        return float(np.sum(self._excess(d) ** 2))

    def gradient(self, w: ComplexArray) -> ComplexArray:
        """The derivative of `value` with respect to positions, ``∂/∂u + i ∂/∂v``; (n,) complex128."""
        d, normal, s = nearest_on_edges(*w[self.corners])
        pull = -2 * self._excess(d) * self.reach / d**2 * normal
        parts = np.concatenate([pull, -(1 - s) * pull, -s * pull])
        at = self.corners.ravel()
        return sum_at(at, parts, w.size)

    def curvature(self, w: ComplexArray) -> QuadraticForm:
        """The second derivative along the current contact directions, in the derivatives that `HATS` defines."""
        d, normal, s = nearest_on_edges(*w[self.corners])
        half: FloatArray = 0.5 * self._stiffness(d)
        # dv − da = dp + dq and db − da = i (dp − dq).
        alpha: ComplexArray = normal.conj() * (1 - 1j * s)
        beta: ComplexArray = normal.conj() * (1 + 1j * s)
        return QuadraticForm(
            pp=half * (1 + s**2),
            qq=half * (1 + s**2),
            p2=half * alpha**2,
            q2=half * beta**2,
            pq=2 * half * alpha * beta,
            pqc=2 * half * alpha * beta.conj(),
        )

    def blocks(self, w: ComplexArray) -> tuple[FloatArray, FloatArray, FloatArray]:
        """A bound of the second derivative that does not couple vertices: blocks xx, xy, yy, (n,) float64 each.

        The square of a sum of three terms is at most three times the sum of their squares.
        """
        d, normal, s = nearest_on_edges(*w[self.corners])
        bound = 3 * self._stiffness(d) * np.stack([np.ones(s.shape), (1 - s) ** 2, s**2])
        at = self.corners.ravel()

        def sum_parts(part: FloatArray) -> FloatArray:
            # For empty input bincount returns integers.
            return np.bincount(at, (bound * part).ravel(), minlength=w.size).astype(np.float64, copy=False)

        return sum_parts(normal.real**2), sum_parts(normal.real * normal.imag), sum_parts(normal.imag**2)

    def split(self, known: IntArray, n: int) -> tuple[RimContacts, RimContacts]:
        """Split into contacts in a known set (3, k), with reach 0 for its other pairs, and the remaining contacts."""
        keys, own = (pairs[0] * n + pairs[1] for pairs in (known, self.corners))
        order = np.argsort(keys)
        keys = np.append(keys[order], np.iinfo(np.int64).max)
        place = np.searchsorted(keys, own)
        found = keys[place] == own
        reach = np.zeros(known.shape[1])
        reach[order[place[found]]] = self.reach[found]
        return RimContacts(known, reach), RimContacts(self.corners[:, ~found], self.reach[~found])

    def within(self, w: ComplexArray, max_ratio: float) -> RimContacts:
        """Return the contacts whose distance is below ``max_ratio`` times their reach."""
        d, _, _ = nearest_on_edges(*w[self.corners])
        near = d < max_ratio * self.reach
        return RimContacts(self.corners[:, near], self.reach[near])

    def _stiffness(self, d: FloatArray) -> FloatArray:
        """The barriers' second derivatives with respect to the distances."""
        ratio = self.reach / d
        return np.where(ratio > 1, 2 * ratio * (3 * ratio - 2) / d**2, 0.0)

    def _excess(self, d: FloatArray) -> FloatArray:
        return np.maximum(self.reach / d - 1, 0)


class Rim:
    """The boundary of a surface: loops (l,) with the surface on their left."""

    def __init__(self, loops: Sequence[IntArray]) -> None:
        self._loops = list(loops)
        self._vertex = np.concatenate(loops)
        ends = np.cumsum([len(loop) for loop in loops])
        starts = ends - [len(loop) for loop in loops]
        number = np.arange(self._vertex.size)
        self._next, self._previous = number + 1, number - 1
        self._next[ends - 1], self._previous[starts] = starts, ends - 1
        self._edges = np.stack([self._vertex, self._vertex[self._next]], axis=1)

    def meets_itself(self, uv: FloatArray) -> bool:
        """Whether the boundary touches or crosses itself under a map (n, 2), or is wound the wrong way; decided
        exactly.

        If it does not and all triangles are positive, the map is bijective (`exact.certificate`). Testing edges for
        intersections is not sufficient: if triangles wind around a boundary vertex by more than a full turn, a loop
        can be simple but wound the wrong way.
        """
        return bool(check_loops(self._loops, uv)[1])

    def meetings(self, uv: FloatArray) -> IntArray:
        """Return the end vertices (k,) of the first 1,000 pairs of intersecting boundary edges."""
        tail, head = uv[self._edges[:, 0]], uv[self._edges[:, 1]]
        short = self._edges[(tail == head).all(axis=1)]
        pairs = contacts(uv, self._edges, _TUNING.max_tracked).pairs
        return np.unique(np.concatenate([short.ravel(), self._edges[pairs].ravel()]))

    def tangled_fraction(self, uv: FloatArray) -> float:
        """The fraction of the boundary's vertices at intersecting edges, from the first 1,000 pairs."""
        return self.meetings(uv).size / self._vertex.size

    def pull_apart(self, F: IntArray, uv: FloatArray) -> FloatArray | None:
        """Move boundary vertices at small overlaps into the surface until the boundary does not meet itself.

        Where two fans of triangles meet in a vertex, or along a slit, an isometric map touches itself. ``F`` (f, 3) are
        the triangles of an injective map (n, 2). Return a bijective map, or None if short moves do not suffice.
        """
        w = to_complex(uv)
        here = w[self._vertex]
        ahead, behind = w[self._vertex[self._next]] - here, w[self._vertex[self._previous]] - here
        # The direction halfway between both boundary edges, through the surface.
        halfway = 0.5 * (np.angle(-behind / ahead) + np.pi)
        inward = np.zeros(w.size, dtype=np.complex128)
        inward[self._vertex] = ahead / np.abs(ahead) * np.exp(1j * halfway)
        inward *= smallest_heights(w, F)
        tried, moved = np.zeros(w.size, dtype=np.int64), uv
        while (pairs := contacts(moved, self._edges, _TUNING.max_pulled).pairs).size:
            met = np.unique(self._edges[pairs])
            tried[met] += 1
            if len(pairs) == _TUNING.max_pulled or tried.max() == len(_SHARES):
                return None
            moved = to_points(w + np.take(_SHARES, tried) * inward)
        return moved if is_injective(F, moved) and not self.meets_itself(moved) else None

    def contacts(self, w: ComplexArray) -> RimContacts:
        """Return pairs that are close to each other across the outside of the surface; the map's boundary is simple."""
        p = w[self._vertex]
        q = p[self._next]
        length = np.abs(q - p)
        around = 0.5 * (length + length[self._previous])
        # Most candidates are the vertex's own and neighbouring edges, so they are removed first.
        radius = (_TUNING.lookout * _TUNING.reach * around)[:, None]
        here, there = to_points(p), to_points(q)
        boxes = here - radius, here + radius, np.minimum(here, there), np.maximum(here, there)
        found = [self._exclude_own_edges(*pairs) for pairs in box_pairs_between(*boxes)]
        i, j = np.concatenate(found, axis=1) if found else np.zeros((2, 0), dtype=np.int64)
        reach = _TUNING.reach * np.minimum(around[i], length[j])
        d, normal, s = nearest_on_edges(p[i], p[j], q[j])
        near = np.flatnonzero(d < _TUNING.lookout * reach)
        i, j, reach, normal, s = i[near], j[near], reach[near], normal[near], s[near]
        # The path from the vertex to the edge must lie outside the surface at both ends,
        head = self._next[j]
        faced = ((q - p)[j].conj() * normal).imag < 0
        for place, at in ((0, j), (1, head)):
            those = np.flatnonzero(s == place)
            faced[those] = ~self._within(p, at[those], normal[those])
        # and must not be an edge of the boundary.
        end = np.where(s == 0, j, np.where(s == 1, head, -1))
        kept = np.flatnonzero(faced & (self._next[i] != end) & (self._previous[i] != end))
        kept = kept[~self._within(p, i[kept], -normal[kept])]
        corners = self._vertex[np.stack([i[kept], j[kept], head[kept]])]
        return RimContacts(corners, reach[kept])

    def _exclude_own_edges(self, i: IntArray, j: IntArray) -> IntArray:
        """Remove pairs of a vertex and one of its own edges; (2, k)."""
        apart = np.flatnonzero((i != j) & (i != self._next[j]))
        return np.stack([i[apart], j[apart]])

    def _within(self, p: ComplexArray, i: IntArray, direction: ComplexArray) -> BoolArray:
        """Whether directions from boundary vertices point into the surface."""
        ahead, behind = p[self._next[i]] - p[i], p[self._previous[i]] - p[i]
        left, right = (ahead.conj() * direction).imag > 0, (direction.conj() * behind).imag > 0
        convex = (ahead.conj() * behind).imag > 0
        return np.where(convex, left & right, left | right)


def smallest_heights(w: ComplexArray, F: IntArray) -> FloatArray:
    """The smallest height of a map's triangles at each vertex; (n,) float64."""
    least = np.full(w.size, np.inf)
    for corner, after, before in F[:, [[0, 1, 2], [1, 2, 0], [2, 0, 1]]].transpose(1, 2, 0):
        side = w[before] - w[after]
        np.minimum.at(least, corner, ((w[after] - w[corner]).conj() * side).imag / np.abs(side))
    return least


def nearest_on_edges(v: ComplexArray, a: ComplexArray, b: ComplexArray) -> tuple[FloatArray, ComplexArray, FloatArray]:
    """Return distances of points from segments, unit vectors from the nearest points, and these points' parameters s.

    The arrays are complex, and broadcast as in NumPy.
    """
    along = b - a
    square = along.real**2 + along.imag**2
    s = np.clip(((v - a) * along.conj()).real / np.where(square > 0, square, 1), 0, 1)
    apart = v - (a + s * along)
    d = np.abs(apart)
    return d, apart / np.where(d > 0, d, 1), s
