"""Conditions on fixed vertices alone that forbid a bijective map with any boundary."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from quasiharmonic.geometry.exact.loops import contacts
from quasiharmonic.geometry.exact.predicates import box_pairs_between, orientation
from quasiharmonic.geometry.mesh.topology import Edges
from quasiharmonic.problem.diagnosis import Diagnosis, Forbids, Kind, Obstruction
from quasiharmonic.problem.diagnosis.conditions import find_inverted_fixed
from quasiharmonic.util.arrays import FloatArray, IntArray, edge_names, mark, names_of

# Maximum number of intersecting pairs that are named.
_MAX_PAIRS = 100


def pin_obstructions(F: IntArray, n: int, found: Edges, fixed: IntArray, target: FloatArray) -> Diagnosis:
    """Find contradictions between the target positions (k, 2) of fixed vertices (k,), each given once.

    ``found`` are the edges of the triangles, which have ``n`` vertices. The diagnosis reports vertices with the same
    target position, triangles of three fixed vertices that are not counterclockwise, edges between two fixed vertices
    that intersect others or a fixed vertex, and fixed vertices inside triangles of others. An empty diagnosis proves
    nothing.
    """
    is_fixed = mark(n, fixed)
    where = np.zeros((n, 2))
    where[fixed] = target
    obstructions = [
        *_find_shared_positions(fixed, target),
        *_find_inverted(F, is_fixed, where, found),
        *_find_crossings(is_fixed, where, found, fixed),
        *_find_covered(F, is_fixed, where, fixed),
    ]
    return Diagnosis(tuple(obstructions), ("the boundary, because it is free",))


def renumber_obstruction(found: Obstruction, vertices: IntArray, triangles: IntArray) -> Obstruction:
    """Return an obstruction of a part in the numbering of the mesh; ``vertices`` and ``triangles`` are the mesh's."""
    return replace(
        found,
        vertices=vertices[found.vertices],
        edges=vertices[found.edges],
        triangles=triangles[found.triangles],
        split=vertices[found.split],
    )


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
    pairs = contacts(where, segments, _MAX_PAIRS).pairs
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
