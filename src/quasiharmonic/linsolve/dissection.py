"""Nested dissection: an elimination order computed from the positions of the vertices.

Cut the vertices in two, number the vertices along the cut last, and repeat with both parts. The factor of a planar
mesh's Laplacian then has O(n log n) entries (George 1973). The methods differ in how they find the cut. A general
library knows only the graph and must search. This module uses the positions. In a flat or gently curved mesh the median
plane across the longest side of a part's bounding box is nearly as good a cut. 250,000 unknowns, MKL PARDISO on one
core; this module / METIS / minimum degree:

=====================  =======================  ===================  ===========================
mesh                   order and analyse, ms    factor, ms           entries of the factor, 10⁶
=====================  =======================  ===================  ===========================
regular, planar        245 / 811 / 158          130 / 180 / 236      12.0 / 12.4 / 15.2
irregular, planar      389 / 1498 / 852         161 / 175 / 304      11.1 / 9.4 / 11.2
head of a cat          332 / 847 / 168          188 / 200 / 268      13.5 / 12.9 / 15.9
=====================  =======================  ===================  ===========================

Factoring is faster partly because unknowns that are eliminated together lie together in memory. On a folded surface a
plane cuts several sheets at once, and with long triangles planes are not short cuts. A search is then better, and
`nested_dissection` returns None.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from quasiharmonic.util.arrays import FloatArray, as_offsets

Indices = NDArray[np.integer]
Codes = NDArray[np.int32]


class DissectionTuning(NamedTuple):
    """Numbers that tune the dissection."""

    # Approximate number of vertices in the smallest parts made by median planes.
    part: int = 256
    # Number of random vertices per smallest part, from which the medians are computed.
    samples: int = 8
    # Limit on the sum of the cubes of the separator sizes over n^(3/2), which is proportional to the work of a
    # factorisation. It is 2.2 to 3.4 for planar and gently curved meshes. At 8 (a scanned hand) a factorisation takes
    # twice as long as with METIS's ordering, and ten factorisations lose the time gained in ordering.
    max_work: float = 4.0


_TUNING = DissectionTuning()

# Within the smallest parts, cuts at equal distances are good enough: 2^BITS along each of the part's two longest sides.
BITS = 4


def nested_dissection(points: FloatArray, tail: Indices, head: Indices) -> NDArray[np.int64] | None:
    """Order the vertices of a mesh for elimination, (n,) int64; ``tail`` and ``head`` (e,) are the ends of its edges.

    The result is None if planes make poor cuts, because the surface is folded or the points coincide.
    """
    n = len(points)
    levels = max(0, int(np.ceil(np.log2(max(n / _TUNING.part, 1)))))
    part = _bisect(points, levels)
    code = (part << 2 * BITS) | _grid_cells(points, part, 1 << levels)
    rank = separators(code, levels, tail, head)
    if _factor_work(code, rank) > _TUNING.max_work * n**1.5:
        return None
    return np.argsort(_number_separators(code, rank), kind="stable")


def _bisect(points: FloatArray, levels: int) -> Codes:
    """Part of each point after ``levels`` bisections; the first cut is the highest bit."""
    n, d = points.shape
    sample = points[np.random.default_rng(0).integers(n, size=_TUNING.samples << levels)][None]
    flat, start = points.ravel(), np.arange(0, n * d, d, dtype=np.int32)
    part = np.zeros(n, dtype=np.int32)
    for _ in range(levels):
        # Process all parts together: they have the same number of sample points.
        half = sample.shape[1] // 2
        axis = np.argmax(np.ptp(sample, axis=1), axis=1)
        along = np.take_along_axis(sample, axis[:, None, None], axis=2)[:, :, 0]
        order = np.argpartition(along, half, axis=1)
        median = np.take_along_axis(along, order[:, half, None], axis=1)[:, 0]
        sample = np.take_along_axis(sample, order[:, :, None], axis=1).reshape(-1, half, d)
        part = 2 * part + (flat[start + axis.astype(np.int32)[part]] >= median[part])
    return part


def _grid_cells(points: FloatArray, part: Codes, parts: int) -> Codes:
    """Cell of each point in a grid over its part, with the bits of row and column interleaved (Morton order)."""
    n, d = points.shape
    order = np.argsort(part.astype(np.min_scalar_type(parts - 1)), kind="stable")  # radix sort for 16 bits or less
    count = np.bincount(part, minlength=parts)
    used = count > 0
    first = (np.cumsum(count) - count)[used]
    low, size = np.zeros((parts, d)), np.zeros((parts, d))
    low[used] = np.minimum.reduceat(points[order], as_offsets(first))
    size[used] = np.maximum.reduceat(points[order], as_offsets(first)) - low[used]
    axes = np.argsort(-size, axis=1, kind="stable")[:, :2]
    flat, start = points.ravel(), np.arange(0, n * d, d, dtype=np.int32)
    code = np.zeros(n, dtype=np.int32)
    for shift, axis in zip((1, 0), axes.T, strict=True):
        side = np.take_along_axis(size, axis[:, None], axis=1)[:, 0]
        scale = 2**BITS * (1 - 1e-9) / np.where(side > 0, side, 1)
        origin = np.take_along_axis(low, axis[:, None], axis=1)[:, 0]
        along = flat[start + axis.astype(np.int32)[part]] - origin[part]
        code |= _SPREAD[(along * scale[part]).astype(np.int32)] << shift
    return code


# Numbers below 2^BITS with a zero inserted between adjacent bits.
_SPREAD = np.array([sum((k >> b & 1) << 2 * b for b in range(BITS)) for k in range(2**BITS)], dtype=np.int32)


def separators(code: Codes, levels: int, tail: Indices, head: Indices) -> NDArray[np.uint8]:
    """Rank of the largest part whose halves each vertex separates; 0 if the vertex separates nothing.

    A part of rank k consists of all vertices whose codes differ only in the last k bits.
    """
    # Rank of the part whose cut an edge crosses: the position of the highest differing bit.
    rank_of_edge = np.frexp((code[tail] ^ code[head]).astype(np.float64))[1].astype(np.uint8)
    order = np.argsort(rank_of_edge, kind="stable")
    tail, head = tail[order], head[order]
    highest = levels + 2 * BITS
    first = np.append(0, np.cumsum(np.bincount(rank_of_edge, minlength=highest + 1)))
    rank = np.zeros(code.size, dtype=np.uint8)
    for k in range(highest, 0, -1):
        u, v = tail[first[k] : first[k + 1]], head[first[k] : first[k + 1]]
        # A vertex in the separator of a larger part separates this part, too.
        left = np.flatnonzero((rank[u] | rank[v]) == 0)
        u, v = u[left], v[left]
        swap = code[u] > code[v]
        u, v = np.where(swap, v, u), np.where(swap, u, v)
        for chosen in smallest_cover(u, v) if k > 2 * BITS else _smaller_sides(u, v, code >> k):
            rank[chosen] = k
    return rank


def _smaller_sides(u: Indices, v: Indices, part: Codes) -> tuple[Indices, Indices]:
    """Separators from the edges u-v that cross cuts: for each part, the ends on the side with fewer of them."""
    marked = np.zeros(part.size, dtype=bool)
    sides = []
    for ends in (u, v):
        marked[ends] = True
        sides.append(np.flatnonzero(marked))
        marked[ends] = False
    one, other = (np.bincount(part[side], minlength=int(part.max()) + 1) for side in sides)
    fewer = one <= other
    return sides[0][fewer[part[sides[0]]]], sides[1][~fewer[part[sides[1]]]]


def smallest_cover(u: Indices, v: Indices) -> tuple[Indices, Indices]:
    """Minimum vertex cover of the edges u-v; about a tenth smaller than the vertices of either side.

    By Kőnig's theorem it has as many vertices as a maximum matching has edges. Start at the unmatched u and alternate
    edges to v with matched edges back to u. The cover consists of every v reached and every u not reached.
    """
    from scipy.sparse import csr_array
    from scipy.sparse.csgraph import maximum_bipartite_matching

    (us, i), (vs, j) = np.unique(u, return_inverse=True), np.unique(v, return_inverse=True)
    # SciPy 1.11 accepts only 32-bit indices for matching.
    edges = csr_array((np.ones(i.size), (i.astype(np.int32), j.astype(np.int32))), shape=(us.size, vs.size))
    mate = maximum_bipartite_matching(edges, perm_type="row")  # of each v, -1 if unmatched
    reached_u, reached_v = np.ones(us.size, dtype=bool), np.zeros(vs.size, dtype=bool)
    reached_u[mate[mate >= 0]] = False
    new = reached_u.copy()
    while new.any():
        reached = j[new[i]]
        reached = reached[~reached_v[reached]]
        reached_v[reached] = True
        # Every v that is reached is matched; otherwise the matching would not be maximum.
        new[:] = False
        new[mate[reached]] = True
        new &= ~reached_u
        reached_u |= new
    return us[~reached_u], vs[reached_v]


def _factor_work(code: Codes, rank: NDArray[np.uint8]) -> float:
    """Sum of the cubes of the sizes of the separators and of the remaining parts."""
    _, size = np.unique(_number_separators(code, rank), return_counts=True)
    return float(np.sum(size.astype(np.float64) ** 3))


def _number_separators(code: Codes, rank: NDArray[np.uint8]) -> NDArray[np.int64]:
    """Number (n,) of each vertex's separator, in the order of elimination.

    A part of rank k, below 32, is a range of 2^k codes. Its separator follows the last code and the separators of its
    own parts.
    """
    end = ((code >> rank) + 1) << rank
    return end.astype(np.int64) << 5 | rank
