"""Exact verdict on a map of a triangle mesh into the plane.

A map is *injective* here when every triangle is strictly positive, which is decided exactly on the
coordinates as stored. It is *bijective* onto its image when, in addition, no two points of the
surface share a place. That is read off the boundary alone:

    Let all triangles of a compact oriented surface be positive. Around a point of the plane that is
    on no edge's image, the boundary's image winds as often as the point has preimages: both are the
    degree of the map there [1]_. So the map is bijective if and only if the images of the boundary
    loops are simple and mutually disjoint and wind 0 or 1 times around every point off them.

    (*Only if*: a bijective map keeps loops simple and apart, and no point has two preimages. *If*:
    almost no point has two preimages. Two points of the surface at one place, of which one is
    interior, would have neighbourhoods whose images overlap in an open set, all of it covered twice;
    two boundary points at one place are excluded by the loops being simple and disjoint. For the
    same reason the triangles around an interior vertex wind around it once: where they wind twice,
    as positive triangles can, the points nearby are covered twice.)

Nothing in this asks how many components the surface has, nor its genus: a surface that cannot lie in
the plane fails the test. For loops that are simple and disjoint the winding numbers are a matter of
nesting: with none or two or four loops around it a loop must run counterclockwise, with one or three
clockwise. For a connected surface this leaves one counterclockwise loop around all others. Which of
its loops that is does not matter; an annulus turned inside out is as bijective as before.

References
----------
.. [1] Y. Lipman, Bijective mappings of meshes with boundary and the degree in mesh processing.
   SIAM Journal on Imaging Sciences 7 (2014).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from enum import StrEnum
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from quasiharmonic.mesh.topology import edges, named, trace_loops
from quasiharmonic.predicates import (
    SegmentRelation,
    box_pairs,
    orientation,
    orientation_or_nonfinite,
    segment_relation,
)

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]
SignArray = NDArray[np.int8]

# Triangles judged at a time: bounds the memory, and is large enough for the overhead not to show.
_TRIANGLE_CHUNK = 1 << 16
# Pairs of boundary edges listed at most; a collapsed boundary has billions.
_MOST_CROSSINGS = 1000
# Pairs of an edge and a point that the nesting test handles at a time.
_PAIR_CHUNK = 1 << 18


class Obstacle(StrEnum):
    """What keeps a map from being bijective."""

    NO_TRIANGLES = "no triangles"
    NOT_INJECTIVE = "not injective"
    NOT_A_SURFACE = "not a surface"
    NO_BOUNDARY = "no boundary"
    SELF_INTERSECTION = "self-intersection"
    INTERSECTION = "intersection"
    WINDING = "winding"
    NESTING = "nesting"
    OVERWOUND = "overwound"


@dataclass(frozen=True)
class Reason:
    """One reason why a map is not bijective.

    Attributes
    ----------
    kind : Obstacle
        What is wrong.
    text : str
        What is wrong and where, in words.
    loops : tuple of int
        The boundary loops concerned, as indices into `Certificate.loops`.
    """

    kind: Obstacle
    text: str
    loops: tuple[int, ...] = ()

    def __str__(self) -> str:
        return self.text


@dataclass(frozen=True, eq=False)
class Certificate:
    """What was decided exactly about a map; made by `certify`.

    Attributes
    ----------
    triangles : int
        Number of triangles judged.
    flipped, degenerate, nonfinite : (k,) int64
        Ascending indices of the triangles that are clockwise, that have exactly no area (a repeated
        vertex included), and that have a NaN or infinite coordinate and so no orientation.
    bijective : bool or None
        Whether the map is injective and covers no point twice; None when it was not asked for.
    reasons : tuple of Reason
        Why the map is not bijective. The loops are judged also where triangles are flipped.
    loops : tuple of (l,) int64
        Boundary vertices, loop by loop, the surface to the left.
    crossings : (m, 4) int64
        Rows ``i, j, k, l``: the boundary edges ``i → j`` and ``k → l`` share a point that they should
        not share. At most 1000 are listed.
    overwound : (k,) int64
        Interior vertices around which positive triangles wind more than once.
    """

    triangles: int
    flipped: IntArray
    degenerate: IntArray
    nonfinite: IntArray
    bijective: bool | None
    reasons: tuple[Reason, ...]
    loops: tuple[IntArray, ...]
    crossings: IntArray
    overwound: IntArray

    def __post_init__(self) -> None:
        for array in (self.flipped, self.degenerate, self.nonfinite, self.crossings, self.overwound, *self.loops):
            array.flags.writeable = False

    @property
    def injective(self) -> bool:
        """Whether there are triangles and every one is strictly positive."""
        return self.triangles > 0 and not (self.flipped.size or self.degenerate.size or self.nonfinite.size)

    def summary(self) -> str:
        """Say in a sentence or two what is certified, or what is wrong and where."""
        further = [r.text for r in self.reasons if r.kind is not Obstacle.NOT_INJECTIVE]
        if self.injective:
            all_of_them = "the only triangle is" if self.triangles == 1 else f"all {self.triangles} triangles are"
            said = f"Injective: {all_of_them} positive."
        elif self.triangles:
            counted = _counted(self.flipped, self.degenerate, self.nonfinite)
            said = f"Not injective: of {self.triangles} triangles, {counted}."
        else:
            return "Not injective: there are no triangles."
        if self.bijective:
            return f"{said} Bijective: the boundary does not meet itself, and no point is covered twice."
        if not further:
            return said
        more = f"; and {len(further) - 3} more" if len(further) > 3 else ""
        return f"{said} Not bijective{'' if self.injective else ' either'}: {'; '.join(further[:3])}{more}."

    def to_dict(self) -> dict[str, Any]:
        """Everything in plain Python types, fit for JSON; of a loop, its first vertex and its length."""
        return {
            "injective": self.injective,
            "bijective": self.bijective,
            "triangles": self.triangles,
            "flipped": self.flipped.tolist(),
            "degenerate": self.degenerate.tolist(),
            "nonfinite": self.nonfinite.tolist(),
            "reasons": [{"kind": r.kind.value, "text": r.text, "loops": list(r.loops)} for r in self.reasons],
            "loops": [{"start": int(loop[0]), "length": len(loop)} for loop in self.loops],
            "crossings": self.crossings.tolist(),
            "overwound": self.overwound.tolist(),
            "summary": self.summary(),
        }


def certify(F: ArrayLike, uv: ArrayLike, *, boundary: bool = True) -> Certificate:
    """Judge a map exactly, on its coordinates as stored.

    Parameters
    ----------
    F : (f, 3) int
        Triangles, any integer dtype.
    uv : (n, 2) float
        Place of every vertex, any dtype that double precision holds exactly. What a consumer in
        single precision would see is ``certify(F, uv.astype(np.float32))``. Vertices of no triangle
        are not looked at.
    boundary : bool
        Judge the boundary too, so that `Certificate.bijective` is known. All components count
        together: islands that overlap are not bijective.

    Returns
    -------
    Certificate
        Which triangles are not positive, and why the map is not bijective where it is not.

    Raises
    ------
    ValueError
        When ``F`` or ``uv`` has the wrong shape or dtype, or ``F`` names vertices that are not there.

    See Also
    --------
    is_injective, flipped_triangles : the triangles alone, as an inner loop wants them.

    Examples
    --------
    >>> F = [[0, 1, 2], [0, 2, 3]]
    >>> certify(F, [[0, 0], [1, 0], [1, 1], [0, 1]]).bijective
    True
    >>> print(certify(F, [[0, 0], [1, 0], [1, 1], [0.9, 0.5]]).summary())
    Not injective: of 2 triangles, 1 is flipped (1).
    """
    F, uv = _checked(F, uv)
    sign, nonfinite = _signs(F, uv)
    flipped = np.flatnonzero(sign < 0)
    degenerate = np.setdiff1d(np.flatnonzero(sign == 0), nonfinite, assume_unique=True)
    reasons: list[Reason] = []
    if not len(F):
        reasons.append(Reason(Obstacle.NO_TRIANGLES, "there are no triangles"))
    if np.any(sign <= 0):
        text = f"of {len(F)} triangles, {_counted(flipped, degenerate, nonfinite)}"
        reasons.append(Reason(Obstacle.NOT_INJECTIVE, text))
    loops: list[IntArray] = []
    crossings, overwound = np.empty((0, 4), dtype=np.int64), np.empty(0, dtype=np.int64)
    if boundary and len(F):
        loops, broken = _loops(F, len(uv))
        reasons += broken
        if not broken:
            overwound = _overwound(F, uv, sign, loops)
            if np.isfinite(uv[np.concatenate(loops)]).all():
                crossings, found = _judge_loops(loops, uv)
                reasons += found
        if overwound.size:
            text = f"triangles wind more than once around {named('vertex', 'vertices', overwound)}"
            reasons.append(Reason(Obstacle.OVERWOUND, text))
    return Certificate(
        triangles=len(F),
        flipped=flipped,
        degenerate=degenerate,
        nonfinite=nonfinite,
        bijective=not reasons if boundary else None,
        reasons=tuple(reasons),
        loops=tuple(loops),
        crossings=crossings,
        overwound=overwound,
    )


def is_injective(F: ArrayLike, uv: ArrayLike) -> bool:
    """Whether there are triangles and every one is strictly positive, decided exactly.

    The predicate to the locator `flipped_triangles`; parameters and errors as in `certify`.
    """
    F, uv = _checked(F, uv)
    return len(F) > 0 and bool(np.all(_signs(F, uv)[0] > 0))


def flipped_triangles(F: ArrayLike, uv: ArrayLike) -> IntArray:
    """Find the triangles that keep a map from being injective, exactly.

    Parameters and errors as in `certify`.

    Returns
    -------
    (k,) int64
        Ascending indices of *all* triangles that are not strictly positive: clockwise, without area
        or not finite. `certify` tells them apart.
    """
    return np.flatnonzero(_signs(*_checked(F, uv))[0] <= 0)


def _checked(F: ArrayLike, uv: ArrayLike) -> tuple[IntArray, FloatArray]:
    """Triangles as int64 and places as float64, or a ValueError that says what is wrong with them."""
    triangles, places = np.asarray(F), np.asarray(uv)
    if triangles.ndim != 2 or triangles.shape[1] != 3:
        raise ValueError(f"F has shape {triangles.shape}, expected (f, 3)")
    if triangles.dtype.kind not in "iu":
        raise ValueError(f"F has dtype {triangles.dtype}, expected integers")
    if places.ndim != 2 or places.shape[1] != 2:
        raise ValueError(f"uv has shape {places.shape}, expected (n, 2)")
    if places.dtype.kind not in "fiu":
        raise ValueError(f"uv has dtype {places.dtype}, expected floating-point numbers")
    n = len(places)
    if triangles.size and (triangles.min() < 0 or triangles.max() >= n):
        bad = np.flatnonzero(((triangles < 0) | (triangles >= n)).any(axis=1))
        raise ValueError(f"F refers to vertices outside 0 … {n - 1} in {named('triangle', 'triangles', bad)}")
    with np.errstate(over="ignore"):
        doubles = places.astype(np.float64)
    # Of the numeric types, wide integers and extended precision have values that double has not.
    rounded = np.zeros(places.shape, dtype=bool)
    if places.dtype.kind != "f":
        rounded = np.abs(doubles) >= 2.0**53
    elif places.dtype.itemsize > 8:
        rounded = (doubles != places) & ~np.isnan(doubles)
    rows = np.flatnonzero(rounded.any(axis=1))
    if rows.size:
        raise ValueError(f"uv does not fit double precision at {named('vertex', 'vertices', rows)}")
    return triangles.astype(np.int64, copy=False), doubles


def _signs(F: IntArray, uv: FloatArray) -> tuple[SignArray, IntArray]:
    """Orientation of every triangle, (f,), and the indices of those with a NaN or infinite coordinate."""
    sign = np.empty(len(F), dtype=np.int8)
    nonfinite = [np.empty(0, dtype=np.int64)]
    for start in range(0, len(F), _TRIANGLE_CHUNK):
        chunk = slice(start, start + _TRIANGLE_CHUNK)
        corners = uv.take(F[chunk], axis=0)
        sign[chunk], undefined = orientation_or_nonfinite(corners[:, 0], corners[:, 1], corners[:, 2])
        nonfinite.append(undefined + start)
    return sign, np.concatenate(nonfinite)


def _counted(flipped: IntArray, degenerate: IntArray, nonfinite: IntArray) -> str:
    """Count and name the triangles that are not positive, by what is wrong with them."""
    return ", ".join(
        f"{bad.size} {'is' if bad.size == 1 else 'are'} {what} ({_first(bad.tolist())})"
        for bad, what in ((flipped, "flipped"), (degenerate, "degenerate"), (nonfinite, "not finite"))
        if bad.size
    )


def _first(items: Sequence[object], most: int = 5) -> str:
    """The first few of some items, in words."""
    return ", ".join(str(item) for item in items[:most]) + (", …" if len(items) > most else "")


def _loops(F: IntArray, n: int) -> tuple[list[IntArray], list[Reason]]:
    """Boundary loops, or why there are none to be judged."""
    repeated = np.flatnonzero((F[:, (1, 2, 0)] == F).any(axis=1))
    parts = edges(F, n)
    wrong = (
        (repeated.tolist(), "triangles repeat a vertex"),
        (_dashed(parts.nonmanifold), "edges are in three or more triangles"),
        (_dashed(parts.inconsistent), "edges are traversed twice in the same direction"),
    )
    broken = [f"{what} ({_first(found)})" for found, what in wrong if found]
    if not broken:
        try:
            loops = trace_loops(parts.boundary)
        except ValueError as error:
            broken = [str(error)]
    if broken:
        return [], [Reason(Obstacle.NOT_A_SURFACE, f"the mesh is not a surface: {text}") for text in broken]
    if not loops:
        return [], [Reason(Obstacle.NO_BOUNDARY, "the surface has no boundary")]
    return loops, []


def _dashed(pairs: IntArray) -> list[str]:
    return [f"{i}–{j}" for i, j in pairs.tolist()]


def _overwound(F: IntArray, uv: FloatArray, sign: SignArray, loops: list[IntArray]) -> IntArray:
    """Interior vertices, all triangles around them positive, around which these wind more than once.

    Positive triangles turn counterclockwise around their vertex by less than half a turn each, so one
    of them passes the direction of the x axis exactly if its next corner lies below the vertex and
    its last does not; as many do as there are turns.
    """
    y = uv[:, 1]
    turns = np.zeros(len(uv), dtype=np.int64)
    for corner, following, last in ((0, 1, 2), (1, 2, 0), (2, 0, 1)):
        level = y[F[:, corner]]
        passing = (y[F[:, following]] < level) & (y[F[:, last]] >= level)
        turns += np.bincount(F[passing, corner], minlength=len(uv))
    turns[F[sign <= 0]] = 0
    turns[np.concatenate(loops)] = 0
    return np.flatnonzero(turns > 1)


@dataclass(frozen=True)
class _Curves:
    """Boundary loops as one array of edges, loop after loop."""

    start: IntArray
    """(l + 1,) Where each loop's edges start."""
    owner: IntArray
    """(k,) The loop of each edge."""
    ends: IntArray
    """(k, 2) Vertices of each edge."""
    p: FloatArray
    """(k, 2) Places of the first vertices."""
    q: FloatArray
    """(k, 2) Places of the second vertices."""

    @classmethod
    def of(cls, loops: list[IntArray], uv: FloatArray) -> _Curves:
        length = np.array([len(loop) for loop in loops])
        start = np.concatenate([[0], np.cumsum(length)])
        tail = np.concatenate(loops)
        following = np.arange(1, len(tail) + 1)
        following[start[1:] - 1] = start[:-1]
        head = tail[following]
        return cls(start, np.repeat(np.arange(len(loops)), length), np.stack([tail, head], 1), uv[tail], uv[head])


