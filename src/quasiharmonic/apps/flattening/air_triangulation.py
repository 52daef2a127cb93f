"""Triangulate the plane around a flat surface with well-shaped triangles: outside up to a frame, and inside holes.

As long as no triangle of surface and air is inverted and the frame is fixed, the surface does not overlap itself. The
air has its own points, which make it flexible; triangles that span a whole gap would lock.

    boundary ──lengths──▶ quadtree ──centres away from edges──▶ inner points ──constrained Delaunay──▶ triangles
             ──▶ those inside the surface removed ──▶ smoothed ──▶ air

No points are added on the boundary. Where a gap is narrower than the edges around it, triangles span it, as this can
only be avoided by splitting edges.

The spacing of the points follows the lengths of the edges and grows away from them. Squares are split until those at an
edge are about as large as the edge's length. Neighbouring squares differ in size by at most a factor of two. So each
edge has a few points near it for any range of lengths. In rows of squares of one size, points are shifted alternately,
so that they form nearly equilateral triangles.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from quasiharmonic.apps.flattening.contacts import nearest_on_edges
from quasiharmonic.energies.deformation import signed_areas
from quasiharmonic.energies.newton.map_model import in_units
from quasiharmonic.geometry.exact.certificate import inverted_triangles
from quasiharmonic.geometry.exact.constrained_delaunay import BlockedError, constrained_delaunay, select_inside
from quasiharmonic.util.arrays import FloatArray, IntArray, find_exponent, names_of, to_complex


class AirTuning(NamedTuple):
    """Numbers that tune the triangulation around a boundary."""

    # Maximum number of times that squares are halved.
    deepest: int = 40
    # Side of a square of the tree, relative to the length of an edge in it.
    spacing: float = 1.4
    # Minimum distance of inner points to the boundary, relative to their square's side.
    clearance: float = 0.55
    # The frame's sides are bent outwards by this fraction of their length, so that corners of the hull are strictly
    # convex.
    bulge: float = 0.05
    # Number of the tree's largest squares along the longer side of the frame.
    largest_squares: int = 8
    smoothings: int = 3
    # Smoothing may reduce shape qualities above this; 1 is an equilateral triangle.
    good: float = 0.5


_TUNING = AirTuning()
# A square is encoded as one integer with this number of bits per coordinate.
_BITS = 31
_BESIDE = (0, 0), (1, 0), (-1, 0), (0, 1), (0, -1)
_MEETS_ITSELF = "the boundary meets itself, so the air around it cannot be meshed: certify(F, uv) lists where"


@dataclass(frozen=True)
class Quadtree:
    """A rectangle of squares, split into quarters where requested; neighbours differ by at most one level."""

    corner: FloatArray  # (2,): lower left corner
    side: float  # Side of the largest squares
    shape: tuple[int, int]  # Numbers of largest squares along x and y
    split: list[IntArray]  # each (k,): split squares of each level, as ascending integers ``y · 2³¹ + x``

    @classmethod
    def around(
        cls, positions: FloatArray, sizes: FloatArray, corner: FloatArray, side: float, shape: tuple[int, int]
    ) -> Quadtree:
        """Split until squares at given positions (k, 2) have at most given sizes (k,)."""
        # The depth is limited by the integers; smaller sizes get squares that are too large.
        deepest = min(_TUNING.deepest, _BITS - 1 - int(np.ceil(np.log2(max(shape)))))
        with np.errstate(divide="ignore"):
            level = np.clip(np.ceil(np.log2(side / sizes)), 0, deepest).astype(np.int64)
        split: list[IntArray] = []
        below = np.empty(0, dtype=np.int64)
        for depth in range(int(level.max(initial=0)) - 1, -1, -1):
            here = positions[level == depth + 1]
            asked = np.floor((here - corner) / (side * 0.5**depth)).astype(np.int64)
            # Neighbours of a split square must exist, so their parent squares are split.
            x, y = below & (1 << _BITS) - 1, below >> _BITS
            beside = [(np.clip(x + dx, 0, None) >> 1, np.clip(y + dy, 0, None) >> 1) for dx, dy in _BESIDE]
            x, y = (np.concatenate([asked[:, k], *(pair[k] for pair in beside)]) for k in range(2))
            inside = (x >= 0) & (y >= 0) & (x < shape[0] << depth) & (y < shape[1] << depth)
            below = np.unique((y[inside] << _BITS) + x[inside])
            split.append(below)
        return cls(corner, side, shape, split[::-1])

    def leaves(self) -> tuple[IntArray, IntArray, IntArray]:
        """Return level and integer position along x and y of every square that is not split; each (k,) int64."""
        x, y = (axis.ravel() for axis in np.indices(self.shape[::-1], dtype=np.int64)[::-1])
        there = (y << _BITS) + x
        levels, kept = [], []
        for depth, split in enumerate([*self.split, np.empty(0, dtype=np.int64)]):
            kept.append(np.setdiff1d(there, split, assume_unique=True))
            levels.append(np.full(kept[-1].size, depth))
            x, y = (split & (1 << _BITS) - 1) * 2, (split >> _BITS) * 2
            there = np.concatenate([(y + dy << _BITS) + x + dx for dx in (0, 1) for dy in (0, 1)])
        keys = np.concatenate(kept)
        return np.concatenate(levels), keys & (1 << _BITS) - 1, keys >> _BITS

    def points(self) -> tuple[FloatArray, FloatArray]:
        """Return a point in every leaf, (k, 2), and the leaves' sides (k,)."""
        level, x, y = self.leaves()
        size = np.asarray(self.side * 0.5**level, dtype=np.float64)
        shifted = x + np.where(y % 2, 0.75, 0.25)
        points: FloatArray = self.corner + size[:, None] * np.stack([shifted, y + 0.5], axis=1)
        return points, size

    def sizes_at(self, positions: FloatArray) -> FloatArray:
        """Return the sides of the leaves at given positions (k, 2) in the rectangle; (k,) float64."""
        size = np.full(len(positions), self.side)
        for depth, split in enumerate(self.split):
            x, y = np.floor((positions - self.corner) / (self.side * 0.5**depth)).astype(np.int64).T
            key = (y << _BITS) + x
            found = split[np.minimum(np.searchsorted(split, key), split.size - 1)] == key
            size[found] = self.side * 0.5 ** (depth + 1)
        return size


