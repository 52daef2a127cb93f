"""Boundary curves: assignment of boundary vertices to curves, and their order along the curves."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from numpy.typing import ArrayLike

from quasiharmonic.geometry.curves.curve import Curve
from quasiharmonic.util.arrays import (
    BoolArray,
    ComplexArray,
    FloatArray,
    IntArray,
    check_numbers,
    check_range,
    cyclic_pairs,
    describe,
    index_array,
    invert_indices,
    loop_arrays,
    names_of,
    reject,
    to_complex,
    vertex_names,
)


def check_corner_angle(angle: float) -> None:
    """Raise a ValueError unless the turning angle of corners is from 0 to 180 degrees."""
    check_numbers(corner_angle=angle)
    if not 0 <= angle <= 180:
        raise ValueError(f"corner_angle must be between 0 and 180 degrees, not {angle}")


class BoundaryCurves:
    """Curves along which boundary vertices slide: the argument ``slide=``.

    Vertices at corners are fixed. The others slide between the corners in their order. A vertex near its curve is first
    moved onto it. The vertex nearest to a corner is moved to the corner if it is within ``tolerance`` of it. A corner
    without such a vertex has no effect.

    Parameters
    ----------
    curves : sequence of Curve or (k, 2) float, or one of these
        Contours, or single sides; arrays are closed polygons.
    on : mapping from int to int, optional
        Index of the curve for some boundary vertices. Each other vertex is on the nearest curve. It is fixed if no
        curve is within ``tolerance``. If all vertices of a boundary loop are in ``fixed`` and none is in ``on``, the
        loop is on no curve, however near one is.
    fixed : sequence of int
        Boundary vertices that are fixed although they could slide.
    corner_angle : float
        Minimum turn of a curve at a corner, in degrees. The ends of an open curve are corners, too. A closed
        curve without corners has no fixed vertices, so all its vertices may slide around it.
    tolerance : float
        Maximum distance of a vertex from its curve, as a fraction of the larger side of all curves.

    Raises
    ------
    ValueError
        If there is no curve, a curve is not valid (see `Curve`), or a number is out of range.

    See Also
    --------
    polish : Takes the curves.
    morph : Takes the curves.
    geometry.curves.Curve : One curve.

    Examples
    --------
    Vertices on the boundary of a disk may slide around the circle. On a square, vertices slide along the sides:

    >>> round_ = BoundaryCurves([Curve.circle()])
    >>> square = BoundaryCurves([[(0, 0), (1, 0), (1, 1), (0, 1)]])
    """

    def __init__(
        self,
        curves: Iterable[Curve | ArrayLike] | Curve,
        *,
        on: Mapping[int, int] | None = None,
        fixed: ArrayLike = (),
        corner_angle: float = 20.0,
        tolerance: float = 1e-3,
    ) -> None:
        if isinstance(curves, Curve) or (isinstance(curves, np.ndarray) and curves.ndim == 2):
            curves = [curves]
        if not isinstance(curves, Iterable):
            raise ValueError(f"curves must be a Curve, a polygon (k, 2) or a list of those, not {describe(curves)}")
        self.curves = [curve if isinstance(curve, Curve) else Curve.polygon(curve) for curve in curves]
        if not self.curves:
            raise ValueError("there is no curve to slide along")
        on = {} if on is None else on
        if not isinstance(on, Mapping):
            raise ValueError(f"on must map vertices to curves, as in {{12: 0}}, not {describe(on)}")
        vertices, numbers = index_array("on", list(on)), index_array("on", list(on.values()))
        check_range("on", numbers, len(self.curves), "curve", "curves")
        self.on: dict[int, int] = dict(zip(vertices.tolist(), numbers.tolist(), strict=True))
        self.fixed = index_array("fixed", fixed).ravel()
        check_corner_angle(corner_angle)
        check_numbers(tolerance=tolerance)
        if not 0 <= tolerance < 1:
            raise ValueError(f"tolerance must be between 0 and 1, not {tolerance}")
        self.corner_angle, self.tolerance = float(corner_angle), float(tolerance)

    @classmethod
    def around(cls, loops: Sequence[IntArray], uv: FloatArray, *, fixed: ArrayLike = ()) -> BoundaryCurves:
        """Create the polygons of boundary loops in a map (n, 2), with each vertex assigned to its own polygon."""
        loops = loop_arrays(loops, len(uv))
        on = {int(v): k for k, loop in enumerate(loops) for v in loop}
        return cls([uv[loop] for loop in loops], on=on, fixed=fixed)

    def with_fixed_unless_on(self, vertices: IntArray) -> BoundaryCurves:
        """Return a copy with more fixed vertices, except those in ``on``."""
        return self._copy_with(
            self.on, np.union1d(self.fixed, np.setdiff1d(vertices, index_array("on", list(self.on))))
        )

    def with_fixed(self, vertices: IntArray) -> BoundaryCurves:
        """Return a copy with more fixed vertices, also those in ``on``."""
        return self._copy_with(self.on, np.union1d(self.fixed, vertices))

    def restrict(self, used: IntArray) -> BoundaryCurves:
        """Return a copy for a submesh with the given vertices, ascending."""
        known = np.concatenate([index_array("on", list(self.on)), self.fixed])
        absent = np.setdiff1d(known, used)
        reject(absent, "vertex", "vertices", "the boundary curves refer to {}, but no triangle uses them")
        on = {int(np.searchsorted(used, v)): k for v, k in self.on.items()}
        return self._copy_with(on, np.searchsorted(used, self.fixed))

    def _copy_with(self, on: Mapping[int, int], fixed: IntArray) -> BoundaryCurves:
        return BoundaryCurves(self.curves, on=on, fixed=fixed, corner_angle=self.corner_angle, tolerance=self.tolerance)

    def lay(self, loops: Sequence[IntArray], uv: FloatArray) -> Track:
        """Find the initial position of every boundary vertex.

        Parameters
        ----------
        loops : list of (l,) int64
            Boundary loops.
        uv : (n, 2) float64
            A map; only its boundary is used.

        Raises
        ------
        ValueError
            If a vertex in ``on`` is not on its curve or not on the boundary, or no vertex is on any curve. Also if two
            vertices have the same position, or neighbours on the boundary are not neighbours on the curve.
        """
        boundary, curve, s = self._assign_curves(loops, uv)
        corners = [self._corners(one, uv[boundary]) for one in self.curves]
        slides = ~np.isin(boundary, self.fixed)
        slides[[member for taken in corners for member in taken]] = False
        positions, chains = uv.copy(), []
        for k, (one, taken) in enumerate(zip(self.curves, corners, strict=True)):
            at_corners = np.array(list(taken), dtype=np.int64)
            members = np.union1d(np.flatnonzero(curve == k), at_corners)
            if not members.size:
                continue
            along = s.copy()
            along[at_corners] = list(taken.values())
            members = members[np.argsort(along[members], kind="stable")]
            chain = Chain(one, boundary[members], along[members], slides[members])
            _check_order(chain, k, loops, len(uv))
            is_moved = (slides[members] | np.isin(members, at_corners)) & ~np.isin(chain.vertices, self.fixed)
            _move_vertices(positions, chain.vertices[is_moved], one.position(chain.s[is_moved]))
            chains.append(chain)
        return Track(chains, positions)

    def find_off_curves(self, loops: Sequence[IntArray], uv: FloatArray) -> IntArray:
        """Return the boundary vertices on no curve, which are fixed; check the vertices in ``on`` as `lay` does."""
        boundary, curve, _ = self._assign_curves(loops, uv)
        return np.setdiff1d(np.concatenate(loops), boundary[curve >= 0])

    def _corners(self, one: Curve, positions: FloatArray) -> dict[int, float]:
        """Rows of the boundary positions (b, 2) that are at corners of a curve, with their lengths along it.

        Each corner gets the vertex nearest to it, on this curve or another. A vertex gets at most one corner.
        """
        marks = one.corners(self.corner_angle)
        found = []
        for mark, corner in zip(marks, one.position(marks), strict=True):
            distances = np.abs(to_complex(positions - corner))
            found.append((float(distances.min()), int(np.argmin(distances)), float(mark)))
        taken: dict[int, float] = {}
        for distance, member, mark in sorted(found):
            if distance <= self.tolerance * one.size:
                taken.setdefault(member, mark)
        return taken

    def _assign_curves(self, loops: Sequence[IntArray], uv: FloatArray) -> tuple[IntArray, IntArray, FloatArray]:
        """Boundary vertices, the index of the curve of each, -1 if there is none, and its length along the curve.

        Loops whose vertices are all fixed are left out, because a body close to a wall is not a part of the wall.
        """
        free = [loop for loop in loops if not np.isin(loop, self.fixed).all() or not self.on.keys().isdisjoint(loop)]
        boundary = np.concatenate(free or loops)
        assigned = index_array("on", list(self.on))
        check_range("on", assigned, len(uv))
        check_range("fixed", self.fixed, len(uv))
        inner = np.setdiff1d(assigned, boundary)
        reject(inner, "vertex", "vertices", "on assigns curves to interior {}: only boundary vertices can slide")
        only = np.array([self.on.get(int(v), -1) for v in boundary])
        allowed = self.tolerance * max(one.size for one in self.curves)
        curve, s, smallest = np.full(boundary.size, -1), np.zeros(boundary.size), np.full(boundary.size, np.inf)
        for k, one in enumerate(self.curves):
            candidates = np.flatnonzero((only < 0) | (only == k))
            where, distance = one.nearest(uv[boundary[candidates]])
            too_far = (distance > allowed) & (only[candidates] == k)
            if too_far.any():
                raise ValueError(
                    f"on assigns curve {k} to {vertex_names(boundary[candidates[too_far]])}, "
                    f"but the distance to it is "
                    f"up to {distance[too_far].max():.3g}, and at most {allowed:.3g} is allowed"
                )
            near = (distance <= allowed) & (distance < smallest[candidates])
            found = candidates[near]
            curve[found], s[found], smallest[found] = k, where[near], distance[near]
        if (curve < 0).all():
            raise ValueError(
                f"no boundary vertex is within {allowed:.3g} of the curves to slide along: check the scale and the "
                "position of the curves"
            )
        return boundary, curve, s


def sliding_curves(slide: bool | BoundaryCurves, loops: Sequence[IntArray], uv: FloatArray) -> BoundaryCurves:
    """Interpret the argument ``slide``: `BoundaryCurves`, or True for the polygons of the current boundary."""
    if isinstance(slide, BoundaryCurves):
        return slide
    if slide is True:
        return BoundaryCurves.around(loops, uv)
    raise ValueError(f"slide must be True or BoundaryCurves, not {describe(slide)}")


@dataclass(frozen=True, eq=False)
class Chain:
    """The vertices (k,) int64 on one curve, in order along it.

    ``s`` (k,) has their initial lengths along the curve, increasing. ``sliding`` (k,) bool tells which vertices may
    slide.
    """

    curve: Curve
    vertices: IntArray
    s: FloatArray
    sliding: BoolArray

    def all_lengths(self, s: FloatArray) -> FloatArray:
        """Lengths of all vertices along the curve, with the sliding ones at ``s``."""
        all_lengths = self.s.copy()
        all_lengths[self.sliding] = s
        return all_lengths

    def in_order(self, s: FloatArray) -> bool:
        """Whether the vertices are still in order with the sliding ones at ``s``."""
        all_lengths = self.all_lengths(s)
        backwards = np.diff(all_lengths) <= 0
        if not self.curve.closed:
            return not backwards.any()
        # Around a closed curve the lengths decrease exactly once.
        return int(backwards.sum()) + int(all_lengths[0] <= all_lengths[-1]) == 1


class Track:
    """All sliding vertices, with the geometry of all curves evaluated together.

    ``uv`` (n, 2) is the map with its boundary on the curves. ``vertices`` (k,) int64 are the sliding vertices, curve by
    curve. ``s`` (k,) float64 has their initial lengths along the curves.
    """

    def __init__(self, chains: Sequence[Chain], uv: FloatArray) -> None:
        self.uv = uv
        self.chains = list(chains)
        self._ends = np.cumsum([0, *(int(chain.sliding.sum()) for chain in chains)])
        self.vertices = np.concatenate([chain.vertices[chain.sliding] for chain in chains])
        self.s = np.concatenate([chain.s[chain.sliding] for chain in chains])

    def all_lengths(self, s: FloatArray) -> list[FloatArray]:
        """Lengths of all vertices of each chain, with the sliding ones at ``s``."""
        return [chain.all_lengths(s[part]) for chain, (_, part) in zip(self.chains, self._parts(), strict=True)]

    def position(self, s: FloatArray) -> FloatArray:
        """Positions of the sliding vertices; (k, 2) float64."""
        return np.concatenate([curve.position(s[part]) for curve, part in self._parts()])

    def frame(self, s: FloatArray, forward: BoolArray) -> tuple[ComplexArray, FloatArray]:
        """Tangents and curvatures as from `Curve.frame`; the tangent is 0 beyond the end of an open curve."""
        tangent, curvature = np.empty(s.size, dtype=np.complex128), np.empty(s.size)
        for curve, part in self._parts():
            tangent[part], curvature[part] = curve.frame(s[part], forward[part])
            tangent[part][curve.has_ended(s[part], forward[part])] = 0
        return tangent, curvature

    def advance(self, s: FloatArray, step: FloatArray, *, stop: bool = False) -> FloatArray:
        """Lengths after a step along the curves, as from `Curve.advance`."""
        return np.concatenate([curve.advance(s[part], step[part], stop=stop) for curve, part in self._parts()])

    def at_kink(self, s: FloatArray) -> BoolArray:
        """Whether each sliding vertex is at a kink or at the end of an open curve; (k,) bool."""
        return np.concatenate([np.isin(s[part], curve.stops) for curve, part in self._parts()])

    def in_order(self, s: FloatArray) -> bool:
        """Whether the vertices of every curve are in order at distinct positions."""
        return all(chain.in_order(s[part]) for chain, (_, part) in zip(self.chains, self._parts(), strict=True))

    def _parts(self) -> list[tuple[Curve, slice]]:
        spans = pairwise(self._ends.tolist())
        return [(chain.curve, slice(*span)) for chain, span in zip(self.chains, spans, strict=True)]


def _move_vertices(positions: FloatArray, vertices: IntArray, there: FloatArray) -> None:
    """Move vertices to their positions, except those that are there up to rounding."""
    # Relative to the largest coordinate: a vertex this close to its position on the curve is not moved.
    same_position = 2.0**-51
    off = np.abs(positions[vertices] - there) > same_position * np.abs(there).max(initial=0)
    is_moved = off.any(axis=1)
    positions[vertices[is_moved]] = there[is_moved]


def _check_order(chain: Chain, k: int, loops: Sequence[IntArray], n: int) -> None:
    """Raise if vertices coincide, or if neighbours along the boundary are not neighbours along the curve."""
    count = chain.vertices.size
    same = np.flatnonzero(np.diff(chain.s) <= 0)
    if same.size:
        pairs = np.stack([chain.vertices[same], chain.vertices[same + 1]], axis=1)
        named = names_of("vertices", "vertices", pairs)
        raise ValueError(f"boundary {named} have the same position on curve {k}: separate them")
    rank = invert_indices(n, chain.vertices)
    sides = np.concatenate([cyclic_pairs(loop) for loop in loops])
    here, there = rank[sides].T
    apart = np.abs(here - there)
    if chain.curve.closed:
        apart = np.minimum(apart, count - apart)
    wrong = sides[(here >= 0) & (there >= 0) & (apart > 1)]
    if len(wrong):
        raise ValueError(
            f"boundary {names_of('vertices', 'vertices', wrong)} are neighbours on the boundary but not along curve "
            f"{k}: correct their order, or, if curves are close together, assign vertices to curves "
            "(BoundaryCurves, on=)"
        )
