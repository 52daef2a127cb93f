"""Contradictions between the target positions of fixed vertices, for a boundary that is otherwise free."""

from __future__ import annotations

from collections.abc import Iterator
from typing import assert_never

import numpy as np
from numpy.typing import NDArray

from quasiharmonic.geometry.exact.box_pairs import box_pairs_between
from quasiharmonic.geometry.exact.loops import contacts
from quasiharmonic.geometry.exact.predicates import orientation
from quasiharmonic.geometry.mesh.topology import Edges, edges
from quasiharmonic.problem.diagnosis import Diagnosis, Forbids, Kind, Obstruction
from quasiharmonic.problem.diagnosis.conditions import find_inverted_fixed
from quasiharmonic.util.arrays import BoolArray, FloatArray, IntArray, edge_names, mark, names_of


def find_pin_obstructions(F: IntArray, n: int, fixed: IntArray, target: FloatArray) -> Diagnosis:
    """Find contradictions between the target positions (k, 2) of fixed vertices (k,), each given once.

    The triangles have ``n`` vertices. The diagnosis reports vertices with the same target position, triangles of three
    fixed vertices that are not counterclockwise, edges between two fixed vertices that intersect others or a fixed
    vertex, and fixed vertices inside triangles of others. Each contradiction forbids a bijective map with any boundary.
    An empty diagnosis proves nothing.
    """
    found, is_fixed = edges(F, n), mark(n, fixed)
    where = np.zeros((n, 2))
    where[fixed] = target
    obstructions = [
        *_find_shared_positions(fixed, target),
        *_find_inverted(F, is_fixed, where, found),
        *_find_crossings(is_fixed, where, found, fixed),
        *_find_covered(F, is_fixed, where, fixed),
    ]
    return Diagnosis(tuple(obstructions), ("the boundary, because it is free",))


def select_without_air(diagnosis: Diagnosis, F: IntArray, n: int, fixed: IntArray) -> Diagnosis | None:
    """Select the obstructions of surface and air that forbid a map of the surface alone; None if there are none.

    The frame around the air is fixed, and so are the vertices ``fixed`` (k,) of the surface. Its triangles (f, 3) are
    the first ones, and its ``n`` vertices the first ones, too.
    """
    own, is_fixed = [], mark(n, fixed)
    for obstruction in diagnosis.obstructions:
        vertices = np.concatenate([obstruction.vertices, obstruction.edges.ravel()])
        in_surface = vertices.max(initial=-1) < n and obstruction.triangles.max(initial=-1) < len(F)
        if in_surface and _holds_without_air(obstruction, F, is_fixed):
            own.append(obstruction)
    return Diagnosis(tuple(own), diagnosis.unchecked) if own else None


def _holds_without_air(obstruction: Obstruction, F: IntArray, is_fixed: BoolArray) -> bool:
    """Whether an obstruction that names elements of the surface only needs neither air nor frame as a reason."""
    kind = obstruction.kind
    match kind:
        case Kind.COLLAPSED_EDGE | Kind.INVERTED_TRIANGLE | Kind.CHORD:
            # The positions of the named vertices contradict each other, wherever the others are.
            return True
        case Kind.INVERTED_PATCH:
            # The fixed edges around the patch determine its area.
            return True
        case Kind.HALF_PLANES | Kind.HIDDEN:
            # Positions were sought inside the frame only. If all neighbours of the vertex are fixed, they surround it,
            # so it has no other positions.
            apex = obstruction.vertices[:1]
            around = np.setdiff1d(F[np.isin(F, apex).any(axis=1)], apex)
            return bool(is_fixed[around].all())
        case Kind.PIN:
            # The pin is not inside the frame. Pins at the same position are found by `find_pin_obstructions` before.
            return False
        case (
            Kind.SIGNED_AREA
            | Kind.REVERSED
            | Kind.TURNING_NUMBER
            | Kind.NEGATIVE_WINDING
            | Kind.GENUS
            | Kind.CROSSING
            | Kind.FOLD
            | Kind.NESTING
            | Kind.LINK_DISTANCE
        ):
            # These concern the boundary, which is the frame.
            return False
    assert_never(kind)


