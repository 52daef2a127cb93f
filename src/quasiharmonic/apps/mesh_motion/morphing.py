"""Morphing of meshes: compute a valid interior after the boundary has moved.

Boundary nodes make way for moved ones that arrive along the same wall, as the walls of a cylinder for its piston.
Between two nodes of a wall that do not slide, the sliding nodes keep their order and the ratios of their distances.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial
from typing import TypedDict, Unpack

import numpy as np
from numpy.typing import ArrayLike

from quasiharmonic.apps.mesh_motion.midsides import find_sides, follow_sides
from quasiharmonic.apps.mesh_motion.morph_result import MorphResult, find_forbidden
from quasiharmonic.apps.mesh_motion.node_search import NodeSearch, Slide
from quasiharmonic.apps.mesh_motion.quality import element_quality
from quasiharmonic.apps.tetrahedra.result import TetrahedraResult
from quasiharmonic.apps.tetrahedra.tetrahedral_maps import is_volume, morph_tetrahedra
from quasiharmonic.energies.energies import Energy
from quasiharmonic.energies.polishing import find_energy
from quasiharmonic.geometry.curves.boundary_curves import BoundaryCurves, Chain
from quasiharmonic.geometry.exact.jacobian_signs import inverted_elements
from quasiharmonic.geometry.exact.predicates import orientation
from quasiharmonic.geometry.mesh.elements import (
    check_spread,
    corner_triangles,
    covering_triangles,
    element_array,
    name_elements,
    nets_of,
    reverse_elements,
)
from quasiharmonic.geometry.mesh.topology import boundary_edges, boundary_loops
from quasiharmonic.io.accepts_mesh import accepts_planar_mesh
from quasiharmonic.linsolve import check_name
from quasiharmonic.problem.result import Status, Step
from quasiharmonic.util.arrays import (
    BoolArray,
    FloatArray,
    IntArray,
    check_finite,
    distinct_vertices,
    map_array,
    reject,
)
from quasiharmonic.util.options import MorphOptions, takes
from quasiharmonic.util.progress import reports_progress


class MorphKeywords(TypedDict, total=False):
    """Types of the options of `morph`."""

    energy: str | Energy | None
    max_iterations: int
    linear_solver: str
    callback: Callable[[Step], object] | None
    slide: bool | BoundaryCurves | ArrayLike
    rest: ArrayLike | None
    start: ArrayLike | None
    tol: float


@accepts_planar_mesh
@reports_progress
@takes(MorphOptions, MorphKeywords)
def morph(
    points: ArrayLike, F: ArrayLike, moved_vertices: ArrayLike, target: ArrayLike, **options: Unpack[MorphKeywords]
) -> MorphResult | TetrahedraResult:
    """Move some nodes of a mesh, planar or of tetrahedra, and place the others so that no element is inverted.

    Parameters
    ----------
    points : (n, 2) or (n, 3) array, or a mesh in place of ``points`` and ``F``
        The current mesh.
    F : (f, 3), (f, 4) or (f, 6) array of int
        If points are in space, tetrahedra (f, 4). Otherwise triangles, quadrilaterals or six-node triangles,
        clockwise or counterclockwise, corners first (see `quasiharmonic.geometry.mesh.elements`). A quadrilateral whose
        last two nodes are equal is a triangle.
    moved_vertices : (k,) array of int
        Nodes to move, on the boundary or inside. Other boundary nodes are fixed, except mid-side nodes, which follow
        their side.
    target : (k, 2) or (k, 3) array
        Target positions of the moved nodes.
    energy : str, Energy or None
        Energy that the placement minimises; see `quasiharmonic.polish`. The default preserves shapes and sizes of the
        triangles, so a graded mesh stays graded. None returns the first valid mesh. For tetrahedra every name
        selects the same isotropic energy.
    max_iterations : int
        Maximum number of linear solves to find a valid mesh. In the plane, a tenth of it limits the Newton steps that
        then lower the energy, but at least 200 are allowed.
    linear_solver : str
        ``"auto"`` or one of `quasiharmonic.linsolve.available`.
    callback : callable, optional
        Called with a `Step` at every iteration, and with the last one again at least every half second in between, but
        not within a single factorisation.
    slide : bool, BoundaryCurves or (m, 4) array
        Let the boundary vertices that are not moved slide along their outline, with fixed corners, like nodes on the
        walls of a channel. With `quasiharmonic.geometry.curves.BoundaryCurves` they slide along these curves, with True
        along the boundary polygon. Moved vertices slide only if ``BoundaryCurves`` assigns them a curve. For
        tetrahedra, True lets them slide along all flat parts of the boundary and along the edges between these, and an
        array of planes ``(a, b, c, d)`` with ``a x + b y + c z = d`` along those on the planes.
    rest : array of the shape of ``points``, optional
        The mesh against which distortion is measured; default ``points``. In a chain of steps use the first mesh, so
        that the chain does not drift (`MorphResult.drift`).
    start : array of the shape of ``points``, optional
        Initial mesh, close to the result. Default: ``points`` if ``rest`` is given, otherwise the harmonic extension of
        the displacement.
    tol : float
        The mesh has converged if a further step is predicted to lower the energy by less than this fraction; see
        `quasiharmonic.polish`. A larger value is faster, and the result depends more on the initial mesh.

    Returns
    -------
    MorphResult, or TetrahedraResult for tetrahedra
        If no valid mesh was found, ``result.status`` has the reason, or ``inverted`` has the inverted elements.

    Raises
    ------
    ValueError
        If the input is malformed (see `Problem`), a moved node is in no element, or the rest mesh overlaps itself. If
        an element at rest has no area, or a quadrilateral at rest is not convex. The message names the elements.

    See Also
    --------
    MovingMesh : Many small steps.
    injective_tetrahedra : Tetrahedra with any fixed vertices.
    warp_by_landmarks : Images.

    Notes
    -----
    Tetrahedra are untangled by a regularised energy, then the energy is lowered further. The search can fail although a
    valid mesh exists. If the moved boundary crosses itself, the result names the triangles, without a search.

    Triangles are searched as any map. For quadrilaterals the search uses the triangles on either side of a diagonal;
    then the triangles at all four corners are untangled and their energy is lowered.

    For six-node triangles the search uses the triangles between corners. Interior mid-side nodes keep their relative
    position on their sides at rest; straight sides stay straight. If a curved side would invert an element, nodes move
    aside as little as possible, if necessary corners too. If this fails, the search is repeated on the four triangles
    between the nodes of each element. With ``slide``, the boundary and its mid-side nodes first slide on these four
    triangles.

    Examples
    --------
    Push the middle of the upper side of a square halfway down:

    >>> import numpy as np
    >>> from quasiharmonic import morph
    >>> from quasiharmonic.surfaces import grid
    >>> points, F = grid(12, 12)
    >>> upper = np.flatnonzero(points[:, 1] == 1)
    >>> x = points[upper, 0]
    >>> morphed = morph(points, F, upper, np.stack([x, 1 - 0.5 * np.sin(np.pi * x) ** 4], axis=1))
    >>> morphed.valid, bool(morphed.quality_after.min() > 0.25)
    (True, True)
    """
    checked = MorphOptions(**options)
    slide, rest, start = checked.slide, checked.rest, checked.start
    if checked.energy is not None:
        find_energy(checked.energy)
    if is_volume(points, F):
        if isinstance(slide, BoundaryCurves):
            raise ValueError("slide must be a bool or an array of planes for tetrahedra, not BoundaryCurves")
        check_name(checked.linear_solver)
        return morph_tetrahedra(points, F, moved_vertices, target, checked)
    if not isinstance(slide, bool | np.bool_ | BoundaryCurves):
        raise ValueError(f"slide must be a bool or BoundaryCurves for planar meshes, not {slide!r}")
    curves = slide if isinstance(slide, BoundaryCurves) else bool(slide)
    if curves is not False and checked.energy is None:
        raise ValueError("the boundary slides only while distortion is lowered: give an energy as well")
    points = map_array("points", points, finite=False)
    F = element_array(F, len(points))
    used = np.unique(F)
    check_finite("points", "vertex", "vertices", points, used)
    first = points if rest is None else _check_positions("rest", rest, points, used)
    begin = (None if rest is None else points) if start is None else _check_positions("start", start, points, used)
    F = _orient_counterclockwise(F, first)
    check_spread(F, len(points))
    fixed, goal = _find_fixed(points, F, moved_vertices, target)
    nets, moved = nets_of(F), np.asarray(moved_vertices)
    if curves is not False:
        there = points.copy()
        there[fixed] = goal
        loops = boundary_loops(nets[-1], len(points))
        goal = make_way(curves, loops, points, there, moved)[fixed]
    search = NodeSearch(F, first, fixed, nets, checked)
    after, result = search.place(points, goal, begin, Slide(curves, moved))
    # Fix the boundary at the positions to which it has slid.
    alone = replace(search, options=replace(checked, callback=None, slide=False, rest=None, start=None))
    inverted = inverted_elements(F, after)
    forbidden = np.intersect1d(inverted, find_forbidden(F, after, fixed))
    if not inverted.size and not result.injective and result.status.acceptable:
        # Curved elements are valid although their straight triangles are not.
        result = replace(result, status=Status.INJECTIVE, diagnosis=None)
    before, now = element_quality(F, points), element_quality(F, after)
    one_step = partial(alone.place_at_once, after[fixed])
    return MorphResult(after, F, inverted, forbidden, result, before, now, points.copy(), one_step)


def _check_positions(name: str, mesh: ArrayLike, points: FloatArray, used: IntArray) -> FloatArray:
    """Check other positions of a mesh's nodes; nodes in no element may be anywhere."""
    array = map_array(name, mesh, len(points), finite=False)
    check_finite(name, "vertex", "vertices", array, used)
    return array