def _judge_loops(loops: list[IntArray], uv: FloatArray) -> tuple[IntArray, list[Reason]]:
    """Edges that meet where they should not (m, 4), and what is wrong with the loops."""
    curves = _Curves.of(loops, uv)
    pairs = _meeting_edges(curves)
    if not len(pairs):
        # Only loops that are simple and apart have an inside to speak of.
        return np.empty((0, 4), dtype=np.int64), _misplaced(curves)
    crossings = curves.ends[pairs].reshape(-1, 4)
    owners = curves.owner[pairs]
    reasons = []
    for i, j in np.unique(owners, axis=0).tolist():
        met = crossings[(owners == (i, j)).all(axis=1)]
        where = _first([f"{a}→{b} with {c}→{d}" for a, b, c, d in met.tolist()], 3)
        if i == j:
            reasons.append(Reason(Obstacle.SELF_INTERSECTION, f"boundary loop {i} meets itself ({where})", (i,)))
        else:
            reasons.append(Reason(Obstacle.INTERSECTION, f"boundary loops {i} and {j} meet ({where})", (i, j)))
    return crossings, reasons


def _meeting_edges(curves: _Curves) -> IntArray:
    """Pairs of edges (m, 2) that share more than the vertex they have in common, if any; sorted."""
    p, q, tail, head = curves.p, curves.q, curves.ends[:, 0], curves.ends[:, 1]
    point = (p == q).all(axis=1)
    found = [np.empty((0, 2), dtype=np.int64)]
    number = 0
    for i, j in box_pairs(np.minimum(p, q), np.maximum(p, q)):
        relation = segment_relation(p.take(i, 0), q.take(i, 0), p.take(j, 0), q.take(j, 0))
        adjacent = (head[i] == tail[j]) | (head[j] == tail[i])
        # Next to each other on the loop, edges may touch: at their common vertex, and nowhere else
        # unless they overlap or one of them has no length.
        folded = (relation == SegmentRelation.OVERLAPPING) | point[i] | point[j]
        meet = np.where(adjacent, folded, relation != SegmentRelation.DISJOINT)
        found.append(np.stack([i[meet], j[meet]], axis=1))
        number += len(found[-1])
        if number >= _MOST_CROSSINGS:
            break
    pairs = np.concatenate(found)[:_MOST_CROSSINGS]
    return pairs[np.lexsort(pairs.T[::-1])]


