"""Find obstructions to a map of a problem, the global ones first."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any, overload

import numpy as np
from numpy.typing import ArrayLike

from quasiharmonic.geometry.exact.predicates import SegmentRelation
from quasiharmonic.geometry.mesh.reference import Reference
from quasiharmonic.io.objects import MeshLike
from quasiharmonic.problem import Problem
from quasiharmonic.problem.diagnosis.clipping import Effort, EffortSpentError
from quasiharmonic.problem.diagnosis.conditions import (
    Sight,
    bad_chords,
    collapsed_edges,
    half_planes,
    inverted_fixed_triangles,
    inverted_patches,
    misplaced_pins,
)
from quasiharmonic.problem.diagnosis.fixture import Corners, Fixture, TargetCurves, stars
from quasiharmonic.problem.diagnosis.obstruction import Diagnosis, Forbids, Kind, Obstruction
from quasiharmonic.problem.diagnosis.shortcuts import Shortcuts
from quasiharmonic.problem.diagnosis.witness import find_unplaced
from quasiharmonic.util.arrays import IntArray, count_of, edge_names, names_of, vertex_names

# Budget for the visibility checks of free vertices, in about microseconds. Vertices beyond it are not checked.
MAX_EFFORT = 3_000_000


@overload
def diagnose(
    V: ArrayLike, F: ArrayLike, fixed: ArrayLike, target: ArrayLike, *, reference: Reference | None = None
) -> Diagnosis: ...
@overload
def diagnose(V: MeshLike, fixed: ArrayLike, target: ArrayLike, *, reference: Reference | None = None) -> Diagnosis: ...
@overload
def diagnose(V: Problem) -> Diagnosis: ...
def diagnose(V: Any, *arguments: Any, **options: Any) -> Diagnosis:
    """Check the known necessary conditions for a map.

    Every obstruction is proven, in exact arithmetic on the coordinates as stored. A reported obstruction excludes all
    maps of the class that it forbids, even with real coordinates. The converse does not hold: a problem without known
    obstruction may still have no map.

    Parameters
    ----------
    V : (n, 2) or (n, 3) array, a mesh in place of ``V`` and ``F``, or a Problem in place of all arguments
        Rest positions.
    F, fixed, target, reference
        As in `Problem`.

    Returns
    -------
    Diagnosis

    Raises
    ------
    ValueError
        If the input is malformed; see `Problem`.

    See Also
    --------
    refine_problem : Splits the edges that prevent a map.
    injective_map : Diagnoses the problem itself if it finds no map.

    Notes
    -----
    Let χ be the Euler characteristic of the surface. For any target, a map without inverted triangles requires

    - no collapsed edge, and no triangle or patch that the fixed vertices around it invert;
    - a positive signed area, turning numbers whose sum is at least χ (exactly χ if the map winds at most once around
      every vertex), and no negative winding number of the boundary;
    - for each free vertex a point to the left of all fixed edges of its triangles;
    - for each position at most as many pins as the winding number there.

    A bijective map also requires loops that are simple, disjoint and nested as holes in one outer loop, and a surface
    without handles. For a target with such loops, every map without inverted triangles is injective on the whole
    interior, and also requires

    - edges between fixed vertices strictly inside the target, which do not meet the boundary or each other;
    - pins strictly inside;
    - for each free vertex a point that sees all fixed neighbours, to the left of the fixed edges of its triangles;
    - for any two boundary vertices, at least as many edges between them as the link distance of their positions, the
      smallest number of segments of a path inside the target [2]_.

    Link distances are compared for targets with one loop and vertices up to eight edges apart. These checks and those
    of visibility stop after some seconds; ``unchecked`` then lists the rest. The diagnosis does not check
    whether a self-crossing curve bounds an immersed surface. For a disk, Blank's theorem [1]_ answers this.

    References
    ----------
    .. [1] V. Poénaru, Extension des immersions en codimension 1 (d'après S. Blank). Séminaire
       Bourbaki 342 (1968).
    .. [2] S. Suri, A linear time algorithm for minimum link paths inside a simple polygon. Computer
       Vision, Graphics, and Image Processing 35 (1986).

    Examples
    --------
    >>> from quasiharmonic import Problem, boundary_loops, diagnose
    >>> from quasiharmonic.surfaces import disk
    >>> V, F = disk(4)
    >>> (rim,) = boundary_loops(F)
    >>> diagnosis = diagnose(Problem(V, F, rim, V[rim[::-1]]))
    >>> [obstruction.kind.name for obstruction in diagnosis.obstructions]
    ['REVERSED']
    """
    if isinstance(V, Problem) and (arguments or options):
        raise TypeError("diagnose(problem) accepts no further arguments")
    problem = V if isinstance(V, Problem) else Problem(V, *arguments, **options)
    fixture = Fixture.of(problem)
    curves = TargetCurves(fixture.positions, problem.domain.loops)
    euler = problem.domain.euler
    area = _twice_area(fixture, curves)
    if area < 0 and _fits_mirrored(curves, euler):
        message = "The target has the opposite orientation to the mesh: every loop runs the wrong way around."
        loops = np.arange(len(problem.domain.loops))
        reversed_ = Obstruction(Kind.REVERSED, Forbids.INJECTIVE, message, loops=loops)
        return Diagnosis(
            (reversed_,), ("all other conditions, which need target and mesh of the same orientation",), problem
        )

    unchecked = list(_list_unchecked(curves))
    found = list(_loop_obstructions(problem, curves, euler, area))
    found += misplaced_pins(problem, fixture, curves)
    found += collapsed_edges(problem, fixture)
    found += inverted_fixed_triangles(problem, fixture)
    found += inverted_patches(problem, fixture)
    chords, corners = fixture.chords, None
    if curves.proper:
        corners = Corners(curves)
        bad = list(bad_chords(problem, fixture, curves, corners))
        found += bad
        wrong = {tuple(o.split[0].tolist()) for o in bad}
        chords = np.array([c for c in chords.tolist() if tuple(c) not in wrong], dtype=np.int64).reshape(-1, 2)
    # A target on a line parallel to an axis has no area; the checks above report that.
    if all(low < high for low, high in zip(fixture.lattice.low, fixture.lattice.high, strict=True)):
        hidden, skipped = _find_unplaced(problem, fixture, curves, corners, np.concatenate([curves.ends, chords]))
        found += hidden
        unchecked += skipped
    if corners is not None and len(problem.domain.loops) == 1:
        shortcuts = Shortcuts(problem, fixture, corners)
        found += shortcuts.find()
        unchecked.append(f"link distances of boundary vertices that are {shortcuts.unchecked} or more edges apart")
    elif curves.proper:
        unchecked.append("link distances of fixed vertices that are three or more edges apart, around holes")
    return Diagnosis(tuple(found), tuple(unchecked), problem)


def _find_unplaced(
    problem: Problem, fixture: Fixture, curves: TargetCurves, corners: Corners | None, walls: IntArray
) -> tuple[list[Obstruction], list[str]]:
    """Return obstructions of free vertices without a valid position, and descriptions of unchecked vertices."""
    around = stars(problem, fixture, curves.folds)
    around = around.take(find_unplaced(around, fixture, corners, walls))
    sight = None if corners is None else Sight(problem, fixture, corners, walls, Effort(MAX_EFFORT))
    found = []
    skipped = []
    for star in map(around.__getitem__, range(len(around))):
        obstruction = half_planes(star, fixture)
        if obstruction is None and sight is not None:
            try:
                obstruction = sight.check_view(star)
            except EffortSpentError:
                skipped.append(star.vertex)
        if obstruction is not None:
            found.append(obstruction)
    which = vertex_names(np.array(skipped))
    return found, [f"whether a point of the target sees all fixed neighbours of {which}"] * bool(skipped)


def _twice_area(fixture: Fixture, curves: TargetCurves) -> int:
    """Return twice the signed area that the boundary encloses, in squared units of the lattice."""
    tails, heads = fixture.points(curves.ends[:, 0]), fixture.points(curves.ends[:, 1])
    return sum(px * qy - py * qx for (px, py), (qx, qy) in zip(tails, heads, strict=True))


def _fits_mirrored(curves: TargetCurves, euler: int) -> bool:
    """Return whether the reflected target meets the conditions on whole curves."""
    mirrored = TargetCurves(curves.positions * [-1.0, 1.0], curves.loops)
    if mirrored.turning is None or sum(mirrored.turning) < euler:
        return False
    return mirrored.winding_range is None or bool((mirrored.winding_range[:, 0] >= 0).all())


def _loop_obstructions(problem: Problem, curves: TargetCurves, euler: int, area: int) -> Iterator[Obstruction]:
    """Yield obstructions by the loops as a whole.

    ``euler`` is the Euler characteristic of the surface. ``area`` has the sign of the area that the loops enclose.
    """
    every = np.arange(len(problem.domain.loops))
    turning, ranges = curves.turning, curves.winding_range
    genus = problem.domain.handles

    if area <= 0:
        message = "The target encloses no positive area."
        yield Obstruction(Kind.SIGNED_AREA, Forbids.INJECTIVE, message, loops=every)
    if genus > 0:
        handles = "a handle" if genus == 1 else f"{genus} handles"
        message = f"The surface has {handles} and cannot be mapped into the plane without overlap."
        forbids = Forbids.INJECTIVE if curves.proper else Forbids.BIJECTIVE
        yield Obstruction(Kind.GENUS, forbids, message)
    if ranges is not None and curves.simple and not curves.proper:
        yield _find_misnested(curves, euler)
    elif ranges is not None and (ranges[:, 0] < 0).any():
        loops = np.flatnonzero(ranges[:, 0] < 0)
        message = f"Around some region beside {_loop_names(loops)} the target winds {ranges[:, 0].min()} times."
        yield Obstruction(Kind.NEGATIVE_WINDING, Forbids.INJECTIVE, message, loops=loops)
    if turning is not None and sum(turning) != euler and not curves.simple:
        fewer = sum(turning) < euler
        message = (
            f"The target's loops turn {sum(turning)} times in total, "
            f"and {'at least ' if fewer else ''}{count_of('is', 'are', euler)} needed for this surface."
        )
        forbids = Forbids.INJECTIVE if fewer else Forbids.UNBRANCHED
        yield Obstruction(Kind.TURNING_NUMBER, forbids, message, loops=every)
    yield from _find_crossings(curves)


def _find_misnested(curves: TargetCurves, euler: int) -> Obstruction:
    """Return the obstruction of simple disjoint loops that are not holes in one outer loop."""
    assert curves.winding_range is not None
    assert curves.turning is not None
    low, high = curves.winding_range.T
    wrong = np.flatnonzero((low < 0) | (high > 1))
    if not wrong.size:
        wrong = np.flatnonzero(np.array(curves.turning) == 1)
    # If the curves wind at most once, a map would be injective onto the enclosed region, which is not this surface. If
    # they wind more often, a map would cover a part repeatedly.
    is_hopeless = low.min() < 0 or high.max() <= 1
    forbids = Forbids.INJECTIVE if is_hopeless else Forbids.UNBRANCHED
    if not is_hopeless and sum(curves.turning) == euler:
        forbids = Forbids.BIJECTIVE
    message = f"The target's loops are not one outer loop with holes inside: see {_loop_names(wrong)}."
    return Obstruction(Kind.NESTING, forbids, message, loops=wrong)


def _find_crossings(curves: TargetCurves) -> Iterator[Obstruction]:
    """Yield obstructions where the curves fold, cross or touch; they forbid bijective maps only."""
    if curves.folds.size:
        message = f"At the boundary {vertex_names(curves.folds)} the target folds back onto itself."
        yield Obstruction(Kind.FOLD, Forbids.BIJECTIVE, message, vertices=curves.folds)
    meet = curves.contacts
    consecutive = (curves.ends[meet.pairs][:, 0, :, None] == curves.ends[meet.pairs][:, 1, None, :]).any(axis=(1, 2))
    pairs, relation = meet.pairs[~consecutive], meet.relation[~consecutive]
    loops = np.sort(curves.loop_of[pairs], axis=1)
    for a, b in np.unique(loops, axis=0):
        here = (loops == [a, b]).all(axis=1)
        crossing = bool((relation[here] == SegmentRelation.CROSSING).any())
        who = f"{_loop_names(np.array([a])).capitalize()} of the target"
        whom = "itself" if a == b else f"loop {b}"
        count = ("" if meet.complete else "at least ") + count_of("pair of edges", "pairs of edges", int(here.sum()))
        involved = curves.ends[pairs[here]].reshape(-1, 2)
        message = (
            f"{who} {'crosses' if crossing else 'touches'} {whom} ({count}), among them "
            f"{edge_names(involved[:1])} and {edge_names(involved[1:2])}."
        )
        yield Obstruction(
            Kind.CROSSING, Forbids.BIJECTIVE, message, edges=np.unique(involved, axis=0), loops=np.unique([a, b])
        )


def _list_unchecked(curves: TargetCurves) -> Iterator[str]:
    """Yield descriptions of the conditions that were not checked, and why."""
    if curves.proper:
        return
    yield "edges between fixed vertices and visibility from vertices, which need a simple target"
    if curves.turning is None:
        yield "turning numbers, which boundary edges of length zero leave undefined"
    if curves.winding_range is None:
        yield "winding numbers, as the target touches or overlaps itself, or crosses itself too often"


def _loop_names(loops: IntArray) -> str:
    """Return text that names the first few of some boundary loops."""
    return names_of("loop", "loops", loops)