#: Lower left corner, side and numbers of the largest squares.
_Squares = tuple[FloatArray, float, tuple[int, int]]


@dataclass(frozen=True, eq=False)
class Air:
    """A triangulation of the surroundings of a flat surface with n vertices."""

    points: FloatArray  # (k, 2): new points, the vertices n … n + k - 1
    F: IntArray  # (a, 3): triangles between the surface's boundary vertices and the new points, counterclockwise
    frame: IntArray  # (h,): the new vertices on the frame, counterclockwise


def triangulate_air(
    uv: ArrayLike, loops: Sequence[IntArray], *, margin: float = 0.5, around: ArrayLike | None = None
) -> Air:
    """Triangulate the plane around a flat surface up to a frame, and its holes.

    The surface's triangles and ``air.F`` together are a triangle mesh whose only boundary is the frame. ``uv`` (n, 2)
    must be bijective, otherwise ValueError; its interior vertices are not read. The ``loops`` have the surface on their
    left. The frame encloses the positions ``around`` (p, 2) too. Its distance is ``margin`` times the longer side of
    the boundary's bounding box. The result is deterministic.
    """
    if not 0 < margin < np.inf:
        raise ValueError(f"margin must be positive, not {margin}")
    positions = np.asarray(uv, dtype=np.float64)
    n, boundary = len(positions), np.concatenate(loops)
    # Scaling by a power of two is exact.
    exponent = find_exponent(positions[boundary])
    others = np.empty((0, 2)) if around is None else np.ldexp(np.asarray(around, dtype=np.float64), -exponent)
    outline = np.ldexp(positions[boundary], -exponent)
    start = np.cumsum([0, *(len(loop) for loop in loops)])
    heads = np.concatenate([np.roll(np.arange(*ends, dtype=np.int64), -1) for ends in pairwise(start.tolist())])
    segments = np.stack([np.arange(len(boundary), dtype=np.int64), heads], axis=1)

    squares = _cover(np.concatenate([outline, others]), margin)
    frame = _frame(*squares)
    inner = _inner_points(outline, outline[heads], squares)
    points, triangles = _triangulate(outline, segments, frame, inner)
    triangles = triangles[select_inside(triangles, segments[:, ::-1], len(points))]
    points = _smooth_points(points, triangles, len(outline) + len(frame))
    # Inner points that were placed inside the surface by mistake were removed with their triangles.
    used = np.unique(triangles[triangles >= len(outline)])
    number = np.concatenate([boundary, np.zeros(len(points) - len(outline), dtype=np.int64)])
    number[used] = n + np.arange(len(used))
    air = Air(np.ldexp(points[used], exponent), number[triangles], number[len(outline) + np.arange(len(frame))])
    bad = inverted_triangles(air.F, np.concatenate([positions, air.points]))
    if bad.size:
        raise ValueError(
            f"the boundary is too close to itself to mesh the air, at {names_of('vertex', 'vertices', air.F[bad, 0])}"
        )
    return air