def _misplaced(curves: _Curves) -> list[Reason]:
    """Loops, all of them simple and apart, that do not bound a region covered once."""
    p, q, start = curves.p, curves.q, curves.start
    # At the lexicographically first vertex of a simple loop the turn is strict and has the loop's sense.
    lowest = np.lexsort((p[:, 1], p[:, 0], curves.owner))[start[:-1]]
    before = np.where(lowest == start[:-1], start[1:], lowest) - 1
    sense = orientation(p[before], p[lowest], q[lowest])
    around, inner = _containing(curves, p[lowest])
    covered = np.bincount(inner, weights=sense[around], minlength=len(sense)).astype(np.int64)
    fits = ((covered == 0) & (sense > 0)) | ((covered == 1) & (sense < 0))
    reasons = []
    for loop in np.flatnonzero(~fits).tolist():
        outside = around[inner == loop].tolist()
        runs = f"boundary loop {loop} runs {'counterclockwise' if sense[loop] > 0 else 'clockwise'}"
        if outside:
            text = f"{runs} inside {_first(outside)}: what it encloses is covered {covered[loop] + sense[loop]} times"
            reasons.append(Reason(Obstacle.NESTING, text, (loop, *outside)))
        else:
            reasons.append(Reason(Obstacle.WINDING, f"{runs} and no other loop is around it", (loop,)))
    return reasons


