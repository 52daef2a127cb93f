"""Chords: interior edges between two boundary vertices, for which the target must leave space."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from numpy.typing import ArrayLike, NDArray

from quasiharmonic.geometry.mesh.topology import edges, trace_loops
from quasiharmonic.io.adapters.objects import mesh_triangles
from quasiharmonic.util.arrays import (
    FloatArray,
    IntArray,
    check_non_negative,
    fixed_vertices,
    invert_indices,
    names_of,
    scale_to_unit,
    target_positions,
    to_complex,
    triangle_array,
    triangle_rows,
)

# Maximum outward bend of a straight line, as a share of the outline's larger side.
STRAIGHT = 1e-9


def chords_of(loop: IntArray, interior: IntArray, n: int) -> IntArray:
    """Return the interior edges (e, 2) between two vertices of a loop, as positions in it, smaller first; (c, 2)."""
    position = invert_indices(n, loop)
    found = position[interior]
    return np.sort(found[(found >= 0).all(axis=1)], axis=1)


def flattened_edges(F: ArrayLike, fixed: ArrayLike, target: ArrayLike, *, tolerance: float = STRAIGHT) -> IntArray:
    """Interior edges that the target places along its own boundary, so that the part they cut off has no area.

    Between the ends of such an edge, the target boundary does not bend outwards. It is straight, like a side of a
    polygon, or goes around a notch. A common case is a triangle with two boundary edges on one side of a rectangle.
    Then no map without inverted triangles exists. (`diagnose` proves this on the exact coordinates, where rounding may
    change the answer.) `refine` splits these edges.

    Parameters
    ----------
    F : (f, 3) array of int
        Triangles of a surface.
    fixed : (k,) array of int
        Fixed vertices, including the whole boundary.
    target : (k, 2) float
        Their target positions.
    tolerance : float
        Maximum outward bend of a straight line, as a share of the target's larger side.

    Returns
    -------
    (s, 2) int64
        The edges, smaller vertex first.

    Raises
    ------
    ValueError
        When an array is malformed, or a boundary vertex is not in ``fixed``.
    """
    check_non_negative("tolerance", tolerance)
    F = triangle_rows(mesh_triangles(F))
    n = int(F.max(initial=-1)) + 1
    F = triangle_array(F, n)
    fixed = fixed_vertices(fixed, n)
    places = target_positions(target, len(fixed))
    found = edges(F, n)
    missing = np.setdiff1d(found.boundary, fixed)
    if missing.size:
        raise ValueError(f"the boundary {names_of('vertex', 'vertices', missing)} not in fixed")
    places = scale_to_unit(places)
    position = np.full((n, 2), np.nan)
    position[fixed] = places
    min_bulge = tolerance * float(np.ptp(places, axis=0).max()) if len(places) else 0.0
    flat = [np.empty((0, 2), dtype=np.int64)]
    for loop in trace_loops(found.boundary):
        chords = chords_of(loop, found.interior, n)
        flat.append(np.sort(loop[chords[list(flat_chords(chords, position[loop], min_bulge))]], axis=1))
    return np.concatenate(flat)


def flat_chords(chords: IntArray, positions: FloatArray, min_bulge: float) -> Iterator[int]:
    """Yield rows of chords between whose ends the loop bends outwards by at most ``min_bulge``."""
    w = to_complex(positions)
    for k, (i, j) in enumerate(chords.tolist()):
        if min(_bulge(w[i : j + 1]), _bulge(np.concatenate([w[j:], w[: i + 1]]))) <= min_bulge:
            yield k


def _bulge(w: NDArray[np.complex128]) -> float:
    """Maximum distance of a curve to the right of the line from its first point to its last."""
    across = w[-1] - w[0]
    if across == 0:
        return 0.0
    return float(-((w[1:-1] - w[0]) * np.conj(across / abs(across))).imag.min())