def _cover(points: FloatArray, margin: float) -> _Squares:
    """Corner, side and numbers of the squares that cover the points' bounding box and a margin around it."""
    low, extent = points.min(axis=0), np.ptp(points, axis=0)
    longer = float(extent.max())
    side = (1 + 2 * margin) * longer / _TUNING.largest_squares
    across = np.ceil((extent + 2 * margin * longer) / side - 1e-9)
    return low + (extent - side * across) / 2, side, (int(across[0]), int(across[1]))


def _frame(corner: FloatArray, side: float, shape: tuple[int, int]) -> FloatArray:
    """A rectangle with bent sides, counterclockwise, with one point per square along it; (h, 2) float64."""
    corners = side * np.array([(0, 0), (1, 0), (1, 1), (0, 1)]) * shape
    frame = []
    for start, along, count in zip(corners, np.roll(corners, -1, axis=0) - corners, (*shape, *shape), strict=True):
        length, t = np.abs(along).max(), (np.arange(count) / count)[:, None]
        bulge = 4 * _TUNING.bulge * length * t * (1 - t)
        frame.append(corner + start + t * along + bulge * np.sign([along[1], -along[0]]))
    return np.concatenate(frame)


def _inner_points(tails: FloatArray, heads: FloatArray, squares: _Squares) -> FloatArray:
    """Points in the air with the density of the boundary's edges, and not too close to them; (k, 2) float64."""
    from scipy.spatial import KDTree

    lengths = np.hypot(*(heads - tails).T)
    asked = _TUNING.spacing * np.concatenate([lengths, lengths])
    tree = Quadtree.around(np.concatenate([(tails + heads) / 2, tails]), asked, *squares)
    points, sizes = tree.points()
    # Edges are cut into pieces of at most half their squares' sides, so that the nearest centre gives the nearest
    # piece.
    pieces = []
    p, q = tails, heads
    while len(p):
        middle = (p + q) / 2
        done = 2 * np.hypot(*(q - p).T) <= 1.01 * tree.sizes_at(middle)
        pieces.append(np.stack([p[done], q[done]]))
        p, q, middle = p[~done], q[~done], middle[~done]
        p, q = np.concatenate([p, middle]), np.concatenate([middle, q])
    p, q = np.concatenate(pieces, axis=1)
    nearest = KDTree((p + q) / 2).query(points)[1]
    at, start, end = (in_units(positions, 0) for positions in (points, p[nearest], q[nearest]))
    outside = ((end - start).conj() * (at - start)).imag < 0
    return points[outside & (nearest_on_edges(at, start, end)[0] > _TUNING.clearance * sizes)]


def _triangulate(
    outline: FloatArray, segments: IntArray, frame: FloatArray, inner: FloatArray
) -> tuple[FloatArray, IntArray]:
    """Triangulate all points with the segments as edges; inner points that lie on a segment are dropped."""
    hull = len(outline) + np.arange(len(frame))
    while True:
        points = np.concatenate([outline, frame, inner])
        try:
            return points, constrained_delaunay(points, segments, hull)
        except BlockedError as blocked:
            at = blocked.point - len(outline) - len(frame)
            if at < 0:
                raise ValueError(_MEETS_ITSELF) from blocked
            inner = np.delete(inner, at, axis=0)
        except ValueError as error:
            raise ValueError(_MEETS_ITSELF) from error


def _smooth_points(points: FloatArray, triangles: IntArray, held: int) -> FloatArray:
    """Move points after the first ``held`` to the mean of their neighbours, if no triangle's shape gets worse."""
    n = len(points)
    tails, heads = triangles.ravel(), np.roll(triangles, -1, axis=1).ravel()
    count = np.maximum(np.bincount(tails, minlength=n), 1)
    best, shape = points, _shapes(points, triangles)
    for _ in range(_TUNING.smoothings):
        middle = np.stack([np.bincount(tails, best[heads, k], minlength=n) / count for k in range(2)], axis=1)
        moved = best.copy()
        moved[held:] = middle[held:]
        idle = np.zeros(n, dtype=bool)
        while True:
            after = _shapes(moved, triangles)
            worse = after < np.minimum(shape, _TUNING.good)
            back = triangles[worse].ravel()
            back = back[~idle[back]]
            back = back[back >= held]
            if not back.size:
                break
            idle[back] = True
            moved[back] = best[back]
        best, shape = moved, after
    return best


def _shapes(points: FloatArray, triangles: IntArray) -> FloatArray:
    """Shape quality of triangles: 1 if equilateral, near 0 for slivers, negative if inverted; (t,) float64."""
    w = to_complex(points)
    corners = w[triangles.T]
    sides = (np.abs(corners - np.roll(corners, 1, axis=0)) ** 2).sum(axis=0)
    return 4 * np.sqrt(3) * signed_areas(triangles, w) / sides
