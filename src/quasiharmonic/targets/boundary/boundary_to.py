"""Target positions on an outline for the whole boundary of a surface, and mapping problems with such targets.

`boundary_to` matches boundary loops to contours, and vertices to positions on them. The holes of a surface are matched
to those of the outline, and their rotation is chosen.

`fit_boundary` and `fix_in_place` make the mapping problem of an island, with its boundary on an outline or in place.
Each of several islands is mapped onto its own copy of the outline, and the copies lie in a row.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from os import PathLike
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

from quasiharmonic.geometry.curves.boundary_curves import check_corner_angle
from quasiharmonic.geometry.exact.loops import check_loops, join_items
from quasiharmonic.geometry.mesh.reference import Reference
from quasiharmonic.geometry.mesh.splitting import make_fans
from quasiharmonic.geometry.mesh.topology import boundary_edges, boundary_loops
from quasiharmonic.io.accepts_mesh import accepts_mesh
from quasiharmonic.io.seamed_mesh import Island
from quasiharmonic.linsolve.laplacian import Laplacian
from quasiharmonic.problem import Domain, Problem
from quasiharmonic.targets.boundary.corner_pins import Corners, CornerSpec, Pins, pins_by_angle
from quasiharmonic.targets.boundary.correspondence import arc_parameters, project_loop
from quasiharmonic.targets.boundary.placement import CornerPlacement, chords_of
from quasiharmonic.targets.boundary.turning import boundary_turning, find_outermost, in_space
from quasiharmonic.targets.outlines.contours import NestedContour, arrange, filled, from_corner, in_unit
from quasiharmonic.targets.outlines.contours import corners as corners_of
from quasiharmonic.targets.specification import outline as specified
from quasiharmonic.util.arrays import ComplexArray, FloatArray, IntArray, count_of, describe, names_of, to_complex

# Default minimum angle, in degrees, by which an outline turns at a corner.
DEFAULT_CORNER_ANGLE = 20.0
# Gap between copies of an outline, relative to the outline's width.
_GAP = 0.05


def match_holes(
    surface: Domain, outer: int, positions: FloatArray, contours: list[FloatArray], to: Mapping[int, int]
) -> dict[int, int]:
    """Assign a nearby contour to every loop that has none in ``to``, which has ``outer``; return these only.

    The surface, its holes filled, is mapped into the outer contour by Tutte's embedding with the outer loop at
    ``positions`` (l, 2). The assignment minimises the sum of squared distances between the centres of its holes and
    those of the contours. The positions of ``surface`` are not used.
    """
    from scipy.optimize import linear_sum_assignment

    loops = [i for i in range(len(surface.loops)) if i not in to]
    holes = [c for c in range(len(contours)) if c not in to.values()]
    if len(loops) < 2:
        return dict(zip(loops, holes, strict=True))
    middles = _middles(surface, outer, positions)
    centres = np.array([_centroid(contours[c]) for c in holes])
    rows, columns = linear_sum_assignment(np.abs(middles[loops, None] - centres) ** 2)
    return {loops[i]: holes[c] for i, c in zip(rows, columns, strict=True)}


def choose_least_stretch(
    surface: Domain, given: Mapping[int, FloatArray], choices: Mapping[int, list[FloatArray]]
) -> dict[int, FloatArray]:
    """Choose positions of loops for which Tutte's embedding has the least Dirichlet energy.

    ``given`` has the positions of some loops, ``choices`` the possible positions of every other one. A hole that is
    rotated against the surrounding surface twists the embedding, which increases the energy. The energy is a quadratic
    form in the boundary's positions. Its part linear in one loop's positions, with the other loops given or shrunk to
    points, needs one solve for all choices. It selects the few most promising choices, for which the whole form is
    computed. Then each loop in turn takes its best choice until none changes.
    """
    # Number of choices per loop for which the full energy is computed.
    candidates = 8
    loops = surface.loops
    if all(len(positions) == 1 for positions in choices.values()):
        return {i: positions[0] for i, positions in choices.items()}
    pattern = Laplacian(surface.F, surface.n, np.concatenate(loops))
    # Weights of equilateral triangles, up to a factor.
    laplacian = pattern.factor(np.full((3, len(surface.F)), -1.0))

    def forces(positions: Mapping[int, ComplexArray]) -> ComplexArray:
        w = np.zeros(surface.n, dtype=np.complex128)
        for i, points in positions.items():
            w[loops[i]] = points
        return laplacian.flux(laplacian.extend(w))

    def work(i: int, offsets: list[ComplexArray], force: ComplexArray) -> FloatArray:
        return np.array([np.vdot(offset, force[loops[i]]).real for offset in offsets])

    of_given = {i: to_complex(positions) for i, positions in given.items()}
    offsets = {}
    for i, positions in choices.items():
        turned = [to_complex(points) for points in positions]
        of_given[i] = np.full(len(loops[i]), np.mean([points.mean() for points in turned]))
        offsets[i] = [points - of_given[i] for points in turned]
    pull = forces(of_given)
    kept, answers, own = {}, {}, {}
    for i in choices:
        linear = 2 * work(i, offsets[i], pull)
        kept[i] = np.argsort(linear, kind="stable")[:candidates]
        offsets[i] = [offsets[i][k] for k in kept[i]]
        answers[i] = [forces({i: offset}) for offset in offsets[i]]
        # The quadratic part of each choice by itself.
        alone = [work(i, [offset], answer)[0] for offset, answer in zip(offsets[i], answers[i], strict=True)]
        own[i] = linear[kept[i]] + alone
    taken = {i: int(np.argmin(own[i])) for i in choices}
    # The descent ends after finitely many combinations, but rounding could make it cycle.
    for _ in range(100):
        before = dict(taken)
        for i in choices:
            others = sum((answers[j][k] for j, k in taken.items() if j != i), np.zeros(surface.n, dtype=np.complex128))
            taken[i] = int(np.argmin(own[i] + 2 * work(i, offsets[i], others)))
        if taken == before:
            break
    return {i: choices[i][kept[i][k]] for i, k in taken.items()}


def _middles(surface: Domain, outer: int, positions: FloatArray) -> ComplexArray:
    """Positions of the centres of the holes, each filled by a fan; one complex number for every loop."""
    holes = [loop for i, loop in enumerate(surface.loops) if i != outer]
    F, n = np.concatenate([surface.F, make_fans(holes, surface.n)]), surface.n + len(holes)
    laplacian = Laplacian(F, n, surface.loops[outer]).factor(np.full((3, len(F)), -1.0))
    w = np.zeros(n, dtype=np.complex128)
    w[surface.loops[outer]] = to_complex(positions)
    # The outer loop has no centre.
    return np.insert(laplacian.extend(w)[surface.n :], outer, np.nan)


def _centroid(contour: FloatArray) -> complex:
    """Centroid of the area inside a contour."""
    w = to_complex(contour - contour[0])
    following = np.roll(w, -1)
    cross = (w.conj() * following).imag
    return complex(*contour[0]) + complex((cross * (w + following)).sum() / (3 * cross.sum()))


@accepts_mesh
def boundary_to(
    V: ArrayLike,
    F: ArrayLike,
    outline: Sequence[ArrayLike] | FloatArray | str | PathLike[str],
    *,
    corners: Corners | Literal["auto"] | None = None,
    corner_angle: float = DEFAULT_CORNER_ANGLE,
) -> tuple[IntArray, FloatArray]:
    """Place the whole boundary of a surface on an outline: ``injective_map(V, F, *boundary_to(V, F, outline))``.

    ``corners`` can assign a loop to a contour. If they assign none to the outer contour, it gets the loop that encloses
    the largest area in space; loops with another contour are not considered. To match the remaining loops to holes, the
    surface with filled holes is embedded in the outer contour. Each of these loops then goes to a hole near its
    position there. Along each contour, vertices are spread by arc length, and each corner of the contour gets a vertex.

    The outer loop starts where it resembles its contour most without rotation (see `arc_length`). Holes are rotated so
    that Tutte's embedding has the least stretch. Among these starts, one is chosen that leaves space for chords,
    interior edges between two boundary vertices. If no start leaves space for all chords, `flattened_edges` lists the
    edges to split.

    Parameters
    ----------
    V : (n, 2) or (n, 3) array, or a mesh in place of ``V`` and ``F``
        Rest positions.
    F : (f, 3) array of int
        Triangles of one connected surface without handles.
    outline : list of (k, 2) float, one (k, 2) float, or str or path
        An outer contour, and one hole for each further boundary loop of the surface, in either orientation. Contours
        must not cross or touch themselves or each other. A string or path specifies an outline as in `outline`:
        ``"letter:R"``, ``"rect:2x1"``, ``"drawing.svg"``. Its holes are then filled if the surface has only one
        boundary loop.
    corners : sequence of int, mapping from int, or "auto", optional
        Boundary vertices that go to corners of the outline. A sequence has one vertex for every corner of its contour,
        in order from the contour's first corner. An outline without corners uses its first point instead. A mapping
        gives for each vertex the corner's number, counted from 0, or a point (x, y) on the outline. The other vertices
        are spread between them, so each part of the boundary stays on its side. ``"auto"`` chooses corners of the outer
        loop by angle (see `boundary_corners`); convex corners go to convex ones, long sides to long ones.
    corner_angle : float
        Minimum angle in degrees by which an outline turns at a corner. Smaller bends belong to a curve.

    Returns
    -------
    fixed : (b,) int64
        The boundary vertices, loop by loop in order.
    target : (b, 2) float64
        Their target positions.

    Raises
    ------
    ValueError
        - As `Problem` for a malformed, closed or disconnected mesh.
        - As `nested` for contours that meet themselves or each other.
        - When the surface has a handle, the numbers of loops and contours differ, or the outline has several pieces.
        - When a contour has more corners than its loop has vertices, or the loop has so few vertices that the boundary
          would cross itself.
        - When a corner vertex is not on the boundary, its target is not on the outline, or vertices and targets follow
          each other in different orders.
    """
    check_corner_angle(corner_angle)
    surface = Domain(V, F, [])
    count = surface.n
    # Corner numbers refer to the user's outline in its own orientation, so its first corner stays the first.
    given = _contours(outline, surface)
    found = arrange(given)
    if not found:
        raise ValueError("the outline has no contour")
    _check_fit(surface, found)
    contours, exponent = in_unit([one.oriented for one in found])
    contours = [from_corner(c, corner_angle, one.reversed) for c, one in zip(contours, found, strict=True)]
    loops = surface.loops
    space = in_space(surface.V)
    if isinstance(corners, str) and corners != "auto":
        raise ValueError(f'corners are boundary vertices or "auto", not {corners!r}')
    by_angle, listed = isinstance(corners, str), None if isinstance(corners, str) else corners
    pins = Pins(listed, loops, contours, [one.reversed for one in found], corner_angle, exponent, count)
    to = dict(pins.contour_of)
    if 0 not in to.values():
        # Of the loops without a given contour, the one that encloses the largest area goes to the outer contour.
        free = [i for i in range(len(loops)) if i not in to]
        to[free[find_outermost([loops[i] for i in free], space)]] = 0
    outer = next(i for i, contour in to.items() if contour == 0)
    flat = project_loop(space[loops[outer]], contours[0])

    def placement(i: int) -> CornerPlacement:
        chords = chords_of(loops[i], surface.edges.interior, count)
        given_pins = pins.along(i, to[i])
        if by_angle and i == outer:
            given_pins = pins_by_angle(boundary_turning(surface.V, surface.F)[i], flat, contours[0], corner_angle)
        return CornerPlacement(
            arc_parameters(space[loops[i]]), contours[to[i]], given_pins, chords, loops[i], corner_angle
        )

    positions = {outer: placement(outer).fit(flat)}
    if len(loops) > 1:
        to |= match_holes(surface, outer, positions[outer], contours, to)
        positions |= choose_least_stretch(surface, positions, {i: placement(i).choices() for i in to if i != outer})
    target = np.ldexp(np.concatenate([positions[i] for i in range(len(loops))]), exponent)
    _check_simple(loops, target, count)
    return np.concatenate(loops), target


def _contours(outline: Sequence[ArrayLike] | FloatArray | str | PathLike[str], surface: Domain) -> list[ArrayLike]:
    """The given contours, or those that the specification describes."""
    if isinstance(outline, str | PathLike):
        described = list[ArrayLike](specified(outline))
        return list(filled(described)) if len(surface.loops) == 1 < len(described) else described
    if not isinstance(outline, Iterable):
        raise ValueError(f'outline must be contours (k, 2), or words as "letter:R", not {describe(outline)}')
    contours = list(outline)
    # A list of pairs of numbers is a single contour.
    return [contours] if contours and all(np.ndim(row) == 1 for row in contours) else contours


def _check_fit(surface: Domain, contours: list[NestedContour]) -> None:
    """Raise unless the surface and the region inside the contours have the same topology."""
    loops, handles = len(surface.loops), surface.handles
    if handles:
        raise ValueError(
            f"the surface has {'a handle' if handles == 1 else f'{handles} handles'} and fits into no outline: "
            "cut it open first (cut_open; --cut of qhm map and qhm flatten)"
        )
    pieces = [one.points[0].tolist() for one in contours if one.depth % 2 == 0]
    if len(pieces) > 1:
        where = join_items([f"({x:g}, {y:g})" for x, y in pieces])
        raise ValueError(
            f"the outline is in {len(pieces)} separate pieces (beginning at {where}), and a connected surface can fill "
            "only one: join them, or map a surface onto each"
        )
    if loops == len(contours):
        return
    holes = len(contours) - 1
    what = (
        f"the surface has {count_of('boundary loop', 'boundary loops', loops)}, and the outline "
        f"{count_of('contour', 'contours', holes + 1)} ({count_of('hole', 'holes', holes) if holes else 'no hole'})"
    )
    if loops == 1:
        raise ValueError(
            f"{what}: fill the outline's holes (quasiharmonic.targets.filled), or cut holes into the surface"
        )
    raise ValueError(
        f"{what}: choose an outline with {count_of('hole', 'holes', loops - 1)}, or close loops of the surface"
    )


def _check_simple(loops: list[IntArray], target: FloatArray, n: int) -> None:
    """Raise if the target does not bound a region, because too few vertices cut off parts of the outline."""
    positions = np.zeros((n, 2))
    positions[np.concatenate(loops)] = target
    _, reasons = check_loops(loops, positions)
    if reasons:
        raise ValueError(
            f"the boundary placed along the outline crosses or touches itself: {reasons[0]}. Its vertices are too few "
            "for the shape, or unevenly spaced: split boundary edges (refine with boundary=True), choose other "
            "corners, or an outline with less detail"
        )


@dataclass(frozen=True, eq=False)
class FittedProblem:
    """The mapping problem of a surface.

    ``corner_vertices`` are boundary vertices whose positions the caller chose, or that were assigned to the outline's
    corners. ``filled_holes`` is the number of holes of the outline that were filled because the surface has no holes.
    """

    problem: Problem
    corner_vertices: list[int] = field(default_factory=list)
    filled_holes: int = 0


def fix_in_place(
    island: Island, fixed: NDArray[np.integer] | None = None, *, reference: Reference | None = None
) -> FittedProblem:
    """Fix an island's boundary, or other vertices of its mesh, at their current positions.

    Raise the ValueErrors of `Problem`, and one if there is no boundary to fix or a fixed vertex has no position.
    """
    if fixed is None:
        own = np.unique(boundary_edges(island.F, len(island.vertices)))
        if not own.size:
            raise ValueError("the mesh has no boundary to fix: cut it open, or give fixed vertices")
    else:
        own = np.flatnonzero(np.isin(island.vertices, fixed))
    nowhere = own[np.isnan(island.uv[own]).any(axis=1)]
    if nowhere.size:
        which = names_of("vertex", "vertices", island.vertices[nowhere])
        raise ValueError(f"no texture coordinates for the fixed {which}: give every fixed vertex a vt")
    return FittedProblem(Problem(island.V, island.F, own, island.uv[own], reference=reference))


def fit_boundary(
    V: FloatArray,
    F: IntArray,
    contours: Sequence[FloatArray],
    *,
    corners: CornerSpec | None = None,
    corner_angle: float = DEFAULT_CORNER_ANGLE,
    reference: Reference | None = None,
    beside: int = 0,
) -> FittedProblem:
    """Lay a surface's boundary along an outline; the outline's holes are filled if the surface has none.

    ``contours``, ``corners`` and ``corner_angle`` are those of `boundary_to`. ``beside`` is the index of the outline's
    copy, from the left; each of several islands has its own. Raises ValueError as `boundary_to` and `Problem`, or if a
    corner is not on the boundary.
    """
    contours = place_beside(contours, beside)
    without_holes = filled(contours)
    holes = len(contours) - len(without_holes)
    try:
        fills = holes > 0 and len(boundary_loops(F, len(V))) == 1
    except ValueError:
        # A mesh without boundary loops is not a valid surface; the error is raised below.
        fills = False
    chosen = None if corners is None else corners.on(V, F)
    onto = without_holes if fills else list(contours)
    fixed, target = boundary_to(V, F, onto, corners=chosen, corner_angle=corner_angle)
    marked = find_corner_vertices(fixed, target, onto, corner_angle) if isinstance(chosen, str) else list(chosen or [])
    problem = Problem(V, F, fixed, target, reference=reference)
    return FittedProblem(problem, marked, holes if fills else 0)


def place_beside(contours: Sequence[FloatArray], beside: int) -> list[FloatArray]:
    """Return a copy of an outline, the one of index ``beside`` from the left; copies are 5 % of their width apart."""
    if not beside:
        return list(contours)
    right = beside * (1 + _GAP) * float(np.ptp(np.concatenate(contours)[:, 0]))
    return [contour + np.array([right, 0.0]) for contour in contours]


def find_corner_vertices(
    fixed: IntArray, target: FloatArray, contours: Sequence[FloatArray], angle: float = DEFAULT_CORNER_ANGLE
) -> list[int]:
    """Find the boundary vertices at the corners of an outline, in the order of the corners.

    ``fixed`` and ``target`` are results of `boundary_to`. ``angle`` is the minimum turning angle of a corner, in
    degrees.
    """
    sharp = [corners_of(unit, angle) for unit in in_unit(list(contours))[0]]
    goals = np.concatenate([contour[marks] for contour, marks in zip(contours, sharp, strict=True)])
    return [int(fixed[(target == goal).all(axis=1)][0]) for goal in goals]
