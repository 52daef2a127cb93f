"""Turning angles of a surface's boundary, measured along the surface, and detection of its corners.

At a boundary vertex, the boundary turns by π minus the sum of the triangles' angles there. At the corner of a square
this is π/2, however the square is bent in space. It is zero along a straight side and negative at a notch. On a ragged
boundary, such as that of a scan, a single vertex says little. So a given number of corners is found jointly, such that
the runs between them are as straight as possible. Let Φ be the direction of the boundary, which jumps at each vertex by
the turning angle. The corners minimise the sum over runs of ∫ (Φ − mean of Φ)² ds: they approximate Φ by a step
function.

Starting from all vertices, corners are removed one after another, each time the one that increases the sum least. Its
turning is distributed to its neighbours like a load on a beam to its supports. Then each corner moves to the best
vertex between its neighbours until the corners converge.
"""

from __future__ import annotations

import heapq
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from quasiharmonic.geometry.mesh.reference import loop_lengths, rest_frames
from quasiharmonic.geometry.mesh.topology import boundary_loops
from quasiharmonic.io.accepts_mesh import accepts_mesh
from quasiharmonic.util.arrays import (
    FloatArray,
    IntArray,
    check_integer,
    find_exponent,
    mark,
    pad_to_space,
    scale_to_unit,
    triangle_array,
    vertex_array,
)


@dataclass(frozen=True, eq=False)
class BoundaryLoop:
    """A boundary loop of a surface with its turning angles.

    Attributes
    ----------
    vertices : (l,) int64
        In order, with the surface to the left.
    lengths : (l,) float64
        Lengths of the edges from each vertex to the next, in the surface's unit.
    turning : (l,) float64
        Turning angle at each vertex in radians: π minus the triangles' angles there, positive at a corner, negative at
        a notch. On a disk the sum is 2π minus the total curvature inside (Gauss and Bonnet).
    """

    # Total turning in radians that is added, spread evenly, so that corners divide a straight side evenly.
    _ADDED_TURNING = 0.01
    # Minimum edge length, as a share of the loop's length.
    _SHORTEST = 1e-12

    vertices: IntArray
    lengths: FloatArray
    turning: FloatArray

    def corners(self, count: int) -> tuple[IntArray, FloatArray]:
        """Find vertices between which the loop is as straight as possible; on a circle they are evenly spaced.

        Parameters
        ----------
        count : int
            Number of corners, at least one.

        Returns
        -------
        positions : (count,) int64
            Positions in ``vertices``, ascending.
        turning : (count,) float64
            Angle in radians from the mean direction of the run before each corner to that of the run after it.

        Raises
        ------
        ValueError
            When the loop has fewer vertices, or all its vertices coincide.
        """
        check_integer("count", count, minimum=1)
        if count > len(self.vertices):
            raise ValueError(
                f"the loop has {len(self.vertices)} vertices, too few for {count} corners: split boundary edges"
            )
        longest = self.lengths.max()
        if longest == 0:
            raise ValueError(f"all vertices of the boundary loop at vertex {self.vertices[0]} coincide")
        lengths = np.maximum(self.lengths / longest, self._SHORTEST)
        lengths /= lengths.sum()
        bent = self.turning + self._ADDED_TURNING * (lengths + np.roll(lengths, 1)) / 2
        found = _improve(lengths, bent, _remove_until(lengths, bent, count))
        return found, mean_turns(lengths, self.turning, found)


@accepts_mesh
def boundary_turning(V: ArrayLike, F: ArrayLike) -> list[BoundaryLoop]:
    """Measure the turning angle of a surface's boundary at each boundary vertex.

    Parameters
    ----------
    V : (n, 2) or (n, 3) array, or a mesh in place of ``V`` and ``F``
        Rest positions.
    F : (f, 3) array of int
        Triangles, consistently oriented, in one or more pieces.

    Returns
    -------
    list of BoundaryLoop
        In the order of `quasiharmonic.geometry.mesh.topology.boundary_loops`; empty for a closed surface.

    Raises
    ------
    ValueError
        When arrays are malformed, or the boundary does not form loops.

    Examples
    --------
    >>> from quasiharmonic.surfaces import grid
    >>> [loop] = boundary_turning(*grid(2, 2))
    >>> np.degrees(loop.turning).round().astype(int).tolist()
    [90, 0, 90, 0, 90, 0, 90, 0]
    """
    V = vertex_array(V)
    F = triangle_array(F, len(V))
    exponent = find_exponent(V)
    V = np.ldexp(V, -exponent)
    loops = boundary_loops(F, len(V))
    on_boundary = mark(len(V), *loops)
    angle = _angle_sums(V, F[on_boundary[F].any(axis=1)])
    lengths = [loop_lengths(V, loop) for loop in loops]
    return [
        BoundaryLoop(loop, np.ldexp(length, exponent), np.pi - angle[loop])
        for loop, length in zip(loops, lengths, strict=True)
    ]


@accepts_mesh
def boundary_corners(V: ArrayLike, F: ArrayLike, count: int) -> IntArray:
    """Find corners of a surface by angle: boundary vertices between which the boundary is as straight as possible.

    Angles are measured along the surface, so bending a sheet does not change its corners. If the boundary has fewer
    distinct corners than requested, the others divide straight or round parts evenly. Zigzags of a ragged boundary do
    not count as corners.

    Parameters
    ----------
    V : (n, 2) or (n, 3) array, or a mesh in place of ``V`` and ``F``
        Rest positions.
    F : (f, 3) array of int
        Triangles, consistently oriented.
    count : int
        Number of corners.

    Returns
    -------
    (count,) int64
        Vertices of the boundary loop that encloses the largest area, in order, with the surface to the left.
        `boundary_to` accepts them as ``corners``. For other loops use `boundary_turning`.

    Raises
    ------
    ValueError
        As `boundary_turning`; when the surface is closed, or the loop has fewer vertices.

    Examples
    --------
    >>> from quasiharmonic.surfaces import grid
    >>> boundary_corners(*grid(8, 5), 4).tolist()
    [0, 8, 53, 45]
    """
    loops = boundary_turning(V, F)
    if not loops:
        raise ValueError("the surface is closed: it has no boundary with corners; cut it open first (cut_open; --cut)")
    loop = loops[find_outermost([one.vertices for one in loops], in_space(vertex_array(V)))]
    return loop.vertices[loop.corners(count)[0]]


