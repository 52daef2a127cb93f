"""Split vertices into their fans, and edges at their midpoints; weld vertices.

A fan is a set of triangles around a vertex that are joined by edges. A vertex with several fans can be split. Vertices
are welded, to count as one, if their positions are equal or close.

`open_along` opens a mesh along edges without changing its vertices and triangles. The result is a second set of
triangles, ``FT``, whose indices differ on the two sides of a cut, like texture corners.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from quasiharmonic.geometry.mesh.topology import (
    ahead,
    are_collapsed,
    are_sides,
    edge_keys,
    find_pairs,
    group_by_label,
    mark_sides,
    number_components,
    pair_keys,
)
from quasiharmonic.geometry.mesh.topology import edges as sort_edges
from quasiharmonic.util.arrays import (
    BoolArray,
    FloatArray,
    IntArray,
    check_bool,
    check_range,
    edge_array,
    first_equal,
    invert_indices,
    mark,
    reject,
    scale_to_unit,
    triangle_rows,
    vertex_array,
)

# Numbers of vertices are sorted if their range is larger than this multiple of the number of corners.
_GAPS = 4
#: Weights of old vertices in a new vertex.
Shares = dict[int, float]

#: No edges (0, 2), for `split_parts`.
NO_CUT = np.empty((0, 2), dtype=np.int64)


def fans(
    F: IntArray, cut: BoolArray | None = None, pairs: tuple[IntArray, IntArray] | None = None
) -> tuple[IntArray, IntArray]:
    """Split vertices at which triangles touch without a common edge.

    Parameters
    ----------
    F : (f, 3) int64
        Any triangles.
    cut : (f, 3) bool, optional
        Sides, from each corner to the next, at which triangles are never joined.
    pairs : two (p,) int64, optional
        The sides that may be joined, as returned by `find_pairs`; by default all of these.

    Returns
    -------
    split : (f, 3) int64
        The same triangles with a separate vertex for every fan. They form surfaces. An edge becomes a boundary unless
        exactly two triangles share it with opposite directions.
    component : (f,) int64
        Component of each triangle. Vertices and components are numbered by first appearance.
    """
    one, other = find_pairs(F) if pairs is None else pairs
    # The sides of a pair have the same ends. They have opposite directions if they start at different ends.
    joined = F.ravel().take(one) != F.ravel().take(other)
    if cut is not None:
        joined &= ~(cut.ravel()[one] | cut.ravel()[other])
    if not joined.all():
        one, other = one[joined], other[joined]
    # The half-edge of a corner begins there. Joining two half-edges identifies the start of each with the end of the
    # other.
    split = number_components(np.concatenate([one, ahead(one)]), np.concatenate([ahead(other), other]), F.size)
    component = number_components(one // 3, other // 3, len(F))
    return split.reshape(-1, 3), component


def renumber(split: IntArray, F: IntArray) -> tuple[IntArray, IntArray]:
    """Number the vertices of some triangles (k, 3), as returned by `fans`, without gaps.

    ``F`` has the same triangles by the original vertices. New numbers follow their order, so a mesh without split
    vertices and without gaps keeps its numbers. Also returns one corner of every vertex, as an index into the flattened
    triangles.
    """
    split = split - split.min(initial=0)
    if split.max(initial=0) > _GAPS * split.size:
        # A small part of a large mesh.
        split = np.unique(split.ravel(), return_inverse=True)[1].reshape(-1, 3)
    corner = np.full(int(split.max(initial=-1)) + 1, -1)
    # The first corner of each vertex is written last.
    corner[split.ravel()[::-1]] = np.arange(split.size)[::-1]
    first = corner[corner >= 0]
    first = first[np.argsort(F.ravel()[first], kind="stable")]
    return invert_indices(corner.size, split.ravel()[first])[split], first


def number_fans(F: IntArray, split: IntArray, n: int) -> tuple[IntArray, IntArray]:
    """Give every fan a vertex: the first fan around a vertex keeps its number, further fans follow all vertices.

    ``split`` are the triangles as numbered by `fans`. Returns the triangles by fans, and the vertex of each fan, whose
    first ``n`` entries are ``0 … n - 1``.
    """
    vertex = np.empty(int(split.max(initial=-1)) + 1, dtype=np.int64)
    vertex[split] = F
    order = np.argsort(vertex, kind="stable")
    is_first = np.diff(vertex[order], prepend=-1) > 0
    kept, copies = order[is_first], order[~is_first]
    own = np.empty(vertex.size, dtype=np.int64)
    own[kept] = vertex[kept]
    own[copies] = np.arange(n, n + copies.size)
    return own[split], np.concatenate([np.arange(n), vertex[copies]])


class FanCorners(NamedTuple):
    """Corners of the triangles of a mesh that was opened along edges.

    Attributes
    ----------
    FT : (f, 3) int64
        The triangles, by copies of vertices. It equals ``F`` where a vertex was not split. One copy of a split vertex
        keeps its number; the others follow all vertices.
    origin : (n + c,) int64
        The vertex of each copy: ``origin[FT]`` is ``F``, and the first ``n`` entries are ``0 … n - 1``.
    """

    FT: IntArray
    origin: IntArray


def open_along(F: IntArray, cut: IntArray, n: int) -> FanCorners:
    """Open a mesh (f, 3) int64 along edges (k, 2) int64.

    Boundary edges have no effect. A single edge with two interior ends opens nothing. Vertices at which triangles touch
    without a common edge are split, too. Raises a ValueError that names the first cuts that are not edges of the mesh.
    """
    check_range("edges", cut, n)
    reject(cut[~are_sides(cut, F, n)], "edge", "edges", "{}: not an edge of the mesh")
    return FanCorners(*number_fans(F, fans(F, mark_sides(F, cut, n))[0], n))


def make_fans(loops: Sequence[IntArray], n: int) -> IntArray:
    """Fill loops, with the surface on their left, by triangles (k, 3) around new vertices numbered from ``n``."""
    triangles = [np.stack([np.roll(loop, -1), loop, np.full(len(loop), n + k)], axis=1) for k, loop in enumerate(loops)]
    return np.concatenate([np.zeros((0, 3), dtype=np.int64), *triangles])


def split_parts(F: IntArray, rows: IntArray, cut: IntArray, n: int) -> list[tuple[IntArray, IntArray, IntArray]]:
    """Split triangles along edges (l, 2); return rows, triangles by own vertices, and vertices of each part."""
    split, component = fans(F, mark_sides(F, cut, n))
    parts = []
    for some in group_by_label(component):
        own, corner = renumber(split[some], F[some])
        parts.append((rows[some], own, F[some].ravel()[corner]))
    return parts


def find_representatives(V: FloatArray, F: IntArray, weld: bool | float, meshes: IntArray | None = None) -> IntArray:
    """Return for each vertex the one that represents it, which has the lowest index; the vertex itself if not welded.

    A vertex becomes a representative if no earlier representative is within the distance. Otherwise the first such
    representative represents it. So a chain of close vertices is not welded beyond the distance.

    Parameters
    ----------
    V : (n, 2) or (n, 3) float64
        Finite positions.
    F : (f, 3) int64
        Triangles. Vertices that they do not use represent themselves.
    weld : bool or float
        False welds no vertices. True and 0 weld equal positions. Other numbers are the maximum distance of a vertex
        from its representative, relative to the diagonal of the bounding box of the triangles.
    meshes : (n,) int64, optional
        Mesh of each vertex. Vertices of different meshes are not welded.

    Returns
    -------
    (n,) int64
        At most the vertex's own index.
    """
    joint = np.arange(len(V))
    if isinstance(weld, bool | np.bool_) and not weld:
        return joint
    used = np.flatnonzero(mark(len(V), F))
    of = np.zeros(len(used)) if meshes is None else meshes[used].astype(np.float64)
    first = first_equal(np.column_stack([V[used], of]))
    distinct = np.flatnonzero(first == np.arange(len(first)))
    if not isinstance(weld, bool | np.bool_) and len(distinct):
        # In this unit, the diagonal neither overflows nor underflows.
        points = scale_to_unit(V[used[distinct]])
        distance = float(weld) * float(np.linalg.norm(np.ptp(points, axis=0)))
        close = _find_close(np.column_stack([points, 2 * distance * of[distinct]]), distance)
        first = distinct[close][np.searchsorted(distinct, first)]
    joint[used] = used[first]
    return joint


def weld_triangles(V: FloatArray, F: IntArray, weld: bool | float) -> tuple[IntArray, IntArray]:
    """Return triangles (f, 3) of the representatives of their vertices, and these (n,); see `find_representatives`.

    ValueError if welding merges corners of a triangle; the message names the triangles.
    """
    joint = find_representatives(V, F, weld)
    remedy = "choose a smaller distance, or remove these triangles"
    message = f"welding at distance {float(weld):g} merges corners of {{}}: {remedy}"
    reject(are_collapsed(joint[F]) & ~are_collapsed(F), "triangle", "triangles", message)
    return joint[F], joint


def _find_close(points: FloatArray, distance: float) -> IntArray:
    """Return for each of several distinct points the first representative within a distance."""
    from scipy.spatial import cKDTree

    first = np.arange(len(points))
    if not distance > 0:
        return first
    tree = cKDTree(points)
    # The maximum norm needs no squares, which would underflow.
    box, _ = tree.query(points, k=[2], p=np.inf, distance_upper_bound=np.nextafter(distance, np.inf))
    waiting = box[:, 0] <= distance
    for i in np.flatnonzero(waiting).tolist():
        if waiting[i]:
            near = np.array(tree.query_ball_point(points[i], distance, p=np.inf))
            near = near[waiting[near]]
            near = near[(((points[near] - points[i]) / distance) ** 2).sum(axis=1) <= 1]
            first[near], waiting[near] = i, False
    return first


def weld_points(points: FloatArray) -> tuple[FloatArray, IntArray]:
    """Return the distinct points of (k, d), in the order of their first occurrence, and the row of each point (k,)."""
    first = first_equal(points)
    distinct = np.flatnonzero(first == np.arange(len(points)))
    return points[distinct], np.searchsorted(distinct, first)


@dataclass(frozen=True, eq=False)
class Refined:
    """A mesh after some of its edges were split, with its relation to the old mesh.

    Attributes
    ----------
    V : (n + s, d) float64
        Vertices: the old ones with their old indices, then the new ones.
    F : (f + …, 3) int64
        Triangles. An old triangle that is not split keeps its index. The first part of a split triangle takes its
        index; further parts follow all old triangles.
    parent : (f + …,) int64
        Index of the old triangle that contains each triangle.
    parents : (s, k) int64
        Old vertices between which each new vertex lies, ascending. After one round these are the two ends of the split
        edge; after several rounds, up to three corners of an old triangle. The last index is repeated to fill the row.
    weights : (s, k) float64
        Weights of the parents; 0 for repeated ones.

    See Also
    --------
    refine : Makes it.
    results.RefinedProblem : A problem on such a mesh.

    Examples
    --------
    >>> from quasiharmonic import refine
    >>> V = [[0.0, 0.0], [1.0, 0.0], [1.0, 1.0], [0.0, 1.0]]
    >>> refined = refine(V, [[0, 1, 2], [0, 2, 3]], [[0, 2]])
    >>> refined.parents.tolist(), refined.V[4].tolist()
    ([[0, 2]], [0.5, 0.5])
    """

    V: FloatArray
    F: IntArray
    parent: IntArray
    parents: IntArray
    weights: FloatArray

    def shares(self) -> list[Shares]:
        """The weights of old vertices in every new vertex."""
        rows = zip(self.parents.tolist(), self.weights.tolist(), strict=True)
        return [{old: share for old, share in zip(*row, strict=True) if share} for row in rows]

    def extend(self, values: ArrayLike) -> FloatArray:
        """Interpolate values (n, …) at the old vertices to all vertices, linearly on the old triangles."""
        old, count = np.asarray(values, dtype=np.float64), len(self.V) - len(self.parents)
        if not old.ndim or len(old) != count:
            rows = "a number" if not old.ndim else f"{len(old)} rows"
            raise ValueError(f"values must have {count} rows, one for each vertex, not {rows}")
        return np.concatenate([old, np.einsum("sk,sk...->s...", self.weights, old[self.parents])])


def compose(first: Refined, second: Refined) -> Refined:
    """Compose two successive refinements into one, with three parents for each vertex."""
    n = len(first.V) - len(first.parents)

    shares = first.shares()
    later = [combine_shares(row, shares, n) for row in second.shares()]
    return Refined(second.V, second.F, first.parent[second.parent], *parents_and_weights([*shares, *later]))


def combine_shares(row: Shares, shares: Sequence[Shares], n: int) -> Shares:
    """Express a vertex between vertices of a refinement by old vertices; ``n`` is their number.

    ``row`` has the weights of those vertices. ``shares`` has the weights of old vertices for each added one.
    """
    total: Shares = {}
    for vertex, weight in row.items():
        for old, share in ({vertex: 1.0} if vertex < n else shares[vertex - n]).items():
            total[old] = total.get(old, 0.0) + weight * share
    return total


def parents_and_weights(shares: Sequence[Shares]) -> tuple[IntArray, FloatArray]:
    """Arrays (s, 3) as in `Refined` of the old vertices and weights; a vertex in an old triangle has at most three."""
    parents = np.array([(*sorted(row), max(row), max(row))[:3] for row in shares], dtype=np.int64).reshape(-1, 3)
    weights = [[*(row[old] for old in sorted(row)), 0.0, 0.0][:3] for row in shares]
    return parents, np.array(weights, dtype=np.float64).reshape(-1, 3)


def split_edges(V: ArrayLike, F: ArrayLike, edges: ArrayLike, *, boundary: bool = False) -> Refined:
    """Split edges at their midpoints; array version of `quasiharmonic.refine`."""
    V, F = vertex_array(V), triangle_rows(F)
    n = len(V)
    check_range("F", F, n)
    wanted = np.unique(np.sort(edge_array("edges", edges), axis=1), axis=0)
    found = sort_edges(F, n)
    allowed = [found.interior, np.sort(found.boundary, axis=1)]
    _check_known(wanted, pair_keys(np.concatenate(allowed), n), n, "not an edge of the mesh")
    check_bool("boundary", boundary)
    if not boundary:
        _check_known(wanted, pair_keys(found.interior, n), n, "on the boundary; pass boundary=True to split it")

    V = np.concatenate([V, V[wanted[:, 0]] / 2 + V[wanted[:, 1]] / 2])
    keys = pair_keys(wanted, n)
    # Midpoint of the side opposite to each corner, or -1.
    sides = edge_keys(F[:, (1, 2, 0)].ravel(), F[:, (2, 0, 1)].ravel(), n)
    at = np.minimum(np.searchsorted(keys, sides), max(len(keys) - 1, 0))
    middle = np.where(keys[at] == sides, n + at, -1).reshape(-1, 3) if len(keys) else np.full(F.shape, -1)
    F, parent = _subdivide(V, F, middle)
    return Refined(V, F, parent, wanted, np.full(wanted.shape, 0.5))


def _subdivide(V: FloatArray, F: IntArray, middle: IntArray) -> tuple[IntArray, IntArray]:
    r"""Replace triangles by their parts; ``middle`` (f, 3) has the midpoint opposite to each corner, or -1.

    Drawn with the midpoints p, q, r opposite to a, b, c:

            c                c                 c
           /|\              / \               / \
          / | \            q---p             q---p
         /  |  \          / `-. \           / \ / \
        a---r---b        a-----`-b         a---r---b
    """
    count = (middle >= 0).sum(axis=1)
    first, parts, of = F.copy(), [np.empty((0, 3), dtype=np.int64)], [np.empty(0, dtype=np.int64)]

    def replace(t: IntArray, *triangles: tuple[IntArray, IntArray, IntArray]) -> None:
        first[t] = np.stack(triangles[0], axis=1)
        for corners in triangles[1:]:
            parts.append(np.stack(corners, axis=1))
            of.append(t)

    def rotate(number: int, to: IntArray) -> tuple[IntArray, IntArray, IntArray]:
        # Corners and midpoints of triangles, rotated so that corner `to` is the last.
        t = np.flatnonzero(count == number)
        columns = (to[t, None] + [1, 2, 0]) % 3
        return t, F[t[:, None], columns].T, middle[t[:, None], columns].T

    t, (a, b, c), (_, _, r) = rotate(1, np.argmax(middle, axis=1))
    replace(t, (r, c, a), (r, b, c))
    t, (a, b, c), (p, q, _) = rotate(2, np.argmin(middle, axis=1))
    through_b = _length(V, b, q) <= _length(V, a, p)
    replace(t, (c, q, p), (q, a, b), (q, b, p))
    k = np.flatnonzero(~through_b)
    parts[-2][k] = np.stack([a, b, p], axis=1)[k]
    parts[-1][k] = np.stack([a, p, q], axis=1)[k]
    t, (a, b, c), (p, q, r) = rotate(3, np.zeros(len(F), dtype=np.int64))
    replace(t, (p, q, r), (a, r, q), (b, p, r), (c, q, p))
    return np.concatenate([first, *parts]), np.concatenate([np.arange(len(F)), *of])


def _length(V: FloatArray, i: IntArray, j: IntArray) -> FloatArray:
    """A quarter of the distances between vertices; the scale prevents overflow."""
    return np.hypot.reduce(V[i] / 4 - V[j] / 4, axis=1)


def _check_known(wanted: IntArray, known: IntArray, n: int, reason: str) -> None:
    inside = ((wanted >= 0) & (wanted < n)).all(axis=1)
    bad = wanted[~(inside & np.isin(pair_keys(wanted, n), known))]
    reject(bad, "edge", "edges", f"cannot split {{}}: {reason}")
