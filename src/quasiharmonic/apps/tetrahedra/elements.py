"""Elements of tetrahedral meshes: the exact orientation of tetrahedra and hexahedra, faces, and defects of the mesh.

The predicate of orientation has four stages, like `quasiharmonic.geometry.exact.predicates`. Each stage processes the
tetrahedra that the previous one could not decide:

1. the determinant in floating point with an error bound [1]_, after scaling the mesh by a power of two;
2. the same after scaling each tetrahedron separately;
3. an exact sum of 24 doubles, if the differences of the corners are exact in doubles;
4. integers of any size.

References
----------
.. [1] J. R. Shewchuk, Adaptive precision floating-point arithmetic and fast robust geometric
   predicates. Discrete & Computational Geometry 18 (1997).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from quasiharmonic.geometry.exact.predicates import ROUNDS_ONCE, exact_sum, two_product, two_sum
from quasiharmonic.geometry.mesh.topology import label_components, pair_keys
from quasiharmonic.util.arrays import FloatArray, IntArray, repeat_each
from quasiharmonic.util.progress import heartbeat

SignArray = NDArray[np.int8]


class VolumeBounds(NamedTuple):
    """Bounds of rounding errors of a determinant."""

    # |computed − exact| ≤ (7u + O(u²)) permanent, u = 2⁻⁵³ [1]_; 8u covers the rounding of the permanent.
    relative: float = 2.0**-50
    # Coordinates are at most one after scaling, so underflow changes the determinant by less than this.
    underflow: float = 2.0**-1060
    # Stage 3 takes differences that are 0 or at least this, so that no product underflows.
    min_difference: float = 2.0**-200
    # Tetrahedra per block, so that the data stay in the cache.
    chunk: int = 1 << 14


_BOUNDS = VolumeBounds()

# Each corner with its three neighbours, right-handed, in the order of Gmsh and VTK.
_CORNERS = np.array(
    [(0, 1, 3, 4), (1, 2, 0, 5), (2, 3, 1, 6), (3, 0, 2, 7), (4, 7, 5, 0), (5, 4, 6, 1), (6, 5, 7, 2), (7, 6, 4, 3)]
)
#: Faces of a positive tetrahedron, counterclockwise seen from outside; face k is opposite vertex k.
FACES = np.array([(1, 2, 3), (0, 3, 2), (0, 1, 3), (0, 2, 1)])
#: Edges of a tetrahedron.
EDGES = np.array([(0, 1), (0, 2), (0, 3), (1, 2), (1, 3), (2, 3)])
_EDGES_OF_TRIANGLE = np.array([(0, 1), (1, 2), (2, 0)])


class ExactSigns:
    """Exact orientations of tetrahedra between points (n, 3).

    ``signs(corners)`` with corners (k, 4) int64 returns (k,) int8: 1 if the determinant of the edge vectors from the
    first corner is positive, -1 if it is negative, 0 if the four points lie exactly in a plane or one of them is NaN or
    infinite.
    """

    def __init__(self, X: FloatArray) -> None:
        self.finite = np.asarray(np.isfinite(X).all(axis=1))
        self._X = np.where(self.finite[:, None], X, 0.0)
        exponent = np.frexp(np.abs(self._X).max(initial=0.0))[1]
        with np.errstate(under="ignore"):
            self._scaled = np.ascontiguousarray(np.ldexp(self._X, -exponent).T)

    def __call__(self, corners: IntArray) -> SignArray:
        sign = np.empty(len(corners), dtype=np.int8)
        with np.errstate(under="ignore"):
            for start in range(0, len(corners), _BOUNDS.chunk):
                heartbeat()
                block = slice(start, start + _BOUNDS.chunk)
                sign[block] = _sign_if_certain(self._edges(corners[block].T))
            undecided = np.flatnonzero(sign == 0)
            if not self.finite.all():
                finite = np.asarray(self.finite[corners].all(axis=1))
                sign[~finite] = 0
                undecided = undecided[finite[undecided]]
            for start in range(0, undecided.size, _BOUNDS.chunk):
                heartbeat()
                chunk = undecided[start : start + _BOUNDS.chunk]
                sign[chunk] = _decide(self._X[corners[chunk]])
        return sign

    def _edges(self, corners: IntArray) -> list[FloatArray]:
        """The nine differences of corners (4, k) to the first corner, vector by vector."""
        axes = [(axis, axis.take(corners[0])) for axis in self._scaled]
        return [axis.take(corners[k]) - first for k in (1, 2, 3) for axis, first in axes]


def tetrahedron_signs(T: IntArray, X: FloatArray) -> tuple[SignArray, IntArray]:
    """Exact orientations (t,) int8 of tetrahedra, and the ascending indices of those with a non-finite coordinate."""
    signs = ExactSigns(X)
    return signs(T), np.flatnonzero(~signs.finite[T].all(axis=1))


def _sign_if_certain(edges: Sequence[FloatArray]) -> SignArray:
    """Sign of the determinant of rounded differences of magnitude at most two, where it is certain; 0 elsewhere.

    ``edges`` are the nine coordinates of three vectors, vector by vector.
    """
    ux, uy, uz, vx, vy, vz, wx, wy, wz = edges
    det, permanent = np.zeros_like(ux), np.zeros_like(ux)
    for a, (b, c), (d, e) in ((ux, (vy, wz), (vz, wy)), (uy, (vz, wx), (vx, wz)), (uz, (vx, wy), (vy, wx))):
        left, right = b * c, d * e
        det += a * (left - right)
        np.abs(left, out=left)
        left += np.abs(right, out=right)
        left *= np.abs(a)
        permanent += left
    permanent *= _BOUNDS.relative
    permanent += _BOUNDS.underflow
    sign = np.asarray(det > permanent).view(np.int8)
    sign -= np.asarray(det < -permanent).view(np.int8)
    return sign


def _decide(p: FloatArray) -> SignArray:
    """Orientation of tetrahedra (k, 4, 3), finite."""
    exponent = np.frexp(np.abs(p).max(axis=(1, 2)))[1]
    scaled = np.ldexp(p, -exponent[:, None, None])
    exact = (np.ldexp(scaled, exponent[:, None, None]) == p).all(axis=(1, 2))  # scaling has not rounded
    difference, tail = two_sum(scaled[:, 1:], -scaled[:, :1])
    sign = _sign_if_certain(list(difference.reshape(-1, 9).T))
    # A component that is the same at all four corners makes the determinant zero, as do two equal corners.
    same = (p[:, 1:] == p[:, :1]).all(axis=1).any(axis=1)
    for i in range(4):
        for j in range(i):
            same |= (p[:, i] == p[:, j]).all(axis=1)
    open_ = (sign == 0) & ~same
    small = (np.abs(difference) < _BOUNDS.min_difference) & (difference != 0)
    summable = ROUNDS_ONCE & exact & ~(tail != 0).any(axis=(1, 2)) & ~small.any(axis=(1, 2))
    some = np.flatnonzero(open_ & summable)
    if some.size:
        sign[some] = np.sign(_determinant(difference[some].reshape(-1, 9).T))
    for k in np.flatnonzero(open_ & ~summable):
        sign[k] = _decide_in_integers(p[k])
    return sign


def _determinant(x: FloatArray) -> FloatArray:
    """The determinant of exact differences (9, k), with a relative error of at most 2⁻⁴⁸."""
    terms = []
    for i, j, k, factor in ((0, 4, 8, 1), (1, 5, 6, 1), (2, 3, 7, 1), (0, 5, 7, -1), (1, 3, 8, -1), (2, 4, 6, -1)):
        product, error = two_product(factor * x[j], x[k])
        terms += [*two_product(x[i], error), *two_product(x[i], product)]
    return exact_sum(np.stack([*terms[1::4], *terms[0::4], *terms[3::4], *terms[2::4]]))


def _decide_in_integers(p: FloatArray) -> int:
    """Orientation of one tetrahedron (4, 3) in integer arithmetic."""
    mantissa, exponent = np.frexp(p.ravel())
    whole = (np.ldexp(mantissa, 53)).astype(np.int64).tolist()
    shift = np.where(mantissa != 0, exponent, exponent.max())
    first = int(shift.min())
    c = [m << (int(e) - first) for m, e in zip(whole, shift, strict=True)]
    ux, uy, uz, vx, vy, vz, wx, wy, wz = (c[i] - c[i % 3] for i in range(3, 12))
    det: int = ux * (vy * wz - vz * wy) + uy * (vz * wx - vx * wz) + uz * (vx * wy - vy * wx)
    return (det > 0) - (det < 0)


def find_bad_corners(H: IntArray, X: FloatArray) -> IntArray:
    """Return the hexahedra (h, 8) with a corner whose tetrahedron is not positive, exactly; ascending.

    Positive corners are necessary for a valid trilinear map, but not sufficient.
    """
    sign, _ = tetrahedron_signs(H[:, _CORNERS].reshape(-1, 4), X)
    return np.flatnonzero((sign.reshape(-1, 8) <= 0).any(axis=1))


@dataclass(frozen=True, eq=False)
class FaceReport:
    """The faces of a tetrahedral mesh.

    Attributes
    ----------
    boundary : (b, 3) int64
        Triangles in one tetrahedron only, counterclockwise seen from outside if the tetrahedron is positive.
    nonmanifold : (k, 3) int64
        Faces of three or more tetrahedra.
    inconsistent : (k, 3) int64
        Faces of two tetrahedra that traverse them in the same direction.
    repeated : (k,) int64
        Tetrahedra with the same four vertices as an earlier one, and those with a vertex twice.
    """

    boundary: IntArray
    nonmanifold: IntArray
    inconsistent: IntArray
    repeated: IntArray


def inspect_faces(T: IntArray, n: int) -> FaceReport:
    """Find the boundary and the defects of tetrahedra (t, 4) among ``n`` vertices."""
    faces = T[:, FACES].reshape(-1, 3)
    ordered, odd = _sort_triples(faces)
    order, first = _group(ordered, n)
    size = np.diff(np.append(first, len(order)))
    alone = np.sort(order[first[size == 1]])
    pair = first[size == 2]
    one, other = order[pair], order[pair + 1]
    opposite = T.ravel()  # face k of a tetrahedron is opposite its vertex k
    twins = opposite[one] == opposite[other]
    twice = np.flatnonzero((np.sort(T, axis=1)[:, 1:] == np.sort(T, axis=1)[:, :-1]).any(axis=1))
    crowded = np.unique(order[repeat_each(size > 2, size)] // 4)
    repeated = [np.maximum(one, other)[twins] // 4, twice]
    if crowded.size:
        keys = np.sort(T[crowded], axis=1)
        _, index, number = np.unique(keys, axis=0, return_index=True, return_inverse=True)
        repeated.append(crowded[index[number.ravel()] != np.arange(len(crowded))])
    return FaceReport(
        boundary=faces[alone],
        nonmanifold=ordered[order[first[size > 2]]],
        inconsistent=ordered[one[odd[one] == odd[other]]],
        repeated=np.unique(np.concatenate(repeated)),
    )


def _sort_triples(faces: IntArray) -> tuple[IntArray, IntArray]:
    """Sort the vertices of every face; also return whether the permutation is odd."""
    a, b, c = faces.T
    odd = (a > b).astype(np.int64) + (a > c) + (b > c)
    low, high = np.minimum(np.minimum(a, b), c), np.maximum(np.maximum(a, b), c)
    return np.stack([low, a + b + c - low - high, high], axis=1), odd & 1


def _group(rows: IntArray, n: int) -> tuple[IntArray, IntArray]:
    """Return an order in which equal rows of vertices are adjacent, and the start of each group of equal rows."""
    # Vertex counts up to this have three vertices in one integer.
    max_packed = 1 << 21
    if not len(rows):
        return np.empty(0, dtype=np.int64), np.empty(0, dtype=np.int64)
    if n <= max_packed:
        key = rows[:, 0]
        for column in rows.T[1:]:
            key = key * n + column
        order = np.argsort(key, kind="stable")
        key = key[order]
        differs = key[1:] != key[:-1]
    else:
        order = np.lexsort(rows.T[::-1])
        rows = rows[order]
        differs = (rows[1:] != rows[:-1]).any(axis=1)
    return order, np.flatnonzero(np.concatenate([[True], differs]))


def find_patches(boundary: IntArray) -> IntArray:
    """Number the parts (b,) of a boundary (b, 3) that are connected across edges of exactly two of its triangles."""
    edges = np.sort(boundary[:, _EDGES_OF_TRIANGLE].reshape(-1, 2), axis=1)
    order, first = _group(edges, int(boundary.max(initial=0)) + 1)
    pair = first[np.diff(np.append(first, len(order))) == 2]
    one, other = order[pair] // 3, order[pair + 1] // 3
    return np.unique(label_components(one, other, len(boundary)), return_inverse=True)[1]


def find_mesh_edges(T: IntArray) -> IntArray:
    """Return the edges (e, 2) of tetrahedra, each once, lower vertex first."""
    pairs = np.sort(T[:, EDGES].reshape(-1, 2), axis=1)
    n = int(T.max(initial=0)) + 1
    return np.stack(np.divmod(np.unique(pair_keys(pairs, n)), n), axis=1)