def _orient_counterclockwise(F: IntArray, rest: FloatArray) -> IntArray:
    """Return the elements with counterclockwise winding; raise ValueError if the distortion of one is undefined."""
    quadrilaterals = F.shape[1] == 4
    triangles, of = corner_triangles(F) if quadrilaterals else covering_triangles(F)
    sign = orientation(*(rest[triangles[:, k]] for k in range(3)))
    if quadrilaterals:
        turning = np.bincount(of, sign, len(F))
        bad = np.flatnonzero(np.abs(turning) != np.bincount(of, minlength=len(F)))
        if bad.size:
            raise ValueError(
                f"{name_elements(F, bad)} not convex: all four corners of a quadrilateral must turn the same way. "
                "Move their nodes, or split them into triangles"
            )
    else:
        flat = np.unique(of[sign == 0])
        if flat.size:
            raise ValueError(f"{name_elements(F, flat)} degenerate: repair the mesh first")
        turning = orientation(*(rest[F[:, k]] for k in range(3))).astype(np.float64)
    return np.where((turning < 0)[:, None], reverse_elements(F), F)


def _find_fixed(
    points: FloatArray, F: IntArray, moved_vertices: ArrayLike, target: ArrayLike
) -> tuple[IntArray, FloatArray]:
    """Return the fixed nodes (moved nodes and the rest of the boundary) and their target positions."""
    given = distinct_vertices("moved_vertices", moved_vertices, len(points))
    positions = map_array("target", target, len(given), finite=False)
    check_finite("target", "row", "rows", positions)
    idle = given[~np.isin(given, F)]
    reject(idle, "vertex", "vertices", "moved_vertices refers to {}, but no triangle uses them: omit them")
    left = np.setdiff1d(boundary_edges(covering_triangles(F)[0], len(points)), given)
    there = points.copy()
    there[given] = positions
    if F.shape[1] == 6:
        middle, ends = find_sides(F)
        follows = np.isin(middle, left)
        there[middle[follows]] = follow_sides(points, there, middle[follows], ends[follows])
    return np.concatenate([given, left]), np.concatenate([positions, there[left]])


