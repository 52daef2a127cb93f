"""Build many small problems at once, faster than one by one.

The checks of a problem cost some microseconds per NumPy call, even for small meshes. This module concatenates the
meshes as separate components, then checks them and traces their boundaries together. If a check fails, the result is
None. The caller then builds each `Problem` separately, and that constructor raises the error.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from quasiharmonic.geometry.mesh.reference import rest_frames
from quasiharmonic.geometry.mesh.topology import Edges, are_collapsed, components, edges, trace_loops
from quasiharmonic.problem.domain import Domain
from quasiharmonic.problem.problem import Problem
from quasiharmonic.util.arrays import IntArray, as_offsets, index_array, mark, real_array, repeat_each, triangle_rows

# Largest binary exponent of a mesh's size, in absolute value, so that lengths neither overflow nor underflow.
_MAX_EXPONENT = 400

Given = tuple[NDArray[Any], NDArray[Any], NDArray[Any], NDArray[Any]]


def set_up_batch(given: Sequence[Given]) -> list[Problem] | None:
    """Return a `Problem` for each (V, F, fixed, target), given as NumPy arrays, without an explicit reference.

    None if a check fails for any of the meshes, or if they differ in dimension. Then build each problem by itself.
    """
    try:
        V = [real_array("V", one[0]) for one in given]
        F = [triangle_rows(one[1]) for one in given]
        fixed = [index_array("fixed", one[2]) for one in given]
        target = [real_array("target", one[3]) for one in given]
    except ValueError:
        return None
    shaped = all(
        v.ndim == 2 and v.shape[1] in (2, 3) and v.shape[1] == V[0].shape[1] and len(v) and len(T) and k.ndim == 1
        for v, T, k in zip(V, F, fixed, strict=True)
    )
    if not shaped or any(uv.shape != (len(k), 2) for uv, k in zip(target, fixed, strict=True)):
        return None
    starts = np.cumsum([0, *map(len, V)])
    positions = np.concatenate(V)
    if not np.isfinite(positions).all() or not np.isfinite(np.concatenate(target)).all():
        return None
    triangles, all_fixed = _renumber(F, starts), _renumber(fixed, starts)
    if triangles is None or all_fixed is None or (np.bincount(all_fixed, minlength=1) > 1).any():
        return None
    found = _surfaces(triangles, starts)
    if found is None:
        return None
    missing = mark(len(positions), found.boundary) & ~mark(len(positions), all_fixed)
    if missing.any() or not _have_areas(positions, triangles, starts):
        return None
    try:
        loops = trace_loops(found.boundary)
    except ValueError:
        return None
    own: list[list[IntArray]] = [[] for _ in given]
    for loop, k in zip(loops, np.searchsorted(starts, [loop[0] for loop in loops], side="right").tolist(), strict=True):
        own[k - 1].append(loop - starts[k - 1])
    none = np.empty((0, 2), dtype=np.int64)
    problems = []
    parts = zip(_split_by_mesh(found.interior, starts), _split_by_mesh(found.boundary, starts), strict=True)
    for k, (interior, boundary) in enumerate(parts):
        edges_of = Edges(interior, boundary, none.copy(), none.copy())
        domain = Domain.from_parts(V[k], F[k], fixed[k], edges_of, own[k])
        problems.append(Problem.on(domain, target[k]))
    return problems


def _renumber(own: Sequence[IntArray], starts: IntArray) -> IntArray | None:
    """Return the vertices of all meshes in a common numbering, or None if an index is out of its mesh's range."""
    for indices, n in zip(own, np.diff(starts).tolist(), strict=True):
        if indices.size and (indices.min() < 0 or indices.max() >= n):
            return None
    return np.concatenate([indices + start for indices, start in zip(own, starts[:-1].tolist(), strict=True)])


def _surfaces(F: IntArray, starts: IntArray) -> Edges | None:
    """Return the edges of the concatenated meshes, or None unless each is a connected surface with boundary."""
    n = int(starts[-1])
    found = edges(F, n)
    if are_collapsed(F).any() or found.nonmanifold.size or found.inconsistent.size:
        return None
    # A vertex of no triangle is a component of its own.
    if not np.array_equal(components(F, n), repeat_each(starts[:-1], np.diff(starts))):
        return None
    bounded = mark(starts.size - 1, np.searchsorted(starts, found.boundary[:, 0], side="right") - 1)
    return found if bounded.all() else None


def _have_areas(V: NDArray[np.float64], F: IntArray, starts: IntArray) -> bool:
    """Return whether all triangles have a positive rest area, computed as in `Domain.check_areas`."""
    size = np.maximum.reduceat(np.abs(V).max(axis=1), as_offsets(starts[:-1]))
    exponent = np.frexp(size)[1]
    if (np.abs(exponent) > _MAX_EXPONENT).any():
        return False
    z1, z2 = rest_frames(np.ldexp(V, -repeat_each(exponent, np.diff(starts))[:, None]), F)
    return not ((z1 == 0) | (z2.imag == 0)).any()


def _split_by_mesh(pairs: IntArray, starts: IntArray) -> list[IntArray]:
    """Split edges (e, 2), sorted by their smaller vertex, by mesh and convert them to each mesh's own numbering."""
    ends = np.searchsorted(np.minimum(pairs[:, 0], pairs[:, 1]), starts[1:-1])
    return [part - start for part, start in zip(np.split(pairs, ends), starts[:-1].tolist(), strict=True)]
