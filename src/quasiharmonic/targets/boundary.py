"""The boundary of a surface onto an outline: which loop to which contour, which vertex to which place."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from quasiharmonic.problem import Problem
from quasiharmonic.targets.chords import STRAIGHT, chords_of, flat_chords
from quasiharmonic.targets.contours import from_corner, nested, signed_area
from quasiharmonic.targets.correspondence import Held, arc, best_start, seen_flat, spread
from quasiharmonic.targets.holes import least_stretch, match_holes
from quasiharmonic.targets.pins import Corners, Pins
from quasiharmonic.targets.room import make_room

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]

# Starts that are tried, nearest to the best fit first, where chords have no room.
_MOST_STARTS = 256
# Ways around to turn a hole.
_TURNS = 48


def boundary_to(
    V: ArrayLike,
    F: ArrayLike,
    outline: Sequence[ArrayLike] | FloatArray,
    *,
    corners: Corners | None = None,
    corner_angle: float = 20.0,
) -> tuple[IntArray, FloatArray]:
    """Lay the whole boundary of a surface along an outline: ``injective_map(V, F, *boundary_to(V, F, outline))``.

    The boundary loop that encloses the largest area in space goes to the outer contour, the others to
    the holes that lie nearest to where they are when the surface, its holes filled, is laid into the
    outer contour. Along each contour vertices are spread by arc length; its corners get vertices of
    their own. The outer loop begins where it and its contour resemble each other most without being
    turned (see `arc_length`); holes are turned such that Tutte's embedding is stretched least. Among
    starts like these one is chosen that leaves room for chords, interior edges between two boundary
    vertices. Where none does, `flattened_edges` tells which edges to split.

    Parameters
    ----------
    V : (n, 2) or (n, 3) array
        Rest positions.
    F : (f, 3) array of int
        Triangles of one connected surface without handles.
    outline : list of (k, 2) float, or one (k, 2) float
        An outer contour and as many holes as the surface has further boundary loops, wound as they like.
    corners : sequence of int, or mapping from int, optional
        Boundary vertices that go to corners of the outline. In a sequence there is one for every corner
        of its contour, in order from the contour's first (an outline without corners has its first
        point). A mapping says for every vertex which corner, counted from 0, or which point (x, y) on
        the outline. The rest is spread between them, so that every run of the boundary keeps to its
        own side.
    corner_angle : float
        Degrees by which an outline turns at a corner, at the least. Lesser bends belong to a curve.

    Returns
    -------
    fixed : (b,) int64
        The boundary vertices, loop by loop in order.
    target : (b, 2) float64
        Their places.

    Raises
    ------
    ValueError
        As `Problem` for a malformed, closed or disconnected mesh; when the surface has a handle; when
        loops and contours differ in number, or the outline is in several pieces; when a contour has
        more corners than its loop has vertices; when a corner vertex is not on the boundary, its place
        not on the outline, or they follow each other in different orders.
    """
    # All vertices fixed, anywhere: this checks the mesh and nothing else.
    count = len(np.asarray(V))
    surface = Problem(V, F, np.arange(count), np.zeros((count, 2)), reference="equilateral")
    contours = nested([outline] if isinstance(outline, np.ndarray) and outline.ndim == 2 else list(outline))
    _check_fit(surface, contours)
    contours = [from_corner(c, corner_angle) for c in contours]
    loops = surface.loops
    space = _in_space(surface.V)
    pins = Pins(corners, loops, contours, corner_angle)
    to = dict(pins.contour_of)
    if 0 not in to.values():
        # Of the loops that may go anywhere the one around the largest area goes outside.
        free = [i for i in range(len(loops)) if i not in to]
        to[free[int(np.argmax([np.linalg.norm(_vector_area(space[loops[i]])) for i in free]))]] = 0
    outer = next(i for i, contour in to.items() if contour == 0)

    def course(i: int) -> _Course:
        chords = chords_of(loops[i], surface.edges.interior, count)
        return _Course(arc(space[loops[i]]), contours[to[i]], pins.along(i, to[i]), chords, loops[i], corner_angle)

    places = {outer: course(outer).fitted(seen_flat(space[loops[outer]], contours[0]))}
    if len(loops) > 1:
        to |= match_holes(surface, outer, places[outer], contours, to)
        places |= least_stretch(surface, places, {i: course(i).choices() for i in to if i != outer})
    return np.concatenate(loops), np.concatenate([places[i] for i in range(len(loops))])


def _check_fit(surface: Problem, contours: list[FloatArray]) -> None:
    """Raise unless the surface and what the contours enclose are of one topology."""
    loops, f = len(surface.loops), len(surface.F)
    euler = surface.n - len(surface.edges.interior) - len(surface.edges.boundary) + f
    handles = (2 - loops - euler) // 2
    if handles:
        raise ValueError(
            f"the surface has {'a handle' if handles == 1 else f'{handles} handles'} and fits into no outline: "
            "cut it open first (cut_open; qhm map --cut)"
        )
    pieces = sum(signed_area(c) > 0 for c in contours)
    if pieces > 1:
        raise ValueError(
            f"the outline is in {pieces} separate pieces, and a connected surface can fill only one: join them, "
            "or map a surface onto each"
        )
    if loops == len(contours):
        return
    holes = len(contours) - 1
    what = (
        f"the surface has {loops} boundary {'loop' if loops == 1 else 'loops'}, and the outline "
        f"{len(contours)} {'contour' if holes == 0 else 'contours'} "
        f"({'no hole' if holes == 0 else '1 hole' if holes == 1 else f'{holes} holes'})"
    )
    if loops == 1:
        raise ValueError(
            f"{what}: fill the outline's holes (quasiharmonic.targets.filled), or cut holes into the surface"
        )
    raise ValueError(
        f"{what}: choose an outline with {loops - 1} hole{'s' if loops > 2 else ''}, or close loops of the surface"
    )


@dataclass(frozen=True, eq=False)
class _Course:
    """One boundary loop and the contour that it goes to.

    Attributes
    ----------
    s : (n,) float64
        Where the vertices lie along the loop.
    contour : (k, 2) float64
    pins : list of (int, float)
        Vertices whose place along the contour is given.
    chords : (c, 2) int64
        Interior edges between vertices of the loop.
    names : (n,) int64
        The loop's vertices.
    corner_angle : float
        Degrees.
    """

    s: FloatArray
    contour: FloatArray
    pins: list[tuple[int, float]]
    chords: IntArray
    names: IntArray
    corner_angle: float

    def laid(self, start: int = 0) -> tuple[FloatArray, bool]:
        """Places, and whether chords have room; ``start`` goes to the contour's first point if nothing is given."""
        pins: Held = self.pins or [(start, 0.0)]
        places = self._spread(pins)
        if self._has_room(places):
            return places, True
        roomy = make_room(self.s, self.contour, pins, corner_angle=self.corner_angle, chords=self.chords)
        other = places if roomy is None else self._spread(roomy)
        return (other, True) if self._has_room(other) else (places, False)

    def _spread(self, pins: Held) -> FloatArray:
        return spread(self.s, self.contour, pins, corner_angle=self.corner_angle, names=self.names)

    def _has_room(self, places: FloatArray) -> bool:
        least = STRAIGHT * float(np.ptp(self.contour, axis=0).max())
        return next(flat_chords(self.chords, places, least), None) is None

    def fitted(self, flat: FloatArray) -> FloatArray:
        """Places from the start that fits best, or the nearest one that leaves chords room if there is any."""
        first = best_start(self.s, flat, self.contour)
        best, roomy = self.laid(first)
        away = np.minimum((self.s - self.s[first]) % 1.0, (self.s[first] - self.s) % 1.0)
        for start in np.argsort(away, kind="stable")[1 : 1 if self.pins else _MOST_STARTS]:
            if roomy:
                break
            places, roomy = self.laid(int(start))
            best = places if roomy else best
        return best

    def choices(self) -> list[FloatArray]:
        """Places from starts all around; only those that leave chords room if there are any."""
        if self.pins:
            return [self.laid()[0]]
        wanted = np.arange(_TURNS) / _TURNS
        starts = np.unique(np.searchsorted(self.s, wanted, side="right") - 1)
        found = [self.laid(int(start)) for start in starts]
        return [places for places, roomy in found if roomy] or [places for places, _ in found]


def _in_space(V: FloatArray) -> FloatArray:
    """Positions (n, 3) of about unit size around the origin, so that nothing made of them overflows."""
    V = np.column_stack([V, np.zeros(len(V))]) if V.shape[1] == 2 else V
    V = np.ldexp(V, -int(np.frexp(np.abs(V).max())[1]))
    return np.asarray(V - V.mean(axis=0))


def _vector_area(points: FloatArray) -> FloatArray:
    """Area that a closed curve in space encloses, as a vector normal to it; its shadow's area along any direction."""
    return np.asarray(np.cross(points, np.roll(points, -1, axis=0)).sum(axis=0) / 2)
