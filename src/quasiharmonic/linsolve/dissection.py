"""Nested dissection: an order of elimination from where the vertices lie.

Cut the vertices in two, give the vertices along the cut the last numbers, and do the same with either part: the factor
of a planar mesh's Laplacian then has O(n log n) entries (George 1973). Orderings differ in how the cut is found. A
general library knows only who is joined to whom and must search. Here the points are known, and in a flat or gently
curved mesh the median plane across the longest side of a part's bounding box is nearly as good a cut. 250,000
unknowns, MKL PARDISO on one core; here / METIS / minimum degree:

=====================  =======================  ===================  ===========================
mesh                   order and analyse, ms    factor, ms           entries of the factor, 10⁶
=====================  =======================  ===================  ===========================
regular, planar        245 / 811 / 158          130 / 180 / 236      12.0 / 12.4 / 15.2
irregular, planar      389 / 1498 / 852         161 / 175 / 304      11.1 / 9.4 / 11.2
the head of a cat      332 / 847 / 168          188 / 200 / 268      13.5 / 12.9 / 15.9
=====================  =======================  ===================  ===========================

Part of the gain in factoring is that unknowns which are eliminated together lie together in memory. Where a surface is
folded a plane cuts several of its sheets at once, and where triangles are long planes are not the short cuts: there
the search pays, and `nested_dissection` says so.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from quasiharmonic.util.arrays import FloatArray

IntArray = NDArray[np.integer]
Codes = NDArray[np.int32]

# Median planes are taken down to parts of about so many vertices ...
_PART = 256
# ... from so many random vertices for each of these parts. Within them, cuts at equal distances will do: 2^BITS along
# each of the part's two longest sides.
_SAMPLES = 8
BITS = 4
# Cubes of the sizes of separators, summed, over n^(3/2): proportional to the work of a factorisation. 2.2 to 3.4 in
# planar and gently curved meshes. At 8 (a scanned hand) a factorisation takes twice as long as with METIS's ordering,
# and ten of them lose what was gained.
_WORST = 4.0


def nested_dissection(points: FloatArray, tail: IntArray, head: IntArray) -> NDArray[np.int64] | None:
    """Order the vertices of a mesh for elimination.

    Parameters
    ----------
    points : (n, d) float64
        Positions of the vertices.
    tail, head : (e,) int
        The ends of the edges, each edge once.

    Returns
    -------
    (n,) int64 or None
        The vertices, first to be eliminated first. None when planes make poor cuts: the surface is folded, or the
        points coincide.
    """
    n = len(points)
    levels = max(0, int(np.ceil(np.log2(max(n / _PART, 1)))))
    part = _halves(points, levels)
    code = (part << 2 * BITS) | _cells(points, part, 1 << levels)
    rank = separators(code, levels, tail, head)
    if _work(code, rank) > _WORST * n**1.5:
        return None
    # A part of rank k is a run of 2^k codes. Its separator follows the last of them, and those of its own parts.
    end = ((code >> rank) + 1) << rank
    return np.argsort(end.astype(np.int64) << 5 | rank, kind="stable")


def _halves(points: FloatArray, levels: int) -> Codes:
    """The part of each point after halving ``levels`` times; the first cut is the highest bit."""
    n, d = points.shape
    sample = points[np.random.default_rng(0).integers(n, size=_SAMPLES << levels)][None]
    flat, start = points.ravel(), np.arange(0, n * d, d, dtype=np.int32)
    part = np.zeros(n, dtype=np.int32)
    for _ in range(levels):
        # All parts at once: they have equally many sample points.
        half = sample.shape[1] // 2
        axis = np.argmax(np.ptp(sample, axis=1), axis=1)
        along = np.take_along_axis(sample, axis[:, None, None], axis=2)[:, :, 0]
        order = np.argpartition(along, half, axis=1)
        median = np.take_along_axis(along, order[:, half, None], axis=1)[:, 0]
        sample = np.take_along_axis(sample, order[:, :, None], axis=1).reshape(-1, half, d)
        part = 2 * part + (flat[start + axis.astype(np.int32)[part]] >= median[part])
    return part


def _cells(points: FloatArray, part: Codes, parts: int) -> Codes:
    """The cell of each point in a grid over its part, the bits of row and column in turn (Morton order)."""
    n, d = points.shape
    order = np.argsort(part.astype(np.min_scalar_type(parts - 1)), kind="stable")  # radix sort, if 16 bits are enough
    count = np.bincount(part, minlength=parts)
    used = count > 0
    first = (np.cumsum(count) - count)[used]
    low, size = np.zeros((parts, d)), np.zeros((parts, d))
    low[used] = np.minimum.reduceat(points[order], first)
    size[used] = np.maximum.reduceat(points[order], first) - low[used]
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


# Numbers below 2^BITS with a zero between any two of their bits.
_SPREAD = np.array([sum((k >> b & 1) << 2 * b for b in range(BITS)) for k in range(2**BITS)], dtype=np.int32)


def separators(code: Codes, levels: int, tail: IntArray, head: IntArray) -> NDArray[np.uint8]:
    """Rank of the largest part that each vertex separates the halves of, 0 if none.

    A part of rank k is all vertices whose codes agree but for the last k bits.
    """
    # The rank of the part whose cut an edge crosses: the number of bits up to the first that differs.
    rank_of_edge = np.frexp((code[tail] ^ code[head]).astype(np.float64))[1].astype(np.uint8)
    order = np.argsort(rank_of_edge, kind="stable")
    tail, head = tail[order], head[order]
    highest = levels + 2 * BITS
    first = np.append(0, np.cumsum(np.bincount(rank_of_edge, minlength=highest + 1)))
    rank = np.zeros(code.size, dtype=np.uint8)
    for k in range(highest, 0, -1):
        u, v = tail[first[k] : first[k + 1]], head[first[k] : first[k + 1]]
        # A vertex in a larger part's separator separates here, too.
        left = np.flatnonzero((rank[u] | rank[v]) == 0)
        u, v = u[left], v[left]
        swap = code[u] > code[v]
        u, v = np.where(swap, v, u), np.where(swap, u, v)
        for chosen in smallest_cover(u, v) if k > 2 * BITS else _smaller_sides(u, v, code >> k):
            rank[chosen] = k
    return rank


def _smaller_sides(u: IntArray, v: IntArray, part: Codes) -> tuple[IntArray, IntArray]:
    """Ends of the edges u-v that cross cuts: of each part the one side's or the other's, whichever are fewer."""
    marked = np.zeros(part.size, dtype=bool)
    sides = []
    for ends in (u, v):
        marked[ends] = True
        sides.append(np.flatnonzero(marked))
        marked[ends] = False
    one, other = (np.bincount(part[side], minlength=int(part.max()) + 1) for side in sides)
    fewer = one <= other
    return sides[0][fewer[part[sides[0]]]], sides[1][~fewer[part[sides[1]]]]


def smallest_cover(u: IntArray, v: IntArray) -> tuple[IntArray, IntArray]:
    """The fewest vertices that are ends of all edges u-v: a tenth less than the vertices of either side.

    By Kőnig's theorem. A largest matching has as many edges. From the u that it leaves out follow edges to v, and back
    by the matching: the cover is every v that is reached and every u that is not.
    """
    from scipy.sparse import csr_array
    from scipy.sparse.csgraph import maximum_bipartite_matching

    (us, i), (vs, j) = np.unique(u, return_inverse=True), np.unique(v, return_inverse=True)
    # SciPy 1.11 matches by 32-bit indices only.
    edges = csr_array((np.ones(i.size), (i.astype(np.int32), j.astype(np.int32))), shape=(us.size, vs.size))
    mate = maximum_bipartite_matching(edges, perm_type="row")  # of each v, -1 if left out
    reached_u, reached_v = np.ones(us.size, dtype=bool), np.zeros(vs.size, dtype=bool)
    reached_u[mate[mate >= 0]] = False
    fresh = reached_u.copy()
    while fresh.any():
        met = j[fresh[i]]
        met = met[~reached_v[met]]
        reached_v[met] = True
        # Every v that is reached has a mate, or the matching could be larger.
        fresh[:] = False
        fresh[mate[met]] = True
        fresh &= ~reached_u
        reached_u |= fresh
    return us[~reached_u], vs[reached_v]


def _work(code: Codes, rank: NDArray[np.uint8]) -> float:
    """Sum of the cubes of the sizes of the separators, and of what is left between them."""
    end = ((code >> rank) + 1) << rank
    _, size = np.unique(end.astype(np.int64) << 5 | rank, return_counts=True)
    return float(np.sum(size.astype(np.float64) ** 3))
