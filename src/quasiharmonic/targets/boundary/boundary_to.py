"""The boundary of a surface onto an outline: which loop to which contour, which vertex to which place."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from os import PathLike
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike

from quasiharmonic.geometry.exact.loops import judge_loops, listed
from quasiharmonic.io.adapters.accepts_mesh import accepts_mesh
from quasiharmonic.problem import Domain
from quasiharmonic.targets.boundary.chords import chords_of
from quasiharmonic.targets.boundary.corner_fit import pins_by_angle
from quasiharmonic.targets.boundary.correspondence import arc, seen_flat
from quasiharmonic.targets.boundary.holes import least_stretch, match_holes
from quasiharmonic.targets.boundary.pins import Corners, Pins
from quasiharmonic.targets.boundary.placement import Placement
from quasiharmonic.targets.boundary.turning import boundary_turning, in_space, outermost
from quasiharmonic.targets.outlines.contours import from_corner, in_unit
from quasiharmonic.targets.outlines.nesting import Arranged, arranged, filled
from quasiharmonic.targets.specification import outline as specified
from quasiharmonic.util.arrays import FloatArray, IntArray, kind_of


@accepts_mesh
def boundary_to(
    V: ArrayLike,
    F: ArrayLike,
    outline: Sequence[ArrayLike] | FloatArray | str | PathLike[str],
    *,
    corners: Corners | Literal["auto"] | None = None,
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
    V : (n, 2) or (n, 3) array, or a mesh in place of ``V`` and ``F``
        Rest positions.
    F : (f, 3) array of int
        Triangles of one connected surface without handles.
    outline : list of (k, 2) float, one (k, 2) float, or str or path
        An outer contour and as many holes as the surface has further boundary loops, wound as they like.
        None may cross or touch itself or another. Or the words for one, as `outline` takes them: ``"letter:R"``,
        ``"rect:2x1"``, ``"drawing.svg"``; its holes are filled for a surface that has none.
    corners : sequence of int, mapping from int, or "auto", optional
        Boundary vertices that go to corners of the outline. In a sequence there is one for every corner
        of its contour, in order from the contour's first (an outline without corners has its first
        point). A mapping says for every vertex which corner, counted from 0, or which point (x, y) on
        the outline. The rest is spread between them, so that every run of the boundary keeps to its
        own side. ``"auto"`` chooses by angle, on the loop and for the contour outside: see
        `boundary_corners`; convex corners go to convex ones, long sides to long ones.
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
        As `Problem` for a malformed, closed or disconnected mesh; as `nested` for contours that meet
        themselves or each other; when the surface has a handle; when loops and contours differ in
        number, or the outline is in several pieces; when a contour has more corners than its loop has
        vertices, or the boundary has so few that it would cross itself; when a corner vertex is not on
        the boundary, its place not on the outline, or they follow each other in different orders.
    """
    surface = Domain(V, F, [])
    count = surface.n
    # Numbers of corners are the user's, whichever way the outline runs: the first of them stays the first point.
    given = _contours(outline, surface)
    found = arranged(given)
    if not found:
        raise ValueError("the outline has no contour")
    _check_fit(surface, found)
    contours, exponent = in_unit([one.wound for one in found])
    contours = [from_corner(c, corner_angle, one.reversed) for c, one in zip(contours, found, strict=True)]
    loops = surface.loops
    space = in_space(surface.V)
    if isinstance(corners, str) and corners != "auto":
        raise ValueError(f'corners are boundary vertices or "auto", not {corners!r}')
    by_angle = isinstance(corners, str)
    pins = Pins(
        None if isinstance(corners, str) else corners,
        loops,
        contours,
        [one.reversed for one in found],
        corner_angle,
        exponent,
        count,
    )
    to = dict(pins.contour_of)
    if 0 not in to.values():
        # Of the loops that may go anywhere the one around the largest area goes outside.
        free = [i for i in range(len(loops)) if i not in to]
        to[free[outermost([loops[i] for i in free], space)]] = 0
    outer = next(i for i, contour in to.items() if contour == 0)
    flat = seen_flat(space[loops[outer]], contours[0])

    def placement(i: int) -> Placement:
        chords = chords_of(loops[i], surface.edges.interior, count)
        held = pins.along(i, to[i])
        if by_angle and i == outer:
            held = pins_by_angle(boundary_turning(surface.V, surface.F)[i], flat, contours[0], corner_angle)
        return Placement(arc(space[loops[i]]), contours[to[i]], held, chords, loops[i], corner_angle)

    places = {outer: placement(outer).fitted(flat)}
    if len(loops) > 1:
        to |= match_holes(surface, outer, places[outer], contours, to)
        places |= least_stretch(surface, places, {i: placement(i).choices() for i in to if i != outer})
    target = np.ldexp(np.concatenate([places[i] for i in range(len(loops))]), exponent)
    _check_simple(loops, target, count)
    return np.concatenate(loops), target


def _contours(outline: Sequence[ArrayLike] | FloatArray | str | PathLike[str], surface: Domain) -> list[ArrayLike]:
    """The contours that were given, or that the words for them mean."""
    if isinstance(outline, str | PathLike):
        meant = specified(outline)
        return list(filled(meant)) if len(surface.loops) == 1 else list(meant)
    if not isinstance(outline, Iterable):
        raise ValueError(f'outline must be contours (k, 2), or words as "letter:R", not {kind_of(outline)}')
    contours = list(outline)
    # Rows of two numbers are the points of one contour.
    return [contours] if contours and all(np.ndim(row) == 1 for row in contours) else contours


def _check_fit(surface: Domain, contours: list[Arranged]) -> None:
    """Raise unless the surface and what the contours enclose are of one topology."""
    loops, f = len(surface.loops), len(surface.F)
    euler = surface.n - len(surface.edges.interior) - len(surface.edges.boundary) + f
    handles = (2 - loops - euler) // 2
    if handles:
        raise ValueError(
            f"the surface has {'a handle' if handles == 1 else f'{handles} handles'} and fits into no outline: "
            "cut it open first (cut_open; --cut of qhm map and qhm flatten)"
        )
    pieces = [one.points[0].tolist() for one in contours if one.depth % 2 == 0]
    if len(pieces) > 1:
        where = listed([f"({x:g}, {y:g})" for x, y in pieces])
        raise ValueError(
            f"the outline is in {len(pieces)} separate pieces (beginning at {where}), and a connected surface can fill "
            "only one: join them, or map a surface onto each"
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


def _check_simple(loops: list[IntArray], target: FloatArray, n: int) -> None:
    """Raise when the target is no boundary of a region: too few vertices cut corners until they meet."""
    places = np.zeros((n, 2))
    places[np.concatenate(loops)] = target
    _, reasons = judge_loops(loops, places)
    if reasons:
        raise ValueError(
            f"the boundary placed along the outline crosses or touches itself: {reasons[0]}. Its vertices are too few "
            "for the shape, or unevenly spaced: split boundary edges (refine with boundary=True), choose other "
            "corners, or an outline with less detail"
        )