def _find_shared_positions(fixed: IntArray, target: FloatArray) -> Iterator[Obstruction]:
    order = np.lexsort((fixed, target[:, 1], target[:, 0]))
    placed = target[order]
    first = np.flatnonzero(np.concatenate([[True], (placed[1:] != placed[:-1]).any(axis=1)]))
    for group in np.split(fixed[order], first[1:]):
        if group.size > 1:
            message = f"{names_of('Vertex', 'Vertices', group)} are fixed at the same position."
            yield Obstruction(Kind.PIN, Forbids.BIJECTIVE, message, vertices=group)


def _find_inverted(F: IntArray, is_fixed: NDArray[np.bool_], where: FloatArray, found: Edges) -> Iterator[Obstruction]:
    for t, abc, s, split in find_inverted_fixed(F, is_fixed, where, found.boundary):
        message = (
            f"All vertices of {names_of('triangle', 'triangles', t)} are fixed, "
            f"and their targets {'invert' if s < 0 else 'flatten'} it."
        )
        yield Obstruction(Kind.INVERTED_TRIANGLE, Forbids.INJECTIVE, message, vertices=abc, triangles=t, split=split)


def _find_crossings(
    is_fixed: NDArray[np.bool_], where: FloatArray, found: Edges, fixed: IntArray
) -> Iterator[Obstruction]:
    """Edges between fixed vertices that intersect other such edges or other fixed vertices."""
    inner, outer = (pairs[is_fixed[pairs].all(axis=1)] for pairs in (found.interior, found.boundary))
    segments = np.concatenate([inner, outer, np.stack([fixed, fixed], axis=1)])
    joined = len(inner) + len(outer)
    if not joined:
        return
    # Maximum number of intersecting pairs that are named.
    max_pairs = 100
    pairs = contacts(where, segments, max_pairs).pairs
    # Vertices with the same position are reported by `_find_shared_positions`, so edges of length zero are omitted.
    apart = (where[segments[:, 0]] != where[segments[:, 1]]).any(axis=1) | (np.arange(len(segments)) >= joined)
    for i, j in pairs[(pairs[:, 0] < joined) & apart[pairs].all(axis=1)].tolist():
        ends = segments[[i, j]]
        other = edge_names(ends[1:]) if j < joined else names_of("vertex", "vertices", ends[1, :1])
        message = f"Both ends of {edge_names(ends[:1])} are fixed, and the segment between them meets {other}."
        split = ends[[k < len(inner) for k in (i, j)]]
        kind = Kind.CHORD if len(split) else Kind.CROSSING
        edges_ = ends if j < joined else ends[:1]
        yield Obstruction(kind, Forbids.BIJECTIVE, message, vertices=np.unique(ends), edges=edges_, split=split)


def _find_covered(
    F: IntArray, is_fixed: NDArray[np.bool_], where: FloatArray, fixed: IntArray
) -> Iterator[Obstruction]:
    """Fixed vertices inside a triangle of other fixed vertices."""
    fixed_triangles = np.flatnonzero(is_fixed[F].all(axis=1))
    corners = where[F[fixed_triangles]]
    positions = where[fixed]
    for i, j in box_pairs_between(corners.min(axis=1), corners.max(axis=1), positions, positions):
        sign = [orientation(corners[i, k], corners[i, k - 2], positions[j]) for k in range(3)]
        inside = (np.minimum.reduce(sign) > 0).nonzero()[0]
        for t, pin in zip(fixed_triangles[i[inside]].tolist(), fixed[j[inside]].tolist(), strict=True):
            message = f"Vertex {pin} is fixed inside triangle {t}, whose vertices are all fixed as well."
            yield Obstruction(
                Kind.PIN, Forbids.BIJECTIVE, message, vertices=np.array([pin, *F[t]]), triangles=np.array([t])
            )
