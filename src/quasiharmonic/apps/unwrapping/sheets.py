"""Sheets: triangles joined in pairs at their edges so that they form consistently oriented surfaces.

Any triangles can be joined this way. At an edge of two triangles, both are joined. At an edge of more triangles, pairs
are. Where no orientation agrees with all pairs, as in a Möbius band, some of them are separated.

A side is an edge of one triangle. Side ``3 t + k`` runs from corner ``k`` of triangle ``t`` to the next corner, so
sides and corners have the same numbers.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from quasiharmonic.geometry.mesh.topology import (
    ahead,
    edge_keys,
    find_sides,
    first_of_pairs,
    label_components,
    opposite_sides,
    previous_sides,
)
from quasiharmonic.util.arrays import BoolArray, FloatArray, IntArray, mark, repeat_each


class SheetTuning(NamedTuple):
    """Numbers that tune which triangles are joined at edges of more than two."""

    # At an edge of more triangles than this, none are joined. The number of pairs grows with its square.
    max_triangles: int = 16
    # Score of a pair at an edge of several triangles, lower is better. The cosine of the angle between the triangles is
    # -1 if the surface is flat there and 1 if it is folded. The penalties exceed this range, so that they take
    # precedence. The orientations of the two triangles disagree.
    disagreeing: float = 4.0
    # The triangles have different vertices of the file at the edge.
    foreign: float = 8.0
    # One of the triangles is so thin that its angle is arbitrary.
    thin: float = 16.0
    # At equal angles a convex edge is preferred, which separates solids that touch along an edge.
    concave: float = 1e-3
    # Relative difference of two areas that is due to rounding.
    rounding: float = 1e-12


_TUNING = SheetTuning()


class Sheets(NamedTuple):
    """Triangles as surfaces.

    Attributes
    ----------
    fan : (f, 3) int64
        Label of each corner. Corners with one label are one vertex of the surface. Labels are the smallest corners.
    turned : (f,) bool
        Triangles whose orientation is reversed.
    seams : (k, 2) int64
        Edges of several triangles at which the surface is cut, by vertices, smaller index first, ascending.
    """

    fan: IntArray
    turned: BoolArray
    seams: IntArray


class Links(NamedTuple):
    """Pairs of sides that are joined.

    Attributes
    ----------
    one, other : (k,) int64
        Sides.
    parallel : (k,) bool
        Whether both run in the same direction, so that one of the triangles must be turned.
    """

    one: IntArray
    other: IntArray
    parallel: BoolArray

    def select(self, which: BoolArray) -> Links:
        """Return some of the links."""
        return Links(self.one[which], self.other[which], self.parallel[which])

    def join(self, more: Links) -> Links:
        """Return these links and more of them."""
        one, other, parallel = (np.concatenate(both) for both in zip(self, more, strict=True))
        return Links(one, other, parallel)


def join_sheets(points: FloatArray, F: IntArray, corners: IntArray, area: FloatArray, thin: BoolArray) -> Sheets:
    """Join triangles to consistently oriented surfaces.

    Parameters
    ----------
    points : (n, 3) float64
        Positions.
    F : (f, 3) int64
        Triangles, none of them degenerate, no two with the same vertices.
    corners : (f, 3) int64
        Their vertices in the file, where several vertices may have one position. At edges of several triangles, those
        with the same vertices in the file are joined first.
    area : (f,) float64
        Areas of the triangles. In each component, the larger part keeps its orientation.
    thin : (f,) bool
        Triangles whose angles at edges are arbitrary. At edges of several triangles, they are joined last.
    """
    side = find_sides(F, len(points))[1]
    opposite, side = opposite_sides(side), side.ravel()
    count = np.bincount(side)
    first = first_of_pairs(opposite)
    by_edge = np.empty(count.size, dtype=np.int64)
    by_edge[side[first]] = first
    one = by_edge[count == 2]
    other = opposite[one]
    # Sides of one edge run in the same direction if they start at the same end.
    links = Links(one, other, F.ravel()[one] == F.ravel()[other])
    turned, fits = _orient(links, np.zeros(len(F), dtype=bool), area)
    contested = [one[~fits], other[~fits]]
    links = links.select(fits)
    if (count > 2).any():
        crowded = np.flatnonzero((count > 2)[side])
        crowded = crowded[np.argsort(side[crowded], kind="stable")]
        contested.append(crowded)
        links = links.join(_pair(points, F, corners, turned, thin, crowded, count[count > 2]))
        turned, fits = _orient(links, turned, area)
        links = links.select(fits)
    fan, links, seams = _split(F, links, turned, np.concatenate(contested))
    return Sheets(fan.reshape(-1, 3), _restore_larger_part(links, turned, area), seams)


def _orient(links: Links, turned: BoolArray, area: FloatArray) -> tuple[BoolArray, BoolArray]:
    """Orient joined triangles consistently.

    Parameters
    ----------
    links : Links
    turned : (f,) bool
        The orientation at the start. Links that agree with it stay.
    area : (f,) float64

    Returns
    -------
    turned : (f,) bool
    fits : (k,) bool
        Whether each link agrees with the orientation. The links that agree connect the same triangles as all links.
    """
    one, other = links.one // 3, links.other // 3
    unlike = links.parallel ^ turned[one] ^ turned[other]
    fits = np.ones(unlike.size, dtype=bool)
    if unlike.any():
        patch = label_components(one[~unlike], other[~unlike], area.size)
        weight: FloatArray = np.bincount(patch, area, area.size).astype(np.float64)
        odd = _two_colour(patch[one[unlike]], patch[other[unlike]], weight)
        turned = turned ^ odd[patch]
        fits = links.parallel == turned[one] ^ turned[other]
    return _restore_larger_part(links.select(fits), turned, area), fits


def _restore_larger_part(links: Links, turned: BoolArray, area: FloatArray) -> BoolArray:
    """Reverse the components of which more than half of the area is turned."""
    if not turned.any():
        return turned
    component = label_components(links.one // 3, links.other // 3, area.size)
    most = np.bincount(component, np.where(turned, area, -area), area.size)
    whole = np.bincount(component, area, area.size)
    return np.asarray(turned ^ (most > _TUNING.rounding * whole)[component])


def _two_colour(one: IntArray, other: IntArray, weight: FloatArray) -> BoolArray:
    """Colour a graph so that linked nodes differ along a spanning tree; the heaviest node of each component is False.

    The tree is a breadth-first one, because the links that disagree with it are then few.
    """
    from scipy.sparse import csr_array
    from scipy.sparse.csgraph import breadth_first_order

    odd = np.zeros(weight.size, dtype=bool)
    apart = one != other
    nodes, ends = np.unique(np.concatenate([one[apart], other[apart]]), return_inverse=True)
    m = nodes.size
    tail, head = np.split(ends, 2)
    component = label_components(tail, head, m)
    order = np.lexsort((-weight[nodes], component))
    roots = order[np.flatnonzero(np.diff(component[order], prepend=-1))]
    # One more node leads to all roots.
    start = np.concatenate([tail, head, np.full(roots.size, m)])
    end = np.concatenate([head, tail, roots])
    graph = csr_array((np.ones(start.size, dtype=np.int8), (start, end)), shape=(m + 1, m + 1))
    ahead = breadth_first_order(graph, m)[1][:m].astype(np.int64)
    ahead[roots] = roots
    colour = ~mark(m, roots)
    while not np.array_equal(further := ahead[ahead], ahead):
        colour ^= colour[ahead]
        ahead = further
    odd[nodes] = colour
    return odd


def _pair(
    points: FloatArray,
    F: IntArray,
    corners: IntArray,
    turned: BoolArray,
    thin: BoolArray,
    crowded: IntArray,
    count: IntArray,
) -> Links:
    """Choose pairs of sides at edges of three or more triangles, best first; ``crowded`` lists the sides by edge."""
    starts = np.cumsum(count) - count
    picks = []
    for size in range(3, _TUNING.max_triangles + 1):
        i, j = np.triu_indices(size, 1)
        start = starts[count == size, None]
        picks.append(np.stack([start + i, start + j], axis=-1).reshape(-1, 2))
    one, other = np.concatenate(picks).T
    edge = repeat_each(np.arange(count.size), count)[one]
    score = _score_pairs(points, F, corners, turned, crowded[one], crowded[other])
    score += _TUNING.thin * (thin[crowded[one] // 3] | thin[crowded[other] // 3])
    order = np.lexsort((other, one, score, edge))
    edge, one, other = edge[order], one[order], other[order]
    free, chosen = np.ones(crowded.size, dtype=bool), []
    while one.size:
        best = np.flatnonzero(np.diff(edge, prepend=-1))
        chosen.append(np.stack([one[best], other[best]]))
        free[chosen[-1]] = False
        rest = free[one] & free[other]
        edge, one, other = edge[rest], one[rest], other[rest]
    one, other = crowded[np.concatenate([np.empty((2, 0), dtype=np.int64), *chosen], axis=1)]
    tail = F.ravel()
    return Links(one, other, tail[one] == tail[other])


def _score_pairs(
    points: FloatArray, F: IntArray, corners: IntArray, turned: BoolArray, one: IntArray, other: IntArray
) -> FloatArray:
    """Return the score of pairs of sides at common edges."""
    tail, head, opposite = F.ravel(), F[:, (1, 2, 0)].ravel(), F[:, (2, 0, 1)].ravel()
    low, high = np.minimum(tail[one], head[one]), np.maximum(tail[one], head[one])
    axis = _normalise(points[high] - points[low])

    def across(side: IntArray) -> FloatArray:
        to = _normalise(points[opposite[side]] - points[low])
        return _normalise(to - (to * axis).sum(axis=1, keepdims=True) * axis)

    upward = [(tail[side] < head[side]) ^ turned[side // 3] for side in (one, other)]
    unlike = upward[0] == upward[1]
    inward, outward = across(one), across(other)
    normal = np.where(upward[0][:, None], 1.0, -1.0) * np.cross(axis, inward)
    in_file, ahead = corners.ravel(), corners[:, (1, 2, 0)].ravel()
    low_in_file, high_in_file = (
        [np.where(tail[side] == end, in_file[side], ahead[side]) for side in (one, other)] for end in (low, high)
    )
    foreign = (low_in_file[0] != low_in_file[1]) | (high_in_file[0] != high_in_file[1])
    score: FloatArray = (inward * outward).sum(axis=1) + _TUNING.disagreeing * unlike + _TUNING.foreign * foreign
    return score + np.where(unlike, 0.0, _TUNING.concave * (normal * outward).sum(axis=1))


def _normalise(vectors: FloatArray) -> FloatArray:
    """Scale vectors (k, 3) to unit length; zero stays zero."""
    vectors = vectors / np.maximum(np.abs(vectors).max(axis=1, keepdims=True), np.finfo(float).tiny)
    return np.asarray(vectors / np.maximum(np.sqrt((vectors**2).sum(axis=1, keepdims=True)), 0.5))


def _split(F: IntArray, links: Links, turned: BoolArray, contested: IntArray) -> tuple[IntArray, Links, IntArray]:
    """Separate corners until every edge has at most two triangles, with opposite directions.

    Parameters
    ----------
    F : (f, 3) int64
    links : Links
    turned : (f,) bool
    contested : (k,) int64
        The sides at edges of several triangles, unless exactly two are there and they are joined.

    Returns
    -------
    fan : (3 f,) int64
        Labels of the corners.
    links : Links
        The links that are left.
    seams : (s, 2) int64
        See `Sheets`.
    """
    while True:
        fan = _label_corners(links, F.size)
        # Sides at one edge of the surface, in order of a side that is joined to another one.
        ends = fan[contested], fan[ahead(contested)]
        edge = edge_keys(*ends, F.size)
        partner = np.full(F.size, F.size)
        partner[links.one], partner[links.other] = links.other, links.one
        leader = np.minimum(contested, partner[contested])
        order = np.lexsort((contested, leader, partner[contested] == F.size, edge))
        side, edge, leader = contested[order], edge[order], leader[order]
        first = np.flatnonzero(np.diff(edge, prepend=-1))
        count = np.diff(first, append=edge.size)
        upward = (ends[0] < ends[1])[order] ^ turned[side // 3]
        two = first[count == 2]
        wrong = count > 2
        wrong[count == 2] = upward[two] == upward[two + 1]
        if not wrong.any():
            tails, heads = F.ravel(), F[:, (1, 2, 0)].ravel()
            rim = side[repeat_each(count == 1, count)]
            seams = np.sort(np.stack([tails[rim], heads[rim]], axis=1), axis=1)
            return fan, links, np.unique(seams, axis=0)
        # Only the first pair of sides, or the first side, stays at this edge. The others get a vertex of their own.
        away = side[repeat_each(wrong, count) & (leader != repeat_each(leader[first], count))]
        at_start = fan[away] < fan[ahead(away)]
        cut = mark(F.size, np.where(at_start, previous_sides(away), ahead(away)))
        apart = cut[links.one] | cut[links.other]
        contested = np.union1d(contested, [links.one[apart], links.other[apart]])
        links = links.select(~apart)


def _label_corners(links: Links, count: int) -> IntArray:
    """Label the corners that joined sides identify; each label is the smallest corner."""
    one, other, parallel = links
    start, end = np.where(parallel, other, ahead(other)), np.where(parallel, ahead(other), other)
    return label_components(np.concatenate([one, ahead(one)]), np.concatenate([start, end]), count)