def make_way(
    slide: bool | BoundaryCurves, loops: Sequence[IntArray], points: FloatArray, there: FloatArray, moved: IntArray
) -> FloatArray:
    """Shift boundary nodes along their walls where a moved node would pass them.

    Parameters
    ----------
    slide : bool or BoundaryCurves
        The walls: True for the boundary before the move.
    loops : list of (l,) int64
        Boundary loops.
    points, there : (n, 2) float64
        Positions before the move, and those after it, where nodes that are not moved have their old positions.
    moved : (k,) int64

    Returns
    -------
    (n, 2) float64
        ``there`` with shifted nodes. Moved nodes are where they were.
    """
    if isinstance(slide, BoundaryCurves):
        walls = slide.with_fixed_unless_on(moved)
    else:
        walls = BoundaryCurves.around(loops, points, fixed=moved)
    try:
        chains = walls.lay(loops, points).chains
    except ValueError:
        # The boundary is not on the curves before the move: no node arrives along them.
        return there
    found = there.copy()
    for chain in chains:
        near = walls.tolerance * chain.curve.size
        is_moved = np.isin(chain.vertices, moved)
        vertices, s = _shift_along(chain, ~chain.sliding | is_moved, _find_shifts(chain, there, is_moved, near))
        found[vertices] = chain.curve.position(s)
    return found


def _find_shifts(chain: Chain, there: FloatArray, is_moved: BoolArray, near: float) -> FloatArray:
    """Lengths (k,) by which the nodes of a chain move along their curve; zero for those that leave it."""
    curve = chain.curve
    with np.errstate(over="ignore"):
        where, distance = curve.nearest(there[chain.vertices])
    shift = where - chain.s
    if curve.closed:
        shift -= curve.length * np.round(shift / curve.length)
    return np.where(is_moved & (distance <= near), shift, 0.0)


def _shift_along(chain: Chain, held: BoolArray, shift: FloatArray) -> tuple[IntArray, FloatArray]:
    """Return the nodes between ``held`` ones (k,) that make way, and their new lengths along the curve."""
    count, length = len(chain.s), chain.curve.length
    stops = np.flatnonzero(held)
    following = np.append(stops[1:], stops[:1] + count) if chain.curve.closed else stops[1:]
    vertices, found = [chain.vertices[:0]], [chain.s[:0]]
    for begin, end in zip(stops.tolist(), following.tolist(), strict=False):
        row = np.arange(begin, end + 1)
        s = chain.s[row % count] + length * (row // count)
        low = s[0] + max(shift[begin], 0.0)
        high = s[-1] + min(shift[end % count], 0.0)
        if len(row) > 2 and low < high and (low >= s[1] or high <= s[-2]):
            moving = low + (s[1:-1] - s[0]) * ((high - low) / (s[-1] - s[0]))
            vertices.append(chain.vertices[row[1:-1] % count])
            found.append(moving % length if chain.curve.closed else moving)
    return np.concatenate(vertices), np.concatenate(found)