def _containing(curves: _Curves, anchor: FloatArray) -> tuple[IntArray, IntArray]:
    """Pairs of loops, the first around the second; ``anchor`` (l, 2) has a vertex of each loop.

    A loop is around a point that is not on it if a ray from the point, here to the right, crosses it
    in one sense more often than in the other.
    """
    p, q = curves.p, curves.q
    by_level = np.argsort(anchor[:, 1])
    # The edges that the line through an anchor crosses: one end above it, the other not.
    first = np.searchsorted(anchor[by_level, 1], np.minimum(p[:, 1], q[:, 1]))
    count = np.searchsorted(anchor[by_level, 1], np.maximum(p[:, 1], q[:, 1])) - first
    until = np.cumsum(count)
    number = len(anchor)
    turns: dict[int, int] = {}
    begin = 0
    while begin < len(p):
        done = until[begin - 1] if begin else 0
        end = max(int(np.searchsorted(until, done + _PAIR_CHUNK, side="right")), begin + 1)
        edge = np.repeat(np.arange(begin, end), count[begin:end])
        point = by_level[first[edge] + np.arange(edge.size) - (until[edge] - count[edge] - done)]
        relevant = (curves.owner[edge] != point) & (np.maximum(p[edge, 0], q[edge, 0]) > anchor[point, 0])
        edge, point = edge[relevant], point[relevant]
        downward = p[edge, 1] > q[edge, 1]
        # To the right of the point, an upward edge has it on its left and a downward one on its right.
        passing = (orientation(p[edge], q[edge], anchor[point]) < 0) == downward
        key, at = np.unique(curves.owner[edge[passing]] * number + point[passing], return_inverse=True)
        sums = np.bincount(at, weights=1 - 2 * downward[passing], minlength=len(key))
        for pair, turn in zip(key.tolist(), sums.tolist(), strict=True):
            turns[pair] = turns.get(pair, 0) + int(turn)
        begin = end
    around, inner = np.divmod(np.array([pair for pair, turn in turns.items() if turn], dtype=np.int64), number)
    return around, inner