def mean_turns(lengths: FloatArray, turning: FloatArray, corners: IntArray) -> FloatArray:
    """Return the angle from the mean direction of the run before each corner to that of the run after it, (k,) radians.

    ``lengths`` and ``turning`` (l,) are edge lengths and turning angles. The sum of the result is that of ``turning``.
    """
    mean, total = np.empty(len(corners)), np.empty(len(corners))
    for j, run in enumerate(_runs(corners, len(lengths))):
        # Relative to the direction at the start of the run.
        direction = np.cumsum(turning[run]) - turning[run[0]]
        mean[j], total[j] = (lengths[run] * direction).sum() / lengths[run].sum(), direction[-1]
    return np.asarray(np.roll(total - mean, 1) + turning[corners] + mean)


def find_outermost(loops: Sequence[IntArray], space: FloatArray) -> int:
    """Index of the loop that encloses the largest area, given positions (n, 3) of about unit size."""
    return int(np.argmax([np.linalg.norm(_vector_area(space[loop])) for loop in loops]))


def in_space(V: FloatArray) -> FloatArray:
    """Return positions (n, 3), centred and scaled to about unit size to avoid overflow."""
    V = pad_to_space(scale_to_unit(V))
    return np.asarray(V - V.mean(axis=0))


def _vector_area(points: FloatArray) -> FloatArray:
    """Vector area of a closed curve in space: its component along a direction is the projected area."""
    return np.asarray(np.cross(points, np.roll(points, -1, axis=0)).sum(axis=0) / 2)


def _angle_sums(V: FloatArray, F: IntArray) -> FloatArray:
    """Sum of the triangles' angles at every vertex in radians; degenerate triangles use their edge directions."""
    z1, z2 = rest_frames(V, F)
    sides = z1 + 0j, z2 - z1, -z2
    total = np.zeros(len(V))
    for k, (ahead, behind) in enumerate(((sides[0], sides[2]), (sides[1], sides[0]), (sides[2], sides[1]))):
        np.add.at(total, F[:, k], np.abs(np.angle(-ahead * behind.conj())))
    return total


def _runs(corners: IntArray, n: int) -> list[IntArray]:
    """Edges of a closed curve of ``n`` edges from each corner to the next; the whole curve for a single corner."""
    after = np.roll(corners, -1)
    return [(c + np.arange((d - c) % n or n)) % n for c, d in zip(corners.tolist(), after.tolist(), strict=True)]


def _remove_until(lengths: FloatArray, turning: FloatArray, count: int) -> IntArray:
    """Remove corners, each time the one that increases the sum least, until ``count`` are left."""
    n = len(lengths)
    # ``run`` has the length of the run that begins at each corner, ``turn`` the corner's turning angle.
    run, turn = lengths.tolist(), turning.tolist()
    before, after = [(i - 1) % n for i in range(n)], [(i + 1) % n for i in range(n)]

    def cost(i: int) -> float:
        a, b = run[before[i]], run[i]
        return float(a * b / (a + b) * turn[i] ** 2)

    latest = [cost(i) for i in range(n)]
    queue = [(latest[i], i) for i in range(n)]
    heapq.heapify(queue)
    left = set(range(n))
    while len(left) > count:
        grown, i = heapq.heappop(queue)
        if i not in left or grown != latest[i]:
            continue
        left.remove(i)
        p, q = before[i], after[i]
        share = run[i] / (run[p] + run[i])
        turn[p] += share * turn[i]
        turn[q] += (1 - share) * turn[i]
        run[p] += run[i]
        after[p], before[q] = q, p
        for j in (p, q):
            latest[j] = cost(j)
            heapq.heappush(queue, (latest[j], j))
    return np.array(sorted(left), dtype=np.int64)


def _improve(lengths: FloatArray, turning: FloatArray, corners: IntArray) -> IntArray:
    """Move each corner to the best vertex between its neighbours until all corners have converged."""
    # Minimum relative decrease of the sum for a move, larger than rounding errors.
    min_decrease = 1e-9
    # Maximum number of passes of moves. The first few give nearly all of the decrease.
    max_rounds = 50
    n, count = len(lengths), len(corners)
    if count == 1:
        return corners
    corners = corners.copy()
    for _ in range(max_rounds):
        before = corners.copy()
        for j in range(count):
            first = int(corners[j - 1])
            run = (first + np.arange((corners[(j + 1) % count] - first) % n or n)) % n
            length, direction = lengths[run], np.cumsum(turning[run]) - turning[first]
            direction -= (length * direction).sum() / length.sum()
            # Decrease of the sum for a step at each of these vertices.
            so_far, along = np.cumsum(length * direction)[:-1], np.cumsum(length)[:-1]
            lowered = so_far**2 * length.sum() / (along * (length.sum() - along))
            here, best = (int(corners[j]) - first) % n - 1, int(np.argmax(lowered))
            if lowered[best] > lowered[here] + min_decrease * (length * direction**2).sum():
                corners[j] = run[best + 1]
        if np.array_equal(corners, before):
            break
    return np.sort(corners)
