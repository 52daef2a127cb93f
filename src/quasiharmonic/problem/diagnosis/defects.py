"""Conditions on single elements that hold for every map without inverted triangles.

They do not depend on whether the target overlaps itself: the triangles of an element must be positive for any positions
of the other vertices.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from quasiharmonic.geometry.exact.loops import winding
from quasiharmonic.geometry.exact.predicates import orientation
from quasiharmonic.geometry.mesh.topology import label_components, pair_keys
from quasiharmonic.problem import Problem
from quasiharmonic.problem.diagnosis.curves import TargetCurves
from quasiharmonic.problem.diagnosis.fixture import Fixture, Star
from quasiharmonic.problem.diagnosis.obstruction import Forbids, Kind, Obstruction, smallest_conflict, vertex_names
from quasiharmonic.util.arrays import BoolArray, FloatArray, IntArray, cyclic_pairs, edge_names, names_of


def collapsed_edges(problem: Problem, fixture: Fixture) -> Iterator[Obstruction]:
    """Yield edges whose two ends are fixed at the same position."""
    every = np.concatenate([problem.domain.edges.boundary, fixture.chords])
    where = fixture.positions
    for edge in every[(where[every[:, 0]] == where[every[:, 1]]).all(axis=1)]:
        message = f"The target gives both ends of {edge_names(edge[None])} the same position."
        yield Obstruction(Kind.COLLAPSED_EDGE, Forbids.INJECTIVE, message, vertices=edge, edges=edge)


def inverted_fixed_triangles(problem: Problem, fixture: Fixture) -> Iterator[Obstruction]:
    """Yield triangles of three fixed vertices that the target makes inverted or degenerate."""
    boundary = problem.domain.edges.boundary
    for t, abc, s, split in find_inverted_fixed(problem.F, fixture.fixed, fixture.positions, boundary):
        message = (
            f"All vertices of {names_of('triangle', 'triangles', t)} are fixed, "
            f"and the target {'inverts' if s < 0 else 'flattens'} it."
        )
        yield Obstruction(Kind.INVERTED_TRIANGLE, Forbids.INJECTIVE, message, vertices=abc, triangles=t, split=split)


def find_inverted_fixed(
    F: IntArray, fixed: BoolArray, where: FloatArray, boundary: IntArray
) -> Iterator[tuple[IntArray, IntArray, np.int8, IntArray]]:
    """Yield triangles (f, 3) of three fixed vertices that their positions ``where`` (n, 2) invert or flatten.

    With each triangle (1,), its corners, its orientation, and its sides that are not in ``boundary`` (k, 2).
    """
    triangles, border = np.flatnonzero(fixed[F].all(axis=1)), pair_keys(boundary, len(fixed))
    corners = F[triangles]
    sign = orientation(*(where[corners[:, k]] for k in range(3)))
    for t, abc, s in zip(triangles[sign <= 0, None], corners[sign <= 0], sign[sign <= 0], strict=True):
        sides = cyclic_pairs(abc)
        yield t, abc, s, sides[~np.isin(pair_keys(sides, len(fixed)), border)]


def inverted_patches(problem: Problem, fixture: Fixture) -> Iterator[Obstruction]:
    """Yield parts of the mesh, cut off by fixed edges, whose area in the target is not positive.

    The areas of a patch's triangles add up to the area that its fixed border encloses.
    """
    if not len(fixture.chords):
        return

    # Triangles that share a free vertex belong to one patch, and so do those at two joined free vertices.
    free, inner = ~fixture.fixed, fixture.inner
    label = label_components(inner[:, 0], inner[:, 1], problem.n)
    open_triangles = np.flatnonzero(free[problem.F].any(axis=1))
    corners = problem.F[open_triangles]
    patch = label[corners[np.arange(len(corners)), np.argmax(free[corners], axis=1)]]
    sides = np.stack([corners, np.roll(corners, -1, axis=1)], axis=2)
    border = fixture.fixed[sides].all(axis=2)
    of, edge = patch[np.nonzero(border)[0]], sides[border]

    if len(open_triangles) == len(problem.F) and (patch == patch[0]).all():
        return  # The fixed edges do not divide the mesh.

    twice_area: dict[int, int] = {}
    for k, (px, py), (qx, qy) in zip(of.tolist(), fixture.points(edge[:, 0]), fixture.points(edge[:, 1]), strict=True):
        twice_area[k] = twice_area.get(k, 0) + px * qy - py * qx
    boundary = pair_keys(problem.domain.edges.boundary, problem.n)
    for k in sorted(k for k, area in twice_area.items() if area <= 0):
        around = edge[of == k]
        message = f"The fixed {edge_names(around)} around a part of the mesh leave it no positive area."
        split = around[~np.isin(pair_keys(around, problem.n), boundary)]
        inside = open_triangles[patch == k]
        yield Obstruction(Kind.INVERTED_PATCH, Forbids.INJECTIVE, message, edges=around, triangles=inside, split=split)


def misplaced_pins(problem: Problem, fixture: Fixture, curves: TargetCurves) -> Iterator[Obstruction]:
    """Yield pins whose positions no map can reach.

    The number of pins at a position must not exceed the winding number of the boundary there. If the boundary winds at
    most once, pins must lie inside, at distinct positions.
    """
    pins = problem.domain.pins
    if not pins.size:
        return
    where, same, times = np.unique(fixture.positions[pins], axis=0, return_inverse=True, return_counts=True)
    covered, on = winding(where, curves.tails, curves.heads)
    bad = np.where(on, curves.proper, covered < times)
    for k in np.flatnonzero(bad).tolist():
        here = pins[same.ravel() == k]
        if on[k]:
            reason = "lies on the target's boundary"
        elif covered[k] <= 0:
            reason = "lies outside the target"
        else:
            once = "once" if covered[k] == 1 else f"{covered[k]} times"
            reason = f"share a position that the target covers only {once}"
        message = f"The pinned interior {vertex_names(here)} {reason}."
        yield Obstruction(Kind.PIN, Forbids.INJECTIVE, message, vertices=here)


def half_planes(star: Star, fixture: Fixture) -> Obstruction | None:
    """Return an obstruction if no point lies to the left of all fixed edges that form triangles with a vertex."""
    area = fixture.extent()
    if fixture.left_of(area, star.opposite) is not None:
        return None
    conflict = smallest_conflict(
        len(star.opposite), lambda some: fixture.left_of(area, star.opposite[some]) is not None
    )
    needed = star.opposite[conflict]
    vertex = np.array([star.vertex])
    message = (
        f"{vertex_names(vertex).capitalize()} must lie to the left of the fixed {edge_names(needed)}, "
        "but no point of the target's bounding box does."
    )
    split = star.edges_to(needed)
    return Obstruction(Kind.HALF_PLANES, Forbids.INJECTIVE, message, vertices=vertex, edges=needed, split=split)
