"""Initial maps of charts, in which no triangle is inverted."""

from __future__ import annotations

import numpy as np

from quasiharmonic.apps.flattening.boundary_first import map_boundary_first
from quasiharmonic.apps.flattening.multilevel import flatten_coarse, map_to_disk
from quasiharmonic.apps.flattening.piece import COARSE_FROM, Piece
from quasiharmonic.geometry.coarsening import has_marked_corner, mark_rings
from quasiharmonic.geometry.exact.certificate import is_injective
from quasiharmonic.geometry.exact.triangles import triangle_signs
from quasiharmonic.geometry.mesh.splitting import NO_CUT, split_parts
from quasiharmonic.linsolve import NotPositiveDefinite
from quasiharmonic.linsolve.laplacian import embed_tutte
from quasiharmonic.problem.result import Status
from quasiharmonic.util.arrays import FloatArray, IntArray, mark, to_complex, to_points

# Maps with a larger share of inverted triangles are not repaired.
_FEW = 0.05
# Rings of triangles around inverted ones that are mapped again, first and later.
_RINGS = 2, 6


def find_initial_map(piece: Piece, linear_solver: str) -> FloatArray | None:
    """Return a map (n, 2) without inverted triangles, or None if none was found in double precision.

    Its boundary may meet itself. A nearly conformal map has less energy than a map to a disk, often by far.
    """
    try:
        uv = map_boundary_first(piece, linear_solver)
    except NotPositiveDefinite:
        uv = None
    if uv is not None:
        uv = repair_map(piece, uv)
    starts = [map_to_disk, flatten_coarse]
    for start in reversed(starts) if len(piece.F) >= COARSE_FROM else starts:
        if uv is None:
            uv = start(piece.V, piece.F, piece.loops)
    return uv


def repair_map(piece: Piece, uv: FloatArray) -> FloatArray | None:
    """Map the surroundings of inverted triangles again, with all other vertices fixed; None if that fails.

    ``uv`` (n, 2) is changed. If the surroundings have no map, larger ones are mapped.
    """
    F, n = piece.F, len(uv)
    rim = mark(n, *piece.loops)
    for rings in _RINGS:
        if is_injective(F, uv):
            return uv
        inverted = triangle_signs(F, uv)[0] <= 0
        if np.count_nonzero(inverted) > _FEW * len(F):
            return None
        loose = mark_rings(F, mark(n, F[inverted]), rings) & ~rim
        rows = np.flatnonzero(has_marked_corner(F, loose))
        if not rows.size:
            return None
        for _, T, vertices in split_parts(F[rows], rows, NO_CUT, n):
            found = _map_surroundings(piece.V[vertices], T, uv[vertices], np.flatnonzero(~loose[vertices]))
            if found is None:
                return None
            uv[vertices] = found
    return uv if is_injective(F, uv) else None


def _map_surroundings(V: FloatArray, F: IntArray, uv: FloatArray, fixed: IntArray) -> FloatArray | None:
    """Map a part (m, 2) of a surface, with some vertices (k,) fixed; None if it is no disk."""
    try:
        embedded = to_points(embed_tutte(F, to_complex(uv), fixed))
        if is_injective(F, embedded):
            return embedded
        # Few surfaces need this, and it imports the whole solver.
        from quasiharmonic.solver.mapping import injective_map

        result = injective_map(V, F, fixed, uv[fixed])
    except (NotPositiveDefinite, ValueError):
        return None
    if result.status is Status.INTERRUPTED:
        raise KeyboardInterrupt
    return result.uv
